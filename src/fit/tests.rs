use super::*;
use crate::field::mesh::TriangleMesh;
use crate::settings::CancelToken;
use std::cell::RefCell;

/// A ball of radius `radius` about `center`, an octahedron cut three times.
fn ball(center: [f64; 3], radius: f64) -> MeshField {
    let mut vertices = vec![DVec3::X, DVec3::Y, -DVec3::X, -DVec3::Y, DVec3::Z, -DVec3::Z];
    let mut triangles: Vec<[u32; 3]> = (0..4).flat_map(|i| [[i, (i + 1) % 4, 4], [(i + 1) % 4, i, 5]]).collect();
    for _ in 0..3 {
        triangles = triangles
            .into_iter()
            .flat_map(|[a, b, c]| {
                let mut middle = |i: u32, j: u32| {
                    vertices.push((vertices[i as usize] + vertices[j as usize]).normalize());
                    vertices.len() as u32 - 1
                };
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    let vertices = vertices.iter().map(|v| (DVec3::from(center) + radius * *v).to_array()).collect();
    MeshField::new(TriangleMesh { vertices, triangles }).unwrap()
}

fn small() -> FitSpec {
    FitSpec { layers: 2, width: 24, epochs: 12, samples: 6000, batch: 768, ..FitSpec::default() }
}

fn with_settings<T>(threads: usize, run: impl FnOnce(&Settings<'_>) -> T) -> T {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    run(&Settings { pool: &pool, cancel: &CancelToken::new(), progress: &|_| {}, watched: false })
}

fn fitted(meshes: &[MeshField], spec: &FitSpec, threads: usize) -> Fitted {
    let training = Training { spec, from: None, checkpoint: &|_| {} };
    with_settings(threads, |settings| fit(meshes, training, settings)).unwrap()
}

#[test]
fn a_ball_is_learned_where_it_is_and_in_its_own_units() {
    let made = fitted(
        &[ball([300.0, -20.0, 7.0], 40.0)],
        &FitSpec { epochs: 60, activation: Some(Activation::Sine { w0: 10.0 }), ..small() },
        2,
    );
    let shape = made.report.shapes[0];
    let distance = shape.closeness.unwrap().distance;
    assert!(shape.error < 0.005 && distance.mean < 0.004 && distance.max < 0.03, "{shape:?}");
    assert!(made.report.losses.last() < made.report.losses.first());
}

#[test]
fn the_bits_are_the_same_for_any_number_of_threads() {
    let meshes = [ball([0.0; 3], 1.0), ball([0.5, 0.0, 0.0], 0.6)];
    let spec = FitSpec { epochs: 2, latent_size: 3, layers: 4, normal: 0.1, eikonal: 0.1, ..small() };
    let (one, four) = (fitted(&meshes, &spec, 1), fitted(&meshes, &spec, 4));
    assert_eq!(one.network, four.network);
    assert_eq!(one.report, four.report);
}

#[test]
fn training_goes_on_from_a_checkpoint_to_the_same_bits() {
    let meshes = [ball([0.0; 3], 1.0), ball([0.5, 0.0, 0.0], 0.6)];
    let spec = FitSpec { epochs: 4, latent_size: 3, ..small() };
    let kept = RefCell::new(Vec::new());
    let keep = |state: &Checkpoint| kept.borrow_mut().push(state.to_bytes(&spec, "meshes"));
    let training = Training { spec: &spec, from: None, checkpoint: &keep };
    let whole = with_settings(2, |settings| fit(&meshes, training, settings)).unwrap();
    let bytes = &kept.borrow()[1];
    let from = Checkpoint::from_bytes(bytes, &spec, 2, "meshes");
    assert_eq!(from.as_ref().map(|state| state.epoch), Some(2));
    let training = Training { spec: &spec, from, checkpoint: &|_| {} };
    let resumed = with_settings(2, |settings| fit(&meshes, training, settings)).unwrap();
    assert_eq!((whole.network, whole.report), (resumed.network, resumed.report));

    // another training, and bytes that are none
    assert_eq!(Checkpoint::from_bytes(bytes, &FitSpec { seed: 1, ..spec }, 2, "meshes"), None);
    assert_eq!(Checkpoint::from_bytes(bytes, &spec, 3, "meshes"), None);
    assert_eq!(Checkpoint::from_bytes(bytes, &spec, 2, "others"), None);
    assert_eq!(Checkpoint::from_bytes(&bytes[..bytes.len() - 4], &spec, 2, "meshes"), None);
    assert_eq!(Checkpoint::from_bytes(b"", &spec, 2, "meshes"), None);
}

#[test]
fn several_balls_get_a_code_each() {
    let meshes = [ball([0.0; 3], 1.0), ball([0.0; 3], 0.7), ball([0.0, 0.0, 0.3], 0.5)];
    let spec = FitSpec { latent_size: 4, width: 32, epochs: 40, ..small() };
    let made = fitted(&meshes, &spec, 2);
    assert_eq!((made.network.latent_rows(), made.network.latent_size), (3, 4));
    for shape in &made.report.shapes {
        assert!(shape.closeness.unwrap().distance.mean < 0.01, "{shape:?}");
    }
}

#[test]
fn balls_of_all_sizes_are_learned_alike_when_each_is_brought_to_the_cube() {
    let meshes = [ball([5.0, 0.0, 0.0], 40.0), ball([0.0, -3.0, 0.0], 0.1)];
    let spec = FitSpec { latent_size: 4, width: 32, epochs: 40, normalize: true, ..small() };
    let made = fitted(&meshes, &spec, 2);
    for (shape, (center, radius)) in made.report.shapes.iter().zip([(5.0, 40.0), (0.0, 0.1)]) {
        assert!(shape.closeness.unwrap().distance.mean < 0.01, "{shape:?}");
        let back = shape.transform.unwrap();
        assert!((back.scale / radius - 1.0).abs() < 1e-9 && (back.translate[0] - center).abs() < 1e-9, "{back:?}");
    }
    let domain = made.network.domain;
    assert!(domain.min.iter().chain(&domain.max).all(|c| (1.0..1.5).contains(&c.abs())), "{domain:?}");
}

#[test]
fn terms_of_the_gradient_bring_its_length_to_one() {
    let miss = |spec: &FitSpec| {
        let mesh = ball([0.0; 3], 1.0);
        let made = fitted(&[ball([0.0; 3], 1.0)], spec, 2);
        let field = made.network.field(&[]).unwrap();
        let tally = crate::field::sampler::Tally::new();
        let points = samples::around(&mesh, 1.0, 4000, 99);
        with_settings(1, |settings| {
            let sampler = crate::field::Sampler::new(&field, *settings, &tally);
            let (_, gradients) = sampler.gradients(&points).unwrap();
            gradients.iter().map(|g| (g.length() - 1.0).abs()).sum::<f64>() / points.len() as f64
        })
    };
    let without = miss(&small());
    assert!(miss(&FitSpec { eikonal: 0.1, ..small() }) < 0.8 * without);
    assert!(miss(&FitSpec { normal: 0.1, ..small() }) < 0.8 * without);
}

#[test]
fn a_wild_learning_rate_is_told_and_a_raised_token_ends_it() {
    let meshes = [ball([0.0; 3], 1.0)];
    with_settings(1, |settings| {
        settings.cancel.cancel();
        let training = Training { spec: &small(), from: None, checkpoint: &|_| {} };
        assert_eq!(fit(&meshes, training, settings).unwrap_err(), FitError::Canceled);
    });
    let faults = FitSpec { learning_rate: f64::NAN, layers: 0, normal: -1.0, ..small() }.faults();
    let pointers: Vec<&str> = faults.iter().map(|f| f.pointer.as_str()).collect();
    assert_eq!(pointers, ["/layers", "/learning_rate", "/normal"]);
}
