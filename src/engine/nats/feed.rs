//! The one consumer of a node: brings every job's entries, the newest of each first and then as they are stored, into the
//! projection.
//!
//! The consumer is made anew from the last entry that came whenever anything is odd: a new connection, a heartbeat that is
//! missing, a number that is left out. Entries that come twice do no harm.

use super::layout::{Layout, Name};
use super::ledger::Ledger;
use super::link::{CALL, failed};
use super::record::Entry;
use crate::engine::EngineError;
use crate::job::Event;
use async_nats::jetstream::Message;
use async_nats::jetstream::consumer::{AckPolicy, DeliverPolicy, pull};
use futures::StreamExt;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tracing::{error, warn};

/// How often the server says that there is nothing new; twice as long without a word is an interruption.
const HEARTBEAT: Duration = Duration::from_secs(2);
/// How long one request for entries stands.
const REQUEST: Duration = Duration::from_secs(30);
/// Time after which the server drops a consumer that nobody reads.
const ABANDONED: Duration = Duration::from_secs(30);
/// Pause before a consumer is made again.
const PAUSE: Duration = Duration::from_millis(200);
/// Entries that are projected together.
const TOGETHER: usize = 64;

/// How far the feed has come.
#[derive(Clone, Copy, Default)]
struct Position {
    /// Number of the last entry that came.
    seq: u64,
    /// Whether everything that was there at the start has come.
    caught_up: bool,
}

/// Handle on the feed, which ends when the handle is dropped.
pub(super) struct Feed {
    position: watch::Receiver<Position>,
    task: tokio::task::JoinHandle<()>,
}

impl Feed {
    /// Starts the feed and waits until everything that is stored now is in the projection.
    pub(super) async fn start(ledger: Arc<Ledger>) -> Result<Self, EngineError> {
        let (sender, mut position) = watch::channel(Position::default());
        let task = tokio::spawn(run(ledger, sender));
        let feed = Self { position: position.clone(), task };
        while !position.borrow_and_update().caught_up {
            let moved = tokio::time::timeout(CALL, position.changed()).await;
            moved
                .map_err(|_| EngineError::Store("the records do not come".to_owned()))?
                .map_err(|_| EngineError::Stopped)?;
        }
        Ok(feed)
    }

    /// Number of the last entry that came.
    pub(super) fn position(&self) -> u64 {
        self.position.borrow().seq
    }

    /// Whether every entry up to this one is in the projection, after a wait of at most `patience`.
    pub(super) async fn reaches(&self, seq: u64, patience: Duration) -> bool {
        let mut position = self.position.clone();
        tokio::time::timeout(patience, position.wait_for(|position| position.seq >= seq)).await.is_ok_and(|r| r.is_ok())
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn run(ledger: Arc<Ledger>, position: watch::Sender<Position>) {
    loop {
        if let Err(error) = follow(&ledger, &position).await {
            warn!(%error, "the feed of jobs was interrupted and goes on");
        }
        tokio::time::sleep(PAUSE).await;
    }
}

async fn follow(ledger: &Ledger, position: &watch::Sender<Position>) -> Result<(), EngineError> {
    let mut connections = ledger.link.connections.clone();
    connections.mark_unchanged();
    let seq = position.borrow().seq;
    let config = pull::Config {
        deliver_policy: match seq {
            0 => DeliverPolicy::LastPerSubject,
            _ => DeliverPolicy::ByStartSequence { start_sequence: seq + 1 },
        },
        ..passing(ledger.layout.every_job())
    };
    let consumer = ledger.layout.jobs.create_consumer(config).await.map_err(|e| failed("the feed")(e.into()))?;
    if consumer.cached_info().num_pending == 0 {
        position.send_modify(|position| position.caught_up = true);
    }
    let messages = consumer.stream().heartbeat(HEARTBEAT).expires(REQUEST).messages().await;
    let mut messages = messages.map_err(|e| failed("the feed")(e.into()))?.ready_chunks(TOGETHER);
    let mut delivered = 0;
    loop {
        let chunk = tokio::select! {
            chunk = messages.next() => chunk,
            // the consumer may be gone with the server that had it
            _ = connections.changed() => return Ok(()),
        };
        let Some(chunk) = chunk else { return Ok(()) };
        let (mut entries, mut last, mut caught_up) = (Vec::new(), None, false);
        let mut interruption = Ok(());
        for message in chunk {
            let message = match message.map_err(|e| failed("the feed")(e.into())) {
                Ok(message) => message,
                Err(error) => {
                    interruption = Err(error);
                    break;
                }
            };
            let info = message.info().map_err(failed("the feed"))?;
            delivered += 1;
            if info.consumer_sequence != delivered {
                interruption = Err(EngineError::Store("an entry was left out".to_owned()));
                break;
            }
            last = Some(info.stream_sequence);
            caught_up |= info.pending == 0;
            entries.extend(read(&message, info.stream_sequence));
        }
        ledger.projection.apply(entries).await?;
        if let Some(last) = last {
            position.send_modify(|position| {
                position.seq = position.seq.max(last);
                position.caught_up |= caught_up;
            });
        }
        interruption?;
    }
}

fn read(message: &Message, seq: u64) -> Option<(u64, Name, Entry)> {
    let name = Layout::name_of(&message.subject)?;
    match Entry::read(&message.payload) {
        Ok(entry) => Some((seq, name, entry)),
        // stored by another version that knew more
        Err(error) => {
            error!(job.id = %name.id, nats.seq = seq, %error, "an entry cannot be read");
            None
        }
    }
}

/// A consumer that is read once from the beginning, or followed, and then left.
pub(super) fn passing(filter_subject: String) -> pull::Config {
    pull::Config {
        filter_subject,
        deliver_policy: DeliverPolicy::All,
        ack_policy: AckPolicy::None,
        // nothing is lost with it that could not be asked for again
        memory_storage: true,
        num_replicas: 1,
        inactive_threshold: ABANDONED,
        ..pull::Config::default()
    }
}

/// All events that a job's subject holds, and the number of the newest entry among them. Needed once for a job that began
/// before this node did, and only when somebody asks.
pub(super) async fn history(ledger: &Ledger, name: &Name) -> Result<(Vec<Event>, u64), EngineError> {
    let what = "the events of a job";
    let consumer = ledger.layout.jobs.create_consumer(passing(ledger.layout.job(name))).await;
    let consumer = consumer.map_err(|e| failed(what)(e.into()))?;
    let info = consumer.cached_info();
    let (name, stored) = (info.name.clone(), info.num_pending as usize);
    let (mut events, mut newest) = (Vec::new(), 0);
    if stored > 0 {
        let batch = consumer.fetch().max_messages(stored).messages().await;
        let mut batch = batch.map_err(|e| failed(what)(e.into()))?;
        while let Some(message) = batch.next().await {
            let message = message.map_err(failed(what))?;
            let seq = message.info().map_err(failed(what))?.stream_sequence;
            if let Some((_, _, Entry::Changed { told, .. })) = read(&message, seq) {
                events.extend(told);
                newest = seq;
            }
        }
    }
    if let Err(error) = ledger.layout.jobs.delete_consumer(&name).await {
        // the server drops it by itself after a while
        warn!(%error, "a consumer could not be deleted");
    }
    Ok((events, newest))
}
