//! Signatures of notices, after the Standard Webhooks specification (symmetric, version `v1`).

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use serde::{Deserialize, Serialize};

/// What a secret's text begins with.
const PREFIX: &str = "whsec_";
/// Bytes of a secret, by the specification.
const SIZES: std::ops::RangeInclusive<usize> = 24..=64;

/// A secret that notices are signed with: `whsec_` and 24 to 64 bytes in base64. Is not told in logs.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Secret(Vec<u8>);

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Secret(..)")
    }
}

impl TryFrom<String> for Secret {
    type Error = &'static str;
    fn try_from(text: String) -> Result<Self, Self::Error> {
        // the text itself stays out of the error
        let expected = "expected whsec_ and 24 to 64 bytes in base64";
        let bytes = text.strip_prefix(PREFIX).and_then(|rest| BASE64_STANDARD.decode(rest).ok()).ok_or(expected)?;
        if SIZES.contains(&bytes.len()) { Ok(Self(bytes)) } else { Err(expected) }
    }
}

impl From<Secret> for String {
    fn from(secret: Secret) -> Self {
        format!("{PREFIX}{}", BASE64_STANDARD.encode(secret.0))
    }
}

/// The header `webhook-signature`: one signature for every secret, so that a receiver which knows only one of them is content.
pub fn sign(secrets: &[Secret], id: &str, timestamp_s: i64, payload: &[u8]) -> String {
    let mut content = format!("{id}.{timestamp_s}.").into_bytes();
    content.extend_from_slice(payload);
    let signatures = secrets.iter().map(|Secret(secret)| {
        let mac = hmac_sha256::HMAC::mac(&content, secret);
        format!("v1,{}", BASE64_STANDARD.encode(mac))
    });
    signatures.collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn secret(text: &str) -> Secret {
        Secret::try_from(text.to_owned()).expect("a secret")
    }

    /// What the specification's own libraries test themselves with.
    #[test]
    fn a_signature_is_that_of_the_specification() {
        let secrets = [secret("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")];
        let signed = sign(&secrets, "msg_p5jXN8AQM9LWM0D4loKWxJek", 1_614_265_330, b"{\"test\": 2432232314}");
        assert_eq!(signed, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
    }

    #[test]
    fn while_secrets_are_changed_every_one_signs() {
        let old = secret("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw");
        let new = secret("whsec_C2FVsBQIhrscChlQIMV+b5sSYspob7oD");
        let both = sign(&[new.clone(), old.clone()], "a", 1, b"x");
        assert_eq!(both, format!("{} {}", sign(&[new], "a", 1, b"x"), sign(&[old], "a", 1, b"x")));
    }

    #[test]
    fn what_is_no_secret_is_refused_without_being_told() {
        let short = format!("whsec_{}", BASE64_STANDARD.encode([7; 23]));
        let long = format!("whsec_{}", BASE64_STANDARD.encode([7; 65]));
        for text in ["", "whsec_", "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "whsec_%%%", &short, &long] {
            let error = Secret::try_from(text.to_owned()).expect_err(text);
            assert!(text.is_empty() || text == "whsec_" || !error.contains(text));
        }
        assert_eq!(format!("{:?}", secret("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw")), "Secret(..)");
    }
}
