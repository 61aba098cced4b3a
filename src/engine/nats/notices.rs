//! The ends of jobs that somebody is to be told.
//!
//! What is owed stands in the record, so it is stored with the end and not beside it; taking and settling are changes of the record
//! like every other. Every node looks into its own projection for what is due, and the compare-and-set decides who has it.

use super::layout::Name;
use super::ledger::{Ledger, Step};
use crate::engine::{DueNotice, EngineError};
use jiff::Timestamp;
use std::time::Duration;

/// Takes what is due, for a time.
pub(super) async fn take(ledger: &Ledger, limit: usize, hold: Duration) -> Result<Vec<DueNotice>, EngineError> {
    let mut taken = Vec::new();
    for name in ledger.projection.due_notices(Timestamp::now(), limit).await? {
        let change = ledger
            .change(&name, None, |draft| if draft.take_notice(hold) { Step::Write(true) } else { Step::Leave(false) });
        match change.await {
            Ok(Some((true, record))) => taken.extend(record.notice.as_ref().map(|notice| DueNotice {
                tenant: record.tenant.clone(),
                job: record.job.clone(),
                url: notice.url.clone(),
                attempts: notice.attempts,
            })),
            Ok(_) => {}
            // what was taken so far is taken
            Err(error) if !taken.is_empty() => {
                tracing::warn!(job.id = %name.id, %error, "a notice could not be taken");
                break;
            }
            Err(error) => return Err(error),
        }
    }
    Ok(taken)
}

/// Notes what became of the newest attempt.
pub(super) async fn settle(
    ledger: &Ledger,
    name: &Name,
    attempts: u32,
    next: Option<Timestamp>,
) -> Result<(), EngineError> {
    let settled =
        ledger.change(
            name,
            None,
            |draft| if draft.settle_notice(attempts, next) { Step::Write(()) } else { Step::Leave(()) },
        );
    settled.await.map(|_| ())
}
