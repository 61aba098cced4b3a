//! What a network's file does not say, said in the query of its upload.

use crate::app::{App, fixture, problem, small, state};
use reqwest::{Method, StatusCode};
use serde_json::{Value, json};

/// Bare safetensors of an octahedron, |x| + |y| + |z| = 0.6, that were left without the name of their family: they look like a
/// DeepSDF, and a DeepSDF has one output where these have a feature beside the distance, as an IDR has.
fn anonymous() -> Vec<u8> {
    let directions: Vec<f32> = [0, 1, 2]
        .iter()
        .flat_map(|&axis| [1.0, -1.0].map(|sign| (axis, sign)))
        .flat_map(|(axis, sign)| {
            let mut row = [0.0; 3];
            row[axis] = sign;
            row
        })
        .collect();
    let tensors: [(&str, &[usize], Vec<f32>); 6] = [
        ("lin0.bias", &[6], vec![0.0; 6]),
        ("lin0.weight_g", &[6, 1], vec![1.0; 6]),
        ("lin0.weight_v", &[6, 3], directions),
        ("lin1.bias", &[2], vec![-0.6, 0.0]),
        ("lin1.weight_g", &[2, 1], vec![6.0f32.sqrt(), 1.0]),
        ("lin1.weight_v", &[2, 6], vec![1.0; 12]),
    ];
    let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
    for (name, shape, numbers) in tensors {
        let start = data.len();
        data.extend(numbers.iter().flat_map(|n| n.to_le_bytes()));
        let tensor = json!({"dtype": "F32", "shape": shape, "data_offsets": [start, data.len()]});
        header.insert(name.to_owned(), tensor);
    }
    let header = Value::Object(header).to_string().into_bytes();
    [&(header.len() as u64).to_le_bytes()[..], &header, &data].concat()
}

/// Parameters and their values.
type Query = [(&'static str, &'static str)];

async fn upload(app: &App, query: &Query, bytes: Vec<u8>) -> reqwest::Response {
    let escaped = |text: &str| text.bytes().map(|byte| format!("%{byte:02x}")).collect::<String>();
    let pairs: Vec<String> = query.iter().map(|(name, value)| format!("{name}={}", escaped(value))).collect();
    let path = format!("/v1/inputs?{}", pairs.join("&"));
    app.request(Method::POST, &path).body(bytes).send().await.expect("an answer")
}

#[tokio::test]
async fn a_network_that_can_only_be_read_once_its_family_is_said_is_uploaded_and_wrapped() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let refused = problem(upload(&app, &[], anonymous()).await, 422, "unsupported_input").await;
    assert!(refused["detail"].as_str().is_some_and(|d| d.contains("2 outputs")), "{refused}");

    let response = upload(&app, &[("family", "idr")], anonymous()).await;
    assert_eq!(response.status(), StatusCode::CREATED);
    let input: Value = response.json().await.expect("JSON");
    let description = &input["description"];
    assert_eq!((&description["family"], &description["because"]), (&json!("idr"), &json!("it was asked for")));
    assert_eq!((&description["activation"], &input["options"]), (&json!("softplus"), &json!({"family": "idr"})));
    assert!(description["assumed"].to_string().contains("beta 100"), "{description}");

    let mut request = small();
    request["field"] = json!({"input": input["id"], "family": "idr"});
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!(state(&job), "succeeded", "{job}");
    // an input is its bytes: a job says for itself how they are to be read
    request["field"] = json!({"input": input["id"]});
    let id = app.submit(&request).await;
    let job = app.ended(&id).await;
    assert_eq!((state(&job), &job["problem"]["code"]), ("failed", &json!("unsupported_input")), "{job}");
}

#[tokio::test]
async fn an_upload_is_described_as_its_own_query_says_whatever_was_said_before() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let softplus = r#"{"softplus": {"beta": 20}}"#;
    let response = upload(&app, &[("family", "idr"), ("activation", softplus)], anonymous()).await;
    assert_eq!(response.status(), StatusCode::CREATED);
    let location = response.headers()["location"].to_str().expect("text").to_owned();
    let first: Value = response.json().await.expect("JSON");
    let assumed = first["description"]["assumed"].to_string();
    assert!(!assumed.contains("softplus"), "what is said is not assumed: {assumed}");

    let relu = upload(&app, &[("activation", "relu"), ("family", "neus")], anonymous()).await;
    assert_eq!(relu.status(), StatusCode::OK);
    let relu: Value = relu.json().await.expect("JSON");
    for name in ["id", "bytes", "created_at"] {
        assert_eq!(relu[name], first[name], "{name}");
    }
    assert_eq!(relu["options"], json!({"family": "neus", "activation": "relu"}));
    assert_eq!((&relu["description"]["family"], &relu["description"]["activation"]), (&json!("neus"), &json!("relu")));
    // that it is stored does not make it readable to one who says nothing
    problem(upload(&app, &[], anonymous()).await, 422, "unsupported_input").await;
    let again = upload(&app, &[("family", "idr"), ("activation", softplus)], anonymous()).await;
    assert_eq!(again.json::<Value>().await.expect("JSON"), first);
    assert_eq!(app.get_json(&location).await, first, "the first upload is what is kept");
}

#[tokio::test]
async fn parameters_of_an_upload_that_do_not_fit_are_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start(folder.path());
    let siren = || fixture("networks/families/blob_siren.pth");
    let scene = || br#"{"sphere": {"radius": 0.5}}"#.to_vec();
    let cases: [(&Query, Vec<u8>, &str); 12] = [
        (&[("famly", "idr")], siren(), "famly"),
        (&[("latent_row", "0")], siren(), "latent_row"),
        (&[("family", "idr"), ("family", "igr")], siren(), "family"),
        (&[("family", "no_family")], siren(), "family: "),
        (&[("activation", "softplus")], siren(), "activation: "),
        (&[("encoding", r#"{"positional": 6}"#)], siren(), "encoding: "),
        (&[("w0", "-1")], siren(), "w0: "),
        (&[("skip", r#"{"scale": 0}"#)], siren(), "skip/scale: "),
        (&[("skip", r#"{"scale": 1}"#)], siren(), "skip: "),
        (&[("family", "siren")], fixture("networks/blob.npz"), "family: "),
        (&[("w0", "30")], scene(), "w0: "),
        (&[("family", "idr"), ("w0", "30")], scene(), "w0: "),
    ];
    for (query, bytes, name) in cases {
        let refused = problem(upload(&app, query, bytes).await, 400, "invalid_query").await;
        assert!(refused["detail"].as_str().is_some_and(|d| d.contains(name)), "{query:?}: {refused}");
    }
    let known = upload(&app, &[("w0", "[12, 15]")], siren()).await;
    assert_eq!(known.status(), StatusCode::CREATED, "nothing of all that was stored");
    let input: Value = known.json().await.expect("JSON");
    assert_eq!(input["options"], json!({"w0": [12.0, 15.0]}));
    assert!(!input["description"]["assumed"].to_string().contains("w0"), "{input}");
}
