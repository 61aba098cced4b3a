//! The Newton system of a chart: gradient and Hessian by vertex, and conjugate gradients on the coordinates that may move.

use super::super::energy::inverse_positive;
use super::super::sphere_map::system::positive_modes;
use super::{CHUNK, Chart, Piece, outer, squared};
use crate::settings::{Canceled, Settings};
use glam::{DMat2, DVec2};
use rayon::prelude::*;

/// A triangle at a vertex.
pub struct Corner {
    /// The triangle.
    pub triangle: u32,
    /// Which of its corners the vertex is.
    pub corner: u8,
    /// Where the two other corners are among the vertex's neighbours.
    slots: [u16; 2],
}

/// Who is beside whom: triangles and neighbours of every vertex, in one array each.
pub struct Rows {
    /// Where a vertex's triangles start; one longer than there are vertices.
    first_corner: Vec<u32>,
    corners: Vec<Corner>,
    /// Where a vertex's neighbours start.
    first: Vec<u32>,
    neighbours: Vec<u32>,
}

impl Rows {
    pub fn new(vertices: usize, pieces: &[Piece]) -> Self {
        let mut first_corner = vec![0u32; vertices + 1];
        for &v in pieces.iter().flat_map(|piece| &piece.corners) {
            first_corner[v as usize + 1] += 1;
        }
        for v in 0..vertices {
            first_corner[v + 1] += first_corner[v];
        }
        let mut next = first_corner.clone();
        let mut places = vec![(0u32, 0u8); 3 * pieces.len()];
        for (t, piece) in pieces.iter().enumerate() {
            for (corner, &v) in piece.corners.iter().enumerate() {
                places[next[v as usize] as usize] = (t as u32, corner as u8);
                next[v as usize] += 1;
            }
        }
        let (mut first, mut neighbours, mut corners) = (vec![0u32], Vec::new(), Vec::with_capacity(places.len()));
        let mut here: Vec<u32> = Vec::new();
        for v in 0..vertices {
            let around = &places[first_corner[v] as usize..first_corner[v + 1] as usize];
            let others =
                |&(t, corner): &(u32, u8)| [1, 2].map(|k| pieces[t as usize].corners[(corner as usize + k) % 3]);
            here.clear();
            here.extend(around.iter().flat_map(others));
            here.sort_unstable();
            here.dedup();
            corners.extend(around.iter().map(|place| Corner {
                triangle: place.0,
                corner: place.1,
                slots: others(place).map(|u| here.partition_point(|&n| n < u) as u16),
            }));
            neighbours.extend_from_slice(&here);
            first.push(neighbours.len() as u32);
        }
        Self { first_corner, corners, first, neighbours }
    }

    /// Triangles at a vertex.
    pub fn corners(&self, v: usize) -> &[Corner] {
        &self.corners[self.first_corner[v] as usize..self.first_corner[v + 1] as usize]
    }

    /// Vertices beside a vertex.
    pub fn neighbours(&self, v: usize) -> &[u32] {
        &self.neighbours[self.range(v)]
    }

    fn range(&self, v: usize) -> std::ops::Range<usize> {
        self.first[v] as usize..self.first[v + 1] as usize
    }
}

/// One vertex's share of a [`System`].
struct Node {
    gradient: DVec2,
    diagonal: DMat2,
    /// Inverse of the diagonal block with its eigenvalues made positive.
    inverse: DMat2,
    /// 1 where it may move.
    freedom: DVec2,
}

/// Gradient and Hessian at a chart, a block per vertex and per pair of neighbours; zero where a coordinate may not move.
pub struct System {
    nodes: Vec<Node>,
    /// Blocks of every vertex against its neighbours.
    edges: Vec<DMat2>,
}

/// The block that is left of one between two vertices.
pub fn held(m: DMat2, row: DVec2, column: DVec2) -> DMat2 {
    DMat2::from_cols(m.x_axis * row * column.x, m.y_axis * row * column.y)
}

impl System {
    /// The exact gradient, and the Hessian made positive triangle by triangle.
    pub fn new(chart: &Chart, places: &[DVec2]) -> Self {
        let rows = &chart.rows;
        let piece = |start: usize| {
            let end = (start + CHUNK).min(places.len());
            let mut nodes = Vec::with_capacity(end - start);
            let mut edges = vec![DMat2::ZERO; (rows.first[end] - rows.first[start]) as usize];
            for v in start..end {
                let (mut gradient, mut diagonal) = (DVec2::ZERO, DMat2::ZERO);
                let at = (rows.first[v] - rows.first[start]) as usize;
                for Corner { triangle, corner, slots } in rows.corners(v) {
                    let piece = &chart.pieces[*triangle as usize];
                    let hat = |k: usize| piece.hats[(*corner as usize + k) % 3];
                    let (slope, modes) = derivatives(piece, places, chart);
                    gradient += slope * hat(0);
                    for mode in modes {
                        let own = mode * hat(0);
                        diagonal += outer(own, own);
                        for k in [1, 2] {
                            edges[at + slots[k - 1] as usize] += outer(own, mode * hat(k));
                        }
                    }
                }
                let freedom = chart.freedom[v];
                for (block, &u) in edges[at..].iter_mut().zip(&rows.neighbours[rows.range(v)]) {
                    *block = held(*block, freedom, chart.freedom[u as usize]);
                }
                let diagonal = held(diagonal, freedom, freedom);
                let inverse = held(inverse_positive(diagonal), freedom, freedom);
                nodes.push(Node { gradient: gradient * freedom, diagonal, inverse, freedom });
            }
            (nodes, edges)
        };
        let starts: Vec<usize> = (0..places.len()).step_by(CHUNK).collect();
        let made: Vec<(Vec<Node>, Vec<DMat2>)> = starts.into_par_iter().map(piece).collect();
        let (mut nodes, mut edges) = (Vec::with_capacity(places.len()), Vec::with_capacity(rows.neighbours.len()));
        for (more_nodes, more_edges) in made {
            nodes.extend(more_nodes);
            edges.extend(more_edges);
        }
        Self { nodes, edges }
    }

    /// How fast the energy changes along a direction.
    pub fn slope(&self, direction: &[DVec2]) -> f64 {
        self.nodes.iter().zip(direction).map(|(node, d)| node.gradient.dot(*d)).sum()
    }

    /// Hessian times `p`; returns the product of both.
    fn product(&self, rows: &Rows, p: &[DVec2], out: &mut [DVec2]) -> f64 {
        let piece = |(k, out): (usize, &mut [DVec2])| {
            let mut curvature = 0.0;
            for (i, y) in out.iter_mut().enumerate() {
                let v = k * CHUNK + i;
                let range = rows.range(v);
                let mut sum = self.nodes[v].diagonal * p[v];
                for (m, &u) in self.edges[range.clone()].iter().zip(&rows.neighbours[range]) {
                    sum += *m * p[u as usize];
                }
                *y = sum;
                curvature += p[v].dot(sum);
            }
            curvature
        };
        out.par_chunks_mut(CHUNK).enumerate().map(piece).collect::<Vec<f64>>().into_iter().sum()
    }

    /// The direction of a Newton step: conjugate gradients with the diagonal blocks as preconditioner (Nocedal and Wright 2006,
    /// "Numerical optimization", algorithm 7.1), stopped where the residual is small enough for the gradient that is left.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn solve(&self, rows: &Rows, products: usize, settings: &Settings<'_>) -> Result<Vec<DVec2>, Canceled> {
        /// The residual's share at which a solution is good enough far from the minimum.
        const FORCING: f64 = 0.05;
        let n = self.nodes.len();
        let mut x = vec![DVec2::ZERO; n];
        let mut r: Vec<DVec2> = self.nodes.iter().map(|k| -k.gradient).collect();
        let mut z: Vec<DVec2> = r.iter().zip(&self.nodes).map(|(r, k)| k.inverse * *r).collect();
        let mut p = z.clone();
        let mut q = vec![DVec2::ZERO; n];
        let mut rz: f64 = (0..n).map(|v| r[v].dot(z[v])).sum();
        let start = rz;
        for _ in 0..products {
            settings.cancel.check()?;
            let curvature = self.product(rows, &p, &mut q);
            if curvature.is_nan() || curvature <= 0.0 {
                break;
            }
            let alpha = rz / curvature;
            let mut next = 0.0;
            for v in 0..n {
                x[v] += alpha * p[v];
                r[v] -= alpha * q[v];
                z[v] = self.nodes[v].inverse * r[v];
                next += r[v].dot(z[v]);
            }
            if next <= FORCING * FORCING * start {
                break;
            }
            let beta = next / rz;
            rz = next;
            for v in 0..n {
                p[v] = z[v] + beta * p[v];
            }
        }
        // rounding must not push what the border holds
        x.iter_mut().zip(&self.nodes).for_each(|(x, node)| *x *= node.freedom);
        Ok(x)
    }
}

/// A triangle's energy by its Jacobian, and its Hessian there as a sum of squares, its negative eigenvalues left out.
pub fn derivatives(piece: &Piece, places: &[DVec2], chart: &Chart) -> (DMat2, [DMat2; 4]) {
    let (jacobian, d) = piece.jacobian(piece.places(places));
    let k = chart.objective.derivatives(squared(jacobian), d);
    // the derivative of the determinant
    let [[a, c], [b, d]] = jacobian.to_cols_array_2d();
    let cofactor = DMat2::from_cols(DVec2::new(d, -b), DVec2::new(-c, a));
    let slope = piece.weight * (2.0 * k.by_t * jacobian + k.by_d * cofactor);
    (slope, positive_modes(jacobian, piece.weight, &chart.objective))
}
