//! The example scenes are what they claim to be: whole, inside the default domain, and without tunnels or voids.

use super::Scene;
use crate::field::{Field, Metric, Points};
use std::path::PathBuf;

/// Nodes per side of the lattice; its spacing over the default cube is below the thinnest wall of an example.
const SIDE: usize = 97;

/// Values on a lattice of `SIDE` nodes per side (one layer in the plane) over the cube of half extent 1.
fn sample(scene: &Scene) -> (Vec<f32>, usize) {
    let layers = if scene.dimension() == 2 { 1 } else { SIDE };
    let at = |k: usize| -1.0 + 2.0 * k as f32 / (SIDE - 1) as f32;
    let (mut x, mut y, mut z) = (Vec::new(), Vec::new(), Vec::new());
    for k in 0..layers * SIDE * SIDE {
        x.push(at(k % SIDE));
        y.push(at(k / SIDE % SIDE));
        z.push(if layers == 1 { 0.0 } else { at(k / (SIDE * SIDE)) });
    }
    let mut values = vec![0.0; x.len()];
    scene.values(Points { x: &x, y: &y, z: &z }, &mut values);
    (values, layers)
}

/// Components of the nodes where `keep` holds, joined by steps of at most 1 along every axis (`corners`) or along one axis.
fn components(keep: &[bool], layers: usize, corners: bool) -> usize {
    let mut seen = vec![false; keep.len()];
    let (mut count, mut stack) = (0, Vec::new());
    for start in 0..keep.len() {
        if !keep[start] || seen[start] {
            continue;
        }
        count += 1;
        seen[start] = true;
        stack.push(start);
        while let Some(k) = stack.pop() {
            let place = [(k % SIDE) as i64, (k / SIDE % SIDE) as i64, (k / (SIDE * SIDE)) as i64];
            for step in 0..27i64 {
                let d = [step % 3 - 1, step / 3 % 3 - 1, step / 9 - 1];
                if !corners && d.iter().map(|c| c.abs()).sum::<i64>() != 1 {
                    continue;
                }
                let q: [i64; 3] = std::array::from_fn(|a| place[a] + d[a]);
                if (0..3).all(|a| q[a] >= 0 && q[a] < [SIDE, SIDE, layers][a] as i64) {
                    let q = (q[2] as usize * SIDE + q[1] as usize) * SIDE + q[0] as usize;
                    if keep[q] && !seen[q] {
                        seen[q] = true;
                        stack.push(q);
                    }
                }
            }
        }
    }
    count
}

/// Euler number of the union of the closed cubes about the inside nodes: every cell of the lattice counts with the sign
/// of its dimension when one of the cubes around it is inside.
fn euler(inside: &[bool], layers: usize) -> i64 {
    let holds = |q: [i64; 3]| {
        (0..3).all(|a| q[a] >= 0 && q[a] < [SIDE, SIDE, layers][a] as i64)
            && inside[(q[2] as usize * SIDE + q[1] as usize) * SIDE + q[0] as usize]
    };
    let mut sum = 0;
    // cell coordinates are doubled: even ones lie between two cubes
    for c in 0..=2 * layers as i64 {
        for b in 0..=2 * SIDE as i64 {
            for a in 0..=2 * SIDE as i64 {
                let cell = [a, b, c];
                let touched = (0..8).any(|corner| {
                    holds(std::array::from_fn(|k| {
                        if cell[k] % 2 == 1 { cell[k] / 2 } else { cell[k] / 2 - (corner >> k & 1) }
                    }))
                });
                if touched {
                    let dimension = cell.iter().filter(|&&c| c % 2 == 1).count();
                    sum += if dimension % 2 == 0 { 1 } else { -1 };
                }
            }
        }
    }
    sum
}

fn examples(folder: &str) -> Vec<(String, Scene)> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(folder);
    let mut files: Vec<_> = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|e| e == "json"))
        .collect();
    files.sort();
    files
        .into_iter()
        .map(|path| {
            let name = path.file_stem().unwrap().to_string_lossy().into_owned();
            let scene = Scene::from_slice(&std::fs::read(&path).unwrap()).unwrap_or_else(|e| panic!("{name}: {e}"));
            (name, scene)
        })
        .collect()
}

/// Solid is what is at most `level` outside: a needle thinner than the spacing is seen from beside it.
fn one_piece_without_tunnels(name: &str, scene: &Scene, level: f64) {
    let (values, layers) = sample(scene);
    let inside: Vec<bool> = values.iter().map(|&v| f64::from(v) <= level).collect();
    let outside: Vec<bool> = inside.iter().map(|i| !i).collect();
    assert_eq!(components(&inside, layers, true), 1, "{name}: components of the solid");
    assert_eq!(components(&outside, layers, false), 1, "{name}: components of the space around it");
    assert_eq!(euler(&inside, layers), 1, "{name}: a solid without tunnels and voids has Euler number 1");
    for (k, inside) in inside.iter().enumerate() {
        let border = [k % SIDE, k / SIDE % SIDE].iter().any(|&c| c == 0 || c == SIDE - 1);
        let border = border || (layers > 1 && (k < SIDE * SIDE || k >= (layers - 1) * SIDE * SIDE));
        assert!(!(border && *inside), "{name} leaves the default domain");
    }
    // what the tree says holds what the lattice found
    let fitted = scene.fit_domain().expect("an example is bounded");
    let spacing = 2.0 / (SIDE - 1) as f64;
    for (k, _) in values.iter().enumerate().filter(|(_, v)| **v <= 0.0) {
        let place = [k % SIDE, k / SIDE % SIDE, k / (SIDE * SIDE)].map(|c| -1.0 + spacing * c as f64);
        let place = if layers == 1 { [place[0], place[1], 0.0] } else { place };
        let held = place.iter().zip(fitted.min).zip(fitted.max).all(|((c, lo), hi)| *c >= lo && *c <= hi);
        assert!(held, "{name}: the fitted domain is too small");
    }
    assert_ne!(scene.metric(), Metric::Sign, "{name}");
}

#[test]
fn every_example_scene_is_one_piece_of_genus_0_in_the_default_domain() {
    let scenes = examples("examples/scenes");
    assert!(scenes.len() >= 12, "only {} example scenes", scenes.len());
    for (name, scene) in scenes {
        assert_eq!(scene.dimension(), 3, "{name}");
        one_piece_without_tunnels(&name, &scene, 0.0);
    }
}

#[test]
fn every_planar_example_is_one_piece_without_holes_in_the_default_domain() {
    let spacing = 2.0 / (SIDE - 1) as f64;
    for (name, scene) in examples("examples/scenes/2d") {
        assert_eq!(scene.dimension(), 2, "{name}");
        one_piece_without_tunnels(&name, &scene, 0.75 * spacing);
    }
}

#[test]
fn the_euler_number_tells_a_ring_from_a_ball() {
    let ring = Scene::from_slice(br#"{"torus": {"major": 0.5, "minor": 0.2}}"#).unwrap();
    let (values, layers) = sample(&ring);
    let inside: Vec<bool> = values.iter().map(|&v| v <= 0.0).collect();
    assert_eq!(euler(&inside, layers), 0);
}
