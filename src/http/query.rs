//! Query parameters and headers with a syntax of their own.

use super::Problem;
use axum::http::HeaderMap;
use std::time::Duration;

/// Longest time a request may wait for a job.
pub const MAX_WAIT: Duration = Duration::from_secs(60);

/// The query's parameters in order, each one of `known`; only those in `repeated` may come more than once.
///
/// # Errors
/// 400 that names the parameter.
pub fn parameters(query: Option<&str>, known: &[&str], repeated: &[&str]) -> Result<Vec<(String, String)>, Problem> {
    let text = query.unwrap_or("");
    let uri: axum::http::Uri = format!("/?{text}").parse().map_err(|_| Problem::query("the query is malformed"))?;
    let axum::extract::Query(pairs) = axum::extract::Query::<Vec<(String, String)>>::try_from_uri(&uri)
        .map_err(|error| Problem::query(error.body_text()))?;
    for (i, (name, _)) in pairs.iter().enumerate() {
        if !known.contains(&name.as_str()) {
            let list = if known.is_empty() { "none".to_owned() } else { known.join(", ") };
            return Err(Problem::query(format!("unknown parameter {name:?}; known here: {list}")));
        }
        if !repeated.contains(&name.as_str()) && pairs[..i].iter().any(|(earlier, _)| earlier == name) {
            return Err(Problem::query(format!("parameter {name:?} is given twice")));
        }
    }
    Ok(pairs)
}

/// The value of a parameter.
pub fn value<'p>(pairs: &'p [(String, String)], name: &str) -> Option<&'p str> {
    pairs.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_str())
}

/// A parameter as a whole number.
pub fn number(pairs: &[(String, String)], name: &str) -> Result<Option<u64>, Problem> {
    let parse = |text: &str| {
        let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        digits.then(|| text.parse().ok()).flatten()
    };
    value(pairs, name)
        .map(|text| {
            parse(text).ok_or_else(|| Problem::query(format!("{name}: expected a whole number, found {text:?}")))
        })
        .transpose()
}

/// A parameter that is `true` or `false`.
pub fn flag(pairs: &[(String, String)], name: &str) -> Result<bool, Problem> {
    match value(pairs, name) {
        None | Some("false") => Ok(false),
        Some("true" | "") => Ok(true),
        Some(other) => Err(Problem::query(format!("{name}: expected true or false, found {other:?}"))),
    }
}

/// `?wait=` in seconds, at most [`MAX_WAIT`].
pub fn wait(pairs: &[(String, String)]) -> Result<Option<Duration>, Problem> {
    Ok(number(pairs, "wait")?.map(|seconds| Duration::from_secs(seconds).min(MAX_WAIT)))
}

/// `Prefer: wait=N` (RFC 7240), at most [`MAX_WAIT`]; a preference that is not understood is ignored, as it says.
pub fn prefer_wait(headers: &HeaderMap) -> Option<Duration> {
    let preferences = headers.get_all("prefer").iter().filter_map(|v| v.to_str().ok()).flat_map(|v| v.split(','));
    preferences
        .filter_map(|preference| preference.split(';').next()?.trim().split_once('='))
        .find(|(name, _)| name.trim().eq_ignore_ascii_case("wait"))
        .and_then(|(_, seconds)| seconds.trim().trim_matches('"').parse().ok())
        .map(|seconds| Duration::from_secs(seconds).min(MAX_WAIT))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_and_repeated_parameters_are_refused_by_name() {
        let known = ["state", "label"];
        assert!(parameters(Some("label=a%3Ab&label=c&state=queued"), &known, &["label"]).is_ok());
        for query in ["stat=queued", "state=a&state=b"] {
            let problem = parameters(Some(query), &known, &["label"]).expect_err(query);
            assert!(problem.detail().contains("stat"), "{}", problem.detail());
        }
    }

    #[test]
    fn a_preferred_wait_is_read_among_others_and_bounded() {
        let prefer = |text: &'static str| {
            let headers =
                HeaderMap::from_iter([(axum::http::HeaderName::from_static("prefer"), text.parse().expect("text"))]);
            prefer_wait(&headers).map(|d| d.as_secs())
        };
        assert_eq!(prefer("respond-async, wait=10"), Some(10));
        assert_eq!(prefer("Wait=\"7\"; x=1"), Some(7));
        assert_eq!(prefer("wait=3600"), Some(60));
        assert_eq!(prefer("wait=soon"), None);
    }
}
