//! Finding the spherical triangle that holds a direction.

use super::rings::Mesh;
use crate::settings::{CancelToken, Canceled};
use glam::DVec3;
use std::collections::HashMap;

/// A direction's place in a map: the triangle and the barycentric weights of its corners.
pub type Place = ([u32; 3], [f64; 3]);

/// Locates `queries` in the map `directions` of `mesh` by walking from triangle to triangle. Near queries should follow
/// each other. A walk that does not end falls back to looking at every triangle.
pub fn locate(
    mesh: &Mesh,
    directions: &[DVec3],
    queries: &[DVec3],
    cancel: &CancelToken,
) -> Result<Vec<Place>, Canceled> {
    /// Steps after which a walk is given up.
    const PATIENCE: usize = 4000;
    let triangles = mesh.rings.triangles();
    let mut owner: HashMap<(u32, u32), u32> = HashMap::with_capacity(3 * triangles.len());
    for (i, t) in triangles.iter().enumerate() {
        for c in 0..3 {
            owner.insert((t[c], t[(c + 1) % 3]), i as u32);
        }
    }
    // across[i][c] is the triangle on the other side of the edge opposite corner c
    let across: Vec<[u32; 3]> =
        triangles.iter().map(|t| [0, 1, 2].map(|c| owner[&(t[(c + 2) % 3], t[(c + 1) % 3])])).collect();
    let weights = |i: usize, q: DVec3| {
        let [a, b, c] = triangles[i].map(|v| directions[v as usize]);
        [q.dot(b.cross(c)), q.dot(c.cross(a)), q.dot(a.cross(b))]
    };
    let (mut current, mut seed) = (0usize, 12345u64);
    queries
        .iter()
        .enumerate()
        .map(|(i, &q)| {
            if i.is_multiple_of(1024) {
                cancel.check()?;
            }
            let mut found = None;
            for _ in 0..PATIENCE {
                let w = weights(current, q);
                let tolerance = -1e-12 * w.iter().map(|x| x.abs()).sum::<f64>();
                if w.iter().all(|&x| x >= tolerance) && w.iter().sum::<f64>() > 0.0 {
                    found = Some(w);
                    break;
                }
                // the first negative edge from a random one on, so that no walk goes round in circles
                seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let start = (seed >> 33) as usize % 3;
                let edge = (0..3).map(|k| (k + start) % 3).find(|&c| w[c] < tolerance).unwrap_or(start);
                current = across[current][edge] as usize;
            }
            let w = found.unwrap_or_else(|| {
                let mut best = f64::NEG_INFINITY;
                let mut kept = [1.0; 3];
                for i in 0..triangles.len() {
                    let w = weights(i, q);
                    let sum: f64 = w.iter().sum();
                    let least = w.iter().copied().fold(f64::INFINITY, f64::min) / sum;
                    if sum > 0.0 && least > best {
                        (best, current, kept) = (least, i, w);
                    }
                }
                kept
            });
            let w = w.map(|x| x.max(0.0));
            let sum: f64 = w.iter().sum();
            Ok((triangles[current], w.map(|x| x / sum)))
        })
        .collect()
}
