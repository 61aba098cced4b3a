//! The exact signed distance to a triangle mesh.
//!
//! The nearest triangle comes from a bounding-volume tree, the sign from the angle-weighted pseudo-normal of
//! the nearest feature (J. A. Baerentzen and H. Aanaes, 2005), which is right for every closed mesh that does not meet
//! itself. Where a closed mesh meets itself, winding numbers say beforehand what is on the two sides of each patch; near
//! the places where it meets itself, for a mesh with holes, and where a pseudo-normal is undecided, the winding number of
//! the point decides. All arithmetic is in `f64` about the center of the mesh; only the given points and the answers are
//! `f32`.

use super::boundary::boundary;
use super::closest::{Feature, closest};
use super::sides::{Sides, classify};
use super::topology::{NONE, Soundness, normals, orient};
use super::tree::Tree;
use super::winding::Winding;
use super::{MAX_TRIANGLES, MAX_VERTICES, TriangleMesh, intersect, limit, malformed};
use crate::field::{Domain, Field, FieldError, Gradients, Metric, Points};
use glam::DVec3;
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
    tree: Tree,
    /// In the order of the tree's places.
    triangles: Vec<Triangle>,
    /// Index in the mesh of the triangle at each of the tree's places.
    order: Vec<u32>,
    neighbours: Vec<[u32; 3]>,
    face_normals: Vec<DVec3>,
    vertex_normals: Vec<DVec3>,
    /// For a closed mesh that meets itself: what is beside its triangles and its vertices.
    sides: Option<(Vec<Sides>, Vec<Sides>)>,
    /// Built when first asked: most meshes never ask.
    winding: OnceLock<Winding>,
    /// The part of a mesh that meets itself which bounds the solid; made when first asked.
    boundary: OnceLock<TriangleMesh>,
}

/// A triangle about the mesh's center, as the nearest-point search wants it.
struct Triangle {
    a: DVec3,
    ab: DVec3,
    ac: DVec3,
}

/// The nearest place found on a leaf.
struct Nearest {
    distance2: f64,
    place: DVec3,
    feature: Feature,
}

impl MeshField {
    /// Prepares the distance to `mesh`. Triangles that disagree with their neighbours are turned, and all of them if the
    /// enclosed volume is negative; [`MeshField::soundness`] counts them. Patches of a mesh that meets itself which lie
    /// inside the solid are left out of the distance (though not of [`MeshField::mesh`]). The domain is the bounding box grown by 12 %
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
        let corners = |triangle: &[u32; 3]| triangle.map(|i| vertices[i as usize]);
        let meets = intersect::find(&vertices, &mesh.triangles);
        soundness.self_intersecting = meets.iter().filter(|&&m| m).count() as u64;
        let winding = OnceLock::new();
        let sides = if soundness.closed && soundness.self_intersecting > 0 {
            let winding = winding.get_or_init(|| Winding::new(&vertices, &mesh.triangles));
            Some(classify(&vertices, &mesh.triangles, &neighbours, &meets, winding))
        } else {
            None
        };
        // a buried patch bounds nothing, and would be a false zero inside the solid
        let is_boundary = |triangle: u32| sides.as_ref().is_none_or(|s| s.0[triangle as usize] != Sides::Buried);
        let mut kept: Vec<u32> = (0..mesh.triangles.len() as u32).filter(|&t| is_boundary(t)).collect();
        if kept.is_empty() {
            kept = (0..mesh.triangles.len() as u32).collect();
        }
        let (tree, places) = Tree::build(kept.iter().map(|&t| corners(&mesh.triangles[t as usize])));
        let order: Vec<u32> = places.into_iter().map(|place| kept[place as usize]).collect();
        let triangles = order
            .iter()
            .map(|&triangle| {
                let [a, b, c] = corners(&mesh.triangles[triangle as usize]);
                Triangle { a, ab: b - a, ac: c - a }
            })
            .collect();
        let margin = DVec3::splat(MARGIN * longest);
        Ok(Self {
            soundness,
            domain: Domain { min: (low - margin).to_array(), max: (high + margin).to_array() },
            center,
            on_surface: ON_SURFACE * (high - low).length(),
            tree,
            triangles,
            order,
            neighbours,
            face_normals,
            vertex_normals,
            sides,
            winding,
            boundary: OnceLock::new(),
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

    /// The tree's place of the triangle nearest to `p` (about the center), and the point there. `near` is the place of
    /// any triangle, best of one close to `p`: it bounds the search.
    fn nearest(&self, p: DVec3, near: u32) -> (u32, Nearest) {
        let at = |place: u32| {
            let t = &self.triangles[place as usize];
            let (place, feature) = closest(p, t.a, t.ab, t.ac);
            Nearest { distance2: p.distance_squared(place), place, feature }
        };
        let bound = at(near).distance2 * WIDENED;
        let mut found: Option<(u32, Nearest)> = None;
        self.tree.nearest(p, bound, |place, bound| {
            let candidate = at(place);
            let distance2 = candidate.distance2;
            // the first of equally near ones stays
            if distance2 < bound || found.is_none() && distance2 <= bound {
                found = Some((place, candidate));
            }
            distance2
        });
        found.unwrap_or_else(|| (near, at(near)))
    }

    /// The pseudo-normal of a feature; of no certain length.
    fn pseudo_normal(&self, triangle: u32, feature: Feature) -> DVec3 {
        let index = triangle as usize;
        match feature {
            Feature::Face => self.face_normals[index],
            Feature::Edge(edge) => {
                let across = self.neighbours[index][usize::from(edge)];
                let other = if across == NONE { DVec3::ZERO } else { self.face_normals[across as usize] };
                self.face_normals[index] + other
            }
            Feature::Corner(corner) => self.vertex_normals[self.mesh.triangles[index][usize::from(corner)] as usize],
        }
    }

    /// What lies on the two sides of a feature.
    fn sides(&self, triangle: u32, feature: Feature) -> Sides {
        if !self.soundness.closed {
            return Sides::Unknown;
        }
        let Some((of_triangles, of_vertices)) = &self.sides else { return Sides::Plain };
        let index = triangle as usize;
        match feature {
            Feature::Face => of_triangles[index],
            Feature::Edge(edge) => {
                let across = self.neighbours[index][usize::from(edge)];
                let both = across != NONE && of_triangles[across as usize] == of_triangles[index];
                if both { of_triangles[index] } else { Sides::Unknown }
            }
            Feature::Corner(corner) => of_vertices[self.mesh.triangles[index][usize::from(corner)] as usize],
        }
    }

    fn winding(&self) -> &Winding {
        self.winding.get_or_init(|| {
            let vertices: Vec<DVec3> = self.mesh.vertices.iter().map(|&v| DVec3::from(v) - self.center).collect();
            Winding::new(&vertices, &self.mesh.triangles)
        })
    }

    /// Whether `p` is inside by the winding number: the surface wraps around it, once or more often, in either sense.
    fn wrapped(&self, p: DVec3) -> bool {
        self.winding().number(p).abs() > 0.5
    }

    /// Signed distance and gradient at `p` (in scene units), and the tree's place of the nearest triangle.
    fn query(&self, p: DVec3, near: u32) -> (f64, DVec3, u32) {
        let p = p - self.center;
        let (found, nearest) = self.nearest(p, near);
        let triangle = self.order[found as usize];
        let away = p - nearest.place;
        let distance = nearest.distance2.sqrt();
        let normal = self.pseudo_normal(triangle, nearest.feature);
        let side = away.dot(normal);
        let decided = side.abs() > UNDECIDED * distance * normal.length();
        let sides =
            if decided || distance <= self.on_surface { self.sides(triangle, nearest.feature) } else { Sides::Unknown };
        let inside = match sides {
            Sides::Plain => side < 0.0,
            Sides::Swapped => side > 0.0,
            Sides::Buried => true,
            Sides::Unknown => self.wrapped(p),
        };
        let sign = if inside { -1.0 } else { 1.0 };
        let gradient = if distance > self.on_surface {
            away * (sign / distance)
        } else {
            // a fold can leave a pseudo-normal of no length; the face's, and at last any direction, stand in
            normal.try_normalize().or_else(|| self.face_normals[triangle as usize].try_normalize()).unwrap_or(DVec3::Z)
        };
        (sign * distance, gradient, found)
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
            let (distance, _, found) = self.query(p, near);
            *value = distance as f32;
            near = found;
        }
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        let mut near = 0;
        for (i, value) in values.iter_mut().enumerate() {
            let p = DVec3::new(f64::from(points.x[i]), f64::from(points.y[i]), f64::from(points.z[i]));
            let (distance, gradient, found) = self.query(p, near);
            *value = distance as f32;
            (gradients.x[i], gradients.y[i], gradients.z[i]) =
                (gradient.x as f32, gradient.y as f32, gradient.z as f32);
            near = found;
        }
    }
    /// The mesh; of one that meets itself the part that bounds the solid.
    fn truth(&self) -> Option<&TriangleMesh> {
        let Some((of_triangles, _)) = &self.sides else { return Some(&self.mesh) };
        Some(self.boundary.get_or_init(|| boundary(&self.mesh, of_triangles, self.winding(), self.center)))
    }
}

#[cfg(test)]
impl MeshField {
    /// Whether the winding number says that `p` (in scene units) is inside.
    pub(super) fn wrapped_at(&self, p: DVec3) -> bool {
        self.wrapped(p - self.center)
    }
}
