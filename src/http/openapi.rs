//! The description of the service, made from the handlers.

mod links;
mod scene;

use super::problem::ProblemDocument;
use crate::notify::payload::Notice;
use axum::Json;
use utoipa::openapi::content::ContentBuilder;
use utoipa::openapi::path::{HttpMethod, Operation, OperationBuilder, Parameter, ParameterBuilder, ParameterIn};
use utoipa::openapi::request_body::RequestBodyBuilder;
use utoipa::openapi::schema::{Array, Object, ObjectBuilder, SchemaType, Type};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{OpenApi, PathItem, Paths, Ref, RefOr, Required, Response, Schema};
use utoipa::{OpenApi as _, ToSchema as _};

/// The media type of every answer that is not a success.
const PROBLEM: &str = "application/problem+json";

#[derive(utoipa::OpenApi)]
#[openapi(
    info(
        title = "shrinkd",
        description = "Signed distance fields in, parameterized surfaces out: a sphere is shrunk onto the zero level set and \
                       keeps its coordinates as UVs. Every answer that is not a success is a problem document (RFC 9457).",
        license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0"),
    ),
    tags(
        (name = "inputs", description = "files that jobs name by their hash"),
        (name = "jobs", description = "the life of a job"),
        (name = "operation", description = "for whoever operates the service"),
    ),
    components(schemas(
        ProblemDocument,
        crate::job::event::EventKind,
        crate::job::preview::MeshPreview,
        crate::job::ProgressView,
        super::list::LabelFilter,
        crate::notify::payload::Notice,
        crate::notify::payload::NoticeOfJob,
    )),
)]
struct Base;

/// The description without its paths.
pub(super) fn base() -> OpenApi {
    Base::openapi()
}

/// Gives every problem its body, every operation the problems that any of them can have, and answers the links to what follows them.
pub(super) fn complete(mut document: OpenApi) -> OpenApi {
    document.webhooks = Some(webhooks());
    for (path, item) in &mut document.paths.paths {
        let operations =
            [&mut item.get, &mut item.head, &mut item.post, &mut item.delete, &mut item.put, &mut item.patch];
        for operation in operations.into_iter().flatten() {
            if !super::caller::OPEN.contains(&path.as_str()) {
                describe_caller(operation);
                describe_outages(operation);
            }
            describe_problems(operation);
            operation.parameters.iter_mut().flatten().for_each(never_null);
        }
        // the router answers HEAD from GET; both are one operation, which needs an own name in each method
        if let Some(head) = &mut item.head {
            head.operation_id = head.operation_id.take().map(|id| format!("{id}_head"));
        }
    }
    let bearer = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some("an API key (`shrinkd keys create`), or a token of the configured OpenID Connect issuer"))
        .build();
    let components = document.components.get_or_insert_default();
    components.add_security_scheme("bearer", SecurityScheme::Http(bearer));
    links::add(&mut document);
    scene::add(&mut document);
    document
}

/// Whoever asks says who it is, where the service asks for it.
fn describe_caller(operation: &mut Operation) {
    let none = Vec::<String>::new();
    operation.security = Some(vec![SecurityRequirement::new("bearer", none), SecurityRequirement::default()]);
    for (status, description) in [
        ("401", "a valid key or token is needed, where the service asks who its callers are"),
        ("403", "the key or token lacks a scope"),
        ("429", "a quota of the tenant is used up: `RateLimit` tells which, where there are quotas"),
    ] {
        operation.responses.responses.entry(status.to_owned()).or_insert_with(|| RefOr::T(Response::new(description)));
    }
}

/// What is needed for an answer may be out of reach, and a body may not come.
fn describe_outages(operation: &mut Operation) {
    let mut with = |status: &str, description: &str| {
        operation.responses.responses.entry(status.to_owned()).or_insert_with(|| RefOr::T(Response::new(description)));
    };
    with(
        "503",
        "the queue, the blob store or the issuer of tokens is out of reach, or the service is stopping: `Retry-After` tells when to ask again",
    );
    if operation.request_body.is_some() {
        with("408", "the body does not come");
    }
}

/// A parameter that is optional is left out; there is no null that could be sent.
fn never_null(parameter: &mut RefOr<Parameter>) {
    let RefOr::T(parameter) = parameter else { return };
    if let Some(RefOr::T(Schema::Object(Object { schema_type, .. }) | Schema::Array(Array { schema_type, .. }))) =
        &mut parameter.schema
        && let SchemaType::Array(types) = schema_type
    {
        types.retain(|kind| *kind != Type::Null);
        if let [one] = types.as_slice() {
            *schema_type = SchemaType::Type(one.clone());
        }
    }
}

/// What the service sends by itself.
fn webhooks() -> Paths {
    let header = |name: &str, description: &str| {
        let text = ObjectBuilder::new().schema_type(Type::String).build();
        let header = ParameterBuilder::new().name(name).parameter_in(ParameterIn::Header).required(Required::True);
        header.description(Some(description)).schema(Some(text)).build()
    };
    let notice = ContentBuilder::new().schema(Some(Ref::from_schema_name(Notice::name()))).build();
    let body = RequestBodyBuilder::new().content("application/json", notice).required(Some(Required::True)).build();
    let told = OperationBuilder::new()
        .operation_id(Some("job_ended"))
        .summary(Some("Tells that a job has ended"))
        .description(Some(
            "Posted to the `webhook` of the job, at least once, after the Standard Webhooks specification.",
        ))
        .parameter(header("webhook-id", "the same for every attempt"))
        .parameter(header("webhook-timestamp", "when this attempt was made, seconds since 1970"))
        .parameter(header(
            "webhook-signature",
            "`v1,` and HMAC-SHA256 of id, timestamp and body in base64; one for every secret",
        ))
        .request_body(Some(body))
        .response("2XX", Response::new("it was taken"))
        .response(
            "410",
            Response::new("nothing more is to be sent; any other answer is a failure, and it is sent again"),
        )
        .build();
    let mut paths = Paths::new();
    paths.paths.insert("job_ended".to_owned(), PathItem::new(HttpMethod::Post, told));
    paths
}

fn describe_problems(operation: &mut Operation) {
    let responses = &mut operation.responses.responses;
    responses
        .entry("500".to_owned())
        .or_insert_with(|| RefOr::T(Response::new("the service failed; the log has the cause under the request's id")));
    for (status, response) in responses {
        if !status.starts_with(['4', '5']) {
            continue;
        }
        if let RefOr::T(response) = response {
            let schema = Ref::from_schema_name(ProblemDocument::name());
            let content = ContentBuilder::new().schema(Some(schema)).build();
            response.content.entry(PROBLEM.to_owned()).or_insert(RefOr::T(content));
        }
    }
}

/// This description
#[utoipa::path(
    get,
    path = "/openapi.json",
    tag = "operation",
    responses((status = 200, description = "OpenAPI 3.1", content_type = "application/json", body = Object))
)]
pub async fn openapi_json() -> Json<OpenApi> {
    Json(super::document())
}
