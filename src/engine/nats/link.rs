//! The connection, and the three things done over it: store a message, read a subject's newest one, and wait no longer than
//! anyone would.
//!
//! Storing is repeated until it is known whether it worked, so a broken connection or a new leader in the middle leaves no
//! doubt and no second copy. A message carries an id for that: when a repetition is refused because the subject has moved on,
//! the message that moved it on is looked at, and may be our own. (The servers' own memory of ids does not help, because they
//! look at what is expected first.)

use super::address::Address;
use crate::engine::EngineError;
use async_nats::connection::State;
use async_nats::header::{NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, NATS_MESSAGE_ID, NATS_ROLLUP};
use async_nats::jetstream::context::{AccountErrorKind, PublishErrorKind};
use async_nats::jetstream::message::StreamMessage;
use async_nats::jetstream::stream::{LastRawMessageErrorKind, RawMessageError, Stream};
use async_nats::jetstream::{self, Context, ErrorCode};
use async_nats::{Client, ConnectOptions, HeaderMap};
use bytes::Bytes;
use std::time::Duration;
use tokio::sync::watch;
use tracing::{info, warn};
use uuid::Uuid;

/// How long one question may take before it is asked again.
const ANSWER: Duration = Duration::from_millis(1500);
/// Pause between two tries.
const PAUSE: Duration = Duration::from_millis(100);
/// How long one call of the engine may take: longer than servers need to agree on a new leader, short enough for a client.
pub(super) const CALL: Duration = Duration::from_secs(8);
/// How long connecting may take at the start.
const CONNECT: Duration = Duration::from_secs(5);
/// Pauses between two attempts to connect again at most.
const RECONNECT: Duration = Duration::from_millis(500);

/// Servers before this version sync to disk by their own clock whatever they are told, so that what was accepted may be lost
/// with the power.
const OLDEST_SERVER: (i64, i64, i64) = (2, 10, 0);
/// A request may take so many times its bytes once defaults are spelled out and it is written for the cluster.
const SPELLED_OUT: usize = 4;

/// The connection to the servers.
#[derive(Clone)]
pub(super) struct Link {
    pub client: Client,
    pub context: Context,
    /// Counts how often the connection was made; what a consumer had under way over an older one is lost.
    pub connections: watch::Receiver<u64>,
}

/// A message as it is stored.
pub(super) struct Stored {
    /// Its number in the stream.
    pub seq: u64,
    pub payload: Bytes,
}

/// Whether a message was stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Store {
    /// Under this number.
    Done(u64),
    /// The subject's newest message is not the one that was expected: somebody else was faster.
    Conflict,
}

/// What a subject must hold for a message to be stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Expect {
    /// Anything.
    Any,
    /// Nothing.
    Nothing,
    /// This message as the newest.
    Newest(u64),
    /// This message as the newest; everything before the new message is dropped.
    Replace(u64),
}

/// Anything that went wrong on the way, for the log.
pub(super) fn failed(what: &str) -> impl Fn(Box<dyn std::error::Error + Send + Sync>) -> EngineError + '_ {
    move |error| EngineError::Store(format!("{what}: {error}"))
}

/// Gives a call up when it takes too long. What it was about to store may still be stored.
pub(super) async fn patiently<T>(call: impl Future<Output = Result<T, EngineError>>) -> Result<T, EngineError> {
    tokio::time::timeout(CALL, call)
        .await
        .unwrap_or_else(|_| Err(EngineError::Store(format!("no answer from the cluster within {} s", CALL.as_secs()))))
}

impl Link {
    /// Connects, and warns of servers that cannot keep this engine's promises.
    ///
    /// # Errors
    /// When no server is reached, or it has no JetStream.
    pub(super) async fn open(address: &Address, request_bytes: u64) -> Result<Self, EngineError> {
        let (connected, connections) = watch::channel(0u64);
        let mut options = ConnectOptions::new();
        if let Some(file) = &address.credentials {
            options = options.credentials_file(file).await.map_err(|e| failed("credentials")(e.into()))?;
        }
        let options = options
            .name(concat!("shrinkd ", env!("CARGO_PKG_VERSION")))
            .connection_timeout(CONNECT)
            .ping_interval(Duration::from_secs(10))
            .reconnect_delay_callback(|attempts| {
                if attempts == 0 { Duration::ZERO } else { RECONNECT.min(Duration::from_millis(50 * attempts as u64)) }
            })
            .event_callback(move |event| {
                match event {
                    async_nats::Event::Connected => {
                        connected.send_modify(|count| *count += 1);
                        info!("connected to the cluster");
                    }
                    event => warn!(%event, "the connection to the cluster changed"),
                }
                std::future::ready(())
            });
        let client = options
            .connect(&address.servers)
            .await
            .map_err(|e| EngineError::Store(format!("no server at {address}: {e}")))?;
        let context =
            jetstream::context::ContextBuilder::new().timeout(ANSWER).ack_timeout(ANSWER).build(client.clone());
        let account = context.query_account().await;
        account.map_err(|e| {
            let why = match e.kind() {
                AccountErrorKind::JetStreamUnavailable => "has no JetStream (start it with -js)",
                _ => "does not answer, or its servers have not agreed on a leader yet",
            };
            EngineError::Store(format!("{address} {why}: {e}"))
        })?;
        let info = client.server_info();
        if !client.is_server_compatible(OLDEST_SERVER.0, OLDEST_SERVER.1, OLDEST_SERVER.2) {
            warn!(
                nats.version = info.version,
                "this server is too old for `sync_interval: always`: a power cut may lose accepted jobs"
            );
        }
        let advised = usize::try_from(request_bytes).unwrap_or(usize::MAX).saturating_mul(SPELLED_OUT);
        if info.max_payload < advised {
            warn!(
                nats.max_payload_bytes = info.max_payload,
                nats.advised_bytes = advised,
                "large requests will fail: raise max_payload of the server"
            );
        }
        Ok(Self { client, context, connections })
    }

    /// Whether there is a connection now.
    pub(super) fn is_up(&self) -> bool {
        self.client.connection_state() == State::Connected
    }

    /// Stores a message if the subject holds what is expected. Repeats until it is known whether it did.
    ///
    /// # Errors
    /// When it can never be stored, such as when it is too large.
    pub(super) async fn store(
        &self,
        stream: &Stream<()>,
        subject: String,
        payload: Bytes,
        expect: Expect,
    ) -> Result<Store, EngineError> {
        let id = Uuid::now_v7().to_string();
        let mut is_repetition = false;
        loop {
            if let Some(stored) = self.store_once(stream, &subject, &payload, expect, &id, is_repetition).await? {
                return Ok(stored);
            }
            is_repetition = true;
            tokio::time::sleep(PAUSE).await;
        }
    }

    /// One try to store a message under an id, perhaps after others; `None` when nobody knows what became of it.
    pub(super) async fn store_once(
        &self,
        stream: &Stream<()>,
        subject: &str,
        payload: &Bytes,
        expect: Expect,
        id: &str,
        is_repetition: bool,
    ) -> Result<Option<Store>, EngineError> {
        let mut headers = HeaderMap::new();
        headers.insert(NATS_MESSAGE_ID, id);
        let newest = match expect {
            Expect::Any => None,
            Expect::Nothing => Some(0),
            Expect::Newest(seq) | Expect::Replace(seq) => Some(seq),
        };
        if let Some(newest) = newest {
            headers.insert(NATS_EXPECTED_LAST_SUBJECT_SEQUENCE, newest.to_string());
        }
        if matches!(expect, Expect::Replace(_)) {
            headers.insert(NATS_ROLLUP, "sub");
        }
        let sent = self.context.publish_with_headers(subject.to_owned(), headers, payload.clone()).await;
        let acknowledged = match sent {
            Ok(acknowledgement) => acknowledgement.await,
            Err(error) => Err(error),
        };
        let error = match acknowledged {
            Ok(acknowledgement) => return Ok(Some(Store::Done(acknowledgement.sequence))),
            Err(error) => error,
        };
        let is_conflict = match error.kind() {
            PublishErrorKind::WrongLastSequence => true,
            PublishErrorKind::TimedOut | PublishErrorKind::StreamNotFound | PublishErrorKind::BrokenPipe => false,
            PublishErrorKind::Other => match server_error(&error) {
                Some(refusal) if refusal.error_code() == ErrorCode::STREAM_WRONG_LAST_SEQUENCE_CONSTANT => true,
                // the stream has no leader at the moment, or the disk is full or slow
                Some(refusal) if refusal.code() < 500 => return Err(failed("a message was refused")(error.into())),
                _ => false,
            },
            _ => return Err(failed("a message was refused")(error.into())),
        };
        if !is_conflict {
            return Ok(None);
        }
        if is_repetition {
            // what was expected to be the newest was followed by exactly one message: an earlier try of this one, or another
            let next = newest.unwrap_or(0) + 1;
            let follower = ask(|| stream.get_first_raw_message_by_subject(subject, next)).await?;
            if let Some(follower) = follower
                && follower.headers.get(NATS_MESSAGE_ID).is_some_and(|found| found.as_str() == id)
            {
                return Ok(Some(Store::Done(follower.sequence)));
            }
        }
        Ok(Some(Store::Conflict))
    }

    /// The newest message of a subject, as the stream's leader has it: what was stored before is seen, whoever stored it.
    pub(super) async fn newest(&self, stream: &Stream<()>, subject: &str) -> Result<Option<Stored>, EngineError> {
        let message = ask(|| stream.get_last_raw_message_by_subject(subject)).await?;
        Ok(message.map(|message| Stored { seq: message.sequence, payload: message.payload }))
    }
}

/// Asks a stream's leader for a message until there is an answer; `None` when there is no such message.
async fn ask<F>(question: impl Fn() -> F) -> Result<Option<StreamMessage>, EngineError>
where
    F: Future<Output = Result<StreamMessage, RawMessageError>>,
{
    loop {
        let error = match question().await {
            Ok(message) => return Ok(Some(message)),
            Err(error) => error,
        };
        match error.kind() {
            LastRawMessageErrorKind::NoMessageFound => return Ok(None),
            // no leader, no answer, no connection
            LastRawMessageErrorKind::Other => {}
            LastRawMessageErrorKind::JetStream(refusal) if refusal.code() >= 500 => {}
            _ => return Err(failed("a message cannot be read")(error.into())),
        }
        tokio::time::sleep(PAUSE).await;
    }
}

/// The server's own error behind an error, where it gave one.
fn server_error<'a>(error: &'a (dyn std::error::Error + 'static)) -> Option<&'a jetstream::Error> {
    std::iter::successors(Some(error), |error| error.source()).find_map(|error| error.downcast_ref())
}
