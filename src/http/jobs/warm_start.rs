//! What a warm start names: an earlier job, of which the surface is looked up when the new job is accepted.

use super::estimate::surface_blob;
use super::{App, Problem};
use crate::blobs::BlobId;
use crate::field::Fault;
use crate::job::spec::{WarmStartSpec, Work};
use crate::job::{Job, JobSpec, State};
use crate::shrink::Method;
use crate::shrink::lattice::LatticeSpec;
use crate::tenant::Tenant;

const POINTER: &str = "/warm_start";

/// Puts the blob of the earlier job's surface into the spec, if there is a warm start. The blob must be kept by a promise
/// until the record of the new job names it.
///
/// # Errors
/// A problem that says what is wrong with the earlier job.
pub async fn resolve(app: &App, tenant: &Tenant, spec: &mut JobSpec) -> Result<(), Problem> {
    let Work::Shrink(work) = &mut spec.work else { return Ok(()) };
    let Some(WarmStartSpec { job, surface }) = work.warm_start else { return Ok(()) };
    if surface.is_some() {
        return Err(refused("wrong_type", "expected the id of a job, as a string".to_owned()));
    }
    let unknown = || refused("unknown_job", format!("there is no job {job}"));
    let earlier = app.engine.get(tenant, job).await?.ok_or_else(unknown)?;
    let surface = surface_of(&earlier, work.shrink.lattice)
        .map_err(|(code, detail)| refused(code, format!("job {job} {detail}")))?;
    work.warm_start = Some(WarmStartSpec { job, surface: Some(surface) });
    Ok(())
}

fn refused(code: &'static str, detail: String) -> Problem {
    Problem::invalid_request("", &[Fault { pointer: POINTER.to_owned(), code, detail }])
}

/// The surface of an earlier job that a new one can begin from; or else a code, and how a sentence about that job ends.
fn surface_of(earlier: &Job, lattice: LatticeSpec) -> Result<BlobId, (&'static str, String)> {
    let Some(shrink) = &earlier.shrink else {
        return Err(("wrong_kind", "made no surface".to_owned()));
    };
    if earlier.state != State::Succeeded {
        return Err(("not_succeeded", format!("has not succeeded: it is {}", earlier.state.name())));
    }
    // only the report of a curve has a dimension
    if earlier.metrics.as_ref().is_some_and(|metrics| metrics.get("dimension").is_some()) {
        return Err(("dimension", "made a curve, and this field has dimension 3".to_owned()));
    }
    if shrink.method != Method::Adaptive {
        return Err(("wrong_method", "was made by the method paper, which folds".to_owned()));
    }
    if shrink.lattice != lattice {
        let [there, here] = [shrink.lattice, lattice].map(|lattice| serde_json::json!(lattice));
        return Err(("other_lattice", format!("is on the lattice {there}, and this one on {here}")));
    }
    surface_blob(earlier).ok_or_else(|| ("no_surface", "has no output \"surface\"".to_owned()))
}
