//! How often a tenant asks this node, and how much it uploads to it; and how an answer tells what is left.
//!
//! Each quota is a bucket that holds as much as the quota and is filled again evenly over its time, so that a burst is let through
//! and the rate is kept. Every node counts what it is asked itself. Answers tell what is left in the fields `RateLimit` and
//! `RateLimit-Policy` (draft-ietf-httpapi-ratelimit-headers-10), named as in the configuration.

use super::Problem;
use crate::quota::{Exceeded, HOUR, MINUTE, Quotas};
use crate::tenant::Tenant;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");
const RATE_LIMIT_POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");
/// Buckets that are looked through for full ones, which say nothing.
const MANY: usize = 1024;

/// When to ask for a stream again that was one too many: nobody knows when another one ends.
const STREAM_PAUSE: Duration = Duration::from_secs(5);

/// Whether a field tells of a quota.
pub(super) fn tells(name: &HeaderName) -> bool {
    *name == RATE_LIMIT || *name == RATE_LIMIT_POLICY
}

/// What is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Rate {
    /// Requests within a minute.
    Requests,
    /// Bytes of uploads within an hour.
    UploadedBytes,
}

/// What a tenant has left of a quota.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Standing {
    quota: &'static str,
    limit: u64,
    window: Option<Duration>,
    left: u64,
    /// Until there is more.
    more_after: Duration,
}

/// Everybody's buckets, and how many streams everybody has open.
#[derive(Default)]
pub struct Rates {
    quotas: Quotas,
    buckets: Mutex<HashMap<(Tenant, Rate), Bucket>>,
    streams: Mutex<HashMap<Tenant, u64>>,
}

/// A stream that is open, until this is dropped.
pub struct OpenStream(Option<(Arc<Rates>, Tenant)>);

impl Drop for OpenStream {
    fn drop(&mut self) {
        let Some((rates, tenant)) = self.0.take() else { return };
        let mut streams = rates.streams.lock().unwrap_or_else(|e| e.into_inner());
        if let Entry::Occupied(mut open) = streams.entry(tenant) {
            *open.get_mut() -= 1;
            if *open.get() == 0 {
                open.remove();
            }
        }
    }
}

#[derive(Clone, Copy)]
struct Bucket {
    left: f64,
    at: Instant,
}

impl Rates {
    /// Full buckets.
    pub fn new(quotas: Quotas) -> Self {
        Self { quotas, ..Self::default() }
    }

    /// Lets a tenant open a stream, where it may have another one.
    ///
    /// # Errors
    /// When it has as many as it may.
    pub fn open_stream(self: &Arc<Self>, tenant: &Tenant) -> Result<OpenStream, Problem> {
        let limit = self.quotas.of(tenant).streams;
        if limit == 0 {
            return Ok(OpenStream(None));
        }
        let mut streams = self.streams.lock().unwrap_or_else(|e| e.into_inner());
        let open = streams.entry(tenant.clone()).or_default();
        if *open >= limit {
            let over = Exceeded { quota: "streams", limit, window: None, left: 0, retry_after: STREAM_PAUSE };
            return Err(Problem::over_quota(over));
        }
        *open += 1;
        Ok(OpenStream(Some((self.clone(), tenant.clone()))))
    }

    /// Takes so much of a tenant's quota; what is left, where there is a limit.
    ///
    /// # Errors
    /// When there is not so much left: then nothing is taken.
    pub fn take(&self, tenant: &Tenant, rate: Rate, amount: u64) -> Result<Option<Standing>, Problem> {
        self.take_at(tenant, rate, amount, Instant::now()).map_err(Problem::over_quota)
    }

    fn take_at(&self, tenant: &Tenant, rate: Rate, amount: u64, now: Instant) -> Result<Option<Standing>, Exceeded> {
        let quota = self.quotas.of(tenant);
        let (name, limit, window) = match rate {
            Rate::Requests => ("requests_per_minute", quota.requests_per_minute, MINUTE),
            Rate::UploadedBytes => ("upload_bytes_per_hour", quota.upload_bytes_per_hour, HOUR),
        };
        if limit == 0 {
            return Ok(None);
        }
        let (capacity, per_second) = (limit as f64, limit as f64 / window.as_secs_f64());
        let filled = |bucket: &Bucket| {
            (bucket.left + per_second * now.saturating_duration_since(bucket.at).as_secs_f64()).min(capacity)
        };
        let mut buckets = self.buckets.lock().unwrap_or_else(|e| e.into_inner());
        if buckets.len() >= MANY {
            // one that nobody took from for its whole time is full
            buckets.retain(|_, bucket| now.saturating_duration_since(bucket.at) < HOUR);
        }
        let bucket = buckets.entry((tenant.clone(), rate)).or_insert(Bucket { left: capacity, at: now });
        *bucket = Bucket { left: filled(bucket), at: now };
        let after = |lacking: f64| Duration::from_secs_f64((lacking / per_second).max(0.0));
        let (asked, left) = (amount as f64, bucket.left.floor() as u64);
        if asked > bucket.left {
            // more than the quota will never be there, and the quota only once the bucket is full
            let retry_after = after(asked.min(capacity) - bucket.left);
            return Err(Exceeded { quota: name, limit, window: Some(window), left, retry_after });
        }
        bucket.left -= asked;
        let more_after = after((bucket.left.floor() + 1.0).min(capacity) - bucket.left);
        Ok(Some(Standing { quota: name, limit, window: Some(window), left: bucket.left.floor() as u64, more_after }))
    }
}

impl Standing {
    /// Adds the fields that tell it.
    pub fn tell(&self, headers: &mut HeaderMap) {
        let (policy, limit) = self.fields();
        headers.append(RATE_LIMIT_POLICY, policy);
        headers.append(RATE_LIMIT, limit);
    }

    fn fields(&self) -> (HeaderValue, HeaderValue) {
        let window = self.window.map(|window| format!(";w={}", window.as_secs())).unwrap_or_default();
        let policy = format!("\"{}\";q={}{window}", self.quota, self.limit);
        let limit = format!("\"{}\";r={};t={}", self.quota, self.left, seconds(self.more_after));
        // names of quotas and numbers
        let value = |text: String| HeaderValue::try_from(text).unwrap_or(HeaderValue::from_static(""));
        (value(policy), value(limit))
    }
}

/// Whole seconds, at least one.
fn seconds(time: Duration) -> u32 {
    time.as_secs_f64().ceil().clamp(1.0, f64::from(u32::MAX)) as u32
}

impl Problem {
    /// 429: a tenant has what it may have.
    pub fn over_quota(over: Exceeded) -> Self {
        let Exceeded { quota, limit, window, left, retry_after: more_after } = over;
        let detail = match (quota, left) {
            ("queued", _) => format!("{limit} jobs of yours wait, and no more may (quota {quota})"),
            ("streams", _) => format!("{limit} streams of yours are open, and no more may be (quota {quota})"),
            (_, 0) => format!("nothing is left of your quota {quota} of {limit}"),
            _ => format!("{left} are left of your quota {quota} of {limit}, fewer than this takes"),
        };
        let (policy, standing) = Standing { quota, limit, window, left, more_after }.fields();
        Self::new(StatusCode::TOO_MANY_REQUESTS, "quota_exceeded", "a quota is used up", detail)
            .with_header(RATE_LIMIT_POLICY, policy)
            .with_header(RATE_LIMIT, standing)
            .retry_after(seconds(more_after))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quota::Quota;

    fn rates() -> Rates {
        let default = Quota { requests_per_minute: 60, upload_bytes_per_hour: 3600, ..Quota::default() };
        Rates::new(Quotas { default, ..Quotas::default() })
    }

    #[test]
    fn a_burst_is_let_through_and_the_rate_is_kept() {
        let (rates, tenant, start) = (rates(), Tenant::default(), Instant::now());
        let take = |at: f64| rates.take_at(&tenant, Rate::Requests, 1, start + Duration::from_secs_f64(at));
        let left: Vec<_> = (0..60).map(|_| take(0.0).expect("is let through").expect("is limited").left).collect();
        assert_eq!((left[0], left[59]), (59, 0));
        let refused = take(0.5).expect_err("is refused");
        assert_eq!((refused.left, seconds(refused.retry_after)), (0, 1));
        assert!(refused.retry_after <= Duration::from_millis(501));
        assert!(take(1.1).is_ok() && take(1.2).is_err(), "one a second, and what was refused took nothing");
        let let_through = (0..1000).filter(|_| take(3600.0).is_ok()).count();
        assert_eq!(let_through, 60, "a bucket holds no more than its quota");
        assert!(rates.take_at(&"other".parse().expect("a name"), Rate::Requests, 1, start).is_ok(), "each has its own");
    }

    #[test]
    fn a_stream_that_ends_makes_room_for_another() {
        let default = Quota { streams: 2, ..Quota::default() };
        let rates = Arc::new(Rates::new(Quotas { default, ..Quotas::default() }));
        let (tenant, other) = (Tenant::default(), "other".parse().expect("a name"));
        let (first, _second) = (rates.open_stream(&tenant).expect("opens"), rates.open_stream(&tenant).expect("opens"));
        let refused = rates.open_stream(&tenant).err().expect("is one too many");
        assert_eq!((refused.code(), refused.retry_after_s()), ("quota_exceeded", Some(5)));
        let _others = rates.open_stream(&other).expect("each has its own");
        drop(first);
        let _third = rates.open_stream(&tenant).expect("there is room again");
        assert!(rates.open_stream(&tenant).is_err());
    }

    #[test]
    fn what_is_left_is_told_in_the_words_of_the_draft() {
        let (rates, tenant) = (rates(), Tenant::default());
        let standing = rates.take(&tenant, Rate::UploadedBytes, 600).expect("is let through").expect("is limited");
        let mut headers = HeaderMap::new();
        standing.tell(&mut headers);
        assert_eq!(headers["ratelimit-policy"], "\"upload_bytes_per_hour\";q=3600;w=3600");
        assert_eq!(headers["ratelimit"], "\"upload_bytes_per_hour\";r=3000;t=1");
        let refused = rates.take(&tenant, Rate::UploadedBytes, 3010).expect_err("is refused");
        assert_eq!((refused.code(), refused.status()), ("quota_exceeded", StatusCode::TOO_MANY_REQUESTS));
        assert!(refused.retry_after_s().is_some_and(|s| (9..=11).contains(&s)), "{refused:?}");
        assert!(Rates::default().take(&tenant, Rate::Requests, 1).expect("is let through").is_none());
    }
}
