//! Shapes and settings for the tests of this room.

use crate::field::{Domain, Field, Gradients, Metric, Points};
use crate::settings::{CancelToken, Settings};
use crate::shrink::lattice::{LatticeSpec, SphereLattice};
use crate::surface::Surface;
use glam::{DVec3, Vec3};

pub(crate) use super::sampling::Splitmix;

/// Runs `f` on a pool of `threads` threads, without cancel or progress.
pub(crate) fn with_settings<R>(threads: usize, f: impl FnOnce(&Settings<'_>) -> R) -> R {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let cancel = CancelToken::new();
    f(&Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false })
}

/// A lat-long sphere as a bare mesh.
pub(crate) fn sphere_mesh(n_theta: u32, n_phi: u32, radius: f64, center: DVec3) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let lattice = SphereLattice::new(LatticeSpec::Latlong { n_theta, n_phi });
    let vertices = lattice.directions.iter().map(|&d| center + radius * d).collect();
    (vertices, lattice.triangles(&vec![false; lattice.quads.len()]))
}

/// A surface whose positions and normals a closure gives for every direction of the sphere.
pub(crate) fn surface_of(spec: LatticeSpec, place: impl Fn(DVec3) -> (DVec3, DVec3)) -> Surface {
    let lattice = SphereLattice::new(spec);
    let diagonals = vec![false; lattice.quads.len()];
    let placed: Vec<(DVec3, DVec3)> = lattice.directions.iter().map(|&d| place(d)).collect();
    Surface {
        positions: placed.iter().map(|(p, _)| p.as_vec3().to_array()).collect(),
        normals: placed.iter().map(|(_, n)| n.normalize().as_vec3().to_array()).collect(),
        gradient_norms: vec![1.0; placed.len()],
        values: vec![0.0; placed.len()],
        triangles: lattice.triangles(&diagonals),
        chart_triangles: lattice.chart_triangles(&diagonals),
        lattice,
        relaxed_uv: None,
    }
}

/// A sphere of a radius about the origin.
pub(crate) fn sphere_surface(spec: LatticeSpec, radius: f64) -> Surface {
    surface_of(spec, |d| (radius * d, d))
}

/// Exact distance to the union of balls, times `slope`.
pub(crate) struct Balls {
    pub(crate) balls: Vec<(Vec3, f32)>,
    pub(crate) slope: f32,
    pub(crate) metric: Metric,
}

impl Balls {
    pub(crate) fn one(radius: f32) -> Self {
        Self { balls: vec![(Vec3::ZERO, radius)], slope: 1.0, metric: Metric::Exact }
    }
    fn at(&self, p: Vec3) -> (f32, Vec3) {
        let (s, d) =
            self.balls.iter().map(|&(c, r)| ((p - c).length() - r, p - c)).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
        (self.slope * s, self.slope * d.normalize_or_zero())
    }
}

impl Field for Balls {
    fn domain(&self) -> Domain {
        Domain::default()
    }
    fn metric(&self) -> Metric {
        self.metric
    }
    fn lipschitz(&self) -> Option<f32> {
        (self.metric == Metric::Exact).then_some(self.slope)
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        for (i, v) in values.iter_mut().enumerate() {
            *v = self.at(Vec3::new(points.x[i], points.y[i], points.z[i])).0;
        }
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        for (i, v) in values.iter_mut().enumerate() {
            let (s, g) = self.at(Vec3::new(points.x[i], points.y[i], points.z[i]));
            *v = s;
            (gradients.x[i], gradients.y[i], gradients.z[i]) = (g.x, g.y, g.z);
        }
    }
}

/// A field of value and gradient by a formula, over a box of half side 1.5 about the origin, that changes by at most 1 per
/// length.
pub(crate) struct Formula<F> {
    pub(crate) at: F,
    pub(crate) metric: Metric,
}

impl<F: Fn(DVec3) -> (f64, DVec3) + Send + Sync> Field for Formula<F> {
    fn domain(&self) -> Domain {
        Domain { min: [-1.5; 3], max: [1.5; 3] }
    }
    fn metric(&self) -> Metric {
        self.metric
    }
    fn lipschitz(&self) -> Option<f32> {
        Some(1.0)
    }
    fn values(&self, p: Points<'_>, values: &mut [f32]) {
        for (i, v) in values.iter_mut().enumerate() {
            *v = (self.at)(DVec3::new(p.x[i].into(), p.y[i].into(), p.z[i].into())).0 as f32;
        }
    }
    fn gradients(&self, p: Points<'_>, values: &mut [f32], g: Gradients<'_>) {
        for (i, value) in values.iter_mut().enumerate() {
            let (s, n) = (self.at)(DVec3::new(p.x[i].into(), p.y[i].into(), p.z[i].into()));
            (*value, g.x[i], g.y[i], g.z[i]) = (s as f32, n.x as f32, n.y as f32, n.z as f32);
        }
    }
}
