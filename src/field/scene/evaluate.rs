//! Evaluation of the tree over a batch: every node runs over a slice of points, so walking the tree costs nothing per
//! point, and takes its temporaries from one scratch buffer.

use super::node::{Combine, Node, Placement, Repeat, Shape};
use super::shape::{self, Sample};

/// Points that go through the tree at once: a node's slices (4 of values, 3 of points, 1 KiB each) stay in the first
/// cache, and the walk is spread over enough points.
pub(super) const CHUNK: usize = 256;

/// Coordinates of a chunk.
type Place<'a> = [&'a [f32]; 3];

/// Value and gradient of a chunk, all slices of the same length; the gradient is scratch where it is not asked for.
pub(super) struct Out<'a> {
    pub value: &'a mut [f32],
    pub gradient: [&'a mut [f32]; 3],
}

/// Takes `K` slices of length `n` off the front of `scratch`.
pub(super) fn blocks<const K: usize>(scratch: &mut [f32], n: usize) -> ([&mut [f32]; K], &mut [f32]) {
    let mut rest = scratch;
    let taken = std::array::from_fn(|_| {
        let (head, tail) = std::mem::take(&mut rest).split_at_mut(n);
        rest = tail;
        head
    });
    (taken, rest)
}

/// Evaluates `node` at the points `p`; with gradients where `G`.
pub(super) fn evaluate<const G: bool>(node: &Node, p: Place<'_>, out: &mut Out<'_>, scratch: &mut [f32]) {
    let n = out.value.len();
    match node {
        Node::Shape(shape) => evaluate_shape::<G>(shape, p, out),
        Node::Combine { how, smooth, of } => {
            let Some((first, rest)) = of.split_first() else { return };
            evaluate::<G>(first, p, out, scratch);
            for child in rest {
                let ([value, x, y, z], scratch) = blocks::<4>(scratch, n);
                let mut other = Out { value, gradient: [x, y, z] };
                evaluate::<G>(child, p, &mut other, scratch);
                combine::<G>(*how, *smooth, out, &other);
            }
        }
        Node::Round { radius, of } => {
            evaluate::<G>(of, p, out, scratch);
            out.value.iter_mut().for_each(|v| *v -= radius);
        }
        Node::Shell { thickness, of } => {
            evaluate::<G>(of, p, out, scratch);
            let Out { value, gradient: [gx, gy, gz] } = out;
            for i in 0..n {
                let side = 1f32.copysign(value[i]);
                value[i] = value[i].abs() - 0.5 * thickness;
                if G {
                    (gx[i], gy[i], gz[i]) = (side * gx[i], side * gy[i], side * gz[i]);
                }
            }
        }
        Node::Displace { amplitude, frequency, of } => {
            evaluate::<G>(of, p, out, scratch);
            displace::<G>(*amplitude, *frequency, p, out);
        }
        Node::Place { kernel, of, .. } => {
            let ([x, y, z], scratch) = blocks::<3>(scratch, n);
            enter(kernel, p, x, y, z);
            evaluate::<G>(of, [x, y, z], out, scratch);
            leave::<G>(kernel, out);
        }
        Node::Mirror { axis, of } => {
            let ([folded], scratch) = blocks::<1>(scratch, n);
            for (f, c) in folded.iter_mut().zip(p[*axis]) {
                *f = c.abs();
            }
            let mut inner = p;
            inner[*axis] = folded;
            evaluate::<G>(of, inner, out, scratch);
            if G {
                for (g, c) in out.gradient[*axis].iter_mut().zip(p[*axis]) {
                    *g *= 1f32.copysign(*c);
                }
            }
        }
        Node::Repeat { repeat, of } => evaluate_copies::<G>(repeat, of, p, out, scratch),
    }
}

/// Runs a shape over the chunk.
#[inline(always)]
fn each<const G: bool>(p: Place<'_>, out: &mut Out<'_>, at: impl Fn([f32; 3]) -> Sample) {
    // as parameters the slices are known not to overlap, which lets the loop become vector code
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn run<const G: bool>(
        (x, y, z): (&[f32], &[f32], &[f32]),
        value: &mut [f32],
        gx: &mut [f32],
        gy: &mut [f32],
        gz: &mut [f32],
        at: impl Fn([f32; 3]) -> Sample,
    ) {
        let n = value.len();
        let (x, y, z) = (&x[..n], &y[..n], &z[..n]);
        let (gx, gy, gz) = (&mut gx[..n], &mut gy[..n], &mut gz[..n]);
        for i in 0..n {
            let sample = at([x[i], y[i], z[i]]);
            value[i] = sample.value;
            if G {
                [gx[i], gy[i], gz[i]] = sample.gradient;
            }
        }
    }
    let Out { value, gradient: [gx, gy, gz] } = out;
    run::<G>((p[0], p[1], p[2]), value, gx, gy, gz, at);
}

fn evaluate_shape<const G: bool>(shape: &Shape, p: Place<'_>, out: &mut Out<'_>) {
    match shape {
        Shape::Sphere { radius } => each::<G>(p, out, |p| shape::sphere(p, *radius)),
        Shape::Ellipsoid { radii } => each::<G>(p, out, |p| shape::ellipsoid(p, *radii)),
        Shape::Box { half_extents, radius } => each::<G>(p, out, |p| shape::boxed(p, *half_extents, *radius)),
        Shape::Capsule { from, along, aside, radius } => {
            let squared = along.iter().map(|c| c * c).sum::<f32>();
            let inverse = if squared > 0.0 { 1.0 / squared } else { 0.0 };
            each::<G>(p, out, |p| shape::capsule(p, *from, *along, inverse, *aside, *radius));
        }
        Shape::Cylinder { radius, half_height } => each::<G>(p, out, |p| shape::cylinder(p, *radius, *half_height)),
        Shape::Torus { major, minor } => each::<G>(p, out, |p| shape::torus(p, *major, *minor)),
        Shape::HalfSpace { normal, offset } => each::<G>(p, out, |p| shape::half_space(p, *normal, *offset)),
        Shape::Octahedron { size } => each::<G>(p, out, |p| shape::octahedron(p, *size)),
        Shape::Rectangle { half_extents } => each::<G>(p, out, |p| shape::rectangle(p, *half_extents)),
        Shape::Polygon { polygon } => {
            let Out { value, gradient: [gx, gy, gz] } = out;
            polygon.nearest(p[0], p[1], value, gx);
            for i in 0..value.len() {
                let d = polygon.edges[gx[i] as usize].distance(p[0][i], p[1][i]);
                value[i] = d.value;
                if G {
                    [gx[i], gy[i], gz[i]] = [d.gradient[0], d.gradient[1], 0.0];
                }
            }
        }
        Shape::Extrude { polygon, half_height } => {
            let Out { value, gradient: [gx, gy, gz] } = out;
            polygon.nearest(p[0], p[1], value, gx);
            for i in 0..value.len() {
                let d = polygon.edges[gx[i] as usize].distance(p[0][i], p[1][i]);
                let (distance, a, b) = shape::corner(d.value, p[2][i].abs() - half_height);
                value[i] = distance;
                if G {
                    [gx[i], gy[i], gz[i]] = [a * d.gradient[0], a * d.gradient[1], b.copysign(p[2][i])];
                }
            }
        }
        Shape::Revolve { polygon } => {
            let Out { value, gradient: [gx, gy, gz] } = out;
            for i in 0..value.len() {
                gy[i] = shape::radial(p[0][i], p[1][i]).0;
            }
            polygon.nearest(gy, p[2], value, gx);
            for i in 0..value.len() {
                let d = polygon.edges[gx[i] as usize].distance(gy[i], p[2][i]);
                value[i] = d.value;
                if G {
                    let (_, x, y) = shape::radial(p[0][i], p[1][i]);
                    [gx[i], gy[i], gz[i]] = [d.gradient[0] * x, d.gradient[0] * y, d.gradient[1]];
                }
            }
        }
    }
}

/// The smaller (union), the larger (intersection), or the larger of the first and the negated second (difference). The
/// smooth form takes h^2 k/4 off the minimum, h = max(k - |a - b|, 0)/k (Quilez, "Smooth minimum", quadratic polynomial):
/// its gradient is a mean of the two, with weight h/2 for the one that is not taken.
fn combine<const G: bool>(how: Combine, smooth: Option<f32>, out: &mut Out<'_>, other: &Out<'_>) {
    // a maximum is a minimum of negated values
    let (first, second) = match how {
        Combine::Union => (1.0, 1.0),
        Combine::Intersection => (-1.0, -1.0),
        Combine::Difference => (-1.0, 1.0),
    };
    let k = smooth.unwrap_or(0.0);
    let inverse = if k > 0.0 { 1.0 / k } else { 0.0 };
    let Out { value, gradient: [gx, gy, gz] } = out;
    let [ox, oy, oz] = &other.gradient;
    blend::<G>((first, second), (k, inverse), value, gx, gy, gz, (other.value, ox, oy, oz));
}

#[inline(always)]
fn blend<const G: bool>(
    (first, second): (f32, f32),
    (k, inverse): (f32, f32),
    value: &mut [f32],
    gx: &mut [f32],
    gy: &mut [f32],
    gz: &mut [f32],
    (other, ox, oy, oz): (&[f32], &[f32], &[f32], &[f32]),
) {
    let n = value.len();
    let (gx, gy, gz) = (&mut gx[..n], &mut gy[..n], &mut gz[..n]);
    let (other, ox, oy, oz) = (&other[..n], &ox[..n], &oy[..n], &oz[..n]);
    for i in 0..n {
        let (a, b) = (first * value[i], second * other[i]);
        let h = (k - (a - b).abs()).max(0.0) * inverse;
        value[i] = first * (a.min(b) - 0.25 * h * h * k);
        if G {
            let weight = if a <= b { 0.5 * h } else { 1.0 - 0.5 * h };
            let (u, v) = (1.0 - weight, first * second * weight);
            gx[i] = u * gx[i] + v * ox[i];
            gy[i] = u * gy[i] + v * oy[i];
            gz[i] = u * gz[i] + v * oz[i];
        }
    }
}

/// Adds amplitude times the product of sin(frequency * coordinate) over the axes whose frequency is not 0.
fn displace<const G: bool>(amplitude: f32, frequency: [f32; 3], p: Place<'_>, out: &mut Out<'_>) {
    for (i, value) in out.value.iter_mut().enumerate() {
        let (mut sines, mut slopes) = ([1.0f32; 3], [0.0f32; 3]);
        for k in 0..3 {
            if frequency[k] != 0.0 {
                let (sine, cosine) = (frequency[k] * p[k][i]).sin_cos();
                (sines[k], slopes[k]) = (sine, frequency[k] * cosine);
            }
        }
        *value += amplitude * sines[0] * sines[1] * sines[2];
        if G {
            for k in 0..3 {
                out.gradient[k][i] += amplitude * slopes[k] * sines[(k + 1) % 3] * sines[(k + 2) % 3];
            }
        }
    }
}

fn enter(kernel: &Placement, p: Place<'_>, x: &mut [f32], y: &mut [f32], z: &mut [f32]) {
    let n = x.len();
    let [tx, ty, tz] = kernel.translation;
    let (px, py, pz) = (&p[0][..n], &p[1][..n], &p[2][..n]);
    let (y, z) = (&mut y[..n], &mut z[..n]);
    for i in 0..n {
        (x[i], y[i], z[i]) = (px[i] - tx, py[i] - ty, pz[i] - tz);
    }
    if let Some(m) = kernel.matrix {
        for i in 0..n {
            let (a, b, c) = (x[i], y[i], z[i]);
            x[i] = m[0][0] * a + m[0][1] * b + m[0][2] * c;
            y[i] = m[1][0] * a + m[1][1] * b + m[1][2] * c;
            z[i] = m[2][0] * a + m[2][1] * b + m[2][2] * c;
        }
    }
}

fn leave<const G: bool>(kernel: &Placement, out: &mut Out<'_>) {
    if kernel.matrix.is_none() {
        return;
    }
    let n = out.value.len();
    out.value.iter_mut().for_each(|v| *v *= kernel.scale);
    if G {
        let r = kernel.rotation;
        let [gx, gy, gz] = &mut out.gradient;
        let (gx, gy, gz) = (&mut gx[..n], &mut gy[..n], &mut gz[..n]);
        for i in 0..n {
            let (a, b, c) = (gx[i], gy[i], gz[i]);
            gx[i] = r[0][0] * a + r[0][1] * b + r[0][2] * c;
            gy[i] = r[1][0] * a + r[1][1] * b + r[1][2] * c;
            gz[i] = r[2][0] * a + r[2][1] * b + r[2][2] * c;
        }
    }
}

/// Index of the first of the `near` copies nearest to coordinate `c`, of `count` copies about the origin.
fn first_copy(c: f32, spacing: f32, count: u32, near: u32) -> f32 {
    if near == count {
        return 0.0;
    }
    let index = c / spacing + 0.5 * (count - 1) as f32;
    (index - 0.5 * near as f32).ceil().clamp(0.0, (count - near) as f32)
}

fn evaluate_copies<const G: bool>(repeat: &Repeat, of: &Node, p: Place<'_>, out: &mut Out<'_>, scratch: &mut [f32]) {
    let n = out.value.len();
    let ([x, y, z, value, gx, gy, gz], scratch) = blocks::<7>(scratch, n);
    let local = [x, y, z];
    let mut other = Out { value, gradient: [gx, gy, gz] };
    let [nx, ny, nz] = repeat.near;
    for copy in 0..nx * ny * nz {
        let step = [copy % nx, copy / nx % ny, copy / (nx * ny)];
        for k in 0..3 {
            let (spacing, count) = (repeat.spacing[k], repeat.count[k]);
            let middle = 0.5 * (count - 1) as f32;
            for i in 0..n {
                let index = first_copy(p[k][i], spacing, count, repeat.near[k]) + step[k] as f32;
                local[k][i] = p[k][i] - spacing * (index - middle);
            }
        }
        let inner = [&*local[0], &*local[1], &*local[2]];
        if copy == 0 {
            evaluate::<G>(of, inner, out, scratch);
        } else {
            evaluate::<G>(of, inner, &mut other, scratch);
            combine::<G>(Combine::Union, None, out, &other);
        }
    }
}
