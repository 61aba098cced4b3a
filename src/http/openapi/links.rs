//! Where an answer leads: the operations that what is in it can be given to (OpenAPI links).
//!
//! One table, so that the walk through the service can be read in one place; every operation that it names must exist.

use serde_json::{Value, json};
use utoipa::openapi::link::LinkBuilder;
use utoipa::openapi::path::Operation;
use utoipa::openapi::{OpenApi, RefOr};

/// The id of a job or an input in the body of an answer.
const ID: &str = "$response.body#/id";
/// The id that the request itself named.
const ASKED: &str = "$request.path.id";

/// What can be done with a job once its id is known.
const OF_A_JOB: [&str; 7] = ["get", "request", "cancel", "events", "forget", "download", "differentiate"];

/// An operation, the statuses of its answers that lead on, the operation they lead to, and a parameter of it with the place of its
/// value.
type Way = (&'static str, &'static [&'static str], &'static str, (&'static str, &'static str));

/// Ways to single operations; those from answers that are a job lead to all of [`OF_A_JOB`].
const WAYS: [Way; 5] = [
    ("upload", &["200", "201"], "describe", ("id", ID)),
    ("list", &["200"], "get", ("id", "$response.body#/jobs/0/id")),
    ("list", &["200"], "list", ("cursor", "$response.body#/next_cursor")),
    ("events", &["200"], "get", ("id", ASKED)),
    ("forget", &["204"], "get", ("id", ASKED)),
];
/// Answers that are a job.
const JOBS: [(&str, &[&str]); 4] =
    [("submit", &["202"]), ("differentiate", &["200", "202"]), ("get", &["200"]), ("cancel", &["200", "202"])];
/// Answers that are an input, which a job can be of.
const INPUTS: [(&str, &[&str]); 2] = [("upload", &["200", "201"]), ("describe", &["200"])];

/// Adds the links to the answers.
pub(super) fn add(document: &mut OpenApi) {
    for (from, statuses, to, (parameter, place)) in WAYS {
        link(document, from, statuses, to, |link| link.parameter(parameter, place));
    }
    for (from, statuses) in JOBS {
        for to in OF_A_JOB {
            link(document, from, statuses, to, |link| {
                let link = link.parameter("id", ID);
                // one that most jobs make
                if to == "download" { link.parameter("name", "report") } else { link }
            });
        }
    }
    for (from, statuses) in INPUTS {
        link(document, from, statuses, "submit", |link| link.request_body(Some(of_an_input())));
    }
}

/// A request for a job of the input that an answer names.
fn of_an_input() -> Value {
    json!({"field": {"input": ID}})
}

fn link(
    document: &mut OpenApi,
    from: &str,
    statuses: &[&str],
    to: &'static str,
    finish: impl Fn(LinkBuilder) -> LinkBuilder,
) {
    let operations = document.paths.paths.values_mut().flat_map(operations);
    for operation in operations.filter(|operation| operation.operation_id.as_deref() == Some(from)) {
        for status in statuses {
            if let Some(RefOr::T(response)) = operation.responses.responses.get_mut(*status) {
                let link = finish(LinkBuilder::new().operation_id(to)).build();
                response.links.insert(to.to_owned(), RefOr::T(link));
            }
        }
    }
}

fn operations(item: &mut utoipa::openapi::PathItem) -> impl Iterator<Item = &mut Operation> {
    [&mut item.get, &mut item.post, &mut item.delete].into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_way_begins_and_ends_at_an_operation() {
        let document = serde_json::to_value(crate::http::document()).expect("JSON");
        let operations = document["paths"].as_object().expect("paths").values();
        let operations: Vec<&Value> =
            operations.flat_map(|item| item.as_object().expect("operations").values()).collect();
        let named = |name: &str| operations.iter().find(|operation| operation["operationId"] == name);
        let jobs = JOBS.iter().flat_map(|(from, statuses)| OF_A_JOB.map(|to| (*from, *statuses, to)));
        let inputs = INPUTS.iter().map(|(from, statuses)| (*from, *statuses, "submit"));
        let ways = WAYS.iter().map(|(from, statuses, to, _)| (*from, *statuses, *to));
        for (from, statuses, to) in ways.chain(jobs).chain(inputs) {
            let target = named(to).unwrap_or_else(|| panic!("no operation {to}"));
            for status in statuses {
                let response = &named(from).unwrap_or_else(|| panic!("no operation {from}"))["responses"][status];
                let link = &response["links"][to];
                assert_eq!(link["operationId"], to, "{from} {status}");
                for parameter in link["parameters"].as_object().into_iter().flatten().map(|(name, _)| name) {
                    let known = target["parameters"].as_array().expect("parameters");
                    assert!(known.iter().any(|known| known["name"] == **parameter), "{to} has no {parameter}");
                }
            }
        }
    }
}
