//! Export of traces by OpenTelemetry (feature `otel`).

use std::sync::OnceLock;

use opentelemetry::Context;
use opentelemetry::trace::{
    SpanContext, SpanId, TraceContextExt, TraceFlags, TraceId, TraceState, TracerProvider,
};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{SdkTracer, SdkTracerProvider};
use tracing::Span;
use tracing_opentelemetry::{OpenTelemetryLayer, OpenTelemetrySpanExt};
use tracing_subscriber::registry::LookupSpan;

/// The environment variables that name a collector.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT"];

static PROVIDER: OnceLock<SdkTracerProvider> = OnceLock::new();

/// A layer that sends spans to the collector that the environment names; `None` if it names none.
pub(crate) fn layer<S>() -> Result<Option<OpenTelemetryLayer<S, SdkTracer>>, String>
where
    S: tracing::Subscriber + for<'span> LookupSpan<'span>,
{
    if ENDPOINTS.iter().all(|variable| std::env::var_os(variable).is_none()) {
        return Ok(None);
    }
    // The exporter's client takes the cryptography of the process. Fails only if it was set before.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let exporter = SpanExporter::builder().with_http().build();
    let exporter = exporter.map_err(|error| error.to_string())?;
    let provider = PROVIDER.get_or_init(|| {
        let resource = Resource::builder().with_service_name("sci-recon").build();
        SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build()
    });
    Ok(Some(tracing_opentelemetry::layer().with_tracer(provider.tracer("sci-recon"))))
}

/// Sends the spans that wait for the next batch.
pub(crate) fn finish() {
    if let Some(Err(error)) = PROVIDER.get().map(SdkTracerProvider::shutdown) {
        tracing::warn!(%error, "the last traces were not sent");
    }
}

/// Makes a span continue the trace of a caller.
pub(crate) fn go_on(span: &Span, trace: &str, parent: &str, is_sampled: bool) {
    let (Ok(trace), Ok(parent)) = (TraceId::from_hex(trace), SpanId::from_hex(parent)) else {
        return;
    };
    let flags = if is_sampled { TraceFlags::SAMPLED } else { TraceFlags::default() };
    let caller = SpanContext::new(trace, parent, flags, true, TraceState::default());
    // Fails only if no spans are exported.
    let _ = span.set_parent(Context::new().with_remote_span_context(caller));
}
