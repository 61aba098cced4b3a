//! The service over gRPC, on the port of HTTP: the same jobs, the same checks, the same numbers of events.
//!
//! Guarantees: whatever the [HTTP room](crate::http) refuses is refused here with the same problem (`refusal`), also when a
//! layer around the routes refuses it ([`speak`]); a call ends at its deadline (`grpc-timeout`), and an open stream ends when
//! the service stops, with `UNAVAILABLE`, so that a client does not take it for the end of a job. Health is that of `/readyz`.
//! Not offered: gRPC-Web, compression of messages, and `sensitivity`, which is asked for over HTTP.

mod call;
mod health;
mod message;
mod refusal;
mod service;

/// What is generated from the contract.
#[allow(missing_docs, clippy::all, clippy::pedantic)]
pub mod proto {
    include!(concat!(env!("OUT_DIR"), "/server/shrinkd.v1.rs"));
}

pub use call::speak;

use crate::http::App;
use axum::Router;
use axum::middleware;
use axum::routing::any_service;
use proto::shrinkd_server::{SERVICE_NAME, ShrinkdServer};
use service::Service;
use tonic_health::pb::health_server::{HealthServer, SERVICE_NAME as HEALTH};
use tonic_reflection::pb::v1::server_reflection_server::SERVICE_NAME as REFLECTION;
use tonic_reflection::pb::v1alpha::server_reflection_server::SERVICE_NAME as REFLECTION_ALPHA;

/// The contract as reflection tells it.
const CONTRACT: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/contract.bin"));
/// Bytes of a message beyond what the limit of a JSON body allows: the key and the frames around the request.
const MESSAGE_EXTRA: u64 = 4096;

/// The routes of a node that answers requests.
pub fn routes(app: App) -> Router {
    let limit = usize::try_from(app.limits.body_bytes.saturating_add(MESSAGE_EXTRA)).unwrap_or(usize::MAX);
    let service = ShrinkdServer::new(Service { app: app.clone() }).max_decoding_message_size(limit);
    let described = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(CONTRACT)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    let mut router = Router::new().route(&methods(SERVICE_NAME), any_service(service));
    // fails only for descriptors that cannot be read, which a test would see
    if let (Ok(reflection), Ok(alpha)) = (described().build_v1(), described().build_v1alpha()) {
        router = router
            .route(&methods(REFLECTION), any_service(reflection))
            .route(&methods(REFLECTION_ALPHA), any_service(alpha));
    }
    router
        .route(&methods(HEALTH), any_service(HealthServer::new(health::Readiness { app })))
        .layer(middleware::from_fn(call::call))
}

/// The routes of a node that only runs jobs: its health.
pub fn health_routes(app: App) -> Router {
    let health = HealthServer::new(health::Readiness { app });
    Router::new().route(&methods(HEALTH), any_service(health)).layer(middleware::from_fn(call::call))
}

/// The path of every method of a service.
fn methods(service: &str) -> String {
    format!("/{service}/{{method}}")
}
