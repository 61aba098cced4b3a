//! Tokens of an OpenID Connect issuer, which the test runs itself: those that count, and every kind that must not.

use crate::app::{App, PATIENCE, problem};
use aws_lc_rs::encoding::AsDer;
use aws_lc_rs::rand::SystemRandom;
use aws_lc_rs::rsa::{KeyPair, KeySize};
use aws_lc_rs::signature::{ECDSA_P256_SHA256_FIXED_SIGNING, EcdsaKeyPair};
use axum::Json;
use axum::http::StatusCode;
use axum::routing::get;
use base64::Engine as _;
use base64::prelude::{BASE64_STANDARD, BASE64_URL_SAFE_NO_PAD};
use jsonwebtoken::jwk::Jwk;
use jsonwebtoken::{Algorithm, EncodingKey, Header};
use serde_json::{Value, json};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

const AUDIENCE: &str = "https://shrinkd.test";

/// A key of an issuer.
struct Key {
    id: &'static str,
    algorithm: Algorithm,
    private: EncodingKey,
}

impl Key {
    fn rsa(id: &'static str) -> Self {
        let pair = KeyPair::generate(KeySize::Rsa2048).expect("a key");
        let der = pair.as_der().expect("DER");
        let text = BASE64_STANDARD.encode(der.as_ref());
        let pem = format!("-----BEGIN PRIVATE KEY-----\n{text}\n-----END PRIVATE KEY-----\n");
        Self { id, algorithm: Algorithm::RS256, private: EncodingKey::from_rsa_pem(pem.as_bytes()).expect("a key") }
    }

    fn elliptic(id: &'static str) -> Self {
        let pair = EcdsaKeyPair::generate_pkcs8(&ECDSA_P256_SHA256_FIXED_SIGNING, &SystemRandom::new()).expect("a key");
        Self { id, algorithm: Algorithm::ES256, private: EncodingKey::from_ec_der(pair.as_ref()) }
    }

    fn public(&self) -> Value {
        let mut key = Jwk::from_encoding_key(&self.private, self.algorithm).expect("a key");
        key.common.key_id = Some(self.id.to_owned());
        serde_json::to_value(key).expect("JSON")
    }

    fn sign(&self, claims: &Value) -> String {
        let header = Header { kid: Some(self.id.to_owned()), ..Header::new(self.algorithm) };
        jsonwebtoken::encode(&header, claims, &self.private).expect("signs")
    }
}

/// What the issuer answers now.
#[derive(Default)]
struct Answers {
    url: String,
    keys: Vec<Value>,
    away: bool,
    /// How often its keys were asked for.
    asked: u32,
}

async fn issuer() -> Arc<Mutex<Answers>> {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let answers = Arc::new(Mutex::new(Answers::default()));
    answers.lock().expect("answers").url = format!("http://{}", listener.local_addr().expect("an address"));
    let (about, keys) = (answers.clone(), answers.clone());
    let router = axum::Router::new()
        .route(
            "/.well-known/openid-configuration",
            get(async move || {
                let answers = about.lock().expect("answers");
                if answers.away {
                    return Err(StatusCode::SERVICE_UNAVAILABLE);
                }
                Ok(Json(json!({"issuer": answers.url, "jwks_uri": format!("{}/keys", answers.url)})))
            }),
        )
        .route(
            "/keys",
            get(async move || {
                let mut answers = keys.lock().expect("answers");
                answers.asked += 1;
                if answers.away {
                    Err(StatusCode::SERVICE_UNAVAILABLE)
                } else {
                    Ok(Json(json!({"keys": answers.keys})))
                }
            }),
        );
    tokio::spawn(async move { axum::serve(listener, router).await });
    answers
}

fn start(folder: &std::path::Path, url: &str) -> App {
    App::start_with(
        folder,
        &[
            ("SHRINKD_AUTH__MODE", "required"),
            ("SHRINKD_AUTH__OIDC__ISSUER", url),
            ("SHRINKD_AUTH__OIDC__AUDIENCE", AUDIENCE),
        ],
    )
}

fn now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).expect("a time").as_secs()
}

/// Claims that count, with these members in place of theirs; `null` takes one away.
fn claims(url: &str, changed: Value) -> Value {
    let mut claims = json!({
        "iss": url, "aud": AUDIENCE, "sub": "someone", "exp": now() + 600, "tenant": "acme", "scope": "openid shrinkd:read",
    });
    for (name, value) in changed.as_object().expect("members") {
        claims[name] = value.clone();
    }
    claims.as_object_mut().expect("members").retain(|_, value| !value.is_null());
    claims
}

async fn list(app: &App, token: &str) -> reqwest::Response {
    app.request(reqwest::Method::GET, "/v1/jobs").bearer_auth(token).send().await.expect("an answer")
}

async fn works_in_time(app: &App, token: &str) {
    let clock = Instant::now();
    while list(app, token).await.status() != 200 {
        assert!(clock.elapsed() < PATIENCE, "it is never taken\n{}", app.log());
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tokens_count_when_the_issuer_signed_them_for_this_service_and_now() {
    let answers = issuer().await;
    let url = answers.lock().expect("answers").url.clone();
    let (rsa, elliptic) = (Key::rsa("one"), Key::elliptic("two"));
    answers.lock().expect("answers").keys = vec![rsa.public(), elliptic.public(), json!({"kty": "unheard of"})];
    let folder = tempfile::tempdir().expect("folder");
    let app = start(folder.path(), &url);
    for key in [&rsa, &elliptic] {
        assert_eq!(list(&app, &key.sign(&claims(&url, json!({})))).await.status(), 200, "{}\n{}", key.id, app.log());
        let listed = claims(&url, json!({"aud": ["other", AUDIENCE], "scope": ["shrinkd:read"]}));
        assert_eq!(list(&app, &key.sign(&listed)).await.status(), 200, "claims may be lists");
    }
    let narrow = rsa.sign(&claims(&url, json!({"scope": "read"})));
    problem(list(&app, &narrow).await, 403, "insufficient_scope").await;

    let unsigned = |header: Value, body: &Value, signature: &[u8]| {
        let part = |value: &Value| BASE64_URL_SAFE_NO_PAD.encode(value.to_string());
        format!("{}.{}.{}", part(&header), part(body), BASE64_URL_SAFE_NO_PAD.encode(signature))
    };
    let good = claims(&url, json!({}));
    let signed = rsa.sign(&good);
    let (head, signature) =
        (signed.split('.').next().expect("a head"), signed.rsplit('.').next().expect("a signature"));
    let other = BASE64_URL_SAFE_NO_PAD.encode(claims(&url, json!({"tenant": "other"})).to_string());
    let public = rsa.public()["n"].as_str().expect("a number").to_owned();
    let shared = EncodingKey::from_secret(&BASE64_URL_SAFE_NO_PAD.decode(&public).expect("base64"));
    let by_secret = Header { kid: Some("one".to_owned()), ..Header::new(Algorithm::HS256) };
    let stranger = Key { id: "one", ..Key::rsa("one") };
    let swapped = Header { kid: Some("two".to_owned()), ..Header::new(Algorithm::RS256) };
    let refused = [
        ("expired", rsa.sign(&claims(&url, json!({"exp": now() - 300})))),
        ("without an end", rsa.sign(&claims(&url, json!({"exp": null})))),
        ("not yet", rsa.sign(&claims(&url, json!({"nbf": now() + 300})))),
        ("another audience", rsa.sign(&claims(&url, json!({"aud": "https://other.test"})))),
        ("no audience", rsa.sign(&claims(&url, json!({"aud": null})))),
        ("another issuer", rsa.sign(&claims(&url, json!({"iss": "https://other.test"})))),
        ("several issuers", rsa.sign(&claims(&url, json!({"iss": [url, "https://other.test"]})))),
        ("no tenant", rsa.sign(&claims(&url, json!({"tenant": null})))),
        ("no name of a tenant", rsa.sign(&claims(&url, json!({"tenant": "../acme"})))),
        ("another's signature", stranger.sign(&good)),
        ("changed afterwards", format!("{head}.{other}.{signature}")),
        ("unsigned", unsigned(json!({"alg": "none", "typ": "JWT"}), &good, b"")),
        ("unsigned, in other letters", unsigned(json!({"alg": "nOnE", "kid": "one"}), &good, b"")),
        ("no signature", format!("{}.", signed.rsplit_once('.').expect("a signature").0)),
        ("the public key as a secret", jsonwebtoken::encode(&by_secret, &good, &shared).expect("signs")),
        ("a key of another kind", jsonwebtoken::encode(&swapped, &good, &rsa.private).expect("signs")),
        ("an unknown key", Key { id: "nine", ..Key::rsa("nine") }.sign(&good)),
        ("too long", rsa.sign(&claims(&url, json!({"padding": "x".repeat(20_000)})))),
    ];
    for (what, token) in &refused {
        let answer = list(&app, token).await;
        assert_eq!(answer.status(), 401, "{what}");
        let challenge = answer.headers()["www-authenticate"].to_str().expect("text").to_owned();
        assert!(challenge.contains("error=\"invalid_token\""), "{what}: {challenge}");
        let said = problem(answer, 401, "unauthenticated").await.to_string();
        assert!(!said.contains(signature), "{what}: {said}");
    }
    assert!(!app.log().contains(signature), "no token is logged");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn keys_change_and_the_issuer_may_be_away_and_is_not_hammered() {
    let answers = issuer().await;
    let url = answers.lock().expect("answers").url.clone();
    let (old, new) = (Key::elliptic("old"), Key::elliptic("new"));
    answers.lock().expect("answers").away = true;
    let folder = tempfile::tempdir().expect("folder");
    let app = start(folder.path(), &url);
    let token = |key: &Key| key.sign(&claims(&url, json!({})));
    problem(list(&app, &token(&old)).await, 503, "issuer_unavailable").await;
    {
        let mut answers = answers.lock().expect("answers");
        (answers.away, answers.keys) = (false, vec![old.public()]);
    }
    works_in_time(&app, &token(&old)).await;

    // whoever makes keys up does not reach the issuer
    let (asked, clock) = (answers.lock().expect("answers").asked, Instant::now());
    let made_up = Key::elliptic("made up");
    for _ in 0..100 {
        assert_eq!(list(&app, &token(&made_up)).await.status(), 401);
    }
    let allowed = 1 + clock.elapsed().as_secs() / 5;
    let asked = u64::from(answers.lock().expect("answers").asked - asked);
    assert!(asked <= allowed, "asked {asked} times in {:?}", clock.elapsed());

    answers.lock().expect("answers").keys = vec![new.public()];
    works_in_time(&app, &token(&new)).await;
    assert_eq!(list(&app, &token(&old)).await.status(), 401, "a key that was withdrawn counts no more");
    answers.lock().expect("answers").away = true;
    for _ in 0..3 {
        assert_eq!(list(&app, &token(&new)).await.status(), 200, "the keys at hand serve on");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_issuer_with_names_of_its_own_is_understood_as_it_is_configured() {
    let answers = issuer().await;
    let keys_at = format!("{}/keys", answers.lock().expect("answers").url);
    let (rsa, elliptic) = (Key::rsa("one"), Key::elliptic("two"));
    answers.lock().expect("answers").keys = vec![rsa.public(), elliptic.public()];
    // nobody answers there, so nothing but the setting tells where the keys are
    let url = "https://issuer.invalid";
    let folder = tempfile::tempdir().expect("folder");
    let app = App::start_with(
        folder.path(),
        &[
            ("SHRINKD_AUTH__MODE", "required"),
            ("SHRINKD_AUTH__OIDC__ISSUER", url),
            ("SHRINKD_AUTH__OIDC__AUDIENCE", AUDIENCE),
            ("SHRINKD_AUTH__OIDC__JWKS_URL", &keys_at),
            ("SHRINKD_AUTH__OIDC__TENANT_CLAIM", "organization"),
            ("SHRINKD_AUTH__OIDC__SCOPE_CLAIM", "permissions"),
            ("SHRINKD_AUTH__OIDC__SCOPE_PREFIX", "surfaces/"),
            ("SHRINKD_AUTH__OIDC__ALGORITHMS", "[\"ES256\"]"),
        ],
    );
    // what the defaults would go by is there, too, and says something else
    let token = |changed: Value| {
        let mut own = json!({"organization": "team-b", "permissions": ["surfaces/read", "surfaces/write"]});
        for (name, value) in changed.as_object().expect("members") {
            own[name] = value.clone();
        }
        elliptic.sign(&claims(url, own))
    };
    let full = token(json!({}));
    assert_eq!(list(&app, &full).await.status(), 200, "{}", app.log());
    assert_eq!(list(&app, &token(json!({"permissions": "openid surfaces/read"}))).await.status(), 200);
    for permissions in [json!(null), json!(["shrinkd:read"]), json!(["read"]), json!("surfaces/write")] {
        let narrow = token(json!({"permissions": permissions.clone(), "scope": "surfaces/read shrinkd:read"}));
        let refused = list(&app, &narrow).await;
        assert_eq!(refused.status(), 403, "{permissions}");
        problem(refused, 403, "insufficient_scope").await;
    }

    // whose things they are is said by the claim that is configured
    let request = app.request(reqwest::Method::POST, "/v1/jobs").bearer_auth(&full).json(&crate::app::small());
    assert_eq!(request.send().await.expect("an answer").status(), 202);
    let seen = async |token: &str| {
        let page: Value = list(&app, token).await.json().await.expect("JSON");
        page["jobs"].as_array().expect("a list").len()
    };
    assert_eq!(seen(&token(json!({"tenant": "somebody else"}))).await, 1);
    assert_eq!(seen(&token(json!({"organization": "acme"}))).await, 0);
    problem(list(&app, &token(json!({"organization": null}))).await, 401, "unauthenticated").await;

    let by_another = rsa.sign(&claims(url, json!({"organization": "team-b", "permissions": ["surfaces/read"]})));
    let refused = problem(list(&app, &by_another).await, 401, "unauthenticated").await;
    assert!(refused["detail"].as_str().is_some_and(|detail| detail.contains("algorithm")), "{refused}");
}
