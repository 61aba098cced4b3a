//! A field mended so that a sphere can wrap it: other components are made outside, voids are filled, handles are plugged and
//! components are bridged. Later stages see an ordinary field of genus 0.

use super::graded::Graded;
use crate::field::mesh::{Sheet, TriangleMesh};
use crate::field::{Domain, Field, Frame, Gradients, Metric, Points};
use glam::DVec3;

/// What becomes of the space around a lattice node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Label {
    /// The field is as it is.
    Keep,
    /// Outside: another component is here.
    Away,
    /// Inside: a void is here.
    Fill,
}

/// Labels on a lattice.
pub(super) struct Territory {
    pub grid: Graded,
    /// The frame that the lattice is in.
    pub frame: Frame,
    /// A label for every node.
    pub labels: Vec<Label>,
}

impl Territory {
    /// The label of the nearest corner of the cell around a place, scene units; beyond the lattice, of the nearest one on its
    /// border.
    pub(super) fn label(&self, p: DVec3) -> Label {
        self.labels[self.grid.nearest(self.frame.from_scene(p))]
    }
    /// Spacing of the lattice where it is finest, scene units.
    fn spacing(&self) -> f64 {
        self.grid.h() * self.frame.scale
    }
}

/// What closes a handle or joins two components: everything within `radius` of a sheet, scene units.
pub(super) struct Plug {
    pub sheet: Sheet,
    pub radius: f64,
}

/// A field with what was changed about it. Values away from the changes are the field's own.
pub struct Mended<'a> {
    pub(super) field: &'a dyn Field,
    pub(super) territory: Option<Territory>,
    pub(super) plugs: Vec<Plug>,
    /// Change of the field's value per length near the zero level set.
    pub(super) slope: f64,
    /// The part of the field's own mesh that is left, when there is one and nothing was added.
    pub(super) truth: Option<TriangleMesh>,
}

/// Least value where another component is made outside, in spacings: beyond what a contraction on a lattice half as fine
/// probes for thin walls.
const AWAY: f64 = 2.0;
/// Least depth where a void is filled, in spacings.
const FILL: f64 = 0.5;

impl Mended<'_> {
    /// The value with other components outside and voids filled.
    fn settled(&self, p: DVec3, value: f32) -> f32 {
        let Some(territory) = &self.territory else { return value };
        let step = (self.slope * territory.spacing()) as f32;
        match territory.label(p) {
            Label::Keep => value,
            // as if it were turned inside out: a contraction goes through it as through free space
            Label::Away => value.abs().max(AWAY as f32 * step),
            Label::Fill => value.min(-FILL as f32 * step),
        }
    }

    /// The value and gradient of the plugs, where that is below `value`.
    fn plugged(&self, p: DVec3, value: f32) -> Option<(f32, DVec3)> {
        let mut least = None;
        let mut below = f64::from(value);
        for plug in &self.plugs {
            let Some(foot) = plug.sheet.nearest(p, below / self.slope + plug.radius) else { continue };
            let away = p - foot;
            let here = self.slope * (away.length() - plug.radius);
            if here < below {
                below = here;
                least = Some((here as f32, self.slope * away.normalize_or(DVec3::Z)));
            }
        }
        least
    }

    /// Whether what is at every place (values and places as long) was invented: a plug, where the field itself is outside.
    pub fn invents(&self, places: &[DVec3], values: &[f64]) -> Vec<bool> {
        let invented = |(&p, &value): (&DVec3, &f64)| self.plugged(p, self.settled(p, value as f32)).is_some();
        places.iter().zip(values).map(invented).collect()
    }
}

fn point(points: &Points<'_>, i: usize) -> DVec3 {
    DVec3::new(f64::from(points.x[i]), f64::from(points.y[i]), f64::from(points.z[i]))
}

impl Field for Mended<'_> {
    fn domain(&self) -> Domain {
        self.field.domain()
    }
    fn metric(&self) -> Metric {
        // the least of distances is one outside only
        self.field.metric().max(Metric::Bound)
    }
    fn lipschitz(&self) -> Option<f32> {
        let own = if self.field.metric() == Metric::Exact { Some(1.0) } else { self.field.lipschitz() };
        own.map(|bound| bound.max(self.slope as f32))
    }
    fn dimension(&self) -> u8 {
        self.field.dimension()
    }
    fn values(&self, points: Points<'_>, values: &mut [f32]) {
        self.field.values(points, values);
        for (i, value) in values.iter_mut().enumerate() {
            let p = point(&points, i);
            *value = self.settled(p, *value);
            if let Some((plug, _)) = self.plugged(p, *value) {
                *value = plug;
            }
        }
    }
    fn gradients(&self, points: Points<'_>, values: &mut [f32], gradients: Gradients<'_>) {
        let Gradients { x, y, z } = gradients;
        self.field.gradients(points, values, Gradients { x: &mut *x, y: &mut *y, z: &mut *z });
        for (i, value) in values.iter_mut().enumerate() {
            let p = point(&points, i);
            *value = self.settled(p, *value);
            if let Some((plug, gradient)) = self.plugged(p, *value) {
                *value = plug;
                (x[i], y[i], z[i]) = (gradient.x as f32, gradient.y as f32, gradient.z as f32);
            }
        }
    }
    fn truth(&self) -> Option<&TriangleMesh> {
        self.truth.as_ref()
    }
}
