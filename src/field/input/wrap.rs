//! Fields around fields: a similarity, another level, another domain.

use super::Transform;
use crate::field::mesh::TriangleMesh;
use crate::field::sampler::close_at_box;
use crate::field::{Domain, Field, Gradients, Metric, Points};
use glam::{DMat3, DVec3};

/// Points moved at a time: their coordinates stay on the stack.
const CHUNK: usize = 256;

/// A field after a similarity of space.
pub(super) struct Transformed {
    inner: Box<dyn Field>,
    scale: f64,
    rotation: DMat3,
    shift: DVec3,
    domain: Domain,
}

impl Transformed {
    /// The domain becomes the box about the moved domain.
    pub fn new(inner: Box<dyn Field>, transform: &Transform) -> Self {
        let (scale, rotation, shift) = (transform.scale, transform.rotation(), DVec3::from(transform.translate));
        let from = inner.domain();
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for corner in 0..8 {
            let p = DVec3::from([0, 1, 2].map(|a| if corner >> a & 1 == 1 { from.max[a] } else { from.min[a] }));
            let moved = rotation * (scale * p) + shift;
            (low, high) = (low.min(moved), high.max(moved));
        }
        let domain = Domain { min: low.to_array(), max: high.to_array() };
        Self { inner, scale, rotation, shift, domain }
    }

    fn run(&self, points: Points<'_>, values: &mut [f32], mut gradients: Option<Gradients<'_>>) {
        let (from, back) = (self.inner.domain(), self.rotation.transpose());
        let (low, high) = (DVec3::from(from.min), DVec3::from(from.max));
        let flat = self.inner.dimension() == 2;
        let mut places = [DVec3::ZERO; CHUNK];
        let [mut x, mut y, mut z] = [[0.0f32; CHUNK]; 3];
        let [mut gx, mut gy, mut gz] = [[0.0f32; CHUNK]; 3];
        for start in (0..points.len()).step_by(CHUNK) {
            let count = CHUNK.min(points.len() - start);
            for i in 0..count {
                let at = start + i;
                let p = DVec3::new(points.x[at].into(), points.y[at].into(), points.z[at].into());
                places[i] = back * (p - self.shift) / self.scale;
                let inside = places[i].clamp(low, high);
                (x[i], y[i], z[i]) = (inside.x as f32, inside.y as f32, inside.z as f32);
                if flat {
                    places[i].z = 0.5 * (low.z + high.z);
                }
            }
            let batch = Points { x: &x[..count], y: &y[..count], z: &z[..count] };
            let into = &mut values[start..start + count];
            if gradients.is_some() {
                let inner = Gradients { x: &mut gx[..count], y: &mut gy[..count], z: &mut gz[..count] };
                self.inner.gradients(batch, into, inner);
            } else {
                self.inner.values(batch, into);
            }
            // a turned box does not fill the box about it: the inner field is closed at its own box here, because the
            // sampler will only close the outer one
            for i in 0..count {
                let gradient = DVec3::new(gx[i].into(), gy[i].into(), gz[i].into());
                let (value, gradient) = close_at_box(places[i], low, high, flat, into[i].into(), gradient);
                into[i] = (value * self.scale) as f32;
                if let Some(out) = &mut gradients {
                    let g = self.rotation * gradient;
                    (out.x[start + i], out.y[start + i], out.z[start + i]) = (g.x as f32, g.y as f32, g.z as f32);
                }
            }
        }
    }
}

impl Field for Transformed {
    fn domain(&self) -> Domain {
        self.domain
    }
    fn metric(&self) -> Metric {
        self.inner.metric()
    }
    fn lipschitz(&self) -> Option<f32> {
        self.inner.lipschitz()
    }
    fn dimension(&self) -> u8 {
        self.inner.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.run(points, values, None);
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.run(points, values, Some(gradients));
    }
}

/// A field whose values are multiplied.
pub(super) struct Scaled {
    inner: Box<dyn Field>,
    factor: f32,
}

impl Scaled {
    /// The field times `factor`, which is not 0; a negative one turns it inside out.
    pub fn new(inner: Box<dyn Field>, factor: f32) -> Self {
        Self { inner, factor }
    }
}

impl Field for Scaled {
    fn domain(&self) -> Domain {
        self.inner.domain()
    }
    /// What is to be lengths is no promise of a distance.
    fn metric(&self) -> Metric {
        self.inner.metric().max(Metric::Bound)
    }
    fn lipschitz(&self) -> Option<f32> {
        self.inner.lipschitz().map(|bound| bound * self.factor.abs())
    }
    fn dimension(&self) -> u8 {
        self.inner.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.inner.values(points, values);
        values.iter_mut().for_each(|v| *v *= self.factor);
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        let Gradients { x, y, z } = gradients;
        self.inner.gradients(points, values, Gradients { x: &mut *x, y: &mut *y, z: &mut *z });
        for list in [values, x, y, z] {
            list.iter_mut().for_each(|v| *v *= self.factor);
        }
    }
}

/// A field whose zero is another of its values.
pub(super) struct Leveled {
    inner: Box<dyn Field>,
    level: f32,
    domain: Domain,
}

impl Leveled {
    /// The domain grows by a positive level where values are distances, so that the grown shape still lies in it.
    pub fn new(inner: Box<dyn Field>, level: f32) -> Self {
        let mut domain = inner.domain();
        if inner.metric() == Metric::Exact && level > 0.0 {
            for axis in 0..3 {
                domain.min[axis] -= f64::from(level);
                domain.max[axis] += f64::from(level);
            }
        }
        Self { inner, level, domain }
    }
}

impl Field for Leveled {
    fn domain(&self) -> Domain {
        self.domain
    }
    /// An offset of a distance is not the distance to the offset on the side where corners round off.
    fn metric(&self) -> Metric {
        self.inner.metric().max(Metric::Bound)
    }
    fn lipschitz(&self) -> Option<f32> {
        self.inner.lipschitz()
    }
    fn dimension(&self) -> u8 {
        self.inner.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.inner.values(points, values);
        values.iter_mut().for_each(|v| *v -= self.level);
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.inner.gradients(points, values, gradients);
        values.iter_mut().for_each(|v| *v -= self.level);
    }
}

/// A field over another domain.
pub(super) struct Boxed {
    inner: Box<dyn Field>,
    domain: Domain,
}

impl Boxed {
    /// The field as it is, over `domain`.
    pub fn new(inner: Box<dyn Field>, domain: Domain) -> Self {
        Self { inner, domain }
    }
}

impl Field for Boxed {
    fn domain(&self) -> Domain {
        self.domain
    }
    fn metric(&self) -> Metric {
        self.inner.metric()
    }
    fn lipschitz(&self) -> Option<f32> {
        self.inner.lipschitz()
    }
    fn dimension(&self) -> u8 {
        self.inner.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.inner.values(points, values);
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        self.inner.gradients(points, values, gradients);
    }
    fn truth(&self) -> Option<&TriangleMesh> {
        self.inner.truth()
    }
}
