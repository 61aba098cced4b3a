//! The embedded engine: SQLite in a folder, for one process.
//!
//! WAL with `synchronous=FULL`: a commit is on the disk before anyone hears of it. One thread writes; what is waiting when it
//! begins is committed together, so that many submits share one sync. Readers have connections of their own and never
//! wait for the writer. A lock file keeps a second process out, so every claim found at the start belongs to a dead worker.

pub(super) mod notices;
mod readers;
pub(super) mod records;
pub(super) mod schema;
pub(super) mod shares;
pub(super) mod writer;

pub(super) use readers::Readers;

use super::{
    Changes, Claim, Depth, DueNotice, Engine, EngineError, EventPage, Forgotten, IdempotencyKey, ListQuery, NewJob,
    Outcome, Page, Renewal, Submitted, Terms, Update,
};
use crate::job::{Failure, Job, JobId, JobSpec, State};
use crate::telemetry::metrics;
use crate::tenant::Tenant;
use jiff::Timestamp;
use records::{Change, Ctx};
use rusqlite::{Connection, OptionalExtension, params};
use std::fs::{File, TryLockError};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::Notify;
use writer::{Hub, Writer};

/// How long an idempotency key is kept.
const KEY_LIFETIME_MS: i64 = 24 * 60 * 60 * 1000;
/// How often a worker that waits for a job looks for leases that ran out.
const SWEEP: Duration = Duration::from_secs(1);

/// The embedded engine.
pub struct SqliteEngine {
    writer: Writer,
    readers: Readers,
    hub: Arc<Hub>,
    queued: Arc<Notify>,
    terms: Terms,
    _lock: File,
}

impl SqliteEngine {
    /// Opens the engine in a folder, making what is not there, and gives every job that a dead process held back to the
    /// queue.
    ///
    /// # Errors
    /// When the folder cannot be written, when another process has it, or when the database is of a newer version.
    pub fn open(folder: &Path, terms: Terms) -> Result<Self, EngineError> {
        std::fs::create_dir_all(folder).map_err(|e| EngineError::Store(format!("{}: {e}", folder.display())))?;
        let lock_path = folder.join("shrinkd.lock");
        let lock = File::create(&lock_path).map_err(|e| EngineError::Store(format!("{}: {e}", lock_path.display())))?;
        lock.try_lock().map_err(|e| match e {
            TryLockError::WouldBlock => EngineError::Store(format!("another process uses {}", folder.display())),
            TryLockError::Error(e) => EngineError::Store(format!("{}: {e}", lock_path.display())),
        })?;
        let path = folder.join("shrinkd.sqlite3");
        let mut connection = connect(&path)?;
        schema::migrate(&mut connection)?;
        let hub = Arc::new(Hub::default());
        let lost = writer::once(&mut connection, &hub, |ctx| records::requeue_lost(ctx, i64::MAX, terms.max_losses))?;
        if lost > 0 {
            metrics::attempts_lost(lost as u64);
            tracing::warn!(jobs = lost, "jobs of an earlier process are taken up again");
        }
        let writer = Writer::start(connection, hub.clone())?;
        let readers = Readers::new(path, connect);
        let queued = Arc::new(Notify::new());
        Ok(Self { writer, readers, hub, queued, terms, _lock: lock })
    }

    async fn write<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Ctx<'_>) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, EngineError> {
        self.writer.run(work).await
    }

    async fn read<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Connection) -> rusqlite::Result<T> + Send + 'static,
    ) -> Result<T, EngineError> {
        self.readers.run(work).await
    }
}

/// What lies in a folder, in a few words, for a person. Nothing is changed, and a service that runs there is not disturbed.
///
/// # Errors
/// When the database cannot be read, is damaged or is of a newer version, or when another process uses the folder.
pub fn look(folder: &Path) -> Result<String, EngineError> {
    let path = folder.join("shrinkd.sqlite3");
    if !path.exists() {
        return Ok("nothing there yet".to_owned());
    }
    if let Ok(lock) = File::open(folder.join("shrinkd.lock"))
        && let Err(TryLockError::WouldBlock) = lock.try_lock()
    {
        return Err(EngineError::Store(format!("another process uses {}: a service runs there", folder.display())));
    }
    let connection = Connection::open_with_flags(&path, rusqlite::OpenFlags::SQLITE_OPEN_READ_ONLY)?;
    schema::check(&connection)?;
    let verdict: String = connection.query_row("PRAGMA quick_check(1)", [], |row| row.get(0))?;
    if verdict != "ok" {
        return Err(EngineError::Store(format!("{}: {verdict}; restore a backup", path.display())));
    }
    let jobs: u64 = connection.query_row("SELECT count(*) FROM jobs", [], |row| row.get(0))?;
    Ok(format!("{jobs} jobs"))
}

fn connect(path: &Path) -> Result<Connection, EngineError> {
    let connection = Connection::open(path)?;
    connection.pragma_update(None, "journal_mode", "WAL")?;
    connection.pragma_update(None, "synchronous", "FULL")?;
    connection.pragma_update(None, "foreign_keys", "ON")?;
    // readers never wait for the writer in WAL mode; this covers the moment of a checkpoint
    connection.busy_timeout(Duration::from_secs(5))?;
    Ok(connection)
}

impl From<rusqlite::Error> for EngineError {
    fn from(error: rusqlite::Error) -> Self {
        EngineError::Store(error.to_string())
    }
}

#[async_trait::async_trait]
impl Engine for SqliteEngine {
    async fn submit(&self, new: NewJob) -> Result<Submitted, EngineError> {
        let terms = self.terms.clone();
        let submitted = self.write(move |ctx| submit(ctx, &new, &terms)).await?;
        if matches!(submitted, Submitted::Created(_)) {
            self.queued.notify_one();
        }
        Ok(submitted)
    }

    async fn recall(&self, tenant: &Tenant, key: IdempotencyKey) -> Result<Option<Submitted>, EngineError> {
        let tenant = tenant.clone();
        self.write(move |ctx| recall(ctx, &tenant, &key)).await
    }

    async fn get(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError> {
        let tenant = tenant.clone();
        self.read(move |c| records::read(c, &tenant, id)).await
    }

    async fn spec(&self, tenant: &Tenant, id: JobId) -> Result<Option<JobSpec>, EngineError> {
        let tenant = tenant.clone();
        let stored = self.read(move |c| records::spec(c, &tenant, id)).await?;
        let read = |value| JobSpec::from_stored(value).map_err(|faults| EngineError::Store(format!("{faults:?}")));
        stored.map(read).transpose()
    }

    async fn list(&self, tenant: &Tenant, query: ListQuery) -> Result<Page, EngineError> {
        let tenant = tenant.clone();
        self.read(move |c| records::list(c, &tenant, &query)).await
    }

    async fn request_cancel(&self, tenant: &Tenant, id: JobId) -> Result<Option<Job>, EngineError> {
        let tenant = tenant.clone();
        self.write(move |ctx| {
            let Some(job) = records::read(ctx.connection, &tenant, id)? else { return Ok(None) };
            match job.state {
                State::Queued => records::change(ctx, id, Change::to(State::Canceled))?,
                State::Running => records::change(ctx, id, Change::to(State::Canceling))?,
                _ => return Ok(Some(job)),
            }
            records::read(ctx.connection, &tenant, id)
        })
        .await
    }

    async fn forget(&self, tenant: &Tenant, id: JobId) -> Result<Forgotten, EngineError> {
        let tenant = tenant.clone();
        self.write(move |ctx| {
            let Some(job) = records::read(ctx.connection, &tenant, id)? else { return Ok(Forgotten::Unknown) };
            if !job.state.ended() {
                return Ok(Forgotten::Running);
            }
            let mut unused = records::named_blobs(ctx.connection, id)?;
            ctx.connection.execute("DELETE FROM jobs WHERE id = ?1", [id.to_string()])?;
            let mut still_named = ctx.connection.prepare_cached("SELECT 1 FROM outputs WHERE sha256 = ?1 LIMIT 1")?;
            let mut kept = Vec::new();
            for hash in &unused {
                kept.push(still_named.exists([hash])?);
            }
            let mut kept = kept.into_iter();
            unused.retain(|_| kept.next() == Some(false));
            Ok(Forgotten::Gone(unused))
        })
        .await
    }

    async fn unnamed(
        &self,
        whose: Option<&Tenant>,
        blobs: Vec<String>,
        expired: Option<Timestamp>,
    ) -> Result<Vec<String>, EngineError> {
        let whose = whose.cloned();
        self.read(move |c| records::unnamed(c, whose.as_ref(), blobs, expired)).await
    }

    async fn claim(&self, worker: &str, slots: usize, wait: Duration) -> Result<Vec<Claim>, EngineError> {
        let deadline = tokio::time::Instant::now() + wait;
        loop {
            let (worker, terms) = (worker.to_owned(), self.terms.clone());
            let claims = self.write(move |ctx| claim(ctx, &worker, slots, &terms)).await?;
            let now = tokio::time::Instant::now();
            if !claims.is_empty() || now >= deadline {
                return Ok(claims);
            }
            let _ = tokio::time::timeout_at(deadline.min(now + SWEEP), self.queued.notified()).await;
        }
    }

    async fn renew(&self, claim: &Claim, news: Vec<Update>) -> Result<Renewal, EngineError> {
        let (claim, lease) = (claim.clone(), self.terms.lease);
        self.write(move |ctx| {
            let renewal = records::standing(ctx.connection, &claim)?;
            if renewal == Renewal::Lost {
                return Ok(renewal);
            }
            let until = ctx.now.saturating_add(lease.as_millis() as i64);
            let renewed = "UPDATE jobs SET lease_until = ?2 WHERE id = ?1";
            ctx.connection.execute(renewed, params![claim.id.to_string(), until])?;
            for update in news {
                records::tell(ctx, claim.id, update)?;
            }
            Ok(renewal)
        })
        .await
    }

    async fn interrupted(&self, claim: &Claim) -> Renewal {
        let mut changes = self.changes(&claim.tenant, claim.id);
        loop {
            let of = claim.clone();
            match self.read(move |c| records::standing(c, &of)).await {
                Ok(Renewal::Keep) => {}
                Ok(interruption) => return interruption,
                // the next heartbeat will tell whether the engine is really gone
                Err(error) => tracing::warn!(job.id = %claim.id, %error, "the claim could not be looked at"),
            }
            // a change of state by another handle on the same file is seen at the next look
            let _ = tokio::time::timeout(SWEEP, changes.next()).await;
        }
    }

    async fn finish(&self, claim: &Claim, outcome: Outcome) -> Result<(), EngineError> {
        let of = claim.clone();
        let released = outcome == Outcome::Released;
        let held = self.write(move |ctx| {
            let standing = records::standing(ctx.connection, &of)?;
            if standing == Renewal::Lost {
                return Ok(false);
            }
            let change = match outcome {
                Outcome::Succeeded { outputs, metrics } => {
                    Change { outputs: Some(outputs), metrics: Some(metrics), ..Change::to(State::Succeeded) }
                }
                Outcome::Failed { problem, outputs, metrics } => {
                    Change { problem: Some(problem), outputs: Some(outputs), metrics, ..Change::to(State::Failed) }
                }
                Outcome::Canceled => Change::to(State::Canceled),
                // a job that is given back while it was to be stopped has stopped
                Outcome::Released if standing == Renewal::CancelRequested => Change::to(State::Canceled),
                Outcome::Released => Change::to(State::Queued),
            };
            records::change(ctx, of.id, change)?;
            Ok(true)
        });
        if !held.await? {
            return Err(EngineError::Fenced { id: claim.id, attempt: claim.attempt });
        }
        if released {
            self.queued.notify_one();
        }
        Ok(())
    }

    async fn events_after(
        &self,
        tenant: &Tenant,
        id: JobId,
        after: u64,
        limit: usize,
    ) -> Result<Option<EventPage>, EngineError> {
        let tenant = tenant.clone();
        self.read(move |c| records::events_after(c, &tenant, id, after, limit)).await
    }

    fn changes(&self, tenant: &Tenant, id: JobId) -> Changes {
        Changes(self.hub.subscribe(tenant, id))
    }

    async fn depth(&self) -> Result<Depth, EngineError> {
        let (open, oldest_queued) = self.read(records::depth).await?;
        Ok(Depth { open, oldest_queued, connected: true, lag: 0 })
    }

    async fn take_notices(&self, limit: usize, hold: Duration) -> Result<Vec<DueNotice>, EngineError> {
        // most looks find nothing, and cost no commit
        let now = Timestamp::now().as_millisecond();
        if limit == 0 || self.read(move |c| notices::due(c, now, 1)).await?.is_empty() {
            return Ok(Vec::new());
        }
        self.write(move |ctx| notices::take(ctx, limit, hold)).await
    }

    async fn settle_notice(
        &self,
        _: &Tenant,
        id: JobId,
        attempts: u32,
        next: Option<Timestamp>,
    ) -> Result<(), EngineError> {
        let next = next.map(Timestamp::as_millisecond);
        self.write(move |ctx| notices::settle(ctx, id, attempts, next)).await
    }

    async fn health(&self) -> Result<(), EngineError> {
        // a write of what is there already: a disk that is full can still be read
        self.write(|ctx| ctx.connection.pragma_update(None, "application_id", schema::APPLICATION)).await
    }
}

/// The answer to an earlier submit with this key.
fn recall(ctx: &mut Ctx<'_>, tenant: &Tenant, key: &IdempotencyKey) -> rusqlite::Result<Option<Submitted>> {
    ctx.connection.execute("DELETE FROM idempotency WHERE expires_at <= ?1", [ctx.now])?;
    let known = "SELECT fingerprint, answer FROM idempotency WHERE tenant = ?1 AND key = ?2";
    let row = |row: &rusqlite::Row<'_>| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?));
    let Some((fingerprint, answer)) = ctx.connection.query_row(known, [tenant.name(), &key.key], row).optional()?
    else {
        return Ok(None);
    };
    if fingerprint != key.fingerprint {
        return Ok(Some(Submitted::KeyConflict));
    }
    Ok(Some(Submitted::Replayed(records::from_json(&answer)?)))
}

fn submit(ctx: &mut Ctx<'_>, new: &NewJob, terms: &Terms) -> rusqlite::Result<Submitted> {
    if let Some(key) = &new.key
        && let Some(answer) = recall(ctx, &new.tenant, key)?
    {
        return Ok(answer);
    }
    shares::drop_old(ctx.connection, ctx.now)?;
    if let Some(refused) = shares::refuse(ctx.connection, ctx.now, new, terms)? {
        return Ok(refused);
    }
    records::insert(ctx, new)?;
    let job = records::read(ctx.connection, &new.tenant, new.id)?.ok_or(rusqlite::Error::QueryReturnedNoRows)?;
    if let Some(key) = &new.key {
        ctx.connection.execute(
            "INSERT INTO idempotency (tenant, key, fingerprint, answer, expires_at) VALUES (?1, ?2, ?3, ?4, ?5)",
            params![new.tenant.name(), key.key, key.fingerprint, records::to_json(&job)?, ctx.now + KEY_LIFETIME_MS],
        )?;
    }
    Ok(Submitted::Created(job))
}

fn claim(ctx: &mut Ctx<'_>, worker: &str, slots: usize, terms: &Terms) -> rusqlite::Result<Vec<Claim>> {
    let lost = records::requeue_lost(ctx, ctx.now, terms.max_losses)?;
    metrics::attempts_lost(lost as u64);
    let mut claims = Vec::new();
    loop {
        let turns = shares::next(ctx.connection, slots - claims.len(), terms)?;
        if turns.is_empty() {
            return Ok(claims);
        }
        for (tenant, id) in turns {
            claims.extend(take_up(ctx, tenant, id, worker, terms.lease)?);
        }
    }
}

/// Claims a job that waits; one whose request cannot be read fails.
fn take_up(
    ctx: &mut Ctx<'_>,
    tenant: Tenant,
    id: JobId,
    worker: &str,
    lease: Duration,
) -> rusqlite::Result<Option<Claim>> {
    let until = ctx.now.saturating_add(lease.as_millis() as i64);
    let take = "UPDATE jobs SET state = 'running', attempt = attempt + 1, revision = revision + 1, worker = ?2,
                    lease_until = ?3, started_at = COALESCE(started_at, ?4), claimed_at = ?4, progress = NULL
                WHERE id = ?1 RETURNING attempt, spec";
    let (attempt, spec): (u32, String) = ctx
        .connection
        .prepare_cached(take)?
        .query_row(params![id.to_string(), worker, until, ctx.now], |row| Ok((row.get(0)?, row.get(1)?)))?;
    let spec: serde_json::Value = records::from_json(&spec)?;
    match JobSpec::from_stored(spec) {
        Ok(spec) => {
            records::tell_state(ctx, id)?;
            Ok(Some(Claim { tenant, id, attempt, spec, worker: worker.to_owned(), lease }))
        }
        // accepted by another version that knew more
        Err(faults) => {
            tracing::error!(job.id = %id, ?faults, "the stored request cannot be read");
            records::change(ctx, id, Change { problem: Some(Failure::internal()), ..Change::to(State::Failed) })?;
            Ok(None)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::conformance;

    fn open(folder: &Path, terms: Terms) -> SqliteEngine {
        SqliteEngine::open(folder, terms).expect("opens")
    }

    #[tokio::test]
    async fn keeps_every_promise_of_an_engine() {
        let folder = tempfile::tempdir().expect("folder");
        let engine = open(folder.path(), conformance::terms());
        conformance::run(Arc::new(engine)).await;
    }

    #[tokio::test]
    async fn a_second_process_is_kept_out() {
        let folder = tempfile::tempdir().expect("folder");
        let _first = open(folder.path(), Terms::default());
        assert!(SqliteEngine::open(folder.path(), Terms::default()).is_err());
    }

    #[tokio::test]
    async fn a_job_that_was_running_is_queued_again_at_the_next_start() {
        let folder = tempfile::tempdir().expect("folder");
        let engine = open(folder.path(), Terms::default());
        let job = conformance::new_job();
        let id = job.id;
        engine.submit(job).await.expect("submits");
        let first = engine.claim("a", 1, Duration::ZERO).await.expect("claims");
        assert_eq!(first.len(), 1);
        drop(engine);
        let engine = open(folder.path(), Terms::default());
        assert_eq!(engine.get(&Tenant::default(), id).await.expect("reads").map(|j| j.state), Some(State::Queued));
        let again = engine.claim("b", 1, Duration::ZERO).await.expect("claims");
        assert_eq!(again[0].attempt, 2);
        assert!(matches!(engine.finish(&first[0], Outcome::Canceled).await, Err(EngineError::Fenced { .. })));
    }

    #[tokio::test]
    async fn a_key_stands_for_its_job_for_a_day_and_no_longer() {
        const DAY_MS: i64 = 24 * 60 * 60 * 1000;
        /// Longer than the test takes.
        const HOUR_MS: i64 = 60 * 60 * 1000;
        let folder = tempfile::tempdir().expect("folder");
        let engine = open(folder.path(), Terms::default());
        let key = IdempotencyKey { key: "k".to_owned(), fingerprint: "one".to_owned() };
        let keyed = || NewJob { key: Some(key.clone()), ..conformance::new_job() };
        let age = async |by: i64| {
            let aged = "UPDATE idempotency SET expires_at = expires_at - ?1";
            assert_eq!(engine.write(move |ctx| ctx.connection.execute(aged, [by])).await.expect("writes"), 1);
        };
        let first = match engine.submit(keyed()).await.expect("submits") {
            Submitted::Created(job) => job,
            other => panic!("expected a new job, found {other:?}"),
        };
        age(DAY_MS - HOUR_MS).await;
        assert_eq!(engine.submit(keyed()).await.expect("submits"), Submitted::Replayed(first.clone()));
        age(HOUR_MS).await;
        assert_eq!(engine.recall(&Tenant::default(), key.clone()).await.expect("answers"), None);
        let second = match engine.submit(keyed()).await.expect("submits") {
            Submitted::Created(job) => job,
            other => panic!("the key is a day old and stands for nothing, found {other:?}"),
        };
        assert_ne!(second.id, first.id);
        // for a day from then on, again
        age(DAY_MS - HOUR_MS).await;
        assert_eq!(engine.submit(keyed()).await.expect("submits"), Submitted::Replayed(second));
    }

    #[tokio::test]
    async fn a_database_of_a_newer_program_is_refused_and_left_as_it_is() {
        let folder = tempfile::tempdir().expect("folder");
        drop(open(folder.path(), Terms::default()));
        let path = folder.path().join("shrinkd.sqlite3");
        let version = |connection: &Connection| {
            connection.query_row("PRAGMA user_version", [], |row| row.get::<_, u32>(0)).expect("reads")
        };
        let newer = {
            let connection = Connection::open(&path).expect("opens");
            let newer = version(&connection) + 1;
            connection.pragma_update(None, "user_version", newer).expect("writes");
            newer
        };
        let Err(error) = SqliteEngine::open(folder.path(), Terms::default()) else { panic!("it was opened") };
        let said = error.to_string();
        assert!(said.contains(&format!("version {newer}")) && said.contains("newer than this program"), "{said}");
        assert_eq!(version(&Connection::open(&path).expect("opens")), newer);
    }
}
