//! `/`: the page for a person. Where it was not built into the program, and at `/plain`: the newest jobs, without scripts and without
//! anything from another host.

use super::{App, Problem, web};
use crate::auth::{Caller, Scope};
use crate::engine::ListQuery;
use crate::job::Job;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{Html, IntoResponse, Response};
use std::fmt::Write as _;

/// Jobs on the page.
const SHOWN: usize = 30;
/// Nothing may run, and nothing may come from elsewhere.
const POLICY: &str =
    "default-src 'none'; img-src 'self'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'";
const HEAD: &str = "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content=\"width=device-width\"><meta http-equiv=refresh content=5><title>shrinkd</title>\
<style>body{font:15px system-ui;margin:2rem auto;max-width:60rem;padding:0 1rem}table{border-collapse:collapse;width:100%}\
td,th{text-align:left;padding:.4rem;border-top:1px solid #ccc;vertical-align:middle}img{height:6rem}code{font-size:85%}</style>\
<h1>shrinkd</h1><p>The newest jobs. The interface is described at <a href=/docs/>/docs</a>.</p>\
<table><tr><th>preview<th>job<th>state<th>progress<th>outputs";

/// The page for a person
///
/// Where it was not built into the program this is the same as `/plain`.
#[utoipa::path(
    get,
    path = "/",
    tag = "operation",
    responses((status = 200, description = "a page", content_type = "text/html", body = String))
)]
pub async fn page(state: State<App>, caller: Result<Caller, Problem>, headers: HeaderMap) -> Result<Response, Problem> {
    match web::index(&headers) {
        Some(page) => Ok(page),
        None => Ok(plain(state, caller?).await?.into_response()),
    }
}

/// The newest jobs, for a person without scripts
#[utoipa::path(
    get,
    path = "/plain",
    tag = "operation",
    responses((status = 200, description = "a page", content_type = "text/html", body = String))
)]
pub async fn plain(State(app): State<App>, caller: Caller) -> Result<impl IntoResponse + use<>, Problem> {
    let tenant = caller.may(Scope::Read)?;
    let newest = ListQuery { limit: SHOWN, ..ListQuery::default() };
    let page = app.engine.list(tenant, newest).await?;
    let mut html = HEAD.to_owned();
    for job in &page.jobs {
        row(&mut html, job);
    }
    html.push_str("</table></html>");
    Ok(([(header::CONTENT_SECURITY_POLICY, POLICY), (header::CACHE_CONTROL, "no-cache")], Html(html)))
}

fn row(html: &mut String, job: &Job) {
    let preview = job.outputs.iter().find(|o| o.name == "preview");
    let picture = preview.map_or(String::new(), |o| format!("<img alt=\"\" src=\"{}\">", escape(&o.href)));
    let labels: Vec<String> = job.labels.iter().map(|(n, v)| escape(&format!("{n}: {v}"))).collect();
    let progress = match (&job.problem, &job.progress) {
        (Some(problem), _) => escape(&problem.detail),
        (None, Some(progress)) if !job.state.ended() => {
            format!("{} {:.0} %", escape(&progress.stage), 100.0 * progress.fraction)
        }
        _ => String::new(),
    };
    let outputs: Vec<String> =
        job.outputs.iter().map(|o| format!("<a href=\"{}\">{}</a>", escape(&o.href), escape(&o.name))).collect();
    // writing to a string cannot fail
    let _ = write!(
        html,
        "<tr><td>{picture}<td><a href=\"/v1/jobs/{id}\"><code>{id}</code></a><br>{}<td>{}<td>{progress}<td>{}",
        labels.join(", "),
        job.state.name(),
        outputs.join(" "),
        id = job.id,
    );
}

fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
