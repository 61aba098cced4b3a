//! The description of the service: pinned, and true.

use crate::app::App;
use serde_json::Value;

#[test]
fn the_committed_description_is_the_one_the_code_makes() {
    let output = std::process::Command::new(crate::app::BINARY).arg("openapi").output().expect("runs");
    assert!(output.status.success());
    let committed = include_str!("../../openapi.yaml");
    // not assert_eq: a diff of two thousand lines helps nobody
    let same = output.stdout == committed.as_bytes();
    assert!(same, "openapi.yaml is out of date: cargo run --release -- openapi > openapi.yaml");
}

#[tokio::test]
async fn every_operation_is_described_with_its_problems() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let document = app.get_json("/openapi.json").await;
    assert!(document["openapi"].as_str().expect("a version").starts_with("3.1"));
    let mut names = std::collections::BTreeSet::new();
    for (path, item) in document["paths"].as_object().expect("paths") {
        for (method, operation) in item.as_object().expect("operations") {
            assert!(operation["summary"].is_string(), "{method} {path} has no summary");
            assert!(names.insert(operation["operationId"].to_string()), "{method} {path} shares its name");
            let open = ["/livez", "/readyz", "/openapi.json"].contains(&path.as_str());
            let outages = [(!open, "503"), (operation["requestBody"].is_object(), "408")];
            for (_, status) in outages.iter().filter(|(can_be, _)| *can_be) {
                assert!(operation["responses"][status].is_object(), "{method} {path} does not tell of {status}");
            }
            for (status, response) in operation["responses"].as_object().expect("responses") {
                if status.starts_with(['4', '5']) {
                    let problem = &response["content"]["application/problem+json"]["schema"]["$ref"];
                    assert_eq!(problem, "#/components/schemas/Problem", "{method} {path} {status}");
                }
            }
        }
    }
    references(&document, &document);
}

/// Every reference in the document leads somewhere.
fn references(document: &Value, value: &Value) {
    match value {
        Value::Object(members) => {
            if let Some(Value::String(reference)) = members.get("$ref") {
                let pointer = reference.strip_prefix('#').expect("within the document");
                assert!(document.pointer(pointer).is_some(), "{reference} leads nowhere");
            }
            members.values().for_each(|v| references(document, v));
        }
        Value::Array(items) => items.iter().for_each(|v| references(document, v)),
        _ => {}
    }
}
