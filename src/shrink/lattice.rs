//! The two lattices on the sphere, their connectivity and their charts.
//!
//! A lattice is a rectangular grid of `rows x columns` grid points whose border is glued so that it closes to a sphere.
//! *Welded* vertices are the points of the sphere, one each; *chart* vertices are their copies in the UV square, doubled
//! along the seam. UVs follow glTF: u to the right, v downwards, seen from outside.

use glam::DVec3;
use std::f64::consts::PI;

/// Which lattice, and how fine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum LatticeSpec {
    /// Rows of latitude and columns of longitude.
    Latlong {
        /// Samples of longitude, theta_i = 2 pi i / n_theta.
        n_theta: u32,
        /// Steps of the polar angle, phi_j = pi j / n_phi.
        n_phi: u32,
    },
    /// A subdivided octahedron with equal areas, unfolded into the square.
    Octahedral {
        /// Subdivisions of an octahedron edge; 4 n^2 + 2 vertices.
        n: u32,
    },
}

impl Default for LatticeSpec {
    /// The paper's 100 x 200.
    fn default() -> Self {
        LatticeSpec::Latlong { n_theta: 200, n_phi: 100 }
    }
}

impl LatticeSpec {
    /// The place in the UV square of a direction of length 1.
    pub fn place(self, direction: DVec3) -> [f64; 2] {
        match self {
            LatticeSpec::Latlong { .. } => {
                let turns = direction.y.atan2(direction.x) / (2.0 * PI);
                [turns.rem_euclid(1.0), direction.z.clamp(-1.0, 1.0).acos() / PI]
            }
            LatticeSpec::Octahedral { .. } => {
                // the inverse of octahedral_direction
                let r = (1.0 - direction.z.abs()).max(0.0).sqrt();
                let b = r * direction.y.abs().atan2(direction.x.abs()) * 2.0 / PI;
                let (a, b) = if direction.z >= 0.0 { (r - b, b) } else { (1.0 - b, 1.0 - (r - b)) };
                [0.5 + 0.5 * a.copysign(direction.x), 0.5 - 0.5 * b.copysign(direction.y)]
            }
        }
    }

    /// Number of welded vertices.
    pub fn vertices(self) -> u64 {
        match self {
            LatticeSpec::Latlong { n_theta, n_phi } => u64::from(n_theta) * u64::from(n_phi.saturating_sub(1)) + 2,
            LatticeSpec::Octahedral { n } => 4 * u64::from(n) * u64::from(n) + 2,
        }
    }
}

/// A sampled sphere: directions, connectivity and chart. Triangles are counter-clockwise seen from outside.
#[derive(Clone, Debug, PartialEq)]
pub struct SphereLattice {
    /// What it was made from.
    pub spec: LatticeSpec,
    /// Grid rows: `n_phi + 1`, or `2 n + 1`.
    pub rows: usize,
    /// Grid columns: `n_theta + 1`, or `2 n + 1`.
    pub columns: usize,
    /// Welded vertex of every grid point, row by row.
    pub grid: Vec<u32>,
    /// Unit direction of every welded vertex.
    pub directions: Vec<DVec3>,
    /// Welded vertex of every chart vertex.
    pub chart: Vec<u32>,
    /// UV of every chart vertex, in [0, 1] squared, v downwards.
    pub uv: Vec<[f64; 2]>,
    /// Quads of chart vertices, counter-clockwise from outside; the first diagonal joins corners 0 and 2.
    pub quads: Vec<[u32; 4]>,
    /// Whether a quad may take its other diagonal without gluing an edge twice.
    pub free: Vec<bool>,
    /// Triangles of chart vertices that belong to no quad (the polar sectors).
    pub caps: Vec<[u32; 3]>,
}

impl SphereLattice {
    /// Builds the lattice.
    pub fn new(spec: LatticeSpec) -> Self {
        match spec {
            LatticeSpec::Latlong { n_theta, n_phi } => latlong(spec, n_theta as usize, n_phi as usize),
            LatticeSpec::Octahedral { n } => octahedral(spec, n as usize),
        }
    }

    /// Triangles of chart vertices; quad `i` takes its other diagonal where `diagonals[i]`. The two triangles of quad `i`
    /// are at `2 i` and `2 i + 1`, the caps follow.
    pub fn chart_triangles(&self, diagonals: &[bool]) -> Vec<[u32; 3]> {
        let mut triangles = Vec::with_capacity(2 * self.quads.len() + self.caps.len());
        for (&[a, b, c, d], &other) in self.quads.iter().zip(diagonals) {
            triangles.extend(if other { [[a, b, d], [b, c, d]] } else { [[a, b, c], [a, c, d]] });
        }
        triangles.extend_from_slice(&self.caps);
        triangles
    }

    /// Which quads take their other diagonal in these triangles over welded vertices; `None` when the triangles are not
    /// those of the lattice in its order, whatever the diagonals.
    pub fn diagonals_of(&self, triangles: &[[u32; 3]]) -> Option<Vec<bool>> {
        // corners 0, 1, 2 with the first diagonal, and 0, 1, 3 with the other
        let other = |(i, quad): (usize, &[u32; 4])| Some(triangles.get(2 * i)?[2] != self.chart[quad[2] as usize]);
        let diagonals: Vec<bool> = self.quads.iter().enumerate().map(other).collect::<Option<_>>()?;
        (self.triangles(&diagonals) == triangles).then_some(diagonals)
    }

    /// The same triangles over welded vertices.
    pub fn triangles(&self, diagonals: &[bool]) -> Vec<[u32; 3]> {
        let mut triangles = self.chart_triangles(diagonals);
        for corner in triangles.iter_mut().flatten() {
            *corner = self.chart[*corner as usize];
        }
        triangles
    }
}

fn latlong(spec: LatticeSpec, n_theta: usize, n_phi: usize) -> SphereLattice {
    let (rows, columns) = (n_phi + 1, n_theta + 1);
    let vertex = |row: usize, column: usize| -> u32 {
        (match row {
            0 => 0,
            row if row == n_phi => 1 + (n_phi - 1) * n_theta,
            row => 1 + (row - 1) * n_theta + column % n_theta,
        }) as u32
    };
    let grid = (0..rows * columns).map(|k| vertex(k / columns, k % columns)).collect();
    let direction = |row: usize, column: usize| {
        let (phi, theta) = (PI * row as f64 / n_phi as f64, 2.0 * PI * column as f64 / n_theta as f64);
        DVec3::new(phi.sin() * theta.cos(), phi.sin() * theta.sin(), phi.cos())
    };
    let mut directions = vec![DVec3::Z];
    directions.extend((1..n_phi).flat_map(|row| (0..n_theta).map(move |column| direction(row, column))));
    directions.push(DVec3::NEG_Z);

    // chart: rows 1..n_phi with the seam column doubled, then one pole copy per sector
    let (mut chart, mut uv) = (Vec::new(), Vec::new());
    for row in 1..n_phi {
        for column in 0..columns {
            chart.push(vertex(row, column));
            uv.push([column as f64 / n_theta as f64, row as f64 / n_phi as f64]);
        }
    }
    let poles = chart.len();
    for (row, v) in [(0, 0.0), (n_phi, 1.0)] {
        for sector in 0..n_theta {
            chart.push(vertex(row, 0));
            uv.push([(sector as f64 + 0.5) / n_theta as f64, v]);
        }
    }
    let at = |row: usize, column: usize| ((row - 1) * columns + column) as u32;
    let mut quads = Vec::with_capacity((n_phi - 2) * n_theta);
    for row in 1..n_phi - 1 {
        for i in 0..n_theta {
            quads.push([at(row, i), at(row + 1, i), at(row + 1, i + 1), at(row, i + 1)]);
        }
    }
    let mut caps = Vec::with_capacity(2 * n_theta);
    for i in 0..n_theta {
        caps.push([(poles + i) as u32, at(1, i), at(1, i + 1)]);
    }
    for i in 0..n_theta {
        caps.push([(poles + n_theta + i) as u32, at(n_phi - 1, i + 1), at(n_phi - 1, i)]);
    }
    let free = vec![true; quads.len()];
    SphereLattice { spec, rows, columns, grid, directions, chart, uv, quads, free, caps }
}

/// Equal-area map of the square [-1, 1]^2 onto the sphere through the octahedron (Clarberg 2008, "Fast equal-area mapping
/// of the (hemi)sphere using SIMD", section 3): the centre is +z, the corners are -z.
fn octahedral_direction(a: f64, b: f64) -> DVec3 {
    let d = 1.0 - (a.abs() + b.abs());
    let r = 1.0 - d.abs();
    let angle = if r == 0.0 { 0.0 } else { ((b.abs() - a.abs()) / r + 1.0) * PI / 4.0 };
    let z = (1.0 - r * r).copysign(d);
    let ring = r * (2.0 - r * r).sqrt();
    DVec3::new((ring * angle.cos()).copysign(a), (ring * angle.sin()).copysign(b), z)
}

fn octahedral(spec: LatticeSpec, n: usize) -> SphereLattice {
    let side = 2 * n + 1;
    let (last, m) = (side - 1, n as i64);
    // grid row 0 is the top of the square (b = +1): v downwards
    let place = |k: usize| ((k % side) as i64 - m, m - (k / side) as i64);
    let index = |a: i64, b: i64| ((m - b) * side as i64 + (a + m)) as usize;
    // the border is folded about the middle of each side
    let glued = |k: usize| -> usize {
        let (a, b) = place(k);
        match (a.abs() == m, b.abs() == m) {
            (true, true) => index(-m, -m),
            (true, false) => index(a, -b.abs()),
            (false, true) => index(-a.abs(), b),
            (false, false) => k,
        }
    };
    let mut grid = vec![u32::MAX; side * side];
    let mut directions = Vec::with_capacity(4 * n * n + 2);
    for (k, vertex) in grid.iter_mut().enumerate() {
        if glued(k) == k {
            let (a, b) = place(k);
            *vertex = directions.len() as u32;
            directions.push(octahedral_direction(a as f64 / m as f64, b as f64 / m as f64));
        }
    }
    for k in 0..side * side {
        grid[k] = grid[glued(k)];
    }
    let uv = (0..side * side).map(|k| [(k % side) as f64 / last as f64, (k / side) as f64 / last as f64]).collect();
    let (mut quads, mut free) = (Vec::with_capacity(last * last), Vec::with_capacity(last * last));
    for row in 0..last {
        for column in 0..last {
            let corner = |dr: usize, dc: usize| ((row + dr) * side + column + dc) as u32;
            let (nw, sw, se, ne) = (corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1));
            // the first diagonal lies along |a| + |b| = const
            let rising = (row < n) == (column < n);
            quads.push(if rising { [sw, se, ne, nw] } else { [nw, sw, se, ne] });
            free.push(row > 0 && column > 0 && row + 1 < last && column + 1 < last);
        }
    }
    let chart = grid.clone();
    SphereLattice { spec, rows: side, columns: side, grid, directions, chart, uv, quads, free, caps: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    fn closed_sphere(lattice: &SphereLattice, diagonals: &[bool]) {
        let triangles = lattice.triangles(diagonals);
        let mut edges: HashMap<(u32, u32), u32> = HashMap::new();
        for t in &triangles {
            for c in 0..3 {
                *edges.entry((t[c], t[(c + 1) % 3])).or_default() += 1;
            }
        }
        for (&(a, b), &n) in &edges {
            assert_eq!(n, 1, "edge {a} {b}");
            assert!(edges.contains_key(&(b, a)), "edge {a} {b} has one side only");
        }
        assert_eq!(lattice.directions.len() + triangles.len() - edges.len() / 2, 2, "Euler characteristic");
        for t in &triangles {
            let [a, b, c] = t.map(|v| lattice.directions[v as usize]);
            assert!((b - a).cross(c - a).dot(a + b + c) > 0.0, "{t:?} is inverted on the sphere");
        }
        for t in lattice.chart_triangles(diagonals) {
            let [a, b, c] = t.map(|v| lattice.uv[v as usize]);
            let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
            assert!(area < 0.0, "v is downwards, so counter-clockwise from outside is negative: {t:?} {area}");
        }
    }

    #[test]
    fn a_direction_has_the_place_that_the_chart_gives_it() {
        for spec in [LatticeSpec::Latlong { n_theta: 20, n_phi: 10 }, LatticeSpec::Octahedral { n: 9 }] {
            let lattice = SphereLattice::new(spec);
            for (&v, &[u, v_down]) in lattice.chart.iter().zip(&lattice.uv) {
                let [found_u, found_v] = spec.place(lattice.directions[v as usize]);
                // a seam has two places, and a pole one in every sector
                let on_border = [u, v_down].iter().any(|c| *c == 0.0 || *c == 1.0);
                assert!(
                    on_border || ((found_u - u).abs() < 1e-6 && (found_v - v_down).abs() < 1e-6),
                    "{spec:?}: {found_u} {found_v} for {u} {v_down}"
                );
            }
        }
    }

    #[test]
    fn every_lattice_is_a_closed_sphere_with_one_unmirrored_chart() {
        for spec in [
            LatticeSpec::Latlong { n_theta: 200, n_phi: 100 },
            LatticeSpec::Latlong { n_theta: 5, n_phi: 4 },
            LatticeSpec::Octahedral { n: 2 },
            LatticeSpec::Octahedral { n: 9 },
        ] {
            let lattice = SphereLattice::new(spec);
            assert_eq!(lattice.directions.len() as u64, spec.vertices());
            closed_sphere(&lattice, &vec![false; lattice.quads.len()]);
            closed_sphere(&lattice, &lattice.free);
        }
    }
}
