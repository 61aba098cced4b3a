//! The one thread that writes, and the hub that tells what was written.

use super::records::Ctx;
use crate::engine::EngineError;
use crate::job::{Event, JobId};
use crate::tenant::Tenant;
use jiff::Timestamp;
use rusqlite::{Connection, TransactionBehavior};
use std::collections::HashMap;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use tokio::sync::{broadcast, oneshot};

/// Pieces of work that share one commit at most: one sync of the disk for all of them.
const GROUP: usize = 64;
/// Pieces that may wait before writers are held back.
const BACKLOG: usize = 1024;
/// Events a slow reader may fall behind before it must ask the engine again.
const LIVE_EVENTS: usize = 64;

/// Fewest senders that are worth looking through for those that nobody listens to.
const FEWEST_TO_PRUNE: usize = 256;

/// Who listens to which job. Listeners are kept by tenant and job, so that nobody hears of another tenant's.
#[derive(Default)]
pub(in crate::engine) struct Hub(Mutex<Listeners>);

#[derive(Default)]
struct Listeners {
    senders: HashMap<(Tenant, JobId), broadcast::Sender<Arc<Event>>>,
    /// Number of senders at which the silent ones are dropped; doubles with those in use, so that subscribing stays cheap.
    prune_at: usize,
}

impl Hub {
    pub(in crate::engine) fn subscribe(&self, tenant: &Tenant, id: JobId) -> broadcast::Receiver<Arc<Event>> {
        let mut hub = self.0.lock().unwrap_or_else(|e| e.into_inner());
        if hub.senders.len() >= hub.prune_at {
            hub.senders.retain(|_, sender| sender.receiver_count() > 0);
            hub.prune_at = FEWEST_TO_PRUNE.max(2 * hub.senders.len());
        }
        hub.senders.entry((tenant.clone(), id)).or_insert_with(|| broadcast::channel(LIVE_EVENTS).0).subscribe()
    }

    fn publish(&self, events: Vec<(Tenant, JobId, Arc<Event>)>) {
        let mut hub = self.0.lock().unwrap_or_else(|e| e.into_inner());
        for (tenant, id, event) in events {
            let job = (tenant, id);
            // sending fails when nobody listens any more
            if hub.senders.get(&job).is_some_and(|sender| sender.send(event).is_err()) {
                hub.senders.remove(&job);
            }
        }
    }
}

/// Runs inside the transaction; what it returns is called after the commit.
type Piece = Box<dyn FnOnce(&mut Ctx<'_>) -> Reply + Send>;
type Reply = Box<dyn FnOnce(Result<(), String>) + Send>;

/// Handle on the writing thread, which ends when the handle is dropped.
pub(in crate::engine) struct Writer {
    pieces: Option<SyncSender<Piece>>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Writer {
    pub(in crate::engine) fn start(connection: Connection, hub: Arc<Hub>) -> Result<Self, EngineError> {
        let (pieces, queue) = sync_channel(BACKLOG);
        let thread = std::thread::Builder::new()
            .name("engine-writer".to_owned())
            .spawn(move || write_all(connection, &queue, &hub))
            .map_err(|e| EngineError::Store(e.to_string()))?;
        Ok(Self { pieces: Some(pieces), thread: Some(thread) })
    }

    /// Runs `work` in a transaction and returns when it is on the disk.
    pub(in crate::engine) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Ctx<'_>) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, EngineError> {
        let (answer, answered) = oneshot::channel();
        let piece: Piece = Box::new(move |ctx| {
            let result = in_savepoint(ctx, work);
            Box::new(move |commit| {
                let result = match (result, commit) {
                    (Ok(value), Ok(())) => Ok(value),
                    (Err(error), _) => Err(EngineError::from(error)),
                    (Ok(_), Err(error)) => Err(EngineError::Store(error)),
                };
                // the asker may have gone away meanwhile
                let _ = answer.send(result);
            })
        });
        let pieces = self.pieces.clone().ok_or(EngineError::Stopped)?;
        // only a full backlog costs a trip to the blocking threads
        if let Err(error) = pieces.try_send(piece) {
            match error {
                std::sync::mpsc::TrySendError::Full(piece) => {
                    let sent = tokio::task::spawn_blocking(move || pieces.send(piece)).await;
                    sent.ok().and_then(Result::ok).ok_or(EngineError::Stopped)?;
                }
                std::sync::mpsc::TrySendError::Disconnected(_) => return Err(EngineError::Stopped),
            }
        }
        answered.await.map_err(|_| EngineError::Stopped)?
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.pieces = None;
        if let Some(thread) = self.thread.take() {
            // it panicked, and has said so
            let _ = thread.join();
        }
    }
}

/// Runs `work` in a transaction of its own, on the calling thread.
pub(super) fn once<T>(
    connection: &mut Connection,
    hub: &Hub,
    work: impl FnOnce(&mut Ctx<'_>) -> rusqlite::Result<T>,
) -> Result<T, EngineError> {
    let tx = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let mut events = Vec::new();
    let result = work(&mut Ctx { connection: &tx, now: Timestamp::now().as_millisecond(), events: &mut events })?;
    tx.commit()?;
    hub.publish(events);
    Ok(result)
}

fn write_all(mut connection: Connection, queue: &Receiver<Piece>, hub: &Hub) {
    while let Ok(first) = queue.recv() {
        let mut events = Vec::new();
        let mut replies = Vec::new();
        let committed = (|| -> rusqlite::Result<()> {
            let tx = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
            let mut next = Some(first);
            while let Some(piece) = next {
                let now = Timestamp::now().as_millisecond();
                replies.push(piece(&mut Ctx { connection: &tx, now, events: &mut events }));
                next = if replies.len() < GROUP { queue.try_recv().ok() } else { None };
            }
            tx.commit()
        })();
        if let Err(error) = &committed {
            tracing::error!(%error, "a commit failed");
        } else {
            // told only now: nobody hears of what might still be lost
            hub.publish(events);
        }
        for reply in replies {
            reply(committed.as_ref().map(|_| ()).map_err(ToString::to_string));
        }
    }
}

/// Undoes a piece that fails without undoing its neighbours in the group.
fn in_savepoint<T>(ctx: &mut Ctx<'_>, work: impl FnOnce(&mut Ctx<'_>) -> rusqlite::Result<T>) -> rusqlite::Result<T> {
    let told = ctx.events.len();
    ctx.connection.execute_batch("SAVEPOINT piece")?;
    let result = work(ctx);
    if result.is_err() {
        ctx.events.truncate(told);
        ctx.connection.execute_batch("ROLLBACK TO piece")?;
    }
    ctx.connection.execute_batch("RELEASE piece")?;
    result
}
