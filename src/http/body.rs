//! Reading request bodies under a limit.

use super::Problem;
use axum::body::Body;
use axum::http::{HeaderMap, StatusCode, header};
use bytes::{Bytes, BytesMut};
use futures::StreamExt;
use serde_json::Value;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Bytes that are still read, and thrown away, from a body that is too large: a client that is not listening yet would
/// otherwise see a broken connection in place of the answer.
const MAX_DISCARDED: u64 = 16 << 20;

/// Longest time without a byte of a body that is not complete.
pub const STALL: Duration = Duration::from_secs(30);
/// Longest time for a whole body: the largest input over a line of three megabits a second.
pub const WHOLE: Duration = Duration::from_secs(15 * 60);

/// Room for the bodies of uploads that are read at the same time. It is taken as bytes come, so that whoever sends none takes none.
#[derive(Clone)]
pub struct Room(Arc<AtomicU64>);

/// What an upload has taken of the room, until this is dropped.
pub struct Taken {
    room: Room,
    bytes: u64,
}

impl Room {
    /// So many bytes.
    pub fn new(bytes: u64) -> Self {
        Self(Arc::new(AtomicU64::new(bytes)))
    }

    /// Nothing yet.
    pub fn taken(&self) -> Taken {
        Taken { room: self.clone(), bytes: 0 }
    }
}

impl Taken {
    /// Takes so many bytes more.
    ///
    /// # Errors
    /// 503 when there are not so many.
    pub fn more(&mut self, bytes: u64) -> Result<(), Problem> {
        let taken = self.room.0.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(bytes));
        taken.map_err(|_| {
            Problem::unavailable("uploads_full", "as many bytes are being uploaded as may at the same time")
        })?;
        self.bytes += bytes;
        Ok(())
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.room.0.fetch_add(self.bytes, Ordering::Relaxed);
    }
}

/// Reads a body of at most `limit` bytes.
///
/// # Errors
/// 413 when it is larger, 400 when it breaks off, 408 when it does not go on.
pub async fn read(body: Body, limit: u64) -> Result<Bytes, Problem> {
    within(WHOLE, read_all(body, limit, |_| Ok(()))).await?
}

/// As [`read`], with the room that the body takes.
///
/// # Errors
/// Those of [`read`], and 503 when there is no room for it beside the others.
pub async fn read_upload(body: Body, limit: u64, room: &Room) -> Result<(Bytes, Taken), Problem> {
    let mut taken = room.taken();
    let bytes = within(WHOLE, read_all(body, limit, |bytes| taken.more(bytes))).await??;
    Ok((bytes, taken))
}

/// What comes in time.
///
/// # Errors
/// 408 when it does not.
pub(crate) async fn within<T>(time: Duration, work: impl Future<Output = T>) -> Result<T, Problem> {
    tokio::time::timeout(time, work).await.map_err(|_| {
        let detail =
            format!("a body goes on within {} s and is complete within {} s", STALL.as_secs(), WHOLE.as_secs());
        Problem::new(StatusCode::REQUEST_TIMEOUT, "body_too_slow", "the body does not come", detail)
    })
}

async fn read_all(body: Body, limit: u64, mut hold: impl FnMut(u64) -> Result<(), Problem>) -> Result<Bytes, Problem> {
    let mut stream = body.into_data_stream();
    let (mut bytes, mut discarded) = (BytesMut::new(), 0u64);
    while let Some(chunk) = within(STALL, stream.next()).await? {
        let chunk = chunk.map_err(|error| {
            tracing::debug!(%error, "a body broke off");
            Problem::bad_request("incomplete_body", "the body broke off", "the body ended before it was complete")
        })?;
        let length = chunk.len() as u64;
        if discarded > 0 || bytes.len() as u64 + length > limit {
            bytes = BytesMut::new();
            discarded += length;
            if discarded > MAX_DISCARDED {
                break;
            }
        } else {
            hold(length)?;
            bytes.extend_from_slice(&chunk);
        }
    }
    if discarded > 0 { Err(Problem::too_large(limit)) } else { Ok(bytes.freeze()) }
}

/// Reads a JSON body of at most `limit` bytes.
///
/// # Errors
/// 415 for another media type, 413 when it is too large, and those of [`parse_json`].
pub async fn read_json(headers: &HeaderMap, body: Body, limit: u64) -> Result<Value, Problem> {
    let media_type = headers.get(header::CONTENT_TYPE).and_then(|v| v.to_str().ok()).unwrap_or("");
    let essence = media_type.split(';').next().unwrap_or("").trim().to_ascii_lowercase();
    if essence != "application/json" {
        let detail = format!("expected application/json, found {media_type:?}");
        let title = "the body has another media type";
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", title, detail));
    }
    parse_json(&read(body, limit).await?)
}

/// Parses JSON.
///
/// # Errors
/// 400 when it is none or nested too deeply.
pub fn parse_json(bytes: &[u8]) -> Result<Value, Problem> {
    serde_json::from_slice(bytes).map_err(|error| {
        // the parser stops at 128 levels and says so only in its message
        if error.to_string().contains("recursion limit") {
            let detail = format!("values may be nested 127 deep; line {}, column {}", error.line(), error.column());
            return Problem::bad_request("too_deep", "the body is nested too deeply", detail);
        }
        Problem::bad_request("malformed_json", "the body is not JSON", error.to_string())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn uploads_have_room_together_and_give_it_back() {
        let room = Room::new(10);
        let upload = |bytes: &'static str| read_upload(Body::from(bytes), 100, &room);
        let (first, held) = upload("123456").await.expect("there is room");
        assert_eq!(first, "123456");
        let refused = upload("12345").await.err().expect("there is no room beside it");
        assert_eq!((refused.code(), refused.status()), ("uploads_full", StatusCode::SERVICE_UNAVAILABLE));
        assert!(upload("1234").await.is_ok(), "what was refused holds nothing");
        drop(held);
        assert!(upload("1234567890").await.is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_does_not_go_on_is_not_waited_for() {
        let begun = || futures::stream::iter([Ok::<_, std::io::Error>("begun")]);
        let stalled = Body::from_stream(begun().chain(futures::stream::pending()));
        assert_eq!(read(stalled, 100).await.expect_err("stalls").code(), "body_too_slow");
        let dripping = futures::stream::unfold((), |()| async {
            tokio::time::sleep(STALL / 2).await;
            Some((Ok::<_, std::io::Error>("."), ()))
        });
        assert_eq!(
            read(Body::from_stream(dripping), 1000).await.expect_err("drips").status(),
            StatusCode::REQUEST_TIMEOUT
        );
        assert_eq!(read(Body::from_stream(begun()), 100).await.expect("is read"), "begun");
    }
}
