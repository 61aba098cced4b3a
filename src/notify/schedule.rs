//! When a notice that was not taken is sent again.

use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimeParser;
use std::time::Duration;
use uuid::Uuid;

/// Pauses after the first, the second, ... attempt: four times as long each time, about 26 hours together.
const PAUSES_S: [u64; 10] = [5, 20, 80, 320, 1280, 5120, 20_480, 21_600, 21_600, 21_600];
/// Longest pause that a receiver may ask for.
const LONGEST: Duration = Duration::from_secs(24 * 3600);

/// The pause after so many attempts, `asked` being what the receiver wants; `None` when it was tried often enough.
pub fn pause(attempts: u32, asked: Option<Duration>) -> Option<Duration> {
    let index = usize::try_from(attempts.saturating_sub(1)).ok()?;
    let own = jittered(Duration::from_secs(*PAUSES_S.get(index)?));
    Some(asked.map_or(own, |asked| asked.min(LONGEST).max(own)))
}

/// Three to five quarters of a time, so that notices that failed together are not sent again together.
fn jittered(time: Duration) -> Duration {
    time.mul_f64(0.75 + 0.5 * f64::from(Uuid::now_v7().as_bytes()[15]) / 255.0)
}

/// Reads `Retry-After`: seconds, or a time (RFC 9110). What is neither says nothing.
pub fn retry_after(text: &str, now: Timestamp) -> Option<Duration> {
    let text = text.trim();
    if !text.is_empty() && text.len() <= 10 && text.bytes().all(|b| b.is_ascii_digit()) {
        return text.parse().ok().map(Duration::from_secs);
    }
    let then = DateTimeParser::new().parse_timestamp(text).ok()?;
    Some(Duration::try_from(then.duration_since(now)).unwrap_or(Duration::ZERO))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_grow_over_about_a_day_and_end() {
        let mut sum = Duration::ZERO;
        for attempts in 1..=10 {
            let (pause, middle) = (pause(attempts, None).expect("again"), PAUSES_S[attempts as usize - 1] as f64);
            assert!((0.75 * middle..=1.25 * middle + 1e-6).contains(&pause.as_secs_f64()), "{attempts}: {pause:?}");
            sum += Duration::from_secs_f64(middle);
        }
        assert!((24 * 3600..30 * 3600).contains(&sum.as_secs()), "{sum:?}");
        assert_eq!(pause(11, None), None);
        assert_eq!(pause(11, Some(Duration::from_secs(1))), None, "who asks for more time does not get more attempts");
    }

    #[test]
    fn a_receiver_may_ask_for_a_longer_pause_and_not_for_a_shorter_or_endless_one() {
        assert_eq!(pause(1, Some(Duration::from_secs(60))), Some(Duration::from_secs(60)));
        assert!(pause(1, Some(Duration::ZERO)) >= Some(Duration::from_secs(3)));
        assert_eq!(pause(1, Some(Duration::MAX)), Some(LONGEST));
    }

    #[test]
    fn retry_after_is_seconds_or_a_time() {
        let now: Timestamp = "1994-11-06T08:49:00Z".parse().expect("a time");
        assert_eq!(retry_after("120", now), Some(Duration::from_secs(120)));
        assert_eq!(retry_after("Sun, 06 Nov 1994 08:49:37 GMT", now), Some(Duration::from_secs(37)));
        assert_eq!(retry_after("Sun, 06 Nov 1994 08:48:37 GMT", now), Some(Duration::ZERO));
        for text in ["", "-1", "soon", "1.5", "99999999999"] {
            assert_eq!(retry_after(text, now), None, "{text}");
        }
    }
}
