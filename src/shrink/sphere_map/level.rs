//! The map of one mesh as flat arrays: sweeps by colour, in parallel.
//!
//! Vertices of one colour share no triangle, so each of them can take its step without knowing the others': the result
//! does not depend on who computes which, and no triangle turns over.

use super::super::colours::colours;
use super::super::energy::{Objective, Reference};
use super::star::{POSITIVE, Relaxed, Star};
use crate::settings::{Canceled, Settings};
use glam::DVec3;
use rayon::prelude::*;

/// Vertices per piece of parallel work; fixed, so that sums do not depend on the number of threads.
pub const CHUNK: usize = 512;
/// Meshes below this many vertices are not worth waking threads for.
pub const PARALLEL: usize = 4096;
/// The same for lists whose items take long to make.
const PARALLEL_LISTS: usize = 1024;

/// A corner of a triangle. Triangles are numbered by their smallest vertex, which is their corner 0, and its ring.
#[derive(Clone, Copy)]
pub struct Place {
    /// The triangle's number.
    pub triangle: u32,
    /// 0, 1 or 2.
    pub corner: u8,
}

/// Connectivity and references of a mesh, rings in one array.
pub struct Level {
    /// Number in the whole mesh of every vertex here.
    pub vertices: Vec<u32>,
    /// Where every vertex's ring starts; one longer than `vertices`.
    pub first: Vec<u32>,
    /// Rings, in numbers of this level.
    pub ring: Vec<u32>,
    /// Reference of the triangle between a ring's entry and the next one, seen from the ring's vertex.
    pub references: Vec<Reference>,
    /// Which triangle that is, and which of its corners the vertex is.
    pub places: Vec<Place>,
    /// Corners of every triangle, the smallest vertex first.
    pub triangles: Vec<[u32; 3]>,
    /// Reference of every triangle, seen from its first corner.
    pub shapes: Vec<Reference>,
    /// Vertices by colour.
    colours: Vec<Vec<u32>>,
}

impl Level {
    /// From the rings of the vertices that are there, and the reference triangle of any three of them (numbers of the whole
    /// mesh).
    pub fn new<'a>(
        vertices: Vec<u32>,
        size: usize,
        ring_of: impl Fn(u32) -> &'a [u32],
        reference: impl Fn([u32; 3]) -> Reference + Sync,
        settings: &Settings<'_>,
    ) -> Self {
        let mut number = vec![u32::MAX; size];
        for (i, &v) in vertices.iter().enumerate() {
            number[v as usize] = i as u32;
        }
        let (mut first, mut ring) = (Vec::with_capacity(vertices.len() + 1), Vec::with_capacity(6 * vertices.len()));
        first.push(0);
        for &v in &vertices {
            ring.extend(ring_of(v).iter().map(|&u| number[u as usize]));
            first.push(ring.len() as u32);
        }
        let mut level = Self {
            vertices,
            first,
            ring,
            references: Vec::new(),
            places: Vec::new(),
            triangles: Vec::new(),
            shapes: Vec::new(),
            colours: Vec::new(),
        };
        level.number_triangles();
        level.shapes = level.map(level.triangles.len(), settings, |t| {
            reference(level.triangles[t].map(|v| level.vertices[v as usize]))
        });
        let shapes = &level.shapes;
        level.references =
            level.places.iter().map(|at| shapes[at.triangle as usize].turned(at.corner.into())).collect();
        level.colours = colours(level.len(), |v| level.ring(v));
        level
    }

    /// Number of vertices.
    pub fn len(&self) -> usize {
        self.vertices.len()
    }
    /// Neighbours of `v`, counter-clockwise.
    pub fn ring(&self, v: usize) -> &[u32] {
        &self.ring[self.range(v)]
    }
    /// Where the ring of `v` is in the flat arrays.
    pub fn range(&self, v: usize) -> std::ops::Range<usize> {
        self.first[v] as usize..self.first[v + 1] as usize
    }

    /// The other two corners of every triangle of `v`, in the ring's order.
    pub fn wedges(&self, v: usize) -> impl Iterator<Item = [usize; 2]> {
        let ring = self.ring(v);
        (0..ring.len()).map(|i| [ring[i] as usize, ring[(i + 1) % ring.len()] as usize])
    }

    fn number_triangles(&mut self) {
        const OTHERS: u32 = u32::MAX;
        let mut places = vec![Place { triangle: OTHERS, corner: 0 }; self.ring.len()];
        let mut triangles = Vec::with_capacity(self.ring.len() / 3);
        for v in 0..self.len() {
            for (slot, [b, c]) in self.range(v).zip(self.wedges(v)) {
                if v < b && v < c {
                    places[slot].triangle = triangles.len() as u32;
                    triangles.push([v, b, c].map(|u| u as u32));
                }
            }
        }
        for v in 0..self.len() {
            for (slot, [b, c]) in self.range(v).zip(self.wedges(v)) {
                if places[slot].triangle == OTHERS {
                    // the smallest vertex, the one after it, and where `v` is counted from there
                    let (owner, next, corner) = if b < c { (b, c, 2) } else { (c, v, 1) };
                    let ring = self.ring(owner);
                    let at = ring.iter().position(|&u| u as usize == next).expect("corners of a triangle are joined");
                    places[slot] = Place { triangle: places[self.range(owner).start + at].triangle, corner };
                }
            }
        }
        (self.places, self.triangles) = (places, triangles);
    }

    /// Lists made for every vertex, one after the other.
    pub fn map_rows<T: Send>(&self, settings: &Settings<'_>, row: impl Fn(usize, &mut Vec<T>) + Sync) -> Vec<T> {
        let piece = |start: usize| {
            let end = (start + CHUNK).min(self.len());
            let mut out = Vec::with_capacity((self.first[end] - self.first[start]) as usize);
            for v in start..end {
                row(v, &mut out);
            }
            out
        };
        let starts = || (0..self.len()).step_by(CHUNK);
        if self.len() < PARALLEL_LISTS {
            return starts().flat_map(piece).collect();
        }
        let starts: Vec<usize> = starts().collect();
        let pieces: Vec<Vec<T>> = settings.pool.install(|| starts.into_par_iter().map(piece).collect());
        pieces.into_iter().flatten().collect()
    }

    /// A list made piece by piece.
    pub fn map<T: Send>(&self, count: usize, settings: &Settings<'_>, item: impl Fn(usize) -> T + Sync) -> Vec<T> {
        if self.len() < PARALLEL_LISTS {
            return (0..count).map(item).collect();
        }
        settings.pool.install(|| (0..count).into_par_iter().with_min_len(CHUNK).map(&item).collect())
    }

    /// A sum in a fixed order.
    pub fn sum(&self, count: usize, settings: &Settings<'_>, term: impl Fn(usize) -> f64 + Sync) -> f64 {
        let piece = |start: usize| (start..(start + CHUNK).min(count)).map(&term).sum::<f64>();
        let starts = (0..count).step_by(CHUNK);
        if self.len() < PARALLEL {
            return starts.map(piece).sum();
        }
        let starts: Vec<usize> = starts.collect();
        let pieces: Vec<f64> = settings.pool.install(|| starts.into_par_iter().map(piece).collect());
        pieces.into_iter().sum()
    }

    fn gather(&self, v: usize, places: &[DVec3], star: &mut Star) {
        star.clear();
        let (ring, references) = (self.ring(v), &self.references[self.range(v)]);
        for i in 0..ring.len() {
            let (b, c) = (ring[i] as usize, ring[(i + 1) % ring.len()] as usize);
            star.push(places[b], places[c], &references[i]);
        }
    }

    /// Energy of the whole map; infinite where a triangle is not positive.
    pub fn energy(&self, places: &[DVec3], objective: &Objective, settings: &Settings<'_>) -> f64 {
        self.sum(self.triangles.len(), settings, |t| {
            let ([x, b, c], shape) = (self.triangles[t].map(|v| places[v as usize]), &self.shapes[t]);
            let d = x.dot(b.cross(c)) / (2.0 * shape.area);
            if d.is_nan() || d <= POSITIVE {
                return f64::INFINITY;
            }
            shape.area * objective.value(shape.dirichlet(x, b, c), d)
        })
    }

    /// One sweep of Newton steps over all vertices, colour by colour; returns by how much the energy fell. Where that of a vertex
    /// fell by more than `notable`, it and its ring go on stepping.
    pub fn sweep(
        &self,
        places: &mut [DVec3],
        objective: &Objective,
        notable: f64,
        settings: &Settings<'_>,
    ) -> Result<f64, Canceled> {
        let (mut fallen, mut moving) = (0.0, Vec::new());
        for colour in &self.colours {
            settings.cancel.check()?;
            let relax = |star: &mut Star, v: u32| {
                self.gather(v as usize, places, star);
                star.relax(places[v as usize], objective)
            };
            let steps: Vec<Option<Relaxed>> = if self.len() < PARALLEL || colour.len() < 2 * CHUNK {
                let mut star = Star::default();
                colour.iter().map(|&v| relax(&mut star, v)).collect()
            } else {
                let work = colour.par_iter().with_min_len(CHUNK);
                settings.pool.install(|| work.map_init(Star::default, |star, &v| relax(star, v)).collect())
            };
            for (&v, step) in colour.iter().zip(steps) {
                if let Some(step) = step {
                    places[v as usize] = step.to;
                    // an energy that was infinite falls by infinity
                    fallen += step.before - step.after;
                    if step.before - step.after > notable {
                        moving.push(v);
                    }
                }
            }
        }
        Ok(fallen + self.follow(moving, places, objective, notable))
    }

    /// Steps of a few vertices, and of the rings of those that gain more than `notable`, until none does.
    fn follow(&self, mut moving: Vec<u32>, places: &mut [DVec3], objective: &Objective, notable: f64) -> f64 {
        const ROUNDS: u32 = 50;
        let (mut star, mut fallen, mut seen) =
            (Star::default(), 0.0, vec![0; if moving.is_empty() { 0 } else { self.len() }]);
        for round in 1..=ROUNDS {
            let mut next = Vec::new();
            moving.sort_unstable();
            for &v in &moving {
                self.gather(v as usize, places, &mut star);
                let Some(step) = star.relax(places[v as usize], objective) else { continue };
                places[v as usize] = step.to;
                fallen += step.before - step.after;
                if step.before - step.after > notable {
                    let around = self.ring(v as usize).iter().chain([&v]);
                    next.extend(around.filter(|&&u| std::mem::replace(&mut seen[u as usize], round) < round));
                }
            }
            moving = next;
            if moving.is_empty() {
                break;
            }
        }
        fallen
    }
}
