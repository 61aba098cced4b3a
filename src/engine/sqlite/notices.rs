//! The ends of jobs that somebody is to be told: a row for each, from the end of its job until it is settled.

use super::records::{self, Ctx};
use crate::engine::DueNotice;
use crate::job::JobId;
use crate::tenant::Tenant;
use rusqlite::{Connection, params};
use std::time::Duration;

/// Owes the end of a job to whoever its request names, if it names somebody.
pub(super) fn owe(ctx: &Ctx<'_>, id: JobId) -> rusqlite::Result<()> {
    let text = "INSERT OR IGNORE INTO notices (job, url, attempts, due_at)
                SELECT id, spec ->> '$.webhook.url', 0, ?2 FROM jobs
                WHERE id = ?1 AND spec ->> '$.webhook.url' IS NOT NULL";
    ctx.connection.prepare_cached(text)?.execute(params![id.to_string(), ctx.now]).map(|_| ())
}

/// The jobs, and whose they are, whose ends are due: the tenants in turn, and of each the one that waits longest first, so that one
/// tenant's silent receivers do not hold up another's notice.
pub(in crate::engine) fn due(
    connection: &Connection,
    now: i64,
    limit: usize,
) -> rusqlite::Result<Vec<(Tenant, JobId)>> {
    let text = "SELECT tenant, job FROM notices JOIN jobs ON id = job WHERE due_at <= ?1
                ORDER BY ROW_NUMBER() OVER (PARTITION BY tenant ORDER BY due_at), due_at LIMIT ?2";
    let mut statement = connection.prepare_cached(text)?;
    let row = |row: &rusqlite::Row<'_>| Ok((row.get::<_, String>(0)?, row.get::<_, String>(1)?));
    let names = statement.query_map(params![now, limit as i64], row)?;
    names
        .map(|name| {
            let (tenant, id) = name?;
            Ok((tenant.parse().map_err(records::corrupt)?, id.parse().map_err(records::corrupt)?))
        })
        .collect()
}

/// Takes what is due, for a time.
pub(super) fn take(ctx: &Ctx<'_>, limit: usize, hold: Duration) -> rusqlite::Result<Vec<DueNotice>> {
    let until = ctx.now.saturating_add(hold.as_millis() as i64);
    let mut taken = Vec::new();
    for (tenant, id) in due(ctx.connection, ctx.now, limit)? {
        let text = "UPDATE notices SET attempts = attempts + 1, due_at = ?2 WHERE job = ?1 RETURNING url, attempts";
        let row = |row: &rusqlite::Row<'_>| Ok((row.get(0)?, row.get(1)?));
        let (url, attempts) = ctx.connection.prepare_cached(text)?.query_row(params![id.to_string(), until], row)?;
        if let Some(job) = records::read(ctx.connection, &tenant, id)? {
            taken.push(DueNotice { tenant, job, url, attempts });
        }
    }
    Ok(taken)
}

/// Notes what became of the newest attempt.
pub(super) fn settle(ctx: &Ctx<'_>, id: JobId, attempts: u32, next: Option<i64>) -> rusqlite::Result<()> {
    let id = id.to_string();
    match next {
        Some(next) => {
            let text = "UPDATE notices SET due_at = ?3 WHERE job = ?1 AND attempts = ?2";
            ctx.connection.execute(text, params![id, attempts, next])?;
        }
        None => {
            let text = "DELETE FROM notices WHERE job = ?1 AND attempts = ?2";
            ctx.connection.execute(text, params![id, attempts])?;
        }
    }
    Ok(())
}
