//! More of the sphere for what a lattice misses: where the base surface is farther from the lattice's triangles than a result
//! may be, the density rises, and the map is brought to its new minimum. The field is not asked.

use super::rings::Mesh;
use glam::DVec3;

/// Largest density over the smallest.
const RANGE: f64 = 40.0;
/// Rings of neighbours that a rise is carried on to, falling to nothing: so far a limb's tip and its flanks are one feature.
const RINGS: usize = 6;

/// Places where a surface was found wanting reach so far, as a share of the base's diagonal.
const AROUND: f64 = 0.02;

/// Length of the diagonal of a mesh's box.
fn diagonal(mesh: &Mesh) -> f64 {
    let (lo, hi) =
        mesh.positions.iter().fold((mesh.positions[0], mesh.positions[0]), |(lo, hi), &p| (lo.min(p), hi.max(p)));
    lo.distance(hi)
}

/// Raises `density` by `rise` around the places where the surface before was found wanting, in the mesh's frame.
pub fn denser_at(mesh: &Mesh, places: &[DVec3], rise: f64, density: &mut [f64]) {
    let reach = AROUND * diagonal(mesh);
    let near = |p: &DVec3| places.iter().any(|q| q.distance(*p) < reach);
    let missed: Vec<f64> = mesh.positions.iter().map(|p| if near(p) { rise * reach } else { 0.0 }).collect();
    denser(mesh, &missed, AROUND, rise, density);
}

/// Raises `density` where the base is `missed` (a distance per vertex) by more than `share` of its diagonal: in proportion, and
/// at most by `most`. Returns whether that was anywhere.
pub fn denser(mesh: &Mesh, missed: &[f64], share: f64, most: f64, density: &mut [f64]) -> bool {
    let limit = share * diagonal(mesh);
    // rises as logarithms, carried on by the larger of a vertex's own and a share of its neighbours'
    let mut rise: Vec<f64> = missed.iter().map(|m| (m / limit).clamp(1.0, most).ln()).collect();
    if rise.iter().all(|&r| r == 0.0) {
        return false;
    }
    let fall = rise.iter().fold(0.0f64, |m, &r| m.max(r)) / RINGS as f64;
    for _ in 0..RINGS {
        rise = (0..rise.len())
            .map(|v| {
                let around = mesh.rings.ring(v as u32).iter().map(|&u| rise[u as usize]).fold(0.0, f64::max);
                rise[v].max(around - fall)
            })
            .collect();
    }
    let least = density.iter().copied().fold(f64::INFINITY, f64::min);
    for (d, r) in density.iter_mut().zip(rise) {
        *d = (*d * r.exp()).min(RANGE * least);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::super::lattice::{LatticeSpec, SphereLattice};
    use super::super::rings::Rings;
    use super::*;

    const RISE: f64 = 3.0;

    fn sphere() -> Mesh {
        let lattice = SphereLattice::new(LatticeSpec::Octahedral { n: 12 });
        let triangles = lattice.triangles(&vec![false; lattice.quads.len()]);
        let rings = Rings::new(lattice.directions.len(), &triangles).unwrap();
        Mesh { positions: lattice.directions.clone(), rings }
    }

    /// A vertex on the other side.
    fn far_from(mesh: &Mesh) -> usize {
        let along = |v: &usize| mesh.positions[*v].dot(mesh.positions[100]);
        (0..mesh.positions.len()).min_by(|a, b| along(a).total_cmp(&along(b))).unwrap()
    }

    #[test]
    fn density_rises_around_what_is_missed_and_nowhere_else() {
        let mesh = sphere();
        let n = mesh.positions.len();
        let (mut density, mut missed) = (vec![1.0; n], vec![0.0; n]);
        assert!(!denser(&mesh, &missed, 0.005, RISE, &mut density) && density.iter().all(|&d| d == 1.0));
        missed[100] = 1.0;
        assert!(denser(&mesh, &missed, 0.005, RISE, &mut density));
        assert!((density[100] - RISE).abs() < 1e-9);
        let neighbour = density[mesh.rings.ring(100)[0] as usize];
        assert!(neighbour > 1.0 && neighbour < RISE, "{neighbour}");
        let far = (0..n).filter(|&v| mesh.positions[v].dot(mesh.positions[100]) < -0.5);
        assert!(far.into_iter().all(|v| density[v] == 1.0));
        let mut around = vec![1.0; n];
        denser_at(&mesh, &[mesh.positions[100]], RISE, &mut around);
        assert!((around[100] - RISE).abs() < 1e-9);
        assert_eq!(around[far_from(&mesh)], 1.0);
        for _ in 0..10 {
            denser(&mesh, &missed, 0.005, RISE, &mut density);
        }
        assert_eq!(density[100], RANGE);
    }
}
