//! Newton steps of single vertices, colour by colour: what a step of the whole chart leaves rough, the few triangles that were
//! nearly flattened above all, only they see.

use super::super::energy::inverse_positive;
use super::system::{Corner, derivatives, held};
use super::{CHUNK, Chart, outer, single};
use crate::settings::{Canceled, Settings};
use glam::{DMat2, DVec2};
use rayon::prelude::*;

impl Chart {
    /// One step of every vertex. The energy never rises, and as no triangle around a vertex turns over, no two vertices of the
    /// border change places.
    ///
    /// # Errors
    /// When the token is raised.
    pub fn sweep(&self, places: &mut [DVec2], settings: &Settings<'_>) -> Result<(), Canceled> {
        for colour in &self.colours {
            settings.cancel.check()?;
            let relax = |&v: &u32| self.relaxed(v as usize, places);
            let to: Vec<Option<DVec2>> = colour.par_iter().with_min_len(CHUNK).map(relax).collect();
            for (&v, to) in colour.iter().zip(to) {
                places[v as usize] = to.unwrap_or(places[v as usize]);
            }
        }
        Ok(())
    }

    /// Place to which a Newton step with backtracking takes a vertex; `None` when none lowers the energy.
    fn relaxed(&self, v: usize, places: &[DVec2]) -> Option<DVec2> {
        let (mut gradient, mut diagonal, mut before) = (DVec2::ZERO, DMat2::ZERO, 0.0);
        for Corner { triangle, corner, .. } in self.rows.corners(v) {
            let piece = &self.pieces[*triangle as usize];
            let hat = piece.hats[*corner as usize];
            let (slope, modes) = derivatives(piece, places, self);
            gradient += slope * hat;
            for mode in modes {
                diagonal += outer(mode * hat, mode * hat);
            }
            before += piece.energy(places, &self.objective);
        }
        let free = self.freedom[v];
        let step = held(inverse_positive(held(diagonal, free, free)), free, free) * -gradient;
        let mut fraction = 1.0;
        for _ in 0..8 {
            let to = single(places[v] + fraction * step);
            if to != places[v] && self.energy_with(v, to, places) < before {
                return Some(to);
            }
            fraction *= 0.4;
        }
        None
    }

    /// Energy of the triangles at a vertex, with the vertex elsewhere.
    fn energy_with(&self, v: usize, to: DVec2, places: &[DVec2]) -> f64 {
        let at = |Corner { triangle, corner, .. }: &Corner| {
            let piece = &self.pieces[*triangle as usize];
            let mut corners = piece.corners.map(|u| places[u as usize]);
            corners[*corner as usize] = to;
            piece.energy_at(corners, &self.objective)
        };
        self.rows.corners(v).iter().map(at).sum()
    }
}
