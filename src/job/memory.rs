//! How much memory a job is estimated to take, and how much there is.
//!
//! The estimate is of the peak of an attempt, from above: the factors are those of `benches/memory.py`, which measures whole processes,
//! rounded up. It is made when a job is accepted, from what is known of its inputs, and stored with it; a worker runs no more jobs at
//! once than have room together.

use super::Failure;
use super::spec::Work;
use crate::field::input::Description;
use crate::fit::FitSpec;
use crate::shrink::Method;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

const KIB: u64 = 1 << 10;
const MIB: u64 = 1 << 20;
/// What every job takes: the front, tables, outputs.
const EVERY: u64 = 64 * MIB;
/// A vertex of the result, with its triangles and the files it is written to, and with the charts of the adaptive method.
const VERTEX: u64 = 1792;
/// A vertex of the paper's loop.
const PAPER_VERTEX: u64 = KIB;
/// A triangle of a mesh whose distance is taken.
const TRIANGLE: u64 = 1536;
/// A byte of a grid's file.
const GRID_BYTE: u64 = 4;
/// A byte of a network's file: read, checked, packed for the kernel.
const NETWORK_BYTE: u64 = 24;
/// What a network is evaluated in: the values of a block of points in every layer, for every thread.
const NETWORK: u64 = 64 * MIB;
/// A byte of a scene, once it is a tree.
const SCENE_BYTE: u64 = 64;
/// A sample of a fit: point, distance, gradient, and the order in which it is taken.
const SAMPLE: u64 = 32;
/// What one output of a layer leaves behind for the way back, for one sample of a batch: of a value, and of a value with its gradient.
const PASS: [u64; 2] = [16, 64];

/// What every job is taken to need.
pub const fn of_least_job() -> u64 {
    EVERY
}

/// What an input takes once it is a field: of so many bytes, and described so.
pub fn of_input(bytes: u64, description: &Description) -> u64 {
    match description {
        Description::Scene { .. } => of_scene(bytes),
        Description::Network { .. } => NETWORK.saturating_add(bytes.saturating_mul(NETWORK_BYTE)),
        Description::Mesh { triangles, .. } => {
            bytes.saturating_mul(2).saturating_add(triangles.saturating_mul(TRIANGLE))
        }
        Description::Grid { .. } => bytes.saturating_mul(GRID_BYTE),
    }
}

/// What a gradient of so many bytes takes with the surface that it is of, which has as many vertices and more about each.
pub fn of_gradient(bytes: u64) -> u64 {
    bytes.saturating_mul(16)
}

/// What a scene of so many bytes takes.
pub fn of_scene(bytes: u64) -> u64 {
    bytes.saturating_mul(SCENE_BYTE)
}

/// What a job takes at its peak: so many vertices, of inputs that take so much.
pub fn of_job(work: &Work, vertices: u64, inputs: u64) -> u64 {
    let own = match work {
        Work::Shrink(work) => vertices.saturating_mul(match work.shrink.method {
            Method::Adaptive => VERTEX,
            Method::Paper => PAPER_VERTEX,
        }),
        Work::Fit(fitting) => of_fit(&fitting.fit, fitting.meshes.len() as u64),
        Work::Sensitivity(_) => 0,
    };
    EVERY.saturating_add(inputs).saturating_add(own)
}

fn of_fit(fit: &FitSpec, meshes: u64) -> u64 {
    let samples = u64::from(fit.samples).saturating_mul(meshes).saturating_mul(SAMPLE);
    // weights, their gradients and the optimizer's two moments
    let (layers, width) = (u64::from(fit.layers) + 1, u64::from(fit.width));
    let parameters = 16 * layers * width * (width + u64::from(fit.latent_size));
    let pass = PASS[usize::from(fit.normal > 0.0 || fit.eikonal > 0.0)];
    let batch = u64::from(fit.batch) * layers * width * pass;
    samples.saturating_add(parameters).saturating_add(batch)
}

/// What a worker's jobs may take together. Whoever comes first is served first, so that a large job is not passed by for ever.
pub struct Memory {
    bytes: u64,
    mib: Arc<Semaphore>,
}

impl Memory {
    /// So many bytes.
    pub fn new(bytes: u64) -> Self {
        // a semaphore counts in 32 bits
        let mib = u32::try_from(bytes / MIB).unwrap_or(u32::MAX).max(1);
        Self { bytes, mib: Arc::new(Semaphore::new(mib as usize)) }
    }

    /// Waits until there are so many bytes, which are held until the permit is dropped.
    ///
    /// # Errors
    /// When there will never be so many.
    pub async fn take(&self, bytes: u64) -> Result<OwnedSemaphorePermit, Failure> {
        if bytes > self.bytes {
            return Err(Failure::memory_exceeded(bytes, self.bytes));
        }
        let mib = u32::try_from(bytes / MIB).unwrap_or(u32::MAX).max(1);
        self.mib.clone().acquire_many_owned(mib).await.map_err(|_| Failure::internal())
    }
}

/// Bytes of memory that this process may take: those of its control group, or of the machine; `None` where neither can be told.
pub fn of_machine() -> Option<u64> {
    let number = |path: &str| std::fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    // a group without a limit says `max`, or (version 1) a number beyond every machine
    let group = number("/sys/fs/cgroup/memory.max").or_else(|| number("/sys/fs/cgroup/memory/memory.limit_in_bytes"));
    let machine = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| total(&text));
    group.into_iter().chain(machine).min()
}

/// The line `MemTotal:  24123456 kB`.
fn total(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(KIB)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn what_has_no_room_beside_others_waits_and_what_never_has_fails() {
        let memory = Memory::new(100 * MIB);
        let first = memory.take(60 * MIB).await.expect("has room");
        let waiting = memory.take(60 * MIB);
        tokio::pin!(waiting);
        assert!(futures::poll!(&mut waiting).is_pending());
        drop(first);
        drop(waiting.await.expect("has room now"));
        assert!(memory.take(101 * MIB).await.is_err_and(|failure| failure.code == "memory_exceeded"));
    }

    #[test]
    fn the_machines_memory_is_read() {
        assert_eq!(total("MemTotal:       24576 kB\nMemFree: 1 kB\n"), Some(24 * MIB));
        assert_eq!(total("MemTotal: much"), None);
        if cfg!(target_os = "linux") {
            assert!(of_machine().is_some_and(|bytes| bytes > 64 * MIB));
        }
    }
}
