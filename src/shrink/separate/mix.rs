//! The better of two states, piece by piece.

use super::super::unfold::Corners;
use super::{Found, Repair, State};

impl Repair<'_> {
    /// Takes every connected piece in which this state and `other` differ from the one in which less is wrong.
    pub(super) fn mix(&mut self, other: &State, other_found: &Found, found: &Found) {
        let n = self.state.at.positions.len();
        let mut parent: Vec<u32> = (0..n as u32).collect();
        fn root(parent: &mut [u32], mut v: u32) -> u32 {
            while parent[v as usize] != v {
                parent[v as usize] = parent[parent[v as usize] as usize];
                v = parent[v as usize];
            }
            v
        }
        let mut join = |t: &[u32]| {
            for &v in &t[1..] {
                let (a, b) = (root(&mut parent, t[0]), root(&mut parent, v));
                parent[b as usize] = a;
            }
        };
        let moved = |v: u32| self.state.at.positions[v as usize] != other.at.positions[v as usize];
        for (t, o) in self.state.triangles.iter().zip(&other.triangles) {
            if t != o || t.iter().any(|&v| moved(v)) {
                join(t);
                join(o);
                join(&[t[0], o[0]]);
            }
        }
        for (pairs, triangles) in [(&found.pairs, &self.state.triangles), (&other_found.pairs, &other.triangles)] {
            for &(i, j) in pairs {
                let (s, t) = (triangles[i as usize], triangles[j as usize]);
                join(&[s[0], s[1], s[2], t[0], t[1], t[2]]);
            }
        }
        let mut balance = vec![0i64; n];
        for t in found.triangles() {
            balance[root(&mut parent, self.state.triangles[t as usize][0]) as usize] += 1;
        }
        for t in other_found.triangles() {
            balance[root(&mut parent, other.triangles[t as usize][0]) as usize] -= 1;
        }
        let worse: Vec<bool> = (0..n as u32).map(|v| balance[root(&mut parent, v) as usize] > 0).collect();
        let mut back = Vec::new();
        for (t, &now) in self.state.triangles.iter().enumerate() {
            let then = other.triangles[t];
            if worse[now[0] as usize] && (now != then || now.iter().any(|&v| moved(v))) {
                back.push(t as u32);
            }
        }
        let state = &mut self.state;
        for v in (0..n).filter(|&v| worse[v]) {
            state.at.positions[v] = other.at.positions[v];
            state.at.values[v] = other.at.values[v];
            state.at.gradients[v] = other.at.gradients[v];
        }
        for t in 0..state.triangles.len() {
            if worse[state.triangles[t][0] as usize] || worse[other.triangles[t][0] as usize] {
                state.triangles[t] = other.triangles[t];
                state.along[t] = other.along[t];
                state.targets[t] = other.targets[t];
                if let Some(diagonal) = state.diagonals.get_mut(t / 2) {
                    *diagonal = other.diagonals[t / 2];
                }
            }
        }
        self.corners = Corners::new(n, &self.state.triangles);
        self.note(&back);
    }
}
