//! The log on standard error, and the spans of calls for a collector, where one is named.
//!
//! OTLP goes over HTTP in protobuf. The standard `OTEL_*` variables set endpoint, headers, service
//! name, resource attributes and sampling.

use std::{collections::HashMap, time::Duration};

use opentelemetry::{propagation::TextMapPropagator, trace::TracerProvider as _};
use opentelemetry_otlp::{Protocol, SpanExporter, WithExportConfig};
use opentelemetry_sdk::{Resource, propagation::TraceContextPropagator, trace::SdkTracerProvider};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::{EnvFilter, Layer, layer::SubscriberExt, util::SubscriberInitExt};

use crate::{
    config::Config,
    error::{Error, Result},
};

/// Variables that name a collector when the configuration does not.
const ENDPOINTS: [&str; 2] = ["OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT"];

/// How long the program waits for the collector at its end.
const LAST_SPANS: Duration = Duration::from_secs(1);

/// Sends what is left when the program ends.
#[derive(Debug, Default)]
pub struct Spans(Option<SdkTracerProvider>);

impl Drop for Spans {
    fn drop(&mut self) {
        if let Some(provider) = self.0.take()
            && let Err(error) = provider.shutdown_with_timeout(LAST_SPANS)
        {
            tracing::warn!(%error, "the last spans are lost");
        }
    }
}

/// Starts the log, and the export of spans where a collector is named. Call it once.
///
/// # Errors
/// `invalid_request` when the filter or the collector's address cannot be used.
pub fn start(config: &Config) -> Result<Spans> {
    let filter = || {
        EnvFilter::try_new(&config.log)
            .map_err(|e| Error::invalid(format!("log: {:?} is no filter: {e}", config.log)))
    };
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr);
    let lines = if config.log_json {
        lines.json().with_filter(filter()?).boxed()
    } else {
        lines.with_filter(filter()?).boxed()
    };
    let named = |name: &str| std::env::var(name).is_ok_and(|value| !value.is_empty());
    let wanted = config.otlp.is_some() || ENDPOINTS.into_iter().any(named);
    let provider = if wanted { Some(provider(config)?) } else { None };
    // Spans of our own alone: those of the HTTP client that sends them would never end.
    let spans = provider.as_ref().map(|provider| {
        tracing_opentelemetry::layer().with_tracer(provider.tracer("segsplat")).with_filter(
            tracing_subscriber::filter::Targets::new()
                .with_target("segsplat", tracing::Level::INFO),
        )
    });
    let started = tracing_subscriber::registry().with(lines).with(spans).try_init();
    // An error says that it has started already: a test runs commands in one process.
    drop(started);
    Ok(Spans(provider))
}

fn provider(config: &Config) -> Result<SdkTracerProvider> {
    crate::crypto::install();
    let mut exporter = SpanExporter::builder().with_http().with_protocol(Protocol::HttpBinary);
    if let Some(endpoint) = &config.otlp {
        exporter = exporter.with_endpoint(format!("{}/v1/traces", endpoint.trim_end_matches('/')));
    }
    let exporter = exporter.build().map_err(|e| {
        Error::invalid(format!("otlp: the collector's address cannot be used: {e}")).caused_by(e)
    })?;
    let mut resource = Resource::builder();
    if std::env::var_os("OTEL_SERVICE_NAME").is_none() {
        resource = resource.with_service_name("segsplat");
    }
    Ok(SdkTracerProvider::builder()
        .with_batch_exporter(exporter)
        .with_resource(resource.build())
        .build())
}

/// Makes `span` a child of the caller's span, whose `traceparent` (W3C) this is. Does nothing where
/// no spans are exported.
pub fn follow(span: &tracing::Span, traceparent: &str) {
    let carrier = HashMap::from([("traceparent".to_owned(), traceparent.to_owned())]);
    // The only error is that no spans are exported.
    let _ = span.set_parent(TraceContextPropagator::new().extract(&carrier));
}

/// The `traceparent` (W3C) of the span that the calling thread is in; `None` where no spans are
/// exported.
#[must_use]
pub fn traceparent() -> Option<String> {
    let mut carrier = HashMap::new();
    let context = tracing::Span::current().context();
    TraceContextPropagator::new().inject_context(&context, &mut carrier);
    carrier.remove("traceparent")
}
