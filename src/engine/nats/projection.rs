//! What this node knows of every job: the tables of the embedded engine, in a file that is made anew at every start.
//!
//! Lists, events and live readers are served from here, so that no client costs the servers a consumer of its own. Entries
//! come in by two ways: from the [feed](super::feed), which brings everybody's, and at once from what this node stored
//! itself. Both ways carry the entry's number in the stream, and an older entry never replaces a newer one.
//!
//! Guarantees: what this node stored or read is in the projection when the call that did it returns; the events kept of a
//! job have no gap. Not guaranteed: that what another node stored is here already. Whatever must not miss that is asked of
//! the stream.

use super::layout::Name;
use super::ledger::Version;
use super::record::{Entry, Record};
use crate::engine::sqlite::records::{self, Ctx, KEPT_EVENTS};
use crate::engine::sqlite::writer::{Hub, Writer};
use crate::engine::sqlite::{Readers, notices, schema, shares};
use crate::engine::{Counts, EngineError, EventPage, ListQuery, NewJob, Page, Submitted, Terms};
use crate::job::{Event, JobId, State};
use crate::tenant::Tenant;
use jiff::Timestamp;
use rusqlite::{Connection, OptionalExtension, params};
use std::collections::HashMap;
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};
use tokio::sync::{Notify, broadcast};

/// Which entry of a job is projected, and whether its events go back as far as the stream's do.
const TABLE: &str = "
    CREATE TABLE projected (
        job          TEXT PRIMARY KEY,
        tenant       TEXT NOT NULL,
        seq          INTEGER NOT NULL,
        whole        INTEGER NOT NULL,
        forgotten_at INTEGER
    ) STRICT, WITHOUT ROWID;
";

/// A job that has not ended, as it was last seen.
#[derive(Clone)]
pub(super) struct Seen {
    pub version: Version,
    /// When this node saw that entry, by its own clock that never jumps.
    pub at: Instant,
}

type Open = Arc<Mutex<HashMap<JobId, Seen>>>;

/// The node's own view.
pub(super) struct Projection {
    writer: Writer,
    readers: Readers,
    hub: Arc<Hub>,
    open: Open,
    /// Told when a job came that waits.
    pub queued: Notify,
    _lock: File,
}

impl Projection {
    /// Begins an empty one in a folder, which nodes may share.
    pub(super) fn open(folder: &Path) -> Result<Self, EngineError> {
        let (path, lock) = free_file(folder).map_err(|e| EngineError::Store(format!("{}: {e}", folder.display())))?;
        let mut connection = connect(&path)?;
        schema::migrate(&mut connection)?;
        connection.execute_batch(TABLE)?;
        let hub = Arc::new(Hub::default());
        let writer = Writer::start(connection, hub.clone())?;
        let (readers, queued) = (Readers::new(path, connect), Notify::new());
        Ok(Self { writer, readers, hub, open: Open::default(), queued, _lock: lock })
    }

    /// Takes entries in, with their numbers in the stream.
    pub(super) async fn apply(&self, entries: Vec<(u64, Name, Entry)>) -> Result<(), EngineError> {
        let open = self.open.clone();
        let is_queued =
            |entry: &Entry| matches!(entry, Entry::Changed { record, .. } if record.job.state == State::Queued);
        let queued = entries.iter().any(|(_, _, entry)| is_queued(entry));
        let applied = self.writer.run(move |ctx| {
            for (seq, name, entry) in entries {
                apply(ctx, &open, seq, name, entry)?;
            }
            Ok(())
        });
        applied.await?;
        if queued {
            self.queued.notify_waiters();
        }
        Ok(())
    }

    /// The jobs whose turn it is, at most `slots`.
    pub(super) async fn next(&self, slots: usize, terms: &Terms) -> Result<Vec<Name>, EngineError> {
        let terms = terms.clone();
        let turns = self.readers.run(move |c| shares::next(c, slots, &terms)).await?;
        Ok(turns.into_iter().map(|(tenant, id)| Name { tenant, id }).collect())
    }

    /// Why there is no room for a job, as far as this node knows; `None` when there is.
    pub(super) async fn refuse(&self, new: NewJob, terms: &Terms) -> Result<Option<Submitted>, EngineError> {
        let terms = terms.clone();
        self.readers.run(move |c| shares::refuse(c, Timestamp::now().as_millisecond(), &new, &terms)).await
    }

    /// Drops a job that is nowhere else, because somebody has removed its messages.
    pub(super) async fn drop_removed(&self, id: JobId) -> Result<(), EngineError> {
        self.lock_open().remove(&id);
        let dropped = self.writer.run(move |ctx| {
            ctx.connection.execute("DELETE FROM jobs WHERE id = ?1", [id.to_string()])?;
            ctx.connection.execute("DELETE FROM projected WHERE job = ?1", [id.to_string()]).map(|_| ())
        });
        dropped.await
    }

    /// A job that has not ended, as it was last seen.
    pub(super) fn seen(&self, id: JobId) -> Option<Version> {
        self.lock_open().get(&id).map(|seen| seen.version.clone())
    }

    /// The jobs that have not ended and are as `wanted`.
    pub(super) fn open_jobs(&self, wanted: impl Fn(&Seen) -> bool) -> Vec<Seen> {
        self.lock_open().values().filter(|seen| wanted(seen)).cloned().collect()
    }

    /// Takes every job for seen now, because nothing could be seen for a while.
    pub(super) fn forgive(&self) {
        let now = Instant::now();
        self.lock_open().values_mut().for_each(|seen| seen.at = now);
    }

    pub(super) fn subscribe(&self, tenant: &Tenant, id: JobId) -> broadcast::Receiver<Arc<Event>> {
        self.hub.subscribe(tenant, id)
    }

    /// How many jobs there are of each kind in each state that is no end, and when the oldest queued one was accepted.
    pub(super) async fn depth(&self) -> Result<(Counts, Option<Timestamp>), EngineError> {
        self.readers.run(records::depth).await
    }

    pub(super) async fn list(&self, tenant: &Tenant, query: ListQuery) -> Result<Page, EngineError> {
        let tenant = tenant.clone();
        self.readers.run(move |c| records::list(c, &tenant, &query)).await
    }

    /// A page of events, and whether the job's events go back as far as the stream's; `None` when the job is not here.
    pub(super) async fn events_after(
        &self,
        name: &Name,
        after: u64,
        limit: usize,
    ) -> Result<Option<(EventPage, bool)>, EngineError> {
        let Name { tenant, id } = name.clone();
        self.readers
            .run(move |c| {
                let Some(page) = records::events_after(c, &tenant, id, after, limit)? else { return Ok(None) };
                let whole = "SELECT whole FROM projected WHERE job = ?1";
                let whole = c.prepare_cached(whole)?.query_row([id.to_string()], |row| row.get(0))?;
                Ok(Some((page, whole)))
            })
            .await
    }

    /// Adds the events that a job had before this node heard of it: all that its subject held up to entry `seq`.
    pub(super) async fn complete(&self, id: JobId, events: Vec<Event>, seq: u64) -> Result<(), EngineError> {
        self.writer.run(move |ctx| complete(ctx, id, &events, seq)).await
    }

    /// Those of the hashes that no job names, of `whose` where that is given; jobs that ended before `expired` do not count.
    pub(super) async fn unnamed(
        &self,
        whose: Option<&Tenant>,
        hashes: Vec<String>,
        expired: Option<Timestamp>,
    ) -> Result<Vec<String>, EngineError> {
        let whose = whose.cloned();
        self.readers.run(move |c| records::unnamed(c, whose.as_ref(), hashes, expired)).await
    }

    /// Jobs that were forgotten before then.
    pub(super) async fn forgotten_before(&self, then: Timestamp) -> Result<Vec<Name>, EngineError> {
        self.names("SELECT tenant, job FROM projected WHERE forgotten_at < ?1", then).await
    }

    /// Drops the memory of forgotten jobs.
    pub(super) async fn drop_forgotten(&self, ids: Vec<JobId>) -> Result<(), EngineError> {
        let dropped = self.writer.run(move |ctx| {
            let text = "DELETE FROM projected WHERE job = ?1 AND forgotten_at IS NOT NULL";
            ids.iter().try_for_each(|id| ctx.connection.execute(text, [id.to_string()]).map(|_| ()))
        });
        dropped.await
    }

    /// Whether the job is here, forgotten or not.
    pub(super) async fn knows(&self, id: JobId) -> Result<bool, EngineError> {
        self.readers
            .run(move |c| c.prepare_cached("SELECT 1 FROM projected WHERE job = ?1")?.exists([id.to_string()]))
            .await
    }

    /// Jobs whose end is due to be told, the one that waits longest first.
    pub(super) async fn due_notices(&self, now: Timestamp, limit: usize) -> Result<Vec<Name>, EngineError> {
        let due = self.readers.run(move |c| notices::due(c, now.as_millisecond(), limit)).await?;
        Ok(due.into_iter().map(|(tenant, id)| Name { tenant, id }).collect())
    }

    /// Jobs that ended before then.
    pub(super) async fn ended_before(&self, then: Timestamp) -> Result<Vec<Name>, EngineError> {
        self.names("SELECT tenant, id FROM jobs WHERE finished_at < ?1", then).await
    }

    /// Drops the events of jobs that ended before then; a reader who asks for them after all gets them from the stream.
    pub(super) async fn drop_events_before(&self, then: Timestamp) -> Result<(), EngineError> {
        let dropped = self.writer.run(move |ctx| {
            let old = "SELECT DISTINCT job FROM events JOIN jobs ON id = job WHERE finished_at < ?1";
            let then = then.as_millisecond();
            ctx.connection.execute(&format!("UPDATE projected SET whole = 0 WHERE job IN ({old})"), [then])?;
            ctx.connection.execute(&format!("DELETE FROM events WHERE job IN ({old})"), [then])?;
            shares::drop_old(ctx.connection, ctx.now)
        });
        dropped.await
    }

    async fn names(&self, query: &'static str, then: Timestamp) -> Result<Vec<Name>, EngineError> {
        let names = self.readers.run(move |c| {
            let mut statement = c.prepare_cached(query)?;
            let rows = statement
                .query_map([then.as_millisecond()], |row| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?)))?;
            rows.map(|row| {
                let (tenant, id) = row?;
                let tenant = tenant.parse().map_err(records::corrupt)?;
                Ok(Name { tenant, id: id.parse().map_err(records::corrupt)? })
            })
            .collect()
        });
        names.await
    }

    fn lock_open(&self) -> MutexGuard<'_, HashMap<JobId, Seen>> {
        self.open.lock().unwrap_or_else(|e| e.into_inner())
    }
}

/// The first file of the folder that no process has, emptied. What a dead process left is used again and never piles up.
fn free_file(folder: &Path) -> std::io::Result<(PathBuf, File)> {
    std::fs::create_dir_all(folder)?;
    for i in 0.. {
        let lock = File::create(folder.join(format!("projection-{i}.lock")))?;
        match lock.try_lock() {
            Ok(()) => {
                let path = folder.join(format!("projection-{i}.sqlite3"));
                for suffix in ["", "-wal", "-shm"] {
                    match std::fs::remove_file(format!("{}{suffix}", path.display())) {
                        Err(error) if error.kind() != std::io::ErrorKind::NotFound => return Err(error),
                        _ => {}
                    }
                }
                return Ok((path, lock));
            }
            Err(TryLockError::WouldBlock) => {}
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
    unreachable!("some number is free")
}

/// Nothing here must survive anything: the streams do.
fn connect(path: &Path) -> Result<Connection, EngineError> {
    let connection = Connection::open(path)?;
    connection.pragma_update(None, "journal_mode", "WAL")?;
    connection.pragma_update(None, "synchronous", "OFF")?;
    connection.pragma_update(None, "foreign_keys", "ON")?;
    connection.busy_timeout(Duration::from_secs(5))?;
    Ok(connection)
}

fn apply(ctx: &mut Ctx<'_>, open: &Open, seq: u64, name: Name, entry: Entry) -> rusqlite::Result<()> {
    let Name { tenant, id } = name;
    let text_id = id.to_string();
    let projected = "SELECT seq FROM projected WHERE job = ?1";
    let projected: Option<u64> =
        ctx.connection.prepare_cached(projected)?.query_row([&text_id], |row| row.get(0)).optional()?;
    if projected.is_some_and(|projected| projected >= seq) {
        return Ok(());
    }
    let mut open = open.lock().unwrap_or_else(|e| e.into_inner());
    match entry {
        Entry::Forgotten { at, accepted_at, cost } => {
            open.remove(&id);
            shares::note(ctx.connection, &tenant, id, accepted_at.map_or(0, Timestamp::as_millisecond), cost)?;
            ctx.connection.execute("DELETE FROM jobs WHERE id = ?1", [&text_id])?;
            note(ctx, &tenant, &text_id, seq, true, Some(at))
        }
        Entry::Changed { record, told } => {
            let newest = "SELECT last_seq FROM jobs WHERE id = ?1";
            let newest: Option<u64> =
                ctx.connection.prepare_cached(newest)?.query_row([&text_id], |row| row.get(0)).optional()?;
            let before = record.last_seq - told.len() as u64;
            shares::note(ctx.connection, &tenant, id, record.job.created_at.as_millisecond(), record.cost)?;
            upsert(ctx, &text_id, &record, newest.is_none())?;
            match newest {
                Some(newest) if newest == before => {
                    ctx.connection
                        .prepare_cached("UPDATE projected SET seq = ?2 WHERE job = ?1")?
                        .execute(params![text_id, seq])?;
                }
                // entries in between were missed, so what was kept has no connection to what comes now
                _ => {
                    ctx.connection.prepare_cached("DELETE FROM events WHERE job = ?1")?.execute([&text_id])?;
                    note(ctx, &tenant, &text_id, seq, before == 0, None)?;
                }
            }
            for event in &told {
                insert_event(ctx, &text_id, event)?;
            }
            if record.last_seq > KEPT_EVENTS {
                let old = "DELETE FROM events WHERE job = ?1 AND seq <= ?2";
                ctx.connection.prepare_cached(old)?.execute(params![text_id, record.last_seq - KEPT_EVENTS])?;
            }
            if record.job.state.ended() {
                open.remove(&id);
            } else {
                let version = Version { seq, record: Arc::from(record) };
                open.insert(id, Seen { version, at: Instant::now() });
            }
            ctx.events.extend(told.into_iter().map(|event| (tenant.clone(), id, Arc::new(event))));
            Ok(())
        }
    }
}

fn note(
    ctx: &Ctx<'_>,
    tenant: &Tenant,
    id: &str,
    seq: u64,
    whole: bool,
    forgotten: Option<Timestamp>,
) -> rusqlite::Result<()> {
    let text = "INSERT OR REPLACE INTO projected (tenant, job, seq, whole, forgotten_at) VALUES (?1, ?2, ?3, ?4, ?5)";
    let forgotten = forgotten.map(|at| at.as_millisecond());
    ctx.connection.prepare_cached(text)?.execute(params![tenant.name(), id, seq, whole, forgotten]).map(|_| ())
}

fn insert_event(ctx: &Ctx<'_>, id: &str, event: &Event) -> rusqlite::Result<()> {
    let text = "INSERT OR IGNORE INTO events (job, seq, kind, at, data) VALUES (?1, ?2, ?3, ?4, ?5)";
    let data = records::to_json(&event.data)?;
    let row = params![id, event.seq, event.kind.name(), event.at.as_millisecond(), data];
    ctx.connection.prepare_cached(text)?.execute(row).map(|_| ())
}

fn upsert(ctx: &Ctx<'_>, id: &str, record: &Record, is_new: bool) -> rusqlite::Result<()> {
    let job = &record.job;
    let settings = match (&job.shrink, &job.fit, &job.of) {
        (Some(shrink), _, _) => records::to_json(shrink)?,
        (_, Some(fit), _) => records::to_json(fit)?,
        (_, _, of) => records::to_json(of)?,
    };
    // the request is read from its stream, when somebody wants it
    let text = "INSERT INTO jobs (id, state, attempt, revision, last_seq, created_at, started_at, finished_at, spec, labels, kind,
                    settings, progress, metrics, outputs, problem, tenant)
                VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, '', ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16)
                ON CONFLICT (id) DO UPDATE SET state = ?2, attempt = ?3, revision = ?4, last_seq = ?5, started_at = ?7,
                    finished_at = ?8, progress = ?12, metrics = ?13, outputs = ?14, problem = ?15";
    ctx.connection.prepare_cached(text)?.execute(params![
        id,
        job.state.name(),
        job.attempt,
        job.revision,
        record.last_seq,
        job.created_at.as_millisecond(),
        job.started_at.map(Timestamp::as_millisecond),
        job.finished_at.map(Timestamp::as_millisecond),
        records::to_json(&job.labels)?,
        job.kind.name(),
        settings,
        job.progress.as_ref().map(records::to_json).transpose()?,
        job.metrics.as_ref().map(records::to_json).transpose()?,
        records::to_json(&job.outputs)?,
        job.problem.as_ref().map(records::to_json).transpose()?,
        record.tenant.name(),
    ])?;
    project_notice(ctx, id, record)?;
    // what the other tables beside hold changes only at the ends of a life
    if !is_new && !job.state.ended() {
        return Ok(());
    }
    for (name, value) in &job.labels {
        let text = "INSERT OR IGNORE INTO labels (tenant, job, name, value) VALUES (?1, ?2, ?3, ?4)";
        ctx.connection.prepare_cached(text)?.execute(params![record.tenant.name(), id, name, value])?;
    }
    let outputs = job.outputs.iter().map(|output| (&output.name, &output.sha256));
    for (name, hash) in outputs.chain(record.held.iter().map(|(name, hash)| (name, hash))) {
        let text = "INSERT OR IGNORE INTO outputs (job, name, sha256) VALUES (?1, ?2, ?3)";
        ctx.connection.prepare_cached(text)?.execute(params![id, name, hash])?;
    }
    Ok(())
}

fn project_notice(ctx: &Ctx<'_>, id: &str, record: &Record) -> rusqlite::Result<()> {
    let due = record.notice.as_ref().and_then(|notice| Some((notice, notice.due_ms?)));
    match due {
        Some((notice, due)) => {
            let text = "INSERT OR REPLACE INTO notices (job, url, attempts, due_at) VALUES (?1, ?2, ?3, ?4)";
            ctx.connection.prepare_cached(text)?.execute(params![id, notice.url, notice.attempts, due])?;
        }
        None if record.job.state.ended() => {
            ctx.connection.prepare_cached("DELETE FROM notices WHERE job = ?1")?.execute([id])?;
        }
        None => {}
    }
    Ok(())
}

fn complete(ctx: &mut Ctx<'_>, id: JobId, events: &[Event], seq: u64) -> rusqlite::Result<()> {
    let text_id = id.to_string();
    let projected = "SELECT seq, (SELECT MIN(seq) FROM events WHERE job = ?1), last_seq
                     FROM projected JOIN jobs ON id = job WHERE job = ?1";
    let row =
        |row: &rusqlite::Row<'_>| Ok((row.get::<_, u64>(0)?, row.get::<_, Option<u64>>(1)?, row.get::<_, u64>(2)?));
    let Some((projected, oldest, newest)) = ctx.connection.query_row(projected, [&text_id], row).optional()? else {
        return Ok(());
    };
    let reached = events.last().map_or(0, |event| event.seq);
    // something newer was projected without what lies between: the next look gets it
    if projected > seq && reached + 1 < oldest.unwrap_or(newest + 1) {
        return Ok(());
    }
    for event in events.iter().filter(|event| event.seq <= newest && event.seq + KEPT_EVENTS > newest) {
        insert_event(ctx, &text_id, event)?;
    }
    ctx.connection.execute("UPDATE projected SET whole = 1 WHERE job = ?1", [&text_id]).map(|_| ())
}
