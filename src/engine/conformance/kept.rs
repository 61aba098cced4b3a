//! What is kept for a job, and what is forgotten.

use super::super::{Engine, Forgotten, NewJob};
use super::{claim_one, new_job, own, submit, success};
use crate::blobs::BlobId;
use crate::job::spec::WarmStartSpec;
use crate::job::spec::Work;
use crate::job::{JobId, JobSpec};
use jiff::Timestamp;
use serde_json::json;
use std::sync::Arc;

pub async fn a_blob_is_named_while_a_job_remembers_it(engine: &Arc<dyn Engine>) {
    let (input, output, stray) =
        (BlobId::of(b"an input"), BlobId::of(b"an output").hex(), BlobId::of(b"a stray").hex());
    let request = json!({"field": {"input": input.to_string()}});
    let spec =
        JobSpec::from_value(&request).unwrap_or_else(|faults| panic!("the suite's own job is refused: {faults:?}"));
    let id = submit(engine, NewJob { tenant: own(), id: JobId::new(), spec, vertices: 0, key: None }).await;
    let unnamed = async |expired: Option<Timestamp>| {
        let blobs = vec![input.hex(), output.clone(), stray.clone()];
        engine.unnamed(None, blobs, expired).await.expect("answers")
    };
    assert_eq!(unnamed(None).await, [output.clone(), stray.clone()]);
    let claim = claim_one(engine, "a").await;
    engine.finish(&claim, success(&output)).await.expect("finishes");
    let ended = engine.get(&own(), id).await.expect("reads").expect("is there").finished_at.expect("has ended");
    assert_eq!(unnamed(None).await, std::slice::from_ref(&stray));
    assert_eq!(unnamed(Some(ended)).await, std::slice::from_ref(&stray), "it ended then, and not before");
    let later = ended.checked_add(jiff::SignedDuration::from_secs(1)).expect("a time");
    assert_eq!(unnamed(Some(later)).await, [input.hex(), output.clone(), stray.clone()]);
    assert_eq!(engine.forget(&own(), id).await.expect("answers"), Forgotten::Gone(vec![output.clone()]), "inputs stay");
    assert_eq!(unnamed(None).await, [input.hex(), output.clone(), stray.clone()]);
}

pub async fn only_an_ended_job_is_forgotten(engine: &Arc<dyn Engine>) {
    let mut ids = Vec::new();
    for _ in 0..2 {
        ids.push(submit(engine, new_job()).await);
        let claim = claim_one(engine, "a").await;
        assert_eq!(engine.forget(&own(), claim.id).await.expect("answers"), Forgotten::Running);
        engine.finish(&claim, success("shared")).await.expect("finishes");
    }
    assert_eq!(
        engine.forget(&own(), ids[0]).await.expect("forgets"),
        Forgotten::Gone(Vec::new()),
        "the other job names it too"
    );
    assert_eq!(engine.forget(&own(), ids[1]).await.expect("forgets"), Forgotten::Gone(vec!["shared".to_owned()]));
    assert_eq!(engine.forget(&own(), ids[1]).await.expect("answers"), Forgotten::Unknown);
    assert_eq!(engine.get(&own(), ids[1]).await.expect("reads"), None);
}

pub async fn a_surface_is_kept_for_the_jobs_that_begin_from_it(engine: &Arc<dyn Engine>) {
    let surface = BlobId::of(b"surface");
    let earlier = submit(engine, new_job()).await;
    let claim = claim_one(engine, "a").await;
    engine.finish(&claim, success(&surface.hex())).await.expect("finishes");
    let mut job = new_job();
    let Work::Shrink(work) = &mut job.spec.work else { panic!("{:?}", job.spec) };
    work.warm_start = Some(WarmStartSpec { job: earlier, surface: Some(surface) });
    let later = submit(engine, job.clone()).await;
    assert_eq!(engine.spec(&own(), later).await.expect("reads"), Some(job.spec.clone()));
    let gone = engine.forget(&own(), earlier).await.expect("forgets");
    assert_eq!(gone, Forgotten::Gone(Vec::new()), "a job that waits begins from it");
    let claim = claim_one(engine, "a").await;
    assert_eq!(claim.spec, job.spec, "the worker is told which blob");
    engine.finish(&claim, success("other")).await.expect("finishes");
    assert_eq!(
        engine.get(&own(), later).await.expect("reads").expect("is there").outputs.len(),
        1,
        "it is no output of its own"
    );
    let gone = engine.forget(&own(), later).await.expect("forgets");
    assert_eq!(gone, Forgotten::Gone(vec!["other".to_owned(), surface.hex()]));
}
