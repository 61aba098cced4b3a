//! Traces from a request to the worker that runs its job, sent to a collector by OTLP over HTTP.
//!
//! A request that comes with a `traceparent` (W3C Trace Context) continues that trace, and its answer says which span it became in
//! `traceresponse`, the header of the W3C's draft for answers. The context is stored with the job, so the worker's span continues the
//! trace on whatever node it runs. Where no collector is configured none of this happens, and nothing is kept of a `traceparent`.
//!
//! Not guaranteed: that a span arrives. Spans are sent in the background; what a collector does not take within the time of a stop
//! is dropped, and the service goes on without it.

use crate::config::TracesConfig;
use bytes::Bytes;
use opentelemetry::propagation::TextMapPropagator;
use opentelemetry::trace::{SpanContext, TraceContextExt as _, TracerProvider as _};
use opentelemetry_otlp::{WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::{Sampler, SdkTracerProvider};
use std::collections::HashMap;
use std::time::Duration;
use tracing::Subscriber;
use tracing_opentelemetry::OpenTelemetrySpanExt as _;
use tracing_subscriber::Layer;
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::registry::LookupSpan;

/// The header that continues a trace.
pub const TRACEPARENT: &str = "traceparent";
/// The header that says which span a request became.
pub const TRACERESPONSE: &str = "traceresponse";
/// How long a collector may take for one message.
const SEND: Duration = Duration::from_secs(5);
/// How long a stop waits for spans that were not sent yet: well within the drain.
const FLUSH: Duration = Duration::from_secs(1);

/// Sends spans until it is [stopped](Traces::stop).
pub struct Traces(SdkTracerProvider);

impl Traces {
    /// Begins to send; `None` where nothing is configured. Sending needs the runtime.
    ///
    /// # Errors
    /// When the address is none.
    pub fn start(
        config: &TracesConfig,
        runtime: &tokio::runtime::Handle,
    ) -> Result<Option<Self>, Box<dyn std::error::Error>> {
        if config.endpoint.is_empty() {
            return Ok(None);
        }
        let client = Client { http: reqwest::Client::new(), runtime: runtime.clone() };
        let exporter = opentelemetry_otlp::SpanExporter::builder()
            .with_http()
            .with_http_client(client)
            .with_endpoint(format!("{}/v1/traces", config.endpoint.trim_end_matches('/')))
            .with_timeout(SEND)
            .build()?;
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            // what a client decided about its trace goes before the ratio
            .with_sampler(Sampler::ParentBased(Box::new(Sampler::TraceIdRatioBased(config.sample_ratio))))
            .with_resource(Resource::builder().with_service_name("shrinkd").build())
            .build();
        Ok(Some(Self(provider)))
    }

    /// What makes spans of the log's spans. Lines of the log are not sent.
    pub fn layer<S>(&self) -> impl Layer<S> + use<S>
    where
        S: Subscriber + for<'span> LookupSpan<'span>,
    {
        tracing_opentelemetry::layer()
            .with_tracer(self.0.tracer("shrinkd"))
            .with_location(false)
            .with_threads(false)
            .with_tracked_inactivity(false)
            .with_filter(filter_fn(|metadata| metadata.is_span() && metadata.target().starts_with("shrinkd")))
    }

    /// Sends what was not sent yet, and no more after that.
    pub async fn stop(self) {
        let stopped = tokio::task::spawn_blocking(move || self.0.shutdown_with_timeout(FLUSH)).await;
        if !matches!(stopped, Ok(Ok(()))) {
            tracing::warn!("the last spans could not be sent");
        }
    }
}

/// Sends over the runtime's own connections from the thread that gathers spans, which has no runtime.
#[derive(Debug)]
struct Client {
    http: reqwest::Client,
    runtime: tokio::runtime::Handle,
}

#[async_trait::async_trait]
impl opentelemetry_http::HttpClient for Client {
    async fn send_bytes(
        &self,
        request: http::Request<Bytes>,
    ) -> Result<http::Response<Bytes>, opentelemetry_http::HttpError> {
        let http = self.http.clone();
        let sent = self.runtime.spawn(async move {
            let answer = http.execute(request.try_into()?).await?;
            let status = answer.status();
            let body = answer.bytes().await?;
            Ok::<_, reqwest::Error>((status, body))
        });
        let (status, body) = sent.await??;
        Ok(http::Response::builder().status(status).body(body)?)
    }
}

/// Makes a span continue the trace that a `traceparent` names. A malformed one is as none, as the standard says.
pub fn join(span: &tracing::Span, traceparent: Option<&str>) {
    let Some(traceparent) = traceparent else { return };
    let carrier = HashMap::from([(TRACEPARENT.to_owned(), traceparent.to_owned())]);
    let context = TraceContextPropagator::new().extract(&carrier);
    if context.span().span_context().is_valid() {
        // fails only where nothing is sent
        let _ = span.set_parent(context);
    }
}

/// Where a span is in its trace, as the value of a `traceparent`; `None` where nothing is sent.
pub fn position(span: &tracing::Span) -> Option<String> {
    let context = span.context();
    let position = context.span().span_context().clone();
    position.is_valid().then(|| written(&position))
}

/// As [`position`], of the span that runs now.
pub fn current() -> Option<String> {
    position(&tracing::Span::current())
}

/// The trace in the value of a `traceparent`.
pub fn trace_id(traceparent: &str) -> &str {
    traceparent.split('-').nth(1).unwrap_or_default()
}

fn written(position: &SpanContext) -> String {
    format!("00-{}-{}-{:02x}", position.trace_id(), position.span_id(), position.trace_flags().to_u8())
}
