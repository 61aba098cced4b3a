//! Rows and what they mean: records, events, and the changes that keep both together.

use super::notices;
use super::shares::{self, Cost};
use crate::engine::{Claim, Counts, EventPage, ListQuery, NewJob, Page, Renewal, Update};
use crate::job::spec::Work;
use crate::job::{Event, EventKind, Failure, Job, JobId, JobKind, Output, ProgressView, State};
use crate::tenant::Tenant;
use jiff::Timestamp;
use rusqlite::types::Value as Sql;
use rusqlite::{Connection, OptionalExtension, Row, params, params_from_iter};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use std::sync::Arc;

/// Events kept per job. A reader that falls further behind starts over from a snapshot.
pub(in crate::engine) const KEPT_EVENTS: u64 = 512;

/// A transaction of the writer.
pub(in crate::engine) struct Ctx<'a> {
    /// The connection, inside its transaction.
    pub connection: &'a Connection,
    /// Milliseconds since the epoch.
    pub now: i64,
    /// Told after the commit.
    pub events: &'a mut Vec<(Tenant, JobId, Arc<Event>)>,
}

/// A new state, and what comes with it.
pub(super) struct Change {
    pub state: State,
    pub outputs: Option<Vec<Output>>,
    pub metrics: Option<serde_json::Value>,
    pub problem: Option<Failure>,
}

impl Change {
    pub(super) fn to(state: State) -> Self {
        Self { state, outputs: None, metrics: None, problem: None }
    }
}

/// A stored value that cannot be read.
pub(in crate::engine) fn corrupt(error: impl std::error::Error + Send + Sync + 'static) -> rusqlite::Error {
    rusqlite::Error::FromSqlConversionFailure(0, rusqlite::types::Type::Text, Box::new(error))
}

pub(super) fn from_json<T: DeserializeOwned>(text: &str) -> rusqlite::Result<T> {
    serde_json::from_str(text).map_err(corrupt)
}

pub(in crate::engine) fn to_json(value: &(impl Serialize + ?Sized)) -> rusqlite::Result<String> {
    serde_json::to_string(value).map_err(|e| rusqlite::Error::ToSqlConversionFailure(Box::new(e)))
}

fn time(ms: i64) -> rusqlite::Result<Timestamp> {
    Timestamp::from_millisecond(ms).map_err(corrupt)
}

const COLUMNS: &str =
    "id, state, attempt, revision, created_at, started_at, finished_at, labels, settings, progress, metrics,
    outputs, problem, last_seq, kind";

fn job_of(row: &Row<'_>) -> rusqlite::Result<Job> {
    let json = |column: usize| row.get::<_, Option<String>>(column);
    let state: String = row.get(1)?;
    let progress: Option<ProgressView> = json(9)?.as_deref().map(from_json).transpose()?;
    let state = State::from_name(&state).ok_or(rusqlite::Error::InvalidColumnType(
        1,
        "state".to_owned(),
        rusqlite::types::Type::Text,
    ))?;
    let kind: String = row.get(14)?;
    let kind = JobKind::from_name(&kind).ok_or(rusqlite::Error::InvalidColumnType(
        14,
        "kind".to_owned(),
        rusqlite::types::Type::Text,
    ))?;
    let settings: String = row.get(8)?;
    Ok(Job {
        id: row.get::<_, String>(0)?.parse().map_err(corrupt)?,
        kind,
        state,
        attempt: row.get(2)?,
        revision: row.get(3)?,
        created_at: time(row.get(4)?)?,
        started_at: row.get::<_, Option<i64>>(5)?.map(time).transpose()?,
        finished_at: row.get::<_, Option<i64>>(6)?.map(time).transpose()?,
        labels: from_json(&row.get::<_, String>(7)?)?,
        shrink: (kind == JobKind::Shrink).then(|| from_json(&settings)).transpose()?,
        fit: (kind == JobKind::Fit).then(|| from_json(&settings)).transpose()?,
        of: (kind == JobKind::Sensitivity).then(|| from_json(&settings)).transpose()?,
        eta_s: progress.as_ref().and_then(|p| p.eta_s).filter(|_| !state.ended()),
        progress,
        metrics: json(10)?.as_deref().map(from_json).transpose()?,
        outputs: from_json(&row.get::<_, String>(11)?)?,
        problem: json(12)?.as_deref().map(from_json).transpose()?,
    })
}

/// The job of that name, looked up by the index of a tenant's jobs: the row of another tenant's job is never touched.
const OF_TENANT: &str = "jobs INDEXED BY jobs_of_tenant WHERE tenant = ?1 AND id = ?2";

pub(super) fn read(connection: &Connection, tenant: &Tenant, id: JobId) -> rusqlite::Result<Option<Job>> {
    let query = format!("SELECT {COLUMNS} FROM {OF_TENANT}");
    connection.prepare_cached(&query)?.query_row(params![tenant.name(), id.to_string()], job_of).optional()
}

/// The request of a job, as it was stored.
pub(super) fn spec(connection: &Connection, tenant: &Tenant, id: JobId) -> rusqlite::Result<Option<serde_json::Value>> {
    let mut query = connection.prepare_cached(&format!("SELECT spec FROM {OF_TENANT}"))?;
    let text = query.query_row(params![tenant.name(), id.to_string()], |row| row.get::<_, String>(0)).optional()?;
    text.as_deref().map(from_json).transpose()
}

pub(super) fn insert(ctx: &mut Ctx<'_>, new: &NewJob) -> rusqlite::Result<()> {
    let (id, spec) = (new.id.to_string(), &new.spec);
    let settings = match &spec.work {
        Work::Shrink(shrinking) => to_json(&shrinking.shrink)?,
        Work::Fit(fitting) => to_json(&fitting.fit)?,
        Work::Sensitivity(sensing) => to_json(&sensing.of)?,
    };
    ctx.connection.execute(
        "INSERT INTO jobs (id, tenant, state, created_at, spec, labels, kind, settings)
         VALUES (?1, ?2, 'queued', ?3, ?4, ?5, ?6, ?7)",
        params![
            id,
            new.tenant.name(),
            ctx.now,
            to_json(spec)?,
            to_json(&spec.labels)?,
            spec.work.kind().name(),
            settings
        ],
    )?;
    shares::note(ctx.connection, &new.tenant, new.id, ctx.now, Cost { vertices: new.vertices, ..Cost::default() })?;
    for (name, blob) in spec.work.held() {
        name_blob(ctx.connection, new.id, name, &blob.hex())?;
    }
    for (name, blob) in spec.work.inputs() {
        name_blob(ctx.connection, new.id, &name, &blob.hex())?;
    }
    for (name, value) in &spec.labels {
        let label = "INSERT INTO labels (tenant, job, name, value) VALUES (?1, ?2, ?3, ?4)";
        ctx.connection.execute(label, params![new.tenant.name(), id, name, value])?;
    }
    tell_state(ctx, new.id)
}

/// Notes that a job names a blob, so that the blob is kept while the job is.
fn name_blob(connection: &Connection, job: JobId, name: &str, sha256: &str) -> rusqlite::Result<()> {
    let named = "INSERT INTO outputs (job, name, sha256) VALUES (?1, ?2, ?3)";
    connection.execute(named, params![job.to_string(), name, sha256]).map(|_| ())
}

/// Those of these blobs that no job names, of `whose` where that is given; jobs that ended before `expired` do not count.
pub(in crate::engine) fn unnamed(
    connection: &Connection,
    whose: Option<&Tenant>,
    mut blobs: Vec<String>,
    expired: Option<Timestamp>,
) -> rusqlite::Result<Vec<String>> {
    let named = "SELECT 1 FROM outputs JOIN jobs ON jobs.id = outputs.job
                 WHERE sha256 = ?1 AND (finished_at IS NULL OR finished_at >= ?2) AND (?3 IS NULL OR tenant = ?3)
                 LIMIT 1";
    let (mut named, expired) = (connection.prepare_cached(named)?, expired.map_or(0, Timestamp::as_millisecond));
    let mut kept = Vec::with_capacity(blobs.len());
    for blob in &blobs {
        kept.push(named.exists(params![blob, expired, whose.map(Tenant::name)])?);
    }
    let mut kept = kept.into_iter();
    blobs.retain(|_| kept.next() == Some(false));
    Ok(blobs)
}

/// The blobs that a job names and that are no inputs of it, each once.
pub(super) fn named_blobs(connection: &Connection, job: JobId) -> rusqlite::Result<Vec<String>> {
    let mut named = connection.prepare_cached(
        "SELECT DISTINCT sha256 FROM outputs WHERE job = ?1 AND name NOT LIKE 'input:%' ORDER BY name",
    )?;
    named.query_map([job.to_string()], |row| row.get(0))?.collect()
}

pub(in crate::engine) fn list(connection: &Connection, tenant: &Tenant, query: &ListQuery) -> rusqlite::Result<Page> {
    let mut wanted = vec!["tenant = ?1".to_owned()];
    let mut values: Vec<Sql> = vec![tenant.name().to_owned().into()];
    let mut bind = |value: Sql| -> String {
        values.push(value);
        format!("?{}", values.len())
    };
    if let Some(before) = query.before {
        wanted.push(format!("id < {}", bind(before.to_string().into())));
    }
    if !query.states.is_empty() {
        let states: Vec<String> = query.states.iter().map(|s| bind(s.name().to_owned().into())).collect();
        wanted.push(format!("state IN ({})", states.join(", ")));
    }
    for (name, value) in &query.labels {
        let (name, value) = (bind(name.clone().into()), bind(value.clone().into()));
        wanted.push(format!("id IN (SELECT job FROM labels WHERE tenant = ?1 AND name = {name} AND value = {value})"));
    }
    if let Some(from) = query.created_from {
        wanted.push(format!("created_at >= {}", bind(from.as_millisecond().into())));
    }
    if let Some(to) = query.created_to {
        wanted.push(format!("created_at < {}", bind(to.as_millisecond().into())));
    }
    // one more than asked for tells whether there are more
    let limit = bind(Sql::Integer(query.limit as i64 + 1));
    let text = format!(
        "SELECT {COLUMNS} FROM jobs INDEXED BY jobs_of_tenant WHERE {} ORDER BY id DESC LIMIT {limit}",
        wanted.join(" AND ")
    );
    let mut statement = connection.prepare_cached(&text)?;
    let mut jobs = statement.query_map(params_from_iter(values), job_of)?.collect::<rusqlite::Result<Vec<_>>>()?;
    let more = jobs.len() > query.limit;
    jobs.truncate(query.limit);
    Ok(Page { jobs, more })
}

/// How many jobs there are of each kind in each state that is no end, and when the oldest queued one was accepted.
pub(in crate::engine) fn depth(connection: &Connection) -> rusqlite::Result<(Counts, Option<Timestamp>)> {
    let text = "SELECT kind, state, COUNT(*), MIN(created_at) FROM jobs
                WHERE state IN ('queued', 'running', 'canceling') GROUP BY kind, state";
    let mut statement = connection.prepare_cached(text)?;
    let mut rows = statement.query([])?;
    let (mut open, mut oldest) = (Vec::new(), None::<i64>);
    while let Some(row) = rows.next()? {
        let (kind, state): (String, String) = (row.get(0)?, row.get(1)?);
        let (Some(kind), Some(state)) = (JobKind::from_name(&kind), State::from_name(&state)) else { continue };
        open.push((kind, state, row.get(2)?));
        if state == State::Queued {
            let first: i64 = row.get(3)?;
            oldest = Some(oldest.map_or(first, |oldest| oldest.min(first)));
        }
    }
    Ok((open, oldest.map(time).transpose()?))
}

/// Moves a job to another state and tells it; a job that ends tells its whole record last.
pub(super) fn change(ctx: &mut Ctx<'_>, id: JobId, change: Change) -> rusqlite::Result<()> {
    let finished = change.state.ended().then_some(ctx.now);
    // whoever held it holds it no more, unless it is only told to stop
    let keeps_hold = change.state == State::Canceling;
    if !keeps_hold {
        shares::stop(ctx.connection, id, ctx.now)?;
    }
    ctx.connection.execute(
        "UPDATE jobs SET state = ?2, revision = revision + 1, finished_at = ?3, outputs = ?4, metrics = ?5, problem = ?6,
            worker = CASE WHEN ?7 THEN worker END, lease_until = CASE WHEN ?7 THEN lease_until END
         WHERE id = ?1",
        params![
            id.to_string(),
            change.state.name(),
            finished,
            to_json(change.outputs.as_deref().unwrap_or_default())?,
            change.metrics.as_ref().map(to_json).transpose()?,
            change.problem.as_ref().map(to_json).transpose()?,
            keeps_hold,
        ],
    )?;
    for output in change.outputs.iter().flatten() {
        name_blob(ctx.connection, id, &output.name, &output.sha256)?;
    }
    tell_state(ctx, id)?;
    if change.state.ended() {
        notices::owe(ctx, id)?;
        let query = format!("SELECT {COLUMNS} FROM jobs WHERE id = ?1");
        let job = ctx.connection.prepare_cached(&query)?.query_row([id.to_string()], job_of)?;
        let job = serde_json::to_value(job).map_err(corrupt)?;
        append(ctx, id, EventKind::Done, job)?;
    }
    Ok(())
}

/// Appends the `state` event of what the record says now.
pub(super) fn tell_state(ctx: &mut Ctx<'_>, id: JobId) -> rusqlite::Result<()> {
    let query = "SELECT state, attempt FROM jobs WHERE id = ?1";
    let (state, attempt) = ctx
        .connection
        .query_row(query, [id.to_string()], |row| Ok((row.get::<_, String>(0)?, row.get::<_, u32>(1)?)))?;
    append(ctx, id, EventKind::State, json!({"state": state, "attempt": attempt}))
}

/// Appends a worker's news.
pub(super) fn tell(ctx: &mut Ctx<'_>, id: JobId, update: Update) -> rusqlite::Result<()> {
    if let Some(progress) = &update.progress {
        let text = "UPDATE jobs SET progress = ?2, revision = revision + 1 WHERE id = ?1";
        ctx.connection.execute(text, params![id.to_string(), to_json(progress)?])?;
    }
    append(ctx, id, update.kind, update.data)
}

fn append(ctx: &mut Ctx<'_>, id: JobId, kind: EventKind, data: serde_json::Value) -> rusqlite::Result<()> {
    let text_id = id.to_string();
    let next = "UPDATE jobs SET last_seq = last_seq + 1 WHERE id = ?1 RETURNING last_seq, tenant";
    let (seq, tenant): (u64, String) =
        ctx.connection.prepare_cached(next)?.query_row([&text_id], |row| Ok((row.get(0)?, row.get(1)?)))?;
    ctx.connection
        .prepare_cached("INSERT INTO events (job, seq, kind, at, data) VALUES (?1, ?2, ?3, ?4, ?5)")?
        .execute(params![text_id, seq, kind.name(), ctx.now, to_json(&data)?])?;
    if seq > KEPT_EVENTS {
        let old = "DELETE FROM events WHERE job = ?1 AND seq <= ?2";
        ctx.connection.prepare_cached(old)?.execute(params![text_id, seq - KEPT_EVENTS])?;
    }
    let tenant = tenant.parse().map_err(corrupt)?;
    ctx.events.push((tenant, id, Arc::new(Event { seq, kind, at: time(ctx.now)?, data })));
    Ok(())
}

pub(in crate::engine) fn events_after(
    connection: &Connection,
    tenant: &Tenant,
    id: JobId,
    after: u64,
    limit: usize,
) -> rusqlite::Result<Option<EventPage>> {
    let query = format!("SELECT {COLUMNS} FROM {OF_TENANT}");
    let found = connection
        .prepare_cached(&query)?
        .query_row(params![tenant.name(), id.to_string()], |row| Ok((job_of(row)?, row.get::<_, u64>(13)?)))
        .optional()?;
    let Some((job, newest)) = found else { return Ok(None) };
    let oldest = "SELECT COALESCE(MIN(seq), 0) FROM events WHERE job = ?1";
    let oldest: u64 = connection.prepare_cached(oldest)?.query_row([id.to_string()], |row| row.get(0))?;
    let after = i64::try_from(after).unwrap_or(i64::MAX);
    let text = "SELECT seq, kind, at, data FROM events WHERE job = ?1 AND seq > ?2 ORDER BY seq LIMIT ?3";
    let mut statement = connection.prepare_cached(text)?;
    let events = statement.query_map(params![id.to_string(), after, limit as i64], |row| {
        let kind: String = row.get(1)?;
        Ok(Event {
            seq: row.get(0)?,
            kind: EventKind::from_name(&kind).unwrap_or(EventKind::State),
            at: time(row.get(2)?)?,
            data: from_json(&row.get::<_, String>(3)?)?,
        })
    })?;
    let events = events.collect::<rusqlite::Result<Vec<_>>>()?;
    Ok(Some(EventPage { events, oldest, newest, job }))
}

/// Whether a claim still holds. Fenced by the attempt: the number moves on with every claim.
pub(super) fn standing(connection: &Connection, claim: &Claim) -> rusqlite::Result<Renewal> {
    let query = "SELECT state, attempt FROM jobs WHERE id = ?1";
    let row = connection
        .query_row(query, [claim.id.to_string()], |row| Ok((row.get::<_, String>(0)?, row.get::<_, u32>(1)?)))
        .optional()?;
    Ok(match row {
        Some((state, attempt)) if attempt == claim.attempt => match State::from_name(&state) {
            Some(State::Running) => Renewal::Keep,
            Some(State::Canceling) => Renewal::CancelRequested,
            _ => Renewal::Lost,
        },
        _ => Renewal::Lost,
    })
}

/// Gives the jobs whose lease ran out before `now` back to the queue; one that was to be stopped is, and one that was lost
/// too often is failed. Returns how many there were.
pub(super) fn requeue_lost(ctx: &mut Ctx<'_>, now: i64, max_losses: u32) -> rusqlite::Result<usize> {
    let query =
        "SELECT id, state, losses FROM jobs WHERE state IN ('running', 'canceling') AND lease_until < ?1 ORDER BY id";
    let mut statement = ctx.connection.prepare_cached(query)?;
    let rows = statement
        .query_map([now], |row| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?, row.get::<_, u32>(2)?)))?;
    let lost = rows.collect::<rusqlite::Result<Vec<_>>>()?;
    for (text_id, state, losses) in &lost {
        let id: JobId = text_id.parse().map_err(corrupt)?;
        ctx.connection.execute("UPDATE jobs SET losses = losses + 1 WHERE id = ?1", [text_id])?;
        let losses = losses + 1;
        tracing::warn!(job.id = %id, losses, "a worker was lost");
        let next = if state == State::Canceling.name() {
            Change::to(State::Canceled)
        } else if losses >= max_losses {
            Change { problem: Some(Failure::attempts_exhausted(losses)), ..Change::to(State::Failed) }
        } else {
            Change::to(State::Queued)
        };
        change(ctx, id, next)?;
    }
    Ok(lost.len())
}
