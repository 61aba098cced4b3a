//! The exact signed distance to a triangle mesh.
//!
//! The nearest triangle comes from parry's bounding-volume hierarchy, the sign from the angle-weighted pseudo-normal of
//! the nearest feature (J. A. Baerentzen and H. Aanaes, 2005), which is right for every closed mesh that does not meet
//! itself. For all other meshes, and where a pseudo-normal is undecided, the generalized winding number decides. All
//! arithmetic is in `f64` about the center of the mesh; only the given points and the answers are `f32`.

use super::closest::{Feature, closest};
use super::topology::{NONE, Soundness, normals, orient};
use super::winding::Winding;
use super::{MAX_TRIANGLES, MAX_VERTICES, TriangleMesh, intersect, limit, malformed};
use crate::field::{Domain, Field, FieldError, Gradients, Metric, Points};
use glam::DVec3;
use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::partitioning::{Bvh, BvhBuildStrategy, BvhLeafCost};
use std::sync::OnceLock;

/// The domain is the bounding box grown on each side by this share of its longest side: room for the start of a front.
const MARGIN: f64 = 0.12;
/// Nearer to the surface than this share of the bounding box's diagonal, the direction to the nearest point is rounding,
/// and the pseudo-normal is the gradient.
const ON_SURFACE: f64 = 1e-9;
/// A pseudo-normal decides the sign when the point is this far from lying across it (as a cosine); a closed surface
/// leaves such points only at needles.
const UNDECIDED: f64 = 1e-7;
/// The previous point's triangle bounds the search of the next, widened by this share so that the bound itself never
/// decides between equally near triangles: the answer must not depend on the batch.
const WIDENED: f64 = 1.0 + 1e-9;

/// The signed distance to a triangle mesh, negative inside, as a [`Field`].
pub struct MeshField {
    mesh: TriangleMesh,
    soundness: Soundness,
    domain: Domain,
    center: DVec3,
    on_surface: f64,
    bvh: Bvh,
    triangles: Vec<Triangle>,
    neighbours: Vec<[u32; 3]>,
    vertex_normals: Vec<DVec3>,
    winding: OnceLock<Winding>,
}

/// A triangle about the mesh's center, as the nearest-point search wants it.
struct Triangle {
    a: DVec3,
    ab: DVec3,
    ac: DVec3,
    normal: DVec3,
}

/// The nearest place found on a leaf.
struct Nearest {
    distance2: f64,
    place: DVec3,
    feature: Feature,
}

impl BvhLeafCost for Nearest {
    fn cost(&self) -> f64 {
        self.distance2
    }
}

impl MeshField {
    /// Prepares the distance to `mesh`. Triangles that disagree with their neighbours are turned, and all of them if the
    /// enclosed volume is negative; [`MeshField::soundness`] counts them. The domain is the bounding box grown by 12 %
    /// of its longest side on each side.
    ///
    /// # Errors
    /// [`FieldError::Malformed`] when the mesh has no triangle, an index has no vertex, a coordinate is not finite or all
    /// vertices are in one place; [`FieldError::Limit`] for more than [`MAX_TRIANGLES`].
    pub fn new(mut mesh: TriangleMesh) -> Result<Self, FieldError> {
        if mesh.triangles.len() > MAX_TRIANGLES {
            return Err(limit("triangles of a mesh", mesh.triangles.len(), MAX_TRIANGLES));
        }
        if mesh.vertices.len() > MAX_VERTICES {
            return Err(limit("vertices of a mesh", mesh.vertices.len(), MAX_VERTICES));
        }
        if mesh.triangles.is_empty() {
            return Err(malformed("mesh", None, "the mesh has no triangle"));
        }
        if mesh.triangles.iter().flatten().any(|&i| i as usize >= mesh.vertices.len()) {
            return Err(malformed("mesh", None, "a triangle has a corner without a vertex"));
        }
        if !mesh.vertices.iter().flatten().all(|c| c.abs() <= super::MAX_COORDINATE) {
            return Err(malformed("mesh", None, "a vertex is not finite or beyond 1e30"));
        }
        let (low, high) = mesh.bounds();
        let (low, high) = (DVec3::from(low), DVec3::from(high));
        let (center, longest) = (0.5 * (low + high), (high - low).max_element());
        if longest <= 0.0 {
            return Err(malformed("mesh", None, "all vertices are in one place"));
        }

        let (neighbours, mut soundness) = orient(&mut mesh);
        let vertices: Vec<DVec3> = mesh.vertices.iter().map(|&v| DVec3::from(v) - center).collect();
        let (face_normals, vertex_normals) = normals(&vertices, &mesh.triangles);
        let triangles: Vec<Triangle> = mesh
            .triangles
            .iter()
            .zip(face_normals)
            .map(|(corners, normal)| {
                let [a, b, c] = corners.map(|i| vertices[i as usize]);
                Triangle { a, ab: b - a, ac: c - a, normal }
            })
            .collect();
        let hulls = mesh.triangles.iter().map(|corners| {
            let [a, b, c] = corners.map(|i| vertices[i as usize]);
            Aabb::new(a.min(b).min(c), a.max(b).max(c))
        });
        let bvh = Bvh::from_iter(BvhBuildStrategy::Binned, hulls.enumerate());
        soundness.self_intersecting = intersect::count(&vertices, &mesh.triangles, &bvh);
        let margin = DVec3::splat(MARGIN * longest);
        Ok(Self {
            soundness,
            domain: Domain { min: (low - margin).to_array(), max: (high + margin).to_array() },
            center,
            on_surface: ON_SURFACE * (high - low).length(),
            bvh,
            triangles,
            neighbours,
            vertex_normals,
            winding: OnceLock::new(),
            mesh,
        })
    }

    /// The mesh, wound counter-clockwise outward.
    pub fn mesh(&self) -> &TriangleMesh {
        &self.mesh
    }

    /// What was found about the mesh's fitness to bound a solid.
    pub fn soundness(&self) -> &Soundness {
        &self.soundness
    }

    /// The nearest place to `p` (about the center). `near` is any triangle, best one close to `p`: it bounds the search.
    fn nearest(&self, p: DVec3, near: u32) -> (u32, Nearest) {
        let at = |triangle: u32| {
            let t = &self.triangles[triangle as usize];
            let (place, feature) = closest(p, t.a, t.ab, t.ac);
            Nearest { distance2: p.distance_squared(place), place, feature }
        };
        let bound = at(near);
        if bound.distance2 == 0.0 {
            return self.first_touching(p).unwrap_or((near, bound));
        }
        let found = self.bvh.find_best(
            bound.distance2 * WIDENED,
            |node, _| {
                // the arithmetic of parry's box distance, without its square root
                (node.mins() - p).max(p - node.maxs()).max(DVec3::ZERO).length_squared()
            },
            |triangle, _| Some(at(triangle)),
        );
        found.unwrap_or((near, bound))
    }

    /// The triangle with the smallest index that `p` lies on exactly, whatever triangle the search began with.
    fn first_touching(&self, p: DVec3) -> Option<(u32, Nearest)> {
        let place = Aabb::new(p, p);
        let touching = self.bvh.intersect_aabb(&place).filter(|&i| {
            let t = &self.triangles[i as usize];
            closest(p, t.a, t.ab, t.ac).0 == p
        });
        touching.min().map(|i| {
            let t = &self.triangles[i as usize];
            let (place, feature) = closest(p, t.a, t.ab, t.ac);
            (i, Nearest { distance2: 0.0, place, feature })
        })
    }

    /// The pseudo-normal of a feature; of no certain length.
    fn pseudo_normal(&self, triangle: u32, feature: Feature) -> DVec3 {
        let index = triangle as usize;
        match feature {
            Feature::Face => self.triangles[index].normal,
            Feature::Edge(edge) => {
                let across = self.neighbours[index][usize::from(edge)];
                let other = if across == NONE { DVec3::ZERO } else { self.triangles[across as usize].normal };
                self.triangles[index].normal + other
            }
            Feature::Corner(corner) => self.vertex_normals[self.mesh.triangles[index][usize::from(corner)] as usize],
        }
    }

    /// Whether `p` is inside by the winding number: the surface wraps around it, once or more often, in either sense.
    fn wrapped(&self, p: DVec3) -> bool {
        let winding = self.winding.get_or_init(|| {
            let vertices: Vec<DVec3> = self.mesh.vertices.iter().map(|&v| DVec3::from(v) - self.center).collect();
            Winding::new(&vertices, &self.mesh.triangles)
        });
        winding.number(p).abs() > 0.5
    }

    /// Signed distance and gradient at `p` (in scene units), and the triangle that is nearest.
    fn query(&self, p: DVec3, near: u32) -> (f64, DVec3, u32) {
        let p = p - self.center;
        let (triangle, nearest) = self.nearest(p, near);
        let away = p - nearest.place;
        let distance = nearest.distance2.sqrt();
        let normal = self.pseudo_normal(triangle, nearest.feature);
        let side = away.dot(normal);
        let decided = side.abs() > UNDECIDED * distance * normal.length();
        let told_by_normal = distance <= self.on_surface || self.soundness.bounds_a_solid() && decided;
        let inside = if told_by_normal { side < 0.0 } else { self.wrapped(p) };
        let sign = if inside { -1.0 } else { 1.0 };
        let gradient = if distance > self.on_surface {
            away * (sign / distance)
        } else {
            // a fold can leave a pseudo-normal of no length; the face's, and at last any direction, stand in
            normal
                .try_normalize()
                .or_else(|| self.triangles[triangle as usize].normal.try_normalize())
                .unwrap_or(DVec3::Z)
        };
        (sign * distance, gradient, triangle)
    }
}

impl Field for MeshField {
    fn domain(&self) -> Domain {
        self.domain
    }
    /// Exact for a closed mesh. A mesh with holes is closed by a jump of the sign across each hole, where the value is
    /// the distance to the rim: only the sign is promised.
    fn metric(&self) -> Metric {
        if self.soundness.closed { Metric::Exact } else { Metric::Sign }
    }
    fn lipschitz(&self) -> Option<f32> {
        self.soundness.closed.then_some(1.0)
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        let mut near = 0;
        for (i, value) in values.iter_mut().enumerate() {
            let p = DVec3::new(f64::from(points.x[i]), f64::from(points.y[i]), f64::from(points.z[i]));
            let (distance, _, triangle) = self.query(p, near);
            *value = distance as f32;
            near = triangle;
        }
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        let mut near = 0;
        for (i, value) in values.iter_mut().enumerate() {
            let p = DVec3::new(f64::from(points.x[i]), f64::from(points.y[i]), f64::from(points.z[i]));
            let (distance, gradient, triangle) = self.query(p, near);
            *value = distance as f32;
            (gradients.x[i], gradients.y[i], gradients.z[i]) =
                (gradient.x as f32, gradient.y as f32, gradient.z as f32);
            near = triangle;
        }
    }
    fn truth(&self) -> Option<&TriangleMesh> {
        Some(&self.mesh)
    }
}

#[cfg(test)]
impl MeshField {
    /// Whether the winding number says that `p` (in scene units) is inside.
    pub(super) fn wrapped_at(&self, p: DVec3) -> bool {
        self.wrapped(p - self.center)
    }
}
