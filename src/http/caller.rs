//! Who asks.
//!
//! The [`identify`] layer finds out who sends a request and puts a [`Caller`] into its extensions, where handlers of every protocol
//! find it. Whoever is not known is refused there, on every route but the few in `OPEN` and the files of the page; a handler that takes a `Caller` cannot be
//! reached without one, and comes to a tenant only by saying what it is about to do ([`Caller::may`]).
//!
//! A key or token comes in the header `Authorization: Bearer` (RFC 6750, section 2.1) and nowhere else: a query would be logged, by
//! proxies too, and a form would be sent from other sites.

use super::rates::{Rate, Rates};
use super::{Problem, web};
use crate::auth::{Authenticator, Caller, NotAllowed, Refused};
use axum::extract::{FromRequestParts, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::sync::Arc;

/// Routes for which it does not matter who asks.
pub(super) const OPEN: [&str; 5] =
    ["/livez", "/readyz", "/openapi.json", "/grpc.health.v1.Health/Check", "/grpc.health.v1.Health/Watch"];

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
        let said = format!("error=\"insufficient_scope\", scope=\"{}\"", missing.0.name());
        Self::new(StatusCode::FORBIDDEN, "insufficient_scope", title, missing.to_string()).challenging(&said)
    }
}

impl Problem {
    /// The same problem with what the client must bring (RFC 6750, section 3).
    fn challenging(self, said: &str) -> Self {
        let said = if said.is_empty() { String::new() } else { format!(", {said}") };
        let challenge = HeaderValue::from_str(&format!("Bearer realm=\"shrinkd\"{said}"));
        self.with_header(header::WWW_AUTHENTICATE, challenge.unwrap_or(HeaderValue::from_static("Bearer")))
    }
}

/// Whom the service lets in, and how often.
#[derive(Clone)]
pub struct Door {
    /// Tells who asks; where there is none everybody may do everything.
    pub authenticator: Option<Arc<Authenticator>>,
    /// How often each tenant may.
    pub rates: Arc<Rates>,
}

/// Puts the [`Caller`] into the request, or refuses it; so it does when the caller's tenant asks too often.
pub async fn identify(State(door): State<Door>, mut request: Request, next: Next) -> Response {
    // nothing from outside brings extensions along: one that is there was put there by this program
    let path = request.uri().path();
    let open = OPEN.contains(&path) || web::is_open(path);
    if request.extensions().get::<Caller>().is_none() && !open {
        let caller = match &door.authenticator {
            None => Caller::anybody(),
            Some(authenticator) => match ask(authenticator, request.headers()).await {
                Ok(caller) => caller,
                Err(problem) => return problem.into_response(),
            },
        };
        let standing = match door.rates.take(caller.whose(), Rate::Requests, 1) {
            Ok(standing) => standing,
            Err(problem) => return problem.into_response(),
        };
        request.extensions_mut().insert(caller);
        let mut response = next.run(request).await;
        // an answer that tells of another quota keeps it beside this one
        standing.inspect(|standing| standing.tell(response.headers_mut()));
        return response;
    }
    next.run(request).await
}

async fn ask(authenticator: &Authenticator, headers: &HeaderMap) -> Result<Caller, Problem> {
    let unauthenticated = |detail: &str, said: &str| {
        let title = "a valid key or token is needed";
        Problem::new(StatusCode::UNAUTHORIZED, "unauthenticated", title, detail).challenging(said)
    };
    let mut given = headers.get_all(header::AUTHORIZATION).iter();
    let (Some(credentials), None) = (given.next(), given.next()) else {
        return Err(unauthenticated("expected one header Authorization: Bearer, with an API key or a token", ""));
    };
    let parts = credentials.to_str().ok().and_then(|text| text.split_once(' '));
    let Some((_, token)) = parts.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer")) else {
        return Err(unauthenticated("expected Authorization: Bearer, with an API key or a token", ""));
    };
    authenticator.identify(token.trim()).await.map_err(|refused| match refused {
        Refused::Invalid(why) => unauthenticated(why, &format!("error=\"invalid_token\", error_description=\"{why}\"")),
        Refused::Unavailable => Problem::unavailable(
            "issuer_unavailable",
            "the issuer's keys cannot be read, so its tokens cannot be checked",
        ),
    })
}
