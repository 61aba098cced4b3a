//! What a job's subject holds: entries of the record after a change and the events that tell the change.
//!
//! One message carries both, so that they are stored together or not at all: an event's number and the record's count of
//! events cannot disagree, whoever dies when, and there is nothing to mend. (The plan had a stream of its own for events,
//! and an outbox between the two.) The newest entry is the job; the older ones are its events.

use super::layout::Name;
use crate::engine::sqlite::shares::Cost;
use crate::engine::{Claim, NewJob, Outcome, Renewal, Update};
use crate::job::spec::INPUT;
use crate::job::spec::Work;
use crate::job::{Event, EventKind, Failure, Job, Output, State};
use crate::tenant::Tenant;
use bytes::Bytes;
use jiff::Timestamp;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::time::Duration;

/// A job with what only the engine knows of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Record {
    pub job: Job,
    /// Whose it is; records of the time before there were tenants do not say.
    #[serde(default)]
    pub tenant: Tenant,
    /// Number of the newest event.
    pub last_seq: u64,
    /// Workers that were lost over it.
    pub losses: u32,
    /// Who holds it, and for how long without a sign of life.
    pub hold: Option<Hold>,
    /// Blobs that are no outputs of its own, by name: hexadecimal SHA-256.
    pub held: Vec<(String, String)>,
    /// Who is to be told of the end, until that is settled.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub notice: Option<Owed>,
    /// What it cost so far.
    #[serde(default)]
    pub cost: Cost,
}

/// A notice of the end that is owed. Its time is one of day, and nodes may disagree about it by what their clocks do: then it is sent
/// earlier or later, or twice, which may happen anyway.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Owed {
    pub url: String,
    /// Attempts that were begun.
    pub attempts: u32,
    /// When the next one is due, milliseconds since the epoch; none before the end.
    pub due_ms: Option<i64>,
}

/// A worker's hold. No time of day decides how long it lasts: see [`Leases`](super::leases).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Hold {
    pub worker: String,
    pub lease_ms: u64,
    /// When it began, milliseconds since the epoch; for its cost only.
    #[serde(default)]
    pub since_ms: i64,
}

/// One message of a job's subject.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Entry {
    /// The record after a change, and the events that tell it; the last one is number `record.last_seq`.
    Changed { record: Box<Record>, told: Vec<Event> },
    /// The job was forgotten then. Kept for longer than idempotency keys are, so that a key's job that is gone is not taken
    /// for one that was never made; and so that every node hears of it.
    Forgotten {
        at: Timestamp,
        /// When it was accepted, and what it cost: its tenant's quota counts it still.
        #[serde(default)]
        accepted_at: Option<Timestamp>,
        #[serde(default)]
        cost: Cost,
    },
}

impl Entry {
    pub(super) fn read(payload: &[u8]) -> serde_json::Result<Self> {
        let mut entry = serde_json::from_slice(payload)?;
        if let Entry::Changed { record, told } = &mut entry {
            for event in told.iter_mut().filter(|event| event.kind == EventKind::Done) {
                event.data = serde_json::to_value(&record.job)?;
            }
        }
        Ok(entry)
    }

    /// The last event's body is the job, which is there already: it is written once.
    pub(super) fn write(&self) -> serde_json::Result<Bytes> {
        let Entry::Changed { record, told } = self else { return Ok(serde_json::to_vec(self)?.into()) };
        let bare = |event: &Event| match event.kind {
            EventKind::Done => Event { data: Value::Null, ..event.clone() },
            _ => event.clone(),
        };
        let told = told.iter().map(bare).collect();
        Ok(serde_json::to_vec(&Entry::Changed { record: record.clone(), told })?.into())
    }
}

/// Now, to the millisecond that the projection keeps.
pub(super) fn now() -> Timestamp {
    let now = Timestamp::now();
    Timestamp::from_millisecond(now.as_millisecond()).unwrap_or(now)
}

impl Record {
    /// A new job, before anything was told of it.
    fn accepted(new: &NewJob, created_at: Timestamp) -> Self {
        let (id, spec) = (new.id, &new.spec);
        let (mut shrink, mut fit, mut of) = (None, None, None);
        match &spec.work {
            Work::Shrink(work) => shrink = Some(work.shrink.clone()),
            Work::Fit(work) => fit = Some(work.fit),
            Work::Sensitivity(work) => of = Some(work.of),
        }
        let job = Job {
            id,
            kind: spec.work.kind(),
            state: State::Queued,
            attempt: 0,
            revision: 1,
            created_at,
            started_at: None,
            finished_at: None,
            labels: spec.labels.clone(),
            shrink,
            fit,
            of,
            progress: None,
            eta_s: None,
            metrics: None,
            outputs: Vec::new(),
            problem: None,
        };
        let cost = Cost { vertices: new.vertices, ..Cost::default() };
        let held = spec.work.held().into_iter().map(|(name, blob)| (name.to_owned(), blob));
        let held = held.chain(spec.work.inputs()).map(|(name, blob)| (name, blob.hex())).collect();
        let notice = spec.webhook.as_ref().map(|webhook| Owed { url: webhook.url.clone(), attempts: 0, due_ms: None });
        Self { job, tenant: new.tenant.clone(), last_seq: 0, losses: 0, hold: None, held, notice, cost }
    }

    pub(super) fn name(&self) -> Name {
        Name::new(&self.tenant, self.job.id)
    }

    /// Whether a claim still holds. Fenced by the attempt: the number moves on with every claim. What is lost stays lost, so
    /// this is final also from a record that is no longer the newest.
    pub(super) fn standing(&self, claim: &Claim) -> Renewal {
        match self.job.state {
            State::Running if self.job.attempt == claim.attempt => Renewal::Keep,
            State::Canceling if self.job.attempt == claim.attempt => Renewal::CancelRequested,
            _ => Renewal::Lost,
        }
    }

    /// The hashes of the blobs that it names and that are no inputs, each once, in the order of their names.
    pub(super) fn named_blobs(&self) -> Vec<String> {
        let outputs = self.job.outputs.iter().map(|output| (&output.name, &output.sha256));
        let mut named: Vec<_> = outputs.chain(self.held.iter().map(|(name, hash)| (name, hash))).collect();
        named.retain(|(name, _)| !name.starts_with(INPUT));
        named.sort_unstable();
        let mut hashes: Vec<String> = Vec::new();
        for (_, hash) in named {
            if !hashes.contains(hash) {
                hashes.push(hash.clone());
            }
        }
        hashes
    }

    /// The lease of a job that a worker has.
    pub(super) fn lease(&self) -> Option<Duration> {
        self.hold.as_ref().map(|hold| Duration::from_millis(hold.lease_ms))
    }
}

/// A change that is being made to a record; nothing of it counts before it is stored.
pub(super) struct Draft {
    pub record: Record,
    pub told: Vec<Event>,
    now: Timestamp,
}

impl Draft {
    pub(super) fn of(record: Record) -> Self {
        Self { record, told: Vec::new(), now: now() }
    }

    /// A new job, queued.
    pub(super) fn accepted(new: &NewJob, created_at: Timestamp) -> Self {
        let record = Record::accepted(new, created_at);
        let mut draft = Self { record, told: Vec::new(), now: created_at };
        draft.tell_state();
        draft
    }

    pub(super) fn entry(self) -> Entry {
        Entry::Changed { record: Box::new(self.record), told: self.told }
    }

    /// A worker takes it up.
    pub(super) fn claim(&mut self, worker: &str, lease: Duration) {
        let job = &mut self.record.job;
        job.state = State::Running;
        job.attempt += 1;
        job.revision += 1;
        job.started_at.get_or_insert(self.now);
        (job.progress, job.eta_s) = (None, None);
        let (lease_ms, since_ms) = (lease.as_millis() as u64, self.now.as_millisecond());
        self.record.hold = Some(Hold { worker: worker.to_owned(), lease_ms, since_ms });
        self.tell_state();
    }

    /// A worker's news.
    pub(super) fn tell(&mut self, update: Update) {
        if let Some(progress) = update.progress {
            let job = &mut self.record.job;
            job.revision += 1;
            job.eta_s = progress.eta_s;
            job.progress = Some(progress);
        }
        self.append(update.kind, update.data);
    }

    /// Moves to a state in which nothing was made.
    pub(super) fn go(&mut self, state: State) {
        self.go_with(state, Vec::new(), None, None);
    }

    /// An attempt comes to its end; `standing` is what its claim is worth, and not [`Renewal::Lost`].
    pub(super) fn finish(&mut self, outcome: Outcome, standing: Renewal) {
        match outcome {
            Outcome::Succeeded { outputs, metrics } => self.go_with(State::Succeeded, outputs, Some(metrics), None),
            Outcome::Failed { problem, outputs, metrics } => {
                self.go_with(State::Failed, outputs, metrics, Some(problem));
            }
            Outcome::Canceled => self.go(State::Canceled),
            // a job that is given back while it was to be stopped has stopped
            Outcome::Released if standing == Renewal::CancelRequested => self.go(State::Canceled),
            Outcome::Released => self.go(State::Queued),
        }
    }

    /// The worker is gone: back to the queue; what was to be stopped has stopped, and what was lost too often has failed.
    pub(super) fn lose(&mut self, max_losses: u32) {
        self.record.losses += 1;
        let losses = self.record.losses;
        if self.record.job.state == State::Canceling {
            self.go(State::Canceled);
        } else if losses >= max_losses {
            self.go_with(State::Failed, Vec::new(), None, Some(Failure::attempts_exhausted(losses)));
        } else {
            self.go(State::Queued);
        }
    }

    /// Begins an attempt to tell the end, if one is due; after `hold` the next one is.
    pub(super) fn take_notice(&mut self, hold: Duration) -> bool {
        let now = self.now.as_millisecond();
        let Some(notice) = self.record.notice.as_mut().filter(|notice| notice.due_ms.is_some_and(|due| due <= now))
        else {
            return false;
        };
        notice.attempts += 1;
        notice.due_ms = Some(now.saturating_add(hold.as_millis() as i64));
        true
    }

    /// Notes what became of the newest attempt to tell the end; `false` when it is not the newest.
    pub(super) fn settle_notice(&mut self, attempts: u32, next: Option<Timestamp>) -> bool {
        let Some(notice) = self.record.notice.as_mut().filter(|notice| notice.attempts == attempts) else {
            return false;
        };
        match next {
            Some(next) => notice.due_ms = Some(next.as_millisecond()),
            None => self.record.notice = None,
        }
        true
    }

    fn go_with(&mut self, state: State, outputs: Vec<Output>, metrics: Option<Value>, problem: Option<Failure>) {
        // whoever held it holds it no more, unless it is only told to stop
        if state != State::Canceling
            && let Some(hold) = self.record.hold.take()
            && hold.since_ms > 0
        {
            let (now, cost) = (self.now.as_millisecond(), &mut self.record.cost);
            cost.ran_ms += (now - hold.since_ms).max(0);
            cost.stopped_at = now;
        }
        let job = &mut self.record.job;
        job.state = state;
        job.revision += 1;
        (job.outputs, job.metrics, job.problem) = (outputs, metrics, problem);
        if state.ended() {
            // the clock of the node that ends it may be behind that of the one which began it
            job.finished_at = Some(self.now.max(job.started_at.unwrap_or(job.created_at)));
            job.eta_s = None;
            if let Some(notice) = &mut self.record.notice {
                notice.due_ms = Some(self.now.as_millisecond());
            }
        }
        self.tell_state();
        if state.ended() {
            let job = serde_json::to_value(&self.record.job).unwrap_or_default();
            self.append(EventKind::Done, job);
        }
    }

    fn tell_state(&mut self) {
        let job = &self.record.job;
        let data = json!({"state": job.state, "attempt": job.attempt});
        self.append(EventKind::State, data);
    }

    fn append(&mut self, kind: EventKind, data: Value) {
        self.record.last_seq += 1;
        self.told.push(Event { seq: self.record.last_seq, kind, at: self.now, data });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::conformance;

    #[test]
    fn an_entry_is_read_back_as_it_was_written_and_its_last_event_is_the_job() {
        let mut draft = Draft::accepted(&conformance::new_job(), now());
        draft.claim("a", Duration::from_secs(30));
        draft.go(State::Canceled);
        let entry = draft.entry();
        let read = Entry::read(&entry.write().expect("writes")).expect("reads");
        assert_eq!(read, entry);
        let Entry::Changed { record, told } = read else { panic!("a change") };
        assert_eq!(told.iter().map(|e| e.seq).collect::<Vec<_>>(), [1, 2, 3, 4]);
        assert_eq!(told[3].data["state"], "canceled");
        assert_eq!(record.hold, None);
    }

    #[test]
    fn blobs_that_two_names_share_are_named_once_and_in_the_order_of_names() {
        let mut record = Draft::accepted(&conformance::new_job(), now()).record;
        record.held = vec![("warm_start".to_owned(), "aa".to_owned())];
        let output = |name: &str, sha256: &str| Output {
            name: name.to_owned(),
            href: String::new(),
            media_type: String::new(),
            bytes: 0,
            sha256: sha256.to_owned(),
            certified: true,
        };
        record.job.outputs = vec![output("surface", "aa"), output("glb", "bb")];
        assert_eq!(record.named_blobs(), ["bb", "aa"]);
    }
}
