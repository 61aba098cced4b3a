//! A sparse-evaluated lattice of nodes over a box: refined by halving, evaluated only near the zero level set.

use crate::field::Sampler;
use crate::settings::Canceled;
use glam::{DVec3, IVec3};

/// The 14 neighbours of a node in the Freudenthal (Kuhn) triangulation; the first seven are the positive ones.
pub const NEIGHBOURS: [IVec3; 14] = [
    IVec3::new(1, 0, 0),
    IVec3::new(0, 1, 0),
    IVec3::new(0, 0, 1),
    IVec3::new(1, 1, 0),
    IVec3::new(1, 0, 1),
    IVec3::new(0, 1, 1),
    IVec3::new(1, 1, 1),
    IVec3::new(-1, 0, 0),
    IVec3::new(0, -1, 0),
    IVec3::new(0, 0, -1),
    IVec3::new(-1, -1, 0),
    IVec3::new(-1, 0, -1),
    IVec3::new(0, -1, -1),
    IVec3::new(-1, -1, -1),
];

/// Nodes of a box-shaped cubic lattice with a value each. Values far from the zero level set are interpolated from a
/// coarser lattice; `known` tells the evaluated ones.
#[derive(Clone, Debug)]
pub struct Grid3 {
    /// Position of node (0, 0, 0), in frame units.
    pub origin: DVec3,
    /// Node spacing.
    pub h: f64,
    /// Nodes per axis.
    pub nodes: [usize; 3],
    /// Value of every node, z fastest.
    pub values: Vec<f32>,
    /// Whether the value was evaluated here.
    pub known: Vec<bool>,
}

impl Grid3 {
    /// Evaluates every node of a lattice over the box `lo..hi`, with one cell to spare on every side.
    pub fn new(sampler: &Sampler<'_>, lo: DVec3, hi: DVec3, h: f64) -> Result<Self, Canceled> {
        let cells = ((hi - lo) / h).ceil().max(DVec3::ONE) + 2.0;
        let nodes = [cells.x as usize + 1, cells.y as usize + 1, cells.z as usize + 1];
        let origin = 0.5 * (lo + hi) - 0.5 * h * cells;
        let count = nodes.iter().product();
        let mut grid = Self { origin, h, nodes, values: vec![0.0; count], known: vec![true; count] };
        let points: Vec<DVec3> = (0..count).map(|i| grid.position(i)).collect();
        grid.values = sampler.values(&points)?.into_iter().map(|v| v as f32).collect();
        Ok(grid)
    }

    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.values.len()
    }
    /// Coordinates of a node.
    pub fn place(&self, i: usize) -> [usize; 3] {
        [i / (self.nodes[1] * self.nodes[2]), i / self.nodes[2] % self.nodes[1], i % self.nodes[2]]
    }
    /// Position of a node.
    pub fn position(&self, i: usize) -> DVec3 {
        let [x, y, z] = self.place(i);
        self.origin + self.h * DVec3::new(x as f64, y as f64, z as f64)
    }
    /// Index of the node at these coordinates.
    pub fn index(&self, x: usize, y: usize, z: usize) -> usize {
        (x * self.nodes[1] + y) * self.nodes[2] + z
    }
    /// Difference of indices that a step by `offset` makes.
    pub fn stride(&self, offset: IVec3) -> isize {
        (offset.x as isize * self.nodes[1] as isize + offset.y as isize) * self.nodes[2] as isize + offset.z as isize
    }
    /// Whether the node lies on the outermost layer.
    pub fn on_border(&self, i: usize) -> bool {
        self.place(i).iter().zip(self.nodes).any(|(&c, n)| c == 0 || c + 1 == n)
    }

    /// The lattice of half the spacing. Nodes whose interpolated magnitude is at most `reach` are evaluated.
    pub fn refine(&self, sampler: &Sampler<'_>, reach: f64) -> Result<Self, Canceled> {
        let nodes = self.nodes.map(|n| 2 * n - 1);
        let count: usize = nodes.iter().product();
        let mut fine = Self {
            origin: self.origin,
            h: 0.5 * self.h,
            nodes,
            values: Vec::with_capacity(count),
            known: Vec::with_capacity(count),
        };
        let (mut wanted, mut points) = (Vec::new(), Vec::new());
        for x in 0..nodes[0] {
            sampler.settings().cancel.check()?;
            for y in 0..nodes[1] {
                for z in 0..nodes[2] {
                    let low = self.index(x / 2, y / 2, z / 2);
                    let (dx, dy, dz) = (x & 1, y & 1, z & 1);
                    let mut sum = 0.0;
                    for corner in 0..8 {
                        let [cx, cy, cz] = [(corner & 1) * dx, (corner >> 1 & 1) * dy, (corner >> 2) * dz];
                        sum += self.values[low + (cx * self.nodes[1] + cy) * self.nodes[2] + cz];
                    }
                    let value = sum / 8.0;
                    let coarse = dx + dy + dz == 0;
                    let known = coarse && self.known[low];
                    if !known && f64::from(value.abs()) <= reach {
                        wanted.push(fine.values.len());
                        points.push(fine.origin + fine.h * DVec3::new(x as f64, y as f64, z as f64));
                    }
                    fine.values.push(value);
                    fine.known.push(known);
                }
            }
        }
        for (&i, v) in wanted.iter().zip(sampler.values(&points)?) {
            fine.values[i] = v as f32;
            fine.known[i] = true;
        }
        Ok(fine)
    }

    /// Trilinear interpolation; `None` outside.
    pub fn interpolate(&self, p: DVec3) -> Option<f64> {
        let q = (p - self.origin) / self.h;
        let low = q.floor();
        let t = q - low;
        let [x, y, z] = [low.x as isize, low.y as isize, low.z as isize];
        let inside = |c: isize, n: usize| c >= 0 && (c as usize) + 1 < n;
        if !(inside(x, self.nodes[0]) && inside(y, self.nodes[1]) && inside(z, self.nodes[2])) {
            return None;
        }
        let base = self.index(x as usize, y as usize, z as usize);
        let mut sum = 0.0;
        for corner in 0..8usize {
            let [dx, dy, dz] = [corner & 1, corner >> 1 & 1, corner >> 2];
            let weight = |d: usize, t: f64| if d == 1 { t } else { 1.0 - t };
            let value = self.values[base + (dx * self.nodes[1] + dy) * self.nodes[2] + dz];
            sum += weight(dx, t.x) * weight(dy, t.y) * weight(dz, t.z) * f64::from(value);
        }
        Some(sum)
    }

    /// Box of the nodes that the solid may reach: those not farther outside than half a cell's diagonal, where values change
    /// by `slope` per length; grown by one spacing. `None` when no node is inside.
    pub fn solid_box(&self, slope: f64) -> Option<(DVec3, DVec3)> {
        let near = 0.5 * 3f64.sqrt() * self.h * slope;
        let mut bounds: Option<(DVec3, DVec3)> = None;
        let mut any = false;
        for i in 0..self.len() {
            any |= self.values[i] <= 0.0;
            if f64::from(self.values[i]) <= near {
                let p = self.position(i);
                bounds = Some(bounds.map_or((p, p), |(lo, hi)| (lo.min(p), hi.max(p))));
            }
        }
        bounds.filter(|_| any).map(|(lo, hi)| (lo - self.h, hi + self.h))
    }

    /// Change of value per length that 95 % of the lattice edges through the zero level set stay below; of all edges
    /// when there are too few of those. 1 for an exact distance.
    pub fn slope(&self) -> f64 {
        /// Fewer edges than this say too little.
        const ENOUGH: usize = 24;
        let (mut crossing, mut all) = (Vec::new(), Vec::new());
        for axis in [IVec3::X, IVec3::Y, IVec3::Z] {
            let stride = self.stride(axis) as usize;
            for i in 0..self.len() {
                let c = self.place(i);
                let last = (0..3).any(|k| axis[k] == 1 && c[k] + 1 == self.nodes[k]);
                if last || !self.known[i] || !self.known[i + stride] {
                    continue;
                }
                let (a, b) = (self.values[i], self.values[i + stride]);
                let slope = f64::from((a - b).abs()) / self.h;
                all.push(slope);
                if (a <= 0.0) != (b <= 0.0) {
                    crossing.push(slope);
                }
            }
        }
        let mut list = if crossing.len() >= ENOUGH { crossing } else { all };
        list.sort_by(f64::total_cmp);
        list.get(list.len() * 95 / 100).copied().unwrap_or(1.0)
    }
}
