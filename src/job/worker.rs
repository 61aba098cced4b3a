//! The worker: claims jobs, runs them on the rayon pool, tells their news, and ends them.
//!
//! Computing happens on threads of its own and on the pool, never on the async runtime, and [gives way](priority) to it. A worker takes exactly as many jobs as
//! it has free slots, renews each claim every third of its lease, and stops a computation within a heartbeat of losing it.

use super::failure::{Ended, Failure};
use super::memory::Memory;
use super::preview::MeshPreview;
use super::priority;
use super::spec::{FieldSpec, Work};
use super::{EventKind, JobId, Output, OutputName, ProgressView};
use crate::blobs::{BlobError, BlobId, Blobs};
use crate::engine::{Claim, Engine, EngineError, Outcome, Renewal, Update};
use crate::job::pipeline::{self, Asked, Kept, StateBytes};
use crate::settings::{CancelToken, Progress, Settings};
use crate::telemetry::metrics::{self, Present};
use crate::telemetry::traces;
use bytes::Bytes;
use std::cell::Cell;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use tokio::sync::{mpsc, oneshot};
use tokio::time::Interval;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;
use tracing::Instrument as _;
use tracing::field::Empty;

/// Least time between two progress events of a job.
const PROGRESS_EVERY: Duration = Duration::from_millis(100);
/// Mean time between two mesh events of a job, ...
const MESH_EVERY: Duration = Duration::from_millis(250);
/// ... of which so many may come at once: a contraction is over in a moment, and is what one wants to see.
const MESH_BURST: u32 = 8;
/// Least time between two checkpoints of a job.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(5);
/// How long a worker that found nothing to do waits before it asks again; a new job wakes it at once.
const CLAIM_WAIT: Duration = Duration::from_secs(20);
/// Pause after the engine failed, so that a broken disk does not make a busy loop.
const BACKOFF: Duration = Duration::from_secs(1);
/// How often a job that waits for memory looks whether it is still wanted.
const ROOM_LOOK: Duration = Duration::from_millis(200);
/// Pause before a job is given back whose inputs or outputs were out of reach, no longer than a lease; it grows with every attempt, ...
const OUT_OF_REACH: Duration = Duration::from_secs(5);
/// ... up to so many times that.
const LONGEST_PAUSE: u32 = 12;
/// How often the end of a job is tried to be written before it is left to the next attempt.
const FINISH_TRIES: u32 = 5;
/// Time that running jobs get to come to their end once the service stops.
pub const GRACE: Duration = Duration::from_secs(2);

/// Why an attempt made nothing.
enum Unfinished {
    /// The job has come to its end.
    Ended(Ended),
    /// What it needs is out of reach: another attempt may do better.
    OutOfReach,
}

impl From<Failure> for Unfinished {
    fn from(failure: Failure) -> Self {
        Self::Ended(failure.into())
    }
}

/// What a worker works with.
pub struct Worker {
    /// Where jobs come from.
    pub engine: Arc<dyn Engine>,
    /// Where bytes lie.
    pub blobs: Blobs,
    /// The pool that all jobs share.
    pub pool: Arc<rayon::ThreadPool>,
    /// Jobs at once.
    pub slots: usize,
    /// Seconds that an attempt may run whose job does not say.
    pub job_seconds: u32,
    /// What its jobs may take together, where that is limited.
    pub memory: Option<Arc<Memory>>,
    /// Name of this worker, different for every process.
    pub name: String,
}

impl Worker {
    /// Works until `stop` is raised; then gives running jobs [`GRACE`] to end, and gives the rest back.
    pub async fn run(self, stop: CancellationToken) {
        let worker = Arc::new(self);
        let slots = Arc::new(tokio::sync::Semaphore::new(worker.slots));
        let (jobs, give_back) = (TaskTracker::new(), CancellationToken::new());
        loop {
            // pull exactly the number of free slots: a job that waits in a worker is a job that another could run
            let free = tokio::select! {
                () = stop.cancelled() => break,
                permit = slots.clone().acquire_owned() => permit.unwrap_or_else(|_| unreachable!("never closed")),
            };
            let mut permits = vec![free];
            while let Ok(more) = slots.clone().try_acquire_owned() {
                permits.push(more);
            }
            let claims = tokio::select! {
                () = stop.cancelled() => break,
                claims = worker.claim(permits.len()) => claims,
            };
            for (claim, permit) in claims.into_iter().zip(permits) {
                let (worker, give_back) = (worker.clone(), give_back.clone());
                let span =
                    tracing::info_span!("job", job.id = %claim.id, job.attempt = claim.attempt, trace.id = Empty);
                traces::join(&span, claim.spec.traceparent.as_deref());
                if let Some(position) = traces::position(&span) {
                    span.record("trace.id", traces::trace_id(&position));
                }
                jobs.spawn(
                    async move {
                        worker.attempt(claim, give_back).await;
                        drop(permit);
                    }
                    .instrument(span),
                );
            }
        }
        jobs.close();
        if tokio::time::timeout(GRACE, jobs.wait()).await.is_err() {
            tracing::info!(jobs = jobs.len(), "running jobs are given back to the queue");
            give_back.cancel();
            jobs.wait().await;
        }
    }

    async fn claim(&self, slots: usize) -> Vec<Claim> {
        match self.engine.claim(&self.name, slots, CLAIM_WAIT).await {
            Ok(claims) => claims,
            Err(error) => {
                tracing::error!(%error, "no job could be claimed");
                tokio::time::sleep(BACKOFF).await;
                Vec::new()
            }
        }
    }

    /// Runs one attempt from claim to end.
    async fn attempt(&self, claim: Claim, give_back: CancellationToken) {
        tracing::info!("job started");
        let (_running, clock, kind) = (Present::running_job(), Instant::now(), claim.spec.work.kind());
        if claim.attempt == 1 {
            metrics::job_began(kind, since_accepted(claim.id));
        }
        let outcome = self.run_attempt(claim, give_back).await;
        metrics::attempt_ended(kind, outcome, clock.elapsed());
    }

    /// Does what [`attempt`](Self::attempt) says; returns how it ended, in a word.
    async fn run_attempt(&self, claim: Claim, give_back: CancellationToken) -> &'static str {
        let cancel = CancelToken::new();
        let (news, mut inbox) = mpsc::unbounded_channel();
        let work = self.work(claim.clone(), cancel.clone(), news);
        // before anything is read; a job that waits for room can be canceled meanwhile, and its time does not run yet
        let needed = claim.spec.memory_bytes.unwrap_or(0);
        let (memory, waiting) = (self.memory.clone(), cancel.clone());
        let (begin, mut begun) = oneshot::channel();
        let work = async move {
            let _room = match &memory {
                Some(memory) => Some(until_canceled(&waiting, memory.take(needed)).await?),
                None => None,
            };
            // nobody listens once the claim is lost
            let _ = begin.send(());
            work.await
        };
        let mut work = tokio::spawn(work.in_current_span());
        let interrupted = self.engine.interrupted(&claim);
        tokio::pin!(interrupted);
        let beat = claim.lease / 3;
        let mut heartbeat = tokio::time::interval_at(tokio::time::Instant::now() + beat, beat);
        let (mut lost, mut watching, mut returning, mut late) = (false, true, false, None);
        let allowed = Duration::from_secs(claim.spec.deadline_s.unwrap_or(self.job_seconds).into());
        let deadline = tokio::time::sleep(allowed);
        tokio::pin!(deadline);
        let mut running = false;
        let result = loop {
            tokio::select! {
                // what was told before the end is stored before the end
                biased;
                Some(update) = inbox.recv() => {
                    let mut updates = vec![update];
                    while let Ok(more) = inbox.try_recv() {
                        updates.push(more);
                    }
                    lost |= self.renew(&claim, updates).await == Renewal::Lost;
                }
                result = &mut work => break result,
                interruption = &mut interrupted, if watching => {
                    watching = false;
                    lost |= interruption == Renewal::Lost;
                    cancel.cancel();
                }
                () = give_back.cancelled(), if !returning => {
                    returning = true;
                    cancel.cancel();
                }
                Ok(()) = &mut begun, if !running => {
                    running = true;
                    deadline.as_mut().reset(tokio::time::Instant::now() + allowed);
                }
                () = &mut deadline, if running && late.is_none() => {
                    // what was to be stopped before has not failed
                    late = Some(!cancel.is_canceled());
                    cancel.cancel();
                }
                _ = heartbeat.tick() => lost |= self.renew(&claim, Vec::new()).await == Renewal::Lost,
            }
            if lost {
                cancel.cancel();
            }
        };
        let result = result.unwrap_or_else(|panic| {
            tracing::error!(%panic, "the job panicked");
            Err(Failure::internal().into())
        });
        if lost {
            tracing::warn!("the claim was lost; nothing of this attempt counts");
            return "lost";
        }
        // nothing that a record names may be removed from here until the record names it
        let promise = self.blobs.promise().await;
        let outcome = match result {
            Ok(made) => self.renewing(&claim, &mut heartbeat, self.store(&claim, made)).await,
            Err(Unfinished::Ended(Ended::Failed(failure))) => Some(Outcome::failed(*failure)),
            Err(Unfinished::Ended(Ended::Canceled)) if late == Some(true) => {
                Some(Outcome::failed(Failure::deadline_exceeded(allowed)))
            }
            Err(Unfinished::Ended(Ended::Canceled)) if returning => Some(Outcome::Released),
            Err(Unfinished::Ended(Ended::Canceled)) => Some(Outcome::Canceled),
            Err(Unfinished::OutOfReach) => None,
        };
        let Some(outcome) = outcome else {
            drop(promise);
            // an outage is no fault of the job's and counts as no loss; nobody knows when it ends
            let pause = OUT_OF_REACH.min(claim.lease) * claim.attempt.clamp(1, LONGEST_PAUSE);
            tracing::warn!(
                pause_s = pause.as_secs(),
                "the blob store is out of reach; the job is given back after a pause"
            );
            let pause = async {
                tokio::select! { () = tokio::time::sleep(pause) => {}, () = give_back.cancelled() => {} }
            };
            self.renewing(&claim, &mut heartbeat, pause).await;
            self.end(&claim, Outcome::Released).await;
            return "unfinished";
        };
        let over = !matches!(outcome, Outcome::Released);
        let ended = self.end(&claim, outcome).await;
        if over
            && matches!(claim.spec.work, Work::Fit(_))
            && let Err(error) = self.blobs.remove_checkpoint(&claim.tenant, &claim.id.to_string()).await
        {
            tracing::warn!(%error, "the checkpoint of an ended job could not be removed");
        }
        drop(promise);
        ended
    }

    /// Does what may take long at the end without losing the claim over it.
    async fn renewing<T>(&self, claim: &Claim, heartbeat: &mut Interval, work: impl Future<Output = T>) -> T {
        tokio::pin!(work);
        loop {
            tokio::select! {
                done = &mut work => return done,
                // should it be lost, the end is fenced off
                _ = heartbeat.tick() => { self.renew(claim, Vec::new()).await; }
            }
        }
    }

    async fn renew(&self, claim: &Claim, updates: Vec<Update>) -> Renewal {
        self.engine.renew(claim, updates).await.unwrap_or_else(|error| {
            // the lease may still hold; when it does not, the fence does
            tracing::error!(%error, "a claim could not be renewed");
            Renewal::Keep
        })
    }

    /// Reads the input and computes, off the async runtime.
    fn work(
        &self,
        claim: Claim,
        cancel: CancelToken,
        news: mpsc::UnboundedSender<Update>,
    ) -> impl Future<Output = Result<pipeline::Finished, Unfinished>> + Send + use<> {
        let (blobs, pool) = (self.blobs.clone(), self.pool.clone());
        async move {
            let clock = Instant::now();
            let (tenant, spec, name) = (claim.tenant, claim.spec, claim.id.to_string());
            let mut inputs = Vec::new();
            for id in spec.work.blobs() {
                inputs.push(read_input(&blobs, id).await?);
            }
            let before = match spec.work {
                Work::Fit(_) => blobs.checkpoint(&tenant, &name).await.unwrap_or_else(|error| {
                    tracing::warn!(%error, "the checkpoint could not be read; training begins anew");
                    None
                }),
                _ => None,
            };
            let (span, runtime) = (tracing::Span::current(), tokio::runtime::Handle::current());
            let compute = move || -> Result<pipeline::Finished, Ended> {
                let _entered = span.enter();
                let teller = Teller::new(news);
                let progress = |progress: Progress| teller.tell(progress);
                let settings = Settings { pool: &pool, cancel: &cancel, progress: &progress, watched: true };
                match &spec.work {
                    Work::Shrink(work) => {
                        let mut inputs = inputs.iter();
                        let mut next = |field: &FieldSpec| field.input.and_then(|_| inputs.next()).map(Bytes::as_ref);
                        let field = next(&work.field);
                        let mut opened = pipeline::open(&work.field, field, "/field")?;
                        if let Some(bytes) = field.filter(|_| work.latent_motion) {
                            opened = opened.with_latent_motion(bytes, &work.field.options)?;
                        }
                        if let Some(weight) = &work.weight {
                            opened = opened.with_weight(weight, next(weight), "/weight")?;
                        }
                        if let Some(surface) = work.warm_start.and_then(|_| inputs.next()) {
                            opened = opened.with_warm_start(surface, work.shrink.lattice)?;
                        }
                        cancel.check()?;
                        let asked = Asked {
                            shrink: &work.shrink,
                            budget: work.budget,
                            outputs: &spec.outputs,
                            load_seconds: clock.elapsed().as_secs_f64(),
                        };
                        pipeline::run(&opened, &asked, settings)
                    }
                    Work::Fit(fitting) => {
                        // one after the first epoch, then one every few seconds
                        let last = Cell::new(None::<Instant>);
                        let keep = |bytes: &StateBytes<'_>| {
                            if last.get().is_some_and(|last| last.elapsed() < CHECKPOINT_EVERY) {
                                return;
                            }
                            if let Err(error) = runtime.block_on(blobs.put_checkpoint(&tenant, &name, bytes().into())) {
                                tracing::warn!(%error, "a checkpoint could not be written");
                            }
                            last.set(Some(Instant::now()));
                        };
                        let kept = Kept { before: before.as_deref(), keep: &keep };
                        pipeline::run_fit(fitting, &inputs, &spec.outputs, &kept, &settings)
                    }
                    Work::Sensitivity(sensing) => {
                        pipeline::run_sensitivity(&sensing.field.options, &inputs, &spec.outputs, &settings)
                    }
                }
            };
            let made = priority::compute(compute).await.unwrap_or_else(|| {
                tracing::error!("the computation panicked");
                Err(Failure::internal().into())
            });
            made.map_err(Unfinished::Ended)
        }
    }

    /// Stores the outputs; they are durable before the outcome that names them is told. `None` when they cannot be stored.
    async fn store(&self, claim: &Claim, made: pipeline::Finished) -> Option<Outcome> {
        let certified = made.certified;
        let mut outputs = Vec::new();
        for (name, bytes) in made.files {
            let size = bytes.len() as u64;
            match self.blobs.put(bytes.into()).await {
                Ok(id) => outputs.push(Output {
                    name: name.name().to_owned(),
                    href: output_href(claim, name),
                    media_type: name.media_type().to_owned(),
                    bytes: size,
                    sha256: id.hex(),
                    certified,
                }),
                Err(error) => {
                    tracing::error!(%error, output = name.name(), "an output could not be stored");
                    return None;
                }
            }
        }
        let metrics = made.metrics;
        Some(match made.problem {
            None => Outcome::Succeeded { outputs, metrics },
            Some(problem) => Outcome::Failed { problem, outputs, metrics: Some(metrics) },
        })
    }

    /// Writes the end of an attempt; returns it in a word.
    async fn end(&self, claim: &Claim, outcome: Outcome) -> &'static str {
        for _ in 0..FINISH_TRIES {
            match self.engine.finish(claim, outcome.clone()).await {
                Ok(()) => {
                    let (ended, code) = match &outcome {
                        Outcome::Succeeded { .. } => ("succeeded", None),
                        Outcome::Failed { problem, .. } => ("failed", Some(problem.code.as_str())),
                        Outcome::Canceled => ("canceled", None),
                        Outcome::Released => ("released", None),
                    };
                    if let Outcome::Succeeded { metrics, .. } | Outcome::Failed { metrics: Some(metrics), .. } =
                        &outcome
                    {
                        metrics::job_reported(metrics);
                    }
                    tracing::info!(job.outcome = ended, problem.code = code, "job ended");
                    return ended;
                }
                Err(EngineError::Fenced { .. }) => {
                    tracing::warn!("the claim was lost at the end; nothing of this attempt counts");
                    return "lost";
                }
                Err(error) => {
                    tracing::error!(%error, "the end of the job could not be written");
                    tokio::time::sleep(BACKOFF).await;
                }
            }
        }
        "unfinished"
    }
}

/// Waits for room, unless the job is no longer wanted before there is any.
async fn until_canceled<T>(
    cancel: &CancelToken,
    room: impl Future<Output = Result<T, Failure>>,
) -> Result<T, Unfinished> {
    tokio::pin!(room);
    loop {
        if cancel.is_canceled() {
            return Err(Unfinished::Ended(Ended::Canceled));
        }
        if let Ok(room) = tokio::time::timeout(ROOM_LOOK, &mut room).await {
            return room.map_err(Unfinished::from);
        }
    }
}

/// Time since a job was named, which is when it was accepted. The clock of the node that accepted it may be ahead.
fn since_accepted(id: JobId) -> Duration {
    let named = id.0.get_timestamp().map_or((0, 0), |time| time.to_unix());
    let named = UNIX_EPOCH + Duration::new(named.0, named.1);
    SystemTime::now().duration_since(named).unwrap_or_default()
}

/// The bytes of an input that a job names.
async fn read_input(blobs: &Blobs, id: BlobId) -> Result<Bytes, Unfinished> {
    match blobs.get(id).await {
        Ok(bytes) => Ok(bytes),
        Err(BlobError::Missing) => {
            let detail = format!("no input {id} is stored");
            Err(Failure::new("unknown_input", "the input is not there", detail).into())
        }
        Err(error @ BlobError::Damaged(_)) => {
            tracing::error!(%error, "the input could not be read");
            Err(Failure::internal().into())
        }
        Err(error @ BlobError::Store(_)) => {
            tracing::error!(%error, "the input could not be read");
            Err(Unfinished::OutOfReach)
        }
    }
}

fn output_href(claim: &Claim, name: OutputName) -> String {
    format!("/v1/jobs/{}/outputs/{}", claim.id, name.name())
}

/// Turns the computation's progress into news, no more often than anyone can look.
struct Teller {
    news: mpsc::UnboundedSender<Update>,
    started: Instant,
    last: Mutex<Last>,
}

#[derive(Default)]
struct Last {
    /// Attempt and stage.
    step: (u32, &'static str),
    progress: Option<Instant>,
    /// When as many mesh events would have come as have, at their mean pace.
    mesh: Option<Instant>,
}

impl Teller {
    fn new(news: mpsc::UnboundedSender<Update>) -> Self {
        Self { news, started: Instant::now(), last: Mutex::default() }
    }

    fn tell(&self, progress: Progress) {
        let now = Instant::now();
        let due = |last: Option<Instant>, every| last.is_none_or(|last: Instant| now.duration_since(last) >= every);
        let mut last = self.last.lock().unwrap_or_else(|e| e.into_inner());
        let step = (progress.attempt, progress.stage);
        if due(last.progress, PROGRESS_EVERY) || step != last.step {
            last.step = step;
            last.progress = Some(now);
            let view = view(&progress, self.started.elapsed());
            let data = serde_json::to_value(&view).unwrap_or_default();
            // nobody listens any more once the claim is lost
            let _ = self.news.send(Update { kind: EventKind::Progress, data, progress: Some(view) });
        }
        let paced = last.mesh.map_or(now, |mesh| mesh.max(now)) + MESH_EVERY;
        if paced <= now + MESH_BURST * MESH_EVERY
            && let Some(preview) = progress.front.as_ref().and_then(MeshPreview::new)
        {
            last.mesh = Some(paced);
            let data = serde_json::to_value(preview).unwrap_or_default();
            let _ = self.news.send(Update { kind: EventKind::Mesh, data, progress: None });
        }
    }
}

/// Progress as clients see it. The rest is judged to go at the pace so far, once a tenth is done.
fn view(progress: &Progress, elapsed: Duration) -> ProgressView {
    let fraction = if progress.fraction.is_finite() { progress.fraction.clamp(0.0, 1.0) } else { 0.0 };
    let done = f64::from(fraction);
    ProgressView {
        stage: progress.stage.to_owned(),
        attempt: progress.attempt,
        iteration: progress.iteration,
        iterations: progress.iterations,
        fraction,
        energy: progress.energy.filter(|e| e.is_finite()),
        max_distance: progress.max_distance.filter(|d| d.is_finite()),
        flips: progress.flips,
        eta_s: (done >= 0.1).then(|| elapsed.as_secs_f64() * (1.0 - done) / done),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn news_are_told_at_a_pace_that_can_be_followed() {
        let (news, mut inbox) = mpsc::unbounded_channel();
        let teller = Teller::new(news);
        let front = crate::settings::Front { positions: vec![[0.0; 3]; 3], triangles: vec![[0, 1, 2]], places: vec![] };
        for iteration in 0..1000 {
            teller.tell(Progress { stage: "contract", iteration, front: Some(front.clone()), ..Progress::default() });
        }
        let elapsed = teller.started.elapsed();
        drop(teller);
        let mut told = [0u32; 2];
        while let Ok(update) = inbox.try_recv() {
            told[usize::from(update.kind == EventKind::Mesh)] += 1;
        }
        assert!(
            told[0] <= 1 + elapsed.as_millis() as u32 / 100 && told[1] <= MESH_BURST + elapsed.as_millis() as u32 / 250,
            "{told:?}"
        );
        assert!(told[0] >= 1 && told[1] >= 1);
    }

    #[test]
    fn figures_that_are_not_finite_are_left_out() {
        let view =
            view(&Progress { fraction: f32::NAN, energy: Some(f64::NAN), ..Progress::default() }, Duration::ZERO);
        assert_eq!((view.fraction, view.energy, view.eta_s), (0.0, None, None));
    }
}
