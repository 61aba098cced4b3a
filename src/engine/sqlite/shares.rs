//! What each tenant has of the queue: whose turn it is, and whether there is room for another job.
//!
//! The table `shares` is kept by triggers, so no change of a job's state can miss it, in the embedded engine and in a cluster node's
//! projection alike. The table `costs` remembers what jobs cost, also of those that were forgotten, for as long as quotas look back.

use super::records::corrupt;
use crate::engine::{NewJob, Submitted, Terms};
use crate::job::JobId;
use crate::quota::{Exceeded, HOUR};
use crate::tenant::Tenant;
use rusqlite::{Connection, OptionalExtension, params};
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

/// What quotas look back over, in milliseconds.
const WINDOW_MS: i64 = HOUR.as_millis() as i64;
/// When there may be room again for a job that was refused because too many wait: nobody knows, and jobs take seconds.
const LATER: Duration = Duration::from_secs(5);

/// What a job cost so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub(in crate::engine) struct Cost {
    /// Vertices that it asked for.
    pub vertices: u64,
    /// Milliseconds that its attempts ran.
    pub ran_ms: i64,
    /// When the last one stopped, milliseconds since the epoch; 0 when none did.
    pub stopped_at: i64,
}

/// The jobs whose turn it is, at most `slots`: of the tenants with jobs that wait, the one with the fewest that run comes first, and of these
/// the one whose last turn is longest ago.
pub(in crate::engine) fn next(
    connection: &Connection,
    slots: usize,
    terms: &Terms,
) -> rusqlite::Result<Vec<(Tenant, JobId)>> {
    let waiting = "SELECT tenant, running, turn FROM shares WHERE queued > 0 ORDER BY running, turn, tenant";
    let mut waiting = connection.prepare_cached(waiting)?;
    let mut rows = waiting.query([])?;
    // as many jobs come from as many tenants at most, and those are the first
    let mut turns = BinaryHeap::new();
    while turns.len() < slots
        && let Some(row) = rows.next()?
    {
        let tenant: Tenant = row.get::<_, String>(0)?.parse().map_err(corrupt)?;
        let (running, turn): (u64, i64) = (row.get(1)?, row.get(2)?);
        let limit = match terms.quotas.of(&tenant).running {
            0 => u64::MAX,
            limit => limit,
        };
        if running < limit {
            turns.push(Reverse((running, turn, tenant, limit, 0)));
        }
    }
    let mut jobs = Vec::new();
    let nth = "SELECT id FROM jobs WHERE state = 'queued' AND tenant = ?1 ORDER BY id LIMIT 1 OFFSET ?2";
    let mut nth = connection.prepare_cached(nth)?;
    while jobs.len() < slots
        && let Some(Reverse((running, turn, tenant, limit, taken))) = turns.pop()
    {
        let id = nth.query_row(params![tenant.name(), taken], |row| row.get::<_, String>(0)).optional()?;
        let Some(id) = id else { continue };
        jobs.push((tenant.clone(), id.parse().map_err(corrupt)?));
        if running + 1 < limit {
            turns.push(Reverse((running + 1, turn, tenant, limit, taken + 1)));
        }
    }
    Ok(jobs)
}

/// Why there is no room for a job; `None` when there is.
pub(in crate::engine) fn refuse(
    connection: &Connection,
    now: i64,
    new: &NewJob,
    terms: &Terms,
) -> rusqlite::Result<Option<Submitted>> {
    let count = |query: &str, values: &[&dyn rusqlite::ToSql]| -> rusqlite::Result<u64> {
        let count: Option<Option<u64>> =
            connection.prepare_cached(query)?.query_row(values, |row| row.get(0)).optional()?;
        Ok(count.flatten().unwrap_or(0))
    };
    if terms.queue > 0 && count("SELECT SUM(queued) FROM shares WHERE queued > 0", &[])? >= terms.queue {
        return Ok(Some(Submitted::QueueFull));
    }
    let (quota, tenant, since) = (terms.quotas.of(&new.tenant), new.tenant.name(), now - WINDOW_MS);
    if quota.queued > 0 && count("SELECT queued FROM shares WHERE tenant = ?1", &[&tenant])? >= quota.queued {
        let over = Exceeded { quota: "queued", limit: quota.queued, window: None, left: 0, retry_after: LATER };
        return Ok(Some(Submitted::OverQuota(over)));
    }
    // of the first of those that are counted on, the time at which it is counted no more
    let room_at = |query: &str| -> rusqlite::Result<Duration> {
        let first = count(query, &[&tenant, &since])?;
        Ok(Duration::from_millis(first.saturating_sub(since as u64).max(1000)))
    };
    let hourly = |quota, limit, left, first| -> rusqlite::Result<Option<Submitted>> {
        let over = Exceeded { quota, limit, window: Some(HOUR), left, retry_after: room_at(first)? };
        Ok(Some(Submitted::OverQuota(over)))
    };
    if quota.vertices_per_hour > 0 && new.vertices > 0 {
        let asked = "SELECT SUM(vertices) FROM costs WHERE tenant = ?1 AND accepted_at > ?2";
        let left = quota.vertices_per_hour.saturating_sub(count(asked, &[&tenant, &since])?);
        if new.vertices > left {
            let first = "SELECT MIN(accepted_at) FROM costs WHERE tenant = ?1 AND accepted_at > ?2";
            return hourly("vertices_per_hour", quota.vertices_per_hour, left, first);
        }
    }
    if quota.seconds_per_hour > 0 {
        let ran = "SELECT SUM(ran_ms) FROM costs WHERE tenant = ?1 AND stopped_at > ?2";
        let left = quota.seconds_per_hour.saturating_sub(count(ran, &[&tenant, &since])?.div_ceil(1000));
        if left == 0 {
            let first = "SELECT MIN(stopped_at) FROM costs WHERE tenant = ?1 AND stopped_at > ?2";
            return hourly("seconds_per_hour", quota.seconds_per_hour, left, first);
        }
    }
    Ok(None)
}

/// Notes what a job cost so far, in place of what was noted of it before.
pub(in crate::engine) fn note(
    connection: &Connection,
    tenant: &Tenant,
    id: JobId,
    accepted_at: i64,
    cost: Cost,
) -> rusqlite::Result<()> {
    let text = "INSERT OR REPLACE INTO costs (job, tenant, accepted_at, vertices, ran_ms, stopped_at)
                VALUES (?1, ?2, ?3, ?4, ?5, ?6)";
    let row = params![id.to_string(), tenant.name(), accepted_at, cost.vertices, cost.ran_ms, cost.stopped_at];
    connection.prepare_cached(text)?.execute(row).map(|_| ())
}

/// Adds the attempt that stops now to what its job cost, if there is one. A lost one ran as long as its lease at most.
pub(super) fn stop(connection: &Connection, id: JobId, now: i64) -> rusqlite::Result<()> {
    let text = "INSERT INTO costs (job, tenant, accepted_at, vertices, ran_ms, stopped_at)
                SELECT id, tenant, created_at, 0, MAX(0, MIN(?2, COALESCE(lease_until, ?2)) - claimed_at), ?2 FROM jobs
                WHERE id = ?1 AND claimed_at IS NOT NULL
                ON CONFLICT (job) DO UPDATE SET ran_ms = ran_ms + excluded.ran_ms, stopped_at = excluded.stopped_at";
    connection.prepare_cached(text)?.execute(params![id.to_string(), now])?;
    let text = "UPDATE jobs SET claimed_at = NULL WHERE id = ?1";
    connection.prepare_cached(text)?.execute([id.to_string()]).map(|_| ())
}

/// Drops what no quota looks back to.
pub(in crate::engine) fn drop_old(connection: &Connection, now: i64) -> rusqlite::Result<()> {
    let text = "DELETE FROM costs WHERE accepted_at <= ?1 AND stopped_at <= ?1";
    connection.prepare_cached(text)?.execute([now - WINDOW_MS]).map(|_| ())
}
