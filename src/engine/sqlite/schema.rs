//! Tables of the embedded engine, and how an older file becomes a newer one.

use crate::engine::EngineError;
use rusqlite::Connection;

/// Marks a database as ours (SQLite's `application_id`): "shkd".
pub(super) const APPLICATION: i32 = 0x7368_6b64;

/// One step per version; `user_version` counts the steps that were taken. A step is never edited once released.
const MIGRATIONS: [&str; 6] = [
    "
    CREATE TABLE jobs (
        id          TEXT PRIMARY KEY,
        state       TEXT NOT NULL,
        attempt     INTEGER NOT NULL DEFAULT 0,
        losses      INTEGER NOT NULL DEFAULT 0,
        revision    INTEGER NOT NULL DEFAULT 1,
        last_seq    INTEGER NOT NULL DEFAULT 0,
        created_at  INTEGER NOT NULL,
        started_at  INTEGER,
        finished_at INTEGER,
        spec        TEXT NOT NULL,
        labels      TEXT NOT NULL,
        shrink      TEXT NOT NULL,
        progress    TEXT,
        metrics     TEXT,
        outputs     TEXT NOT NULL DEFAULT '[]',
        problem     TEXT,
        worker      TEXT,
        lease_until INTEGER
    ) STRICT;
    CREATE INDEX jobs_open ON jobs (state, id) WHERE state IN ('queued', 'running', 'canceling');
    CREATE TABLE labels (
        job   TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
        name  TEXT NOT NULL,
        value TEXT NOT NULL,
        PRIMARY KEY (name, value, job)
    ) STRICT, WITHOUT ROWID;
    CREATE INDEX labels_of_job ON labels (job);
    CREATE TABLE outputs (
        job    TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
        name   TEXT NOT NULL,
        sha256 TEXT NOT NULL,
        PRIMARY KEY (job, name)
    ) STRICT, WITHOUT ROWID;
    CREATE INDEX outputs_by_hash ON outputs (sha256);
    CREATE TABLE events (
        job  TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
        seq  INTEGER NOT NULL,
        kind TEXT NOT NULL,
        at   INTEGER NOT NULL,
        data TEXT NOT NULL,
        PRIMARY KEY (job, seq)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE idempotency (
        key         TEXT PRIMARY KEY,
        fingerprint TEXT NOT NULL,
        answer      TEXT NOT NULL,
        expires_at  INTEGER NOT NULL
    ) STRICT;
    CREATE INDEX idempotency_by_age ON idempotency (expires_at);
",
    "
    ALTER TABLE jobs ADD COLUMN kind TEXT NOT NULL DEFAULT 'shrink';
    ALTER TABLE jobs RENAME COLUMN shrink TO settings;
",
    // the blobs that the requests of jobs name, whatever member of them does; a job that comes later is noted with its own
    "
    INSERT INTO outputs (job, name, sha256)
        SELECT jobs.id, 'input:' || member.fullkey, substr(member.value, 8) FROM jobs, json_tree(jobs.spec) AS member
        WHERE member.type = 'text' AND length(member.value) = 71 AND substr(member.value, 1, 7) = 'sha256:';
",
    // whose a job is; everything that was there before belongs to the default tenant
    "
    ALTER TABLE jobs ADD COLUMN tenant TEXT NOT NULL DEFAULT 'default';
    CREATE UNIQUE INDEX jobs_of_tenant ON jobs (tenant, id);
    CREATE TABLE labels_of_tenants (
        tenant TEXT NOT NULL,
        job    TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
        name   TEXT NOT NULL,
        value  TEXT NOT NULL,
        PRIMARY KEY (tenant, name, value, job)
    ) STRICT, WITHOUT ROWID;
    INSERT INTO labels_of_tenants (tenant, job, name, value) SELECT 'default', job, name, value FROM labels;
    DROP TABLE labels;
    ALTER TABLE labels_of_tenants RENAME TO labels;
    CREATE INDEX labels_of_job ON labels (job);
    CREATE TABLE idempotency_of_tenants (
        tenant      TEXT NOT NULL,
        key         TEXT NOT NULL,
        fingerprint TEXT NOT NULL,
        answer      TEXT NOT NULL,
        expires_at  INTEGER NOT NULL,
        PRIMARY KEY (tenant, key)
    ) STRICT;
    INSERT INTO idempotency_of_tenants (tenant, key, fingerprint, answer, expires_at)
        SELECT 'default', key, fingerprint, answer, expires_at FROM idempotency;
    DROP TABLE idempotency;
    ALTER TABLE idempotency_of_tenants RENAME TO idempotency;
    CREATE INDEX idempotency_by_age ON idempotency (expires_at);
    ",
    "
    CREATE TABLE notices (
        job      TEXT PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
        url      TEXT NOT NULL,
        attempts INTEGER NOT NULL,
        due_at   INTEGER NOT NULL
    ) STRICT, WITHOUT ROWID;
    CREATE INDEX notices_by_time ON notices (due_at);
",
    // what each tenant has of the queue, kept by triggers, and what its jobs cost
    "
    ALTER TABLE jobs ADD COLUMN claimed_at INTEGER;
    CREATE INDEX jobs_queued ON jobs (tenant, id) WHERE state = 'queued';
    CREATE TABLE shares (
        tenant  TEXT PRIMARY KEY,
        queued  INTEGER NOT NULL,
        running INTEGER NOT NULL,
        turn    INTEGER NOT NULL DEFAULT 0
    ) STRICT, WITHOUT ROWID;
    INSERT INTO shares (tenant, queued, running)
        SELECT tenant, SUM(state = 'queued'), SUM(state IN ('running', 'canceling')) FROM jobs GROUP BY tenant;
    CREATE INDEX shares_in_turn ON shares (running, turn, tenant, queued) WHERE queued > 0;
    CREATE INDEX shares_by_turn ON shares (turn);
    CREATE TRIGGER share_of_a_new_job AFTER INSERT ON jobs BEGIN
        INSERT INTO shares (tenant, queued, running)
            VALUES (NEW.tenant, NEW.state = 'queued', NEW.state IN ('running', 'canceling'))
            ON CONFLICT (tenant) DO UPDATE SET queued = queued + excluded.queued, running = running + excluded.running;
    END;
    CREATE TRIGGER share_of_a_changed_job AFTER UPDATE OF state ON jobs WHEN OLD.state <> NEW.state BEGIN
        UPDATE shares SET
            queued = queued + (NEW.state = 'queued') - (OLD.state = 'queued'),
            running = running + (NEW.state IN ('running', 'canceling')) - (OLD.state IN ('running', 'canceling')),
            turn = CASE WHEN NEW.state = 'running' THEN (SELECT MAX(turn) + 1 FROM shares) ELSE turn END
        WHERE tenant = NEW.tenant;
    END;
    CREATE TRIGGER share_of_a_job_that_goes AFTER DELETE ON jobs BEGIN
        UPDATE shares SET
            queued = queued - (OLD.state = 'queued'),
            running = running - (OLD.state IN ('running', 'canceling'))
        WHERE tenant = OLD.tenant;
    END;
    CREATE TABLE costs (
        job         TEXT PRIMARY KEY,
        tenant      TEXT NOT NULL,
        accepted_at INTEGER NOT NULL,
        vertices    INTEGER NOT NULL,
        ran_ms      INTEGER NOT NULL,
        stopped_at  INTEGER NOT NULL
    ) STRICT, WITHOUT ROWID;
    CREATE INDEX costs_asked ON costs (tenant, accepted_at, vertices);
    CREATE INDEX costs_ran ON costs (tenant, stopped_at, ran_ms);
    CREATE INDEX costs_by_age ON costs (accepted_at, stopped_at);
",
];

/// The file's version.
///
/// # Errors
/// When it is newer than this program's.
pub(in crate::engine) fn check(connection: &Connection) -> Result<usize, EngineError> {
    let version: usize = connection.query_row("PRAGMA user_version", [], |row| row.get(0))?;
    if version > MIGRATIONS.len() {
        return Err(EngineError::Store(format!("the database is of version {version}, newer than this program")));
    }
    Ok(version)
}

/// Brings the file to this version.
pub(in crate::engine) fn migrate(connection: &mut Connection) -> Result<(), EngineError> {
    let version = check(connection)?;
    for (i, step) in MIGRATIONS.iter().enumerate().skip(version) {
        let tx = connection.transaction()?;
        tx.execute_batch(step)?;
        tx.pragma_update(None, "user_version", i + 1)?;
        tx.commit()?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_file_of_an_earlier_version_holds_belongs_to_the_default_tenant() {
        let mut connection = Connection::open_in_memory().expect("opens");
        for step in &MIGRATIONS[..3] {
            connection.execute_batch(step).expect("runs");
        }
        let old = "INSERT INTO jobs (id, state, created_at, spec, labels, settings) VALUES ('a', 'queued', 0, '{}', '{}', '{}');
                   INSERT INTO labels VALUES ('a', 'name', 'value');
                   INSERT INTO idempotency VALUES ('k', 'f', '{}', 9);
                   PRAGMA user_version = 3";
        connection.execute_batch(old).expect("writes");
        migrate(&mut connection).expect("migrates");
        let belongs = "SELECT (SELECT tenant FROM jobs WHERE id = 'a') = 'default'
            AND EXISTS (SELECT 1 FROM labels WHERE tenant = 'default' AND job = 'a' AND name = 'name' AND value = 'value')
            AND EXISTS (SELECT 1 FROM idempotency WHERE tenant = 'default' AND key = 'k' AND fingerprint = 'f')";
        assert!(connection.query_row(belongs, [], |row| row.get::<_, bool>(0)).expect("reads"));
        connection.execute_batch("PRAGMA foreign_keys = ON; DELETE FROM jobs WHERE id = 'a'").expect("deletes");
        let left: u32 = connection.query_row("SELECT COUNT(*) FROM labels", [], |row| row.get(0)).expect("reads");
        assert_eq!(left, 0, "labels go with their job");
        let share = "SELECT queued FROM shares WHERE tenant = 'default'";
        assert_eq!(
            connection.query_row(share, [], |row| row.get::<_, u32>(0)).expect("reads"),
            0,
            "nor does its share stay"
        );
    }
}
