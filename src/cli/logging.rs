//! Writes log lines to standard error. The default level is `info`; `RUST_LOG` overrides it.

use std::io::IsTerminal;

use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Layer};

use crate::config::LogFormat;

/// Starts logging. A second call has no effect.
pub(crate) fn start(format: LogFormat) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let lines = tracing_subscriber::fmt::layer()
        .with_writer(std::io::stderr)
        // A line that can't be written, such as to a full disk, must not fail a request.
        .log_internal_errors(false)
        .with_ansi(std::io::stderr().is_terminal());
    let lines = match format {
        LogFormat::Text => lines.boxed(),
        // Spans are not nested, so the list of all spans would repeat the current one.
        LogFormat::Json => lines.json().with_span_list(false).boxed(),
    };
    let subscriber = tracing_subscriber::registry().with(lines).with(filter);
    #[cfg(feature = "otel")]
    let (subscriber, refusal) = match crate::traces::layer() {
        Ok(spans) => (subscriber.with(spans), None),
        Err(error) => (subscriber.with(None), Some(error)),
    };
    let started = subscriber.try_init();
    #[cfg(feature = "otel")]
    if let Some(error) = refusal {
        tracing::error!(error, "traces can't be exported");
    }
    if let Err(error) = started {
        tracing::debug!(%error, "logging has already started");
    }
}
