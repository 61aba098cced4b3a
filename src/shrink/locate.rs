//! Finding the spherical triangle that holds a direction.

use super::rings::Mesh;
use crate::settings::{Canceled, Settings};
use glam::DVec3;
use rayon::prelude::*;

/// A direction's place in a map: the triangle and the barycentric weights of its corners.
pub type Place = ([u32; 3], [f64; 3]);

/// Queries that follow one walk; fixed, so that the number of threads changes nothing.
const CHUNK: usize = 2048;

/// Locates `queries` in the map `directions` of `mesh` by walking from triangle to triangle. Near queries should follow
/// each other. A walk that does not end falls back to looking at every triangle.
pub fn locate(
    mesh: &Mesh,
    directions: &[DVec3],
    queries: &[DVec3],
    settings: &Settings<'_>,
) -> Result<Vec<Place>, Canceled> {
    let map = Map::new(mesh, directions);
    let chunk = |(k, queries): (usize, &[DVec3])| {
        settings.cancel.check()?;
        let mut walk = Walk { map: &map, current: map.start(queries[0]), seed: 12345 + k as u64 };
        Ok(queries.iter().map(|&q| walk.to(q)).collect())
    };
    let chunks: Result<Vec<Vec<Place>>, Canceled> =
        settings.pool.install(|| queries.par_chunks(CHUNK).enumerate().map(chunk).collect());
    Ok(chunks?.into_iter().flatten().collect())
}

/// The triangles of a map and who is next to whom.
struct Map<'a> {
    directions: &'a [DVec3],
    triangles: Vec<[u32; 3]>,
    /// The triangle on the other side of the edge opposite each corner.
    across: Vec<[u32; 3]>,
}

impl<'a> Map<'a> {
    fn new(mesh: &Mesh, directions: &'a [DVec3]) -> Self {
        let triangles = mesh.rings.triangles();
        // the triangle left of every directed edge, in the order of the rings
        let mut first = Vec::with_capacity(mesh.rings.len() + 1);
        first.push(0);
        for v in 0..mesh.rings.len() as u32 {
            first.push(first[v as usize] + mesh.rings.valence(v));
        }
        let slot = |v: u32, w: u32| {
            let place = mesh.rings.ring(v).iter().position(|&u| u == w).expect("corners of a triangle are joined");
            first[v as usize] + place
        };
        let mut left = vec![u32::MAX; first[mesh.rings.len()]];
        for (i, t) in triangles.iter().enumerate() {
            for c in 0..3 {
                left[slot(t[c], t[(c + 1) % 3])] = i as u32;
            }
        }
        let across = triangles.iter().map(|t| [0, 1, 2].map(|c| left[slot(t[(c + 2) % 3], t[(c + 1) % 3])])).collect();
        Self { directions, triangles, across }
    }

    /// Barycentric weights of a direction, all of one sign inside, up to a common factor.
    fn weights(&self, triangle: usize, q: DVec3) -> [f64; 3] {
        let [a, b, c] = self.triangles[triangle].map(|v| self.directions[v as usize]);
        [q.dot(b.cross(c)), q.dot(c.cross(a)), q.dot(a.cross(b))]
    }

    /// The nearest of some triangles spread over the mesh.
    fn start(&self, q: DVec3) -> usize {
        const SAMPLES: usize = 512;
        let nearness = |t: usize| self.directions[self.triangles[t][0] as usize].dot(q);
        let stride = self.triangles.len().div_ceil(SAMPLES);
        (0..self.triangles.len())
            .step_by(stride)
            .max_by(|&a, &b| nearness(a).total_cmp(&nearness(b)))
            .expect("a mesh has triangles")
    }
}

/// One walk over a map.
struct Walk<'a> {
    map: &'a Map<'a>,
    current: usize,
    seed: u64,
}

impl Walk<'_> {
    fn to(&mut self, q: DVec3) -> Place {
        /// Steps after which a walk is given up.
        const PATIENCE: usize = 10_000;
        for _ in 0..PATIENCE {
            let w = self.map.weights(self.current, q);
            let tolerance = -1e-12 * w.iter().map(|x| x.abs()).sum::<f64>();
            if w.iter().all(|&x| x >= tolerance) && w.iter().sum::<f64>() > 0.0 {
                return self.place(w);
            }
            // the first negative edge from a random one on, so that no walk goes round in circles
            self.seed = self.seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let start = (self.seed >> 33) as usize % 3;
            let edge = (0..3).map(|k| (k + start) % 3).find(|&c| w[c] < tolerance).unwrap_or(start);
            self.current = self.map.across[self.current][edge] as usize;
        }
        let (mut best, mut kept) = (f64::NEG_INFINITY, [1.0; 3]);
        for i in 0..self.map.triangles.len() {
            let w = self.map.weights(i, q);
            let sum: f64 = w.iter().sum();
            let least = w.iter().copied().fold(f64::INFINITY, f64::min) / sum;
            if sum > 0.0 && least > best {
                (best, self.current, kept) = (least, i, w);
            }
        }
        self.place(kept)
    }

    fn place(&self, w: [f64; 3]) -> Place {
        let w = w.map(|x| x.max(0.0));
        let sum: f64 = w.iter().sum();
        (self.map.triangles[self.current], w.map(|x| x / sum))
    }
}

#[cfg(test)]
mod tests {
    use super::super::lattice::{LatticeSpec, SphereLattice};
    use super::super::rings::Rings;
    use super::*;
    use crate::settings::{CancelToken, Progress};

    #[test]
    fn every_direction_is_found_in_a_triangle_that_holds_it_whoever_looks() {
        let base = SphereLattice::new(LatticeSpec::Octahedral { n: 12 });
        let rings = Rings::new(base.directions.len(), &base.triangles(&vec![false; base.quads.len()])).unwrap();
        let mesh = Mesh { positions: base.directions.clone(), rings };
        let queries = SphereLattice::new(LatticeSpec::Latlong { n_theta: 120, n_phi: 60 }).directions;
        assert!(queries.len() > 3 * CHUNK, "more than one walk");
        let found = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let cancel = CancelToken::new();
            let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_: Progress| {}, watched: false };
            locate(&mesh, &base.directions, &queries, &settings).unwrap()
        };
        let places = found(1);
        for (q, (t, w)) in queries.iter().zip(&places) {
            let p: DVec3 = (0..3).map(|c| w[c] * base.directions[t[c] as usize]).sum();
            assert!(p.normalize().distance(*q) < 1e-9, "{q} was placed at {p}");
        }
        assert_eq!(places, found(5));
    }
}
