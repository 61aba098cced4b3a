//! The nearest of many points: a balanced k-d tree in one array.

use glam::DVec3;

/// Points in the order of a balanced tree: every range is split at its middle along its own axis.
pub struct Points {
    points: Vec<DVec3>,
    axes: Vec<u8>,
}

impl Points {
    /// From at least one point.
    pub fn new(mut points: Vec<DVec3>) -> Self {
        let mut axes = vec![0u8; points.len()];
        split(&mut points, &mut axes);
        Self { points, axes }
    }

    /// The point nearest to `q`.
    pub fn nearest(&self, q: DVec3) -> DVec3 {
        let mut best = (f64::INFINITY, self.points[0]);
        self.search(0, self.points.len(), q, &mut best);
        best.1
    }

    fn search(&self, from: usize, to: usize, q: DVec3, best: &mut (f64, DVec3)) {
        if from >= to {
            return;
        }
        let middle = from + (to - from) / 2;
        let (p, axis) = (self.points[middle], usize::from(self.axes[middle]));
        let distance = p.distance_squared(q);
        if distance < best.0 {
            *best = (distance, p);
        }
        let gap = q[axis] - p[axis];
        let (near, far) =
            if gap < 0.0 { ((from, middle), (middle + 1, to)) } else { ((middle + 1, to), (from, middle)) };
        self.search(near.0, near.1, q, best);
        if gap * gap < best.0 {
            self.search(far.0, far.1, q, best);
        }
    }
}

fn split(points: &mut [DVec3], axes: &mut [u8]) {
    if points.is_empty() {
        return;
    }
    let (lo, hi) = points.iter().fold((points[0], points[0]), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    let size = hi - lo;
    let axis = if size.x >= size.y && size.x >= size.z {
        0
    } else if size.y >= size.z {
        1
    } else {
        2
    };
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis]));
    axes[middle] = axis as u8;
    let (below, above) = points.split_at_mut(middle);
    let (axes_below, axes_above) = axes.split_at_mut(middle);
    split(below, axes_below);
    split(&mut above[1..], &mut axes_above[1..]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_point_is_the_one_that_looking_at_all_of_them_finds() {
        let mut seed = 3u64;
        let mut random = || {
            seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            (seed >> 11) as f64 / (1u64 << 53) as f64
        };
        let mut point = || DVec3::new(random(), 0.2 * random(), (4.0 * random()).floor());
        let points: Vec<DVec3> = (0..500).map(|_| point()).collect();
        let tree = Points::new(points.clone());
        for _ in 0..200 {
            let q = 1.5 * point();
            let least = points.iter().map(|p| p.distance_squared(q)).fold(f64::INFINITY, f64::min);
            assert_eq!(tree.nearest(q).distance_squared(q), least);
        }
    }
}
