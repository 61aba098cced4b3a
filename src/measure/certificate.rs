//! What makes a result a parameterized sphere: closed, Euler 2, one component, one chart, nothing folded, nothing crossing.

use super::intersection::self_intersections;
use super::report::Flips;
use super::{corners, doubled_normal};
use crate::field::Sampler;
use crate::settings::{Canceled, Settings};
use crate::surface::Surface;
use glam::{DVec3, Vec3};

/// Places listed at most, of each kind.
const PLACES: usize = 16;

/// The certificate of a surface.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Certificate {
    /// Topology of the welded triangles.
    pub topology: Topology,
    /// Charts: components of the chart triangles through shared chart vertices.
    pub charts: u64,
    /// Folded triangles.
    pub flips: Flips,
    /// Centroids of the first triangles folded on the surface, scene units.
    pub flip_places: Vec<DVec3>,
    /// Triangles of exactly no area on the surface.
    pub degenerate: u64,
    /// Pairs of triangles that meet in more than what they share; see [`self_intersections`].
    pub self_intersections: u64,
    /// Centroids of the first triangles of such pairs, scene units.
    pub intersection_places: Vec<DVec3>,
}

/// Topology of a triangle mesh.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Topology {
    /// Whether every directed edge occurs exactly once and so does its reverse.
    pub closed: bool,
    /// V - E + F over the vertices that triangles use and undirected edges.
    pub euler: i64,
    /// Components through shared vertices.
    pub components: u64,
}

/// Positions of a surface in double precision, exactly as written.
pub fn positions(surface: &Surface) -> Vec<DVec3> {
    surface.positions.iter().map(|&p| Vec3::from(p).as_dvec3()).collect()
}

/// Examines a surface against the field behind `sampler` (one value with gradient per triangle).
///
/// # Errors
/// When the token is raised.
pub fn certify(surface: &Surface, sampler: &Sampler<'_>) -> Result<Certificate, Canceled> {
    let vertices = positions(surface);
    let (folded, degenerate) = surface_flips(&vertices, &surface.triangles, sampler)?;
    let crossing = self_intersections(&vertices, &surface.triangles, sampler.settings())?;
    let places = |list: &[u32]| -> Vec<DVec3> {
        let centroid = |&t: &u32| corners(&vertices, surface.triangles[t as usize]).iter().sum::<DVec3>() / 3.0;
        list.iter().take(PLACES).map(centroid).collect()
    };
    Ok(Certificate {
        topology: topology(vertices.len(), &surface.triangles),
        charts: topology(surface.lattice.chart.len(), &surface.chart_triangles).components,
        flips: Flips { surface: folded.len() as u64, sphere: sphere_flips(surface), uv: uv_flips(surface) },
        flip_places: places(&folded),
        degenerate,
        self_intersections: crossing.pairs,
        intersection_places: places(&crossing.triangles),
    })
}

/// Topology of triangles over `vertices` vertices. A mesh without triangles is closed and has Euler number 0.
pub fn topology(vertices: usize, triangles: &[[u32; 3]]) -> Topology {
    let mut edges: Vec<(u32, u32)> =
        triangles.iter().flat_map(|t| [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])]).collect();
    edges.sort_unstable();
    let once = edges.windows(2).all(|pair| pair[0] != pair[1]) && edges.iter().all(|e| e.0 != e.1);
    let closed = once && edges.iter().all(|&(a, b)| edges.binary_search(&(b, a)).is_ok());
    let mut undirected: Vec<(u32, u32)> = edges.iter().map(|&(a, b)| (a.min(b), a.max(b))).collect();
    undirected.sort_unstable();
    undirected.dedup();

    let mut parent: Vec<u32> = (0..vertices as u32).collect();
    fn root(parent: &mut [u32], mut v: u32) -> u32 {
        while parent[v as usize] != v {
            parent[v as usize] = parent[parent[v as usize] as usize];
            v = parent[v as usize];
        }
        v
    }
    let mut used = vec![false; vertices];
    for t in triangles {
        for &v in t {
            used[v as usize] = true;
        }
        let first = root(&mut parent, t[0]);
        for &v in &t[1..] {
            let other = root(&mut parent, v);
            parent[other as usize] = first;
        }
    }
    let in_use = used.iter().filter(|&&u| u).count();
    let components = (0..vertices).filter(|&v| used[v] && parent[v] as usize == v).count();
    Topology {
        closed,
        euler: in_use as i64 - undirected.len() as i64 + triangles.len() as i64,
        components: components as u64,
    }
}

/// Triangles whose normal opposes the field's gradient at their centroid, and the number of those without area.
pub fn surface_flips(
    vertices: &[DVec3],
    triangles: &[[u32; 3]],
    sampler: &Sampler<'_>,
) -> Result<(Vec<u32>, u64), Canceled> {
    let centroids: Vec<DVec3> = triangles.iter().map(|&t| corners(vertices, t).iter().sum::<DVec3>() / 3.0).collect();
    let (_, gradients) = sampler.gradients(&centroids)?;
    let (mut folded, mut degenerate) = (Vec::new(), 0);
    for (i, (&t, &gradient)) in triangles.iter().zip(&gradients).enumerate() {
        let normal = doubled_normal(corners(vertices, t));
        if normal == DVec3::ZERO {
            degenerate += 1;
        } else if normal.dot(gradient) < 0.0 {
            folded.push(i as u32);
        }
    }
    Ok((folded, degenerate))
}

/// Triangles of the lattice that are not counter-clockwise on the sphere, seen from outside.
fn sphere_flips(surface: &Surface) -> u64 {
    let turned = |t: &&[u32; 3]| {
        let [a, b, c] = corners(&surface.lattice.directions, **t);
        a.dot(b.cross(c)) <= 0.0
    };
    surface.triangles.iter().filter(turned).count() as u64
}

/// Chart triangles that are mirrored or have no area. As v points down, counter-clockwise from outside is negative in (u, v).
pub fn uv_flips(surface: &Surface) -> u64 {
    let uv = surface.uv();
    let mirrored = |t: &&[u32; 3]| {
        let [a, b, c] = t.map(|v| uv[v as usize]);
        (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) >= 0.0
    };
    surface.chart_triangles.iter().filter(mirrored).count() as u64
}

/// Self-intersections of any mesh, by count and by the centroids of the first triangles that take part.
pub fn crossings(
    vertices: &[DVec3],
    triangles: &[[u32; 3]],
    settings: &Settings<'_>,
) -> Result<(u64, Vec<DVec3>), Canceled> {
    let crossing = self_intersections(vertices, triangles, settings)?;
    let places = crossing
        .triangles
        .iter()
        .take(PLACES)
        .map(|&t| corners(vertices, triangles[t as usize]).iter().sum::<DVec3>() / 3.0);
    Ok((crossing.pairs, places.collect()))
}

#[cfg(test)]
mod tests {
    use super::super::fixtures::*;
    use super::*;
    use crate::field::sampler::Tally;
    use crate::shrink::lattice::LatticeSpec;

    const SPECS: [LatticeSpec; 2] =
        [LatticeSpec::Latlong { n_theta: 40, n_phi: 20 }, LatticeSpec::Octahedral { n: 12 }];

    fn certificate(surface: &Surface) -> Certificate {
        with_settings(2, |settings| {
            let tally = Tally::new();
            certify(surface, &Sampler::new(&Balls::one(0.5), *settings, &tally)).unwrap()
        })
    }

    #[test]
    fn a_sphere_has_nothing_to_complain_about() {
        for spec in SPECS {
            let found = certificate(&sphere_surface(spec, 0.5));
            let topology = Topology { closed: true, euler: 2, components: 1 };
            assert_eq!(found, Certificate { topology, charts: 1, ..Default::default() }, "{spec:?}");
        }
    }

    #[test]
    fn a_flipped_triangle_is_counted_and_opens_the_surface() {
        let mut surface = sphere_surface(SPECS[0], 0.5);
        surface.triangles[100].swap(0, 1);
        let found = certificate(&surface);
        assert!(!found.topology.closed);
        assert_eq!(found.flips, Flips { surface: 1, sphere: 1, uv: 0 });
        assert_eq!(found.flip_places.len(), 1);
        surface.chart_triangles[7].swap(0, 2);
        assert_eq!(certificate(&surface).flips.uv, 1);
    }

    #[test]
    fn a_vertex_pulled_across_its_neighbours_folds_and_is_seen() {
        let mut surface = sphere_surface(SPECS[1], 0.5);
        let v = surface.triangles[60][0];
        let away = surface.triangles[60].map(|i| Vec3::from(surface.positions[i as usize]));
        let across = away[0] + 4.0 * (away[1] - away[0]);
        surface.positions[v as usize] = (0.5 * across.normalize()).to_array();
        let found = certificate(&surface);
        assert!(found.flips.surface > 0 && found.self_intersections > 0, "{found:?}");
        assert!(!found.intersection_places.is_empty());
    }

    #[test]
    fn an_edge_with_three_triangles_is_not_closed() {
        let (vertices, mut triangles) = sphere_mesh(8, 6, 1.0, DVec3::ZERO);
        assert!(topology(vertices.len(), &triangles).closed);
        let [a, b, _] = triangles[0];
        triangles.push([a, b, 20]);
        assert!(!topology(vertices.len(), &triangles).closed);
    }

    #[test]
    fn two_spheres_are_two_components_of_euler_number_four() {
        let (vertices, mut triangles) = sphere_mesh(8, 6, 1.0, DVec3::ZERO);
        let n = vertices.len() as u32;
        triangles.extend(triangles.clone().iter().map(|t| t.map(|v| v + n)));
        assert_eq!(topology(2 * vertices.len(), &triangles), Topology { closed: true, euler: 4, components: 2 });
    }
}
