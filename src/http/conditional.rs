//! Entity tags and byte ranges (RFC 9110).

use axum::http::{HeaderMap, HeaderName, header};
use std::ops::Range;

/// Whether an `If-None-Match` (or `If-Match`) list names this tag. Tags are compared weakly, as `If-None-Match` asks.
pub fn names_tag(headers: &HeaderMap, name: HeaderName, tag: &str) -> bool {
    let opaque = |t: &str| t.trim().trim_start_matches("W/").to_owned();
    let values = headers.get_all(name).iter().filter_map(|v| v.to_str().ok());
    values.flat_map(|v| v.split(',')).any(|listed| listed.trim() == "*" || opaque(listed) == opaque(tag))
}

/// What part of a body is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Part {
    /// All of it.
    Whole,
    /// These bytes of it.
    Bytes(Range<u64>),
    /// Bytes that it does not have: 416.
    Unsatisfiable,
}

/// The part of a body of `length` bytes with the strong tag `tag` that the headers ask for. A range of another unit,
/// several ranges, a malformed one, and one whose `If-Range` names another version are ignored, as the standard allows.
pub fn part(headers: &HeaderMap, tag: &str, length: u64) -> Part {
    let Some(range) = headers.get(header::RANGE).and_then(|v| v.to_str().ok()) else { return Part::Whole };
    if let Some(condition) = headers.get(header::IF_RANGE)
        && condition.to_str().map_or("", str::trim) != tag
    {
        return Part::Whole;
    }
    let Some((first, last)) = range.trim().strip_prefix("bytes=").and_then(|r| r.trim().split_once('-')) else {
        return Part::Whole;
    };
    let number = |text: &str| -> Option<u64> {
        let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        // more digits than fit are a number past every end
        digits.then(|| text.parse().unwrap_or(u64::MAX))
    };
    let range = match (first.trim(), last.trim()) {
        ("", suffix) => match number(suffix) {
            Some(0) => return Part::Unsatisfiable,
            Some(suffix) => length.saturating_sub(suffix)..length,
            None => return Part::Whole,
        },
        (first, "") => match number(first) {
            Some(first) => first..length,
            None => return Part::Whole,
        },
        (first, last) => match (number(first), number(last)) {
            (Some(first), Some(last)) if first <= last => first..last.saturating_add(1).min(length),
            _ => return Part::Whole,
        },
    };
    if range.start >= length { Part::Unsatisfiable } else { Part::Bytes(range) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(HeaderName, &str)]) -> HeaderMap {
        pairs.iter().map(|(n, v)| (n.clone(), v.parse().expect("value"))).collect()
    }

    #[test]
    fn a_range_is_what_the_standard_says_it_is() {
        let cases = [
            ("bytes=0-0", Part::Bytes(0..1)),
            ("bytes=2-", Part::Bytes(2..10)),
            ("bytes=-3", Part::Bytes(7..10)),
            ("bytes=-30", Part::Bytes(0..10)),
            ("bytes=4-99", Part::Bytes(4..10)),
            ("bytes=10-", Part::Unsatisfiable),
            ("bytes=-0", Part::Unsatisfiable),
            ("bytes=99999999999999999999-", Part::Unsatisfiable),
            ("bytes=5-4", Part::Whole),
            ("bytes=1-2,4-5", Part::Whole),
            ("bytes=a-b", Part::Whole),
            ("items=0-1", Part::Whole),
        ];
        for (range, expected) in cases {
            assert_eq!(part(&headers(&[(header::RANGE, range)]), "\"t\"", 10), expected, "{range}");
        }
    }

    #[test]
    fn a_range_of_another_version_is_the_whole() {
        for (condition, expected) in [
            ("\"t\"", Part::Bytes(0..1)),
            ("\"u\"", Part::Whole),
            ("W/\"t\"", Part::Whole),
            ("Sun, 06 Nov 1994 08:49:37 GMT", Part::Whole),
        ] {
            let headers = headers(&[(header::RANGE, "bytes=0-0"), (header::IF_RANGE, condition)]);
            assert_eq!(part(&headers, "\"t\"", 10), expected, "{condition}");
        }
    }

    #[test]
    fn tags_are_found_in_lists() {
        let tag = "W/\"7\"";
        for list in ["W/\"7\"", "\"7\"", "\"6\", W/\"7\"", "*"] {
            assert!(names_tag(&headers(&[(header::IF_NONE_MATCH, list)]), header::IF_NONE_MATCH, tag), "{list}");
        }
        assert!(!names_tag(&headers(&[(header::IF_NONE_MATCH, "\"77\"")]), header::IF_NONE_MATCH, tag));
    }
}
