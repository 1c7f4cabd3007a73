//! Writes log lines to standard error. The default level is `info`; `RUST_LOG` overrides it.

use std::io::IsTerminal;

use tracing_subscriber::EnvFilter;

use crate::config::LogFormat;

/// Starts logging. A second call has no effect.
pub(crate) fn start(format: LogFormat) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    let lines = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        // A line that can't be written, such as to a full disk, must not fail a request.
        .log_internal_errors(false)
        .with_ansi(std::io::stderr().is_terminal());
    let started = match format {
        LogFormat::Text => lines.try_init(),
        // Spans are not nested, so the list of all spans would repeat the current one.
        LogFormat::Json => lines.json().with_span_list(false).try_init(),
    };
    if let Err(error) = started {
        tracing::debug!(%error, "logging has already started");
    }
}
