//! What stands between a shape and a sphere, and how to mend it: asked for with `component` or with `on_topology: wrap`.
//!
//! The solid is looked at on the contraction's own lattice. Other components than the chosen one become outside, voids are
//! filled. A carved ball that cannot give up its last nodes spans every handle with a membrane and joins components
//! with a chain; what is near those nodes becomes solid, so that the mended field has genus 0 and every later stage works
//! on it unchanged.
//!
//! Not guaranteed: that a handle narrower than the lattice is found; a finer study finds it.

use super::complex::{Complex, Rings};
use super::contract::{Lattice, Resolution, carve, lattice, mark};
use super::graded::Graded;
use super::mend::{Label, Mended, Plug, Territory};
use super::topology::{PLACES, middle};
use super::{Component, OnTopology, ShrinkError, ShrinkSpec};
use crate::field::mesh::{Sheet, TriangleMesh};
use crate::field::{Frame, Sampler};
use crate::settings::{CancelToken, Canceled};
use glam::DVec3;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Doublings of the coarsest lattice in a first study.
const LEVELS: u32 = 3;
/// How much deeper than the first a study can go.
pub const DEEPEST: u32 = 1;
/// Nodes that could not be given up and are farther outside than this many spacings span a handle or a gap: one of about two
/// spacings across. Half of what the contraction refuses, because who asks for a look wants to know.
const OBSTRUCTION: f64 = 0.9;
/// Beyond this many spacings such a node may be in a narrow gap as well as in an unevenness; a finer lattice tells.
const DOUBTFUL: f64 = 0.3;
/// Half the thickness of a membrane, in spacings: more than the covering radius of the lattice, sqrt(3)/2, so that no gap
/// is left between its nodes.
const MEMBRANE: f64 = 1.0;
/// Radius of a bridge, in spacings: thick enough for the remeshing to go round it.
const BRIDGE: f64 = 2.0;
/// Rounds of plugging: what one round's plugs leave open is seen by the next.
const ROUNDS: usize = 3;
/// Smoothing sweeps of the plugs' nodes, which takes the lattice's stairs out of them.
const SWEEPS: usize = 20;

/// What a shape was found to be, where that was looked at.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize, utoipa::ToSchema)]
#[schema(as = FoundTopology)]
pub struct Topology {
    /// Components of the solid.
    pub components: u32,
    /// Voids inside it; filled.
    pub voids: u32,
    /// Index of the component that was wrapped, largest first; absent when all were.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub component: Option<u32>,
    /// Handles of what was wrapped.
    pub handles: u32,
    /// Share of the surface's area that was invented: membranes across handles, and bridges between components.
    pub invented_area: f64,
    /// Scene positions of membranes and bridges; at most 16.
    pub places: Vec<[f64; 3]>,
}

/// A shape's topology, and the field to go on with where it had to be mended.
pub struct Study<'a> {
    /// The mended field; `None` where the shape needs nothing.
    pub field: Option<Mended<'a>>,
    /// What was found.
    pub topology: Topology,
}

/// Looks at the shape behind the sampler, where the spec asks for it. `depth` (up to [`DEEPEST`]) doubles the lattice.
///
/// # Errors
/// [`ShrinkError`] when the run was canceled, when there is no zero level set, or no such component.
pub fn study<'a>(sampler: &Sampler<'a>, spec: &ShrinkSpec, depth: u32) -> Result<Option<Study<'a>>, ShrinkError> {
    if spec.component.is_none() && spec.on_topology == OnTopology::Refuse {
        return Ok(None);
    }
    sampler.tally().stage("topology");
    let cancel = sampler.settings().cancel;
    let resolution = Resolution { levels: LEVELS + depth.min(DEEPEST), local: 0 };
    let Lattice { mut grid, frame, slope } = lattice(sampler, resolution).map_err(|refusal| refusal.error)?;
    let h = grid.h();
    let limit = (OBSTRUCTION * h) as f32;
    let (complex, mut values, inside) = look(&sampler.framed(frame), &mut grid, limit)?;
    // what could not be given up and is near is an unevenness below the lattice: it counts as solid
    let doubtful = (DOUBTFUL * h) as f32;
    let in_doubt = (0..grid.len()).any(|i| inside[i] && values[i] > doubtful && values[i] <= limit);
    if spec.component.is_some() && in_doubt && depth < DEEPEST {
        // an index must not depend on whether a narrow gap was seen
        return study(sampler, spec, depth + 1);
    }
    let solid: Vec<bool> = (0..grid.len()).map(|i| inside[i] && values[i] <= limit).collect();
    let mut bodies = complex.clusters(&solid);
    let size = |body: &Vec<usize>| body.iter().map(|&i| complex.spacing(i).powi(3)).sum::<f64>();
    bodies.sort_by(|a, b| size(b).total_cmp(&size(a)));
    let empty: Vec<bool> = solid.iter().map(|s| !s).collect();
    let voids: Vec<Vec<usize>> =
        complex.clusters(&empty).into_iter().filter(|c| !c.iter().any(|&i| complex.border[i])).collect();
    let chosen = match spec.component {
        None => None,
        Some(Component::Largest) => Some(0),
        Some(Component::Index(index)) => Some(index as usize),
    };
    if let Some(index) = chosen
        && index >= bodies.len()
    {
        let places = bodies.iter().take(PLACES).map(|body| middle(&complex, body, frame)).collect();
        return Err(ShrinkError::NoComponent { index: index as u32, count: bodies.len(), places });
    }
    let territory = settle(&complex, h, &mut values, (&bodies, chosen, &voids), &solid, cancel)?;
    let kept: Vec<bool> = match &territory {
        None => solid,
        Some(labels) => {
            (0..grid.len()).map(|i| (solid[i] && labels[i] == Label::Keep) || labels[i] == Label::Fill).collect()
        }
    };
    let pieces = if chosen.is_some() { 1 } else { bodies.len() as i64 };
    let mut topology = Topology {
        components: bodies.len() as u32,
        voids: voids.len() as u32,
        component: chosen.map(|index| index as u32),
        handles: (pieces - complex.euler(&kept)).max(0) as u32,
        ..Topology::default()
    };
    let mut plugs = Vec::new();
    if spec.on_topology == OnTopology::Wrap {
        (plugs, topology.places) = plug((&grid, &complex), &mut values, frame, cancel)?;
    }
    if territory.is_none() && plugs.is_empty() {
        return Ok(Some(Study { field: None, topology }));
    }
    let territory = territory.map(|labels| Territory { grid, frame, labels });
    let mut field = Mended { field: sampler.field(), territory, plugs, slope, truth: None };
    if field.plugs.is_empty() {
        field.truth = sampler.field().truth().map(|mesh| left_of(mesh, &field));
    }
    Ok(Some(Study { field: Some(field), topology }))
}

/// The lattice's complex, what the nodes count with, and what a carved ball leaves inside. Where nodes that are farther
/// outside than `limit` could not be given up, the lattice is made as fine as it is near the zero level set.
fn look(sampler: &Sampler<'_>, grid: &mut Graded, limit: f32) -> Result<(Complex, Vec<f32>, Vec<bool>), Canceled> {
    /// Rounds at most; a membrane may move when the lattice under it changes.
    const ROUNDS: usize = 8;
    let fine = grid.h();
    let mut round = 0;
    loop {
        let complex = grid.complex(sampler.settings())?;
        let values = mark(sampler, grid, &complex)?.target;
        let inside = carve(&complex, &values, sampler.settings().cancel, &[], &mut |_, _| {})?;
        let coarse = |i: &usize| inside[*i] && values[*i] > limit && complex.spacing(*i) > 1.5 * fine;
        let nodes: Vec<(usize, i32)> = (0..complex.len()).filter(coarse).map(|i| (i, complex.sides[i])).collect();
        round += 1;
        if round == ROUNDS || nodes.is_empty() || !grid.halve_around(sampler, nodes, 1.0, 1.0)? {
            return Ok((complex, values, inside));
        }
    }
}

/// Makes components other than the chosen one outside and fills voids, in the lattice's values; returns the label of every
/// node, or `None` when there is nothing to do.
fn settle(
    complex: &Complex,
    h: f64,
    values: &mut [f32],
    (bodies, chosen, voids): (&[Vec<usize>], Option<usize>, &[Vec<usize>]),
    solid: &[bool],
    cancel: &CancelToken,
) -> Result<Option<Vec<Label>>, Canceled> {
    let others = chosen.is_some() && bodies.len() > 1;
    if !others && voids.is_empty() {
        return Ok(None);
    }
    let mut labels = vec![Label::Keep; complex.len()];
    if others {
        let seeds: Vec<(&[usize], u32)> =
            bodies.iter().enumerate().map(|(k, body)| (body.as_slice(), u32::from(Some(k) != chosen))).collect();
        let owner = flood(complex, &seeds, |_| true, cancel)?;
        for (label, owner) in labels.iter_mut().zip(owner) {
            if owner == 1 {
                *label = Label::Away;
            }
        }
    }
    if !voids.is_empty() {
        let is_void = {
            let mut is_void = vec![false; complex.len()];
            voids.iter().flatten().for_each(|&i| is_void[i] = true);
            is_void
        };
        let exterior: Vec<usize> = (0..complex.len()).filter(|&i| !solid[i] && !is_void[i]).collect();
        let mut seeds: Vec<(&[usize], u32)> = vec![(exterior.as_slice(), 0)];
        seeds.extend(voids.iter().map(|void| (void.as_slice(), 1)));
        let side = flood(complex, &seeds, |i| solid[i], cancel)?;
        for (label, side) in labels.iter_mut().zip(side) {
            if side == 1 && *label == Label::Keep {
                *label = Label::Fill;
            }
        }
    }
    let h = h as f32;
    for (value, label) in values.iter_mut().zip(&labels) {
        match label {
            Label::Keep => {}
            Label::Away => *value = value.abs().max(h),
            Label::Fill => *value = value.min(-h),
        }
    }
    Ok(Some(labels))
}

/// For every node the mark of the seeds that reach it first, going through nodes that `may` be entered; `u32::MAX` where none
/// does.
fn flood(
    complex: &Complex,
    seeds: &[(&[usize], u32)],
    may: impl Fn(usize) -> bool,
    cancel: &CancelToken,
) -> Result<Vec<u32>, Canceled> {
    let mut mark = vec![u32::MAX; complex.len()];
    let mut queue = VecDeque::new();
    for &(nodes, seed) in seeds {
        for &i in nodes {
            mark[i] = seed;
            queue.push_back(i);
        }
    }
    let mut rings = Rings::new(complex);
    let mut taken = 0u64;
    while let Some(i) = queue.pop_front() {
        taken += 1;
        if taken.is_multiple_of(1 << 16) {
            cancel.check()?;
        }
        for j in rings.of(i).nodes.iter().map(|&j| j as usize) {
            if mark[j] == u32::MAX && may(j) {
                mark[j] = mark[i];
                queue.push_back(j);
            }
        }
    }
    Ok(mark)
}

/// Carves, and makes solid what is near the nodes that could not be given up, until all can. Returns the plugs in scene units,
/// and a place in each cluster of such nodes.
fn plug(
    (grid, complex): (&Graded, &Complex),
    values: &mut [f32],
    frame: Frame,
    cancel: &CancelToken,
) -> Result<(Vec<Plug>, Vec<[f64; 3]>), Canceled> {
    let limit = (OBSTRUCTION * grid.h()) as f32;
    let (mut membranes, mut bridges) = (Vec::<[DVec3; 3]>::new(), Vec::<[DVec3; 3]>::new());
    let mut places = Vec::new();
    for _ in 0..ROUNDS {
        let inside = carve(complex, values, cancel, &[], &mut |_, _| {})?;
        let stuck: Vec<bool> = (0..complex.len()).map(|i| inside[i] && values[i] > 0.0).collect();
        let far: Vec<Vec<usize>> =
            complex.clusters(&stuck).into_iter().filter(|c| c.iter().any(|&i| values[i] > limit)).collect();
        if far.is_empty() {
            break;
        }
        for cluster in &far {
            if places.len() < PLACES {
                places.push(middle(complex, cluster, frame));
            }
            let (triangles, segments) = span(complex, cluster, &inside, values);
            membranes.extend(triangles);
            bridges.extend(segments.into_iter().map(|[a, b]| [a, b, b]));
        }
        cancel.check()?;
        for (list, radius) in [(&membranes, MEMBRANE), (&bridges, BRIDGE)] {
            let sheet = Sheet::new(list);
            let reach = radius * grid.h();
            for i in around(grid, list, reach) {
                if let Some(foot) = sheet.nearest(complex.positions[i], reach) {
                    values[i] = values[i].min((foot.distance(complex.positions[i]) - reach) as f32);
                }
            }
            cancel.check()?;
        }
    }
    let to_scene =
        |list: &[[DVec3; 3]]| -> Vec<[DVec3; 3]> { list.iter().map(|t| t.map(|p| frame.to_scene(p))).collect() };
    let plugs = [(membranes, MEMBRANE), (bridges, BRIDGE)].into_iter().filter(|(list, _)| !list.is_empty());
    let plugs = plugs
        .map(|(list, radius)| Plug { sheet: Sheet::new(&to_scene(&list)), radius: radius * grid.h() * frame.scale });
    Ok((plugs.collect(), places))
}

/// The nodes within `reach` of triangles that are no larger than a cell, and some more.
fn around(grid: &Graded, triangles: &[[DVec3; 3]], reach: f64) -> BTreeSet<usize> {
    triangles.iter().flatten().flat_map(|&p| grid.near(p, reach + grid.h())).collect()
}

/// The triangles and the lone edges of the lattice that a cluster of stuck nodes spans with itself and the solid it hangs
/// on, smoothed, in frame units.
fn span(complex: &Complex, cluster: &[usize], inside: &[bool], values: &[f32]) -> (Vec<[DVec3; 3]>, Vec<[DVec3; 2]>) {
    // a node of its own or of the solid; ordered, so that nothing depends on hashing
    let mut index: BTreeMap<usize, usize> = cluster.iter().enumerate().map(|(k, &i)| (i, k)).collect();
    let own = cluster.len();
    let mut positions: Vec<DVec3> = cluster.iter().map(|&i| complex.positions[i]).collect();
    let mut links: Vec<Vec<usize>> = vec![Vec::new(); own];
    let mut rings = Rings::new(complex);
    for (k, &i) in cluster.iter().enumerate() {
        for j in rings.of(i).nodes.iter().map(|&j| j as usize) {
            let hangs_on = inside[j] && values[j] <= 0.0;
            if !hangs_on && !index.contains_key(&j) {
                continue;
            }
            let n = *index.entry(j).or_insert_with(|| {
                positions.push(complex.positions[j]);
                positions.len() - 1
            });
            links[k].push(n);
        }
    }
    let (mut triangles, mut edges) = (Vec::new(), BTreeMap::new());
    for (&i, &a) in &index {
        let ring = rings.of(i);
        let higher: Vec<(usize, usize)> = (0..ring.nodes.len())
            .filter(|&k| ring.nodes[k] as usize > i)
            .filter_map(|k| Some((k, *index.get(&(ring.nodes[k] as usize))?)))
            .collect();
        for (n, &(j, b)) in higher.iter().enumerate() {
            if a.min(b) < own {
                edges.entry((a.min(b), a.max(b))).or_insert(true);
            }
            for &(k, c) in &higher[n + 1..] {
                if a.min(b).min(c) < own && ring.links[j] >> k & 1 == 1 {
                    triangles.push([a, b, c]);
                }
            }
        }
    }
    for &[a, b, c] in &triangles {
        for (p, q) in [(a, b), (b, c), (c, a)] {
            edges.insert((p.min(q), p.max(q)), false);
        }
    }
    for _ in 0..SWEEPS {
        let before = positions.clone();
        for (k, around) in links.iter().enumerate().filter(|(_, around)| !around.is_empty()) {
            let mean = around.iter().map(|&n| before[n]).sum::<DVec3>() / around.len() as f64;
            positions[k] = 0.5 * (before[k] + mean);
        }
    }
    let lone = edges.into_iter().filter(|(_, alone)| *alone).map(|((a, b), _)| [positions[a], positions[b]]).collect();
    (triangles.into_iter().map(|t| t.map(|v| positions[v])).collect(), lone)
}

/// The components of a mesh whose vertices mostly lie where the field was left as it is.
fn left_of(mesh: &TriangleMesh, field: &Mended<'_>) -> TriangleMesh {
    let mut parent: Vec<usize> = (0..mesh.vertices.len()).collect();
    fn root(parent: &mut [usize], mut v: usize) -> usize {
        while parent[v] != v {
            parent[v] = parent[parent[v]];
            v = parent[v];
        }
        v
    }
    for t in &mesh.triangles {
        let first = root(&mut parent, t[0] as usize);
        for &v in &t[1..] {
            let other = root(&mut parent, v as usize);
            parent[other] = first;
        }
    }
    let mut votes = vec![0i64; mesh.vertices.len()];
    for (v, &p) in mesh.vertices.iter().enumerate() {
        let keeps = field.territory.as_ref().is_none_or(|t| t.label(DVec3::from(p)) == Label::Keep);
        votes[root(&mut parent, v)] += if keeps { 1 } else { -1 };
    }
    let stays = |t: &[u32; 3], parent: &mut Vec<usize>| votes[root(parent, t[0] as usize)] > 0;
    // only vertices in use: the diagonal of the rest is what distances are measured in
    let mut left = TriangleMesh::default();
    let mut number = vec![u32::MAX; mesh.vertices.len()];
    for t in mesh.triangles.iter().filter(|t| stays(t, &mut parent)) {
        left.triangles.push(t.map(|v| {
            let number = &mut number[v as usize];
            if *number == u32::MAX {
                *number = left.vertices.len() as u32;
                left.vertices.push(mesh.vertices[v as usize]);
            }
            *number
        }));
    }
    left
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::sampler::Tally;
    use crate::field::scene::Scene;
    use crate::field::{Field, Points};
    use crate::measure::fixtures::with_settings;
    use serde_json::{Value, json};

    fn ball(x: f64, radius: f64) -> Value {
        json!({"translate": {"by": [x, 0, 0], "of": {"sphere": {"radius": radius}}}})
    }

    fn torus() -> Value {
        json!({"torus": {"major": 0.6, "minor": 0.2}})
    }

    const WRAP: ShrinkSpec = ShrinkSpec {
        method: super::super::Method::Adaptive,
        lattice: super::super::lattice::LatticeSpec::Octahedral { n: 8 },
        density: super::super::Density::Area,
        distortion: super::super::Distortion::Isometric,
        relax_uv: false,
        on_topology: OnTopology::Wrap,
        component: None,
        samples: None,
    };

    fn component(component: Component) -> ShrinkSpec {
        ShrinkSpec { on_topology: OnTopology::Refuse, component: Some(component), ..WRAP }
    }

    /// Studies a scene; then the mended field again, asked to be wrapped; and hands both and the field to `look`.
    fn studied(scene: &Value, spec: &ShrinkSpec, look: impl FnOnce(&Study<'_>, Option<Topology>)) {
        let scene = Scene::from_value(scene).expect("a scene");
        with_settings(2, |settings| {
            let tally = Tally::new();
            let found = study(&Sampler::new(&scene, *settings, &tally), spec, 0).expect("studied").expect("asked for");
            let again = found.field.as_ref().map(|field| {
                let mended = Sampler::new(field, *settings, &tally);
                study(&mended, &WRAP, 0).expect("studied").expect("asked for").topology
            });
            look(&found, again);
        });
    }

    fn value(field: &dyn Field, p: [f32; 3]) -> f32 {
        let mut value = [0.0];
        field.values(Points { x: &p[..1], y: &p[1..2], z: &p[2..] }, &mut value);
        value[0]
    }

    #[test]
    fn a_sphere_needs_no_mending() {
        studied(&ball(0.0, 0.5), &WRAP, |found, again| {
            assert!(found.field.is_none() && again.is_none());
            assert_eq!(found.topology, Topology { components: 1, ..Topology::default() });
        });
    }

    #[test]
    fn a_handle_is_found_and_plugged_where_it_is() {
        studied(&torus(), &WRAP, |found, again| {
            assert_eq!((found.topology.components, found.topology.handles), (1, 1));
            assert_eq!(found.topology.places.len(), 1);
            let [x, y, z] = found.topology.places[0];
            assert!(x.hypot(y) < 0.4 && z.abs() < 0.2, "in the hole: {:?}", found.topology.places);
            let again = again.expect("mended");
            assert_eq!((again.handles, again.places.len()), (0, 0), "nothing is left to plug");
            let field = found.field.as_ref().expect("mended");
            assert!(value(field, [0.9, 0.0, 0.4]) > 0.0, "away from the plug the field is its own");
            assert!((value(field, [0.6, 0.0, 0.0]) + 0.2).abs() < 1e-6);
        });
    }

    #[test]
    fn components_are_bridged_and_voids_filled_by_a_wrap() {
        let two = json!({"union": {"of": [ball(-0.5, 0.3), ball(0.5, 0.3)]}});
        studied(&two, &WRAP, |found, again| {
            assert_eq!((found.topology.components, found.topology.handles), (2, 0));
            assert_eq!(again.expect("mended").components, 1);
        });
        let shell = json!({"difference": {"of": [ball(0.0, 0.6), ball(0.0, 0.4)]}});
        studied(&shell, &WRAP, |found, again| {
            assert_eq!((found.topology.components, found.topology.voids), (1, 1));
            assert_eq!(again.expect("mended").voids, 0);
            let field = found.field.as_ref().expect("mended");
            assert!(value(field, [0.0; 3]) < 0.0 && value(field, [0.3, 0.1, 0.2]) < 0.0, "the void is filled");
            assert!((value(field, [0.0, 0.0, 0.65]) - 0.05).abs() < 1e-6);
        });
    }

    #[test]
    fn one_component_is_left_and_the_others_are_outside() {
        let three = json!({"union": {"of": [ball(-0.6, 0.2), ball(0.0, 0.3), ball(0.6, 0.25)]}});
        for (which, center, radius) in
            [(Component::Largest, 0.0, 0.3), (Component::Index(1), 0.6, 0.25), (Component::Index(2), -0.6, 0.2)]
        {
            studied(&three, &component(which), |found, again| {
                assert_eq!(found.topology.components, 3);
                assert_eq!(again.expect("mended").components, 1);
                let field = found.field.as_ref().expect("mended");
                assert!((value(field, [center, 0.0, 0.0]) + radius).abs() < 1e-6);
                for other in [-0.6, 0.0, 0.6].into_iter().filter(|&x| x != center) {
                    assert!(value(field, [other, 0.0, 0.0]) > 0.0);
                    assert!(value(field, [other, 0.19, 0.0]) > 0.0);
                }
            });
        }
        let scene = Scene::from_value(&three).expect("a scene");
        with_settings(1, |settings| {
            let tally = Tally::new();
            let found = study(&Sampler::new(&scene, *settings, &tally), &component(Component::Index(3)), 0);
            let Err(ShrinkError::NoComponent { index, count, places }) = found.map(|_| ()) else {
                panic!("there are 3")
            };
            assert_eq!((index, count, places.len()), (3, 3, 3));
        });
    }

    #[test]
    fn the_truth_of_a_component_is_its_own_part_of_the_mesh() {
        let (vertices, triangles) = crate::measure::fixtures::sphere_mesh(24, 12, 0.5, DVec3::ZERO);
        let n = vertices.len() as u32;
        let small = vertices.iter().map(|&v| 0.5 * v + DVec3::X * 2.0);
        let mesh = TriangleMesh {
            vertices: vertices.iter().copied().chain(small).map(|v| v.to_array()).collect(),
            triangles: triangles.iter().copied().chain(triangles.iter().map(|t| t.map(|v| v + n))).collect(),
        };
        let field = crate::field::mesh::MeshField::new(mesh).expect("a mesh");
        with_settings(1, |settings| {
            let tally = Tally::new();
            let sampler = Sampler::new(&field, *settings, &tally);
            let found = study(&sampler, &component(Component::Index(1)), 0).expect("studied").expect("asked for");
            let field = found.field.expect("mended");
            let truth = field.truth().expect("the small sphere");
            assert_eq!((truth.vertices.len(), truth.triangles.len()), (n as usize, triangles.len()));
            assert!(truth.vertices.iter().all(|v| v[0] > 1.5));
        });
    }
}
