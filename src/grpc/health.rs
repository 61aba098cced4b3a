//! `grpc.health.v1`: the same answer as `/readyz`, for the whole node and for the service by name.

use super::proto::shrinkd_server::SERVICE_NAME;
use crate::http::{App, health};
use futures::StreamExt as _;
use futures::stream::{self, BoxStream};
use std::time::Duration;
use tonic::{Request, Response, Status};
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_server::Health;
use tonic_health::pb::{HealthCheckRequest, HealthCheckResponse};

/// Time between two looks for those who watch.
const LOOK: Duration = Duration::from_secs(2);

/// Answers for the node.
#[derive(Clone)]
pub struct Readiness {
    pub app: App,
}

impl Readiness {
    async fn serving(&self, service: &str) -> ServingStatus {
        if !service.is_empty() && service != SERVICE_NAME {
            return ServingStatus::ServiceUnknown;
        }
        match health::ready(&self.app).await {
            Ok(()) => ServingStatus::Serving,
            Err(_) => ServingStatus::NotServing,
        }
    }
}

fn answer(status: ServingStatus) -> HealthCheckResponse {
    HealthCheckResponse { status: status.into() }
}

#[tonic::async_trait]
impl Health for Readiness {
    type WatchStream = BoxStream<'static, Result<HealthCheckResponse, Status>>;

    async fn check(&self, request: Request<HealthCheckRequest>) -> Result<Response<HealthCheckResponse>, Status> {
        match self.serving(&request.into_inner().service).await {
            ServingStatus::ServiceUnknown => Err(Status::not_found("there is no such service")),
            status => Ok(Response::new(answer(status))),
        }
    }

    /// The status now and whenever it changes; ends after saying that the node is stopping.
    async fn watch(&self, request: Request<HealthCheckRequest>) -> Result<Response<Self::WatchStream>, Status> {
        let service = request.into_inner().service;
        let looks = stream::unfold((self.clone(), service, None, false), |(node, service, told, over)| async move {
            if over {
                return None;
            }
            loop {
                let stops = node.app.stop.is_cancelled();
                let status = node.serving(&service).await;
                if told != Some(status) || stops {
                    return Some((Ok(answer(status)), (node, service, Some(status), stops)));
                }
                tokio::select! {
                    () = tokio::time::sleep(LOOK) => {}
                    () = node.app.stop.cancelled() => {}
                }
            }
        });
        Ok(Response::new(looks.boxed()))
    }
}
