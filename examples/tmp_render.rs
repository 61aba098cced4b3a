//! tmp
use shrinkd::field::{Field, Gradients, Points, Sampler, sampler::Tally, scene::Scene};
use shrinkd::settings::*;
use shrinkd::shrink::{Method, curve::*};
fn main() {
    let mut files: Vec<_> = std::fs::read_dir("examples/scenes")
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| p.extension().is_some_and(|e| e == "json"))
        .collect();
    files.sort();
    let (cols, s) = (5usize, 220usize);
    let rows = files.len().div_ceil(cols);
    let mut img = image::RgbImage::new((cols * s) as u32, (rows * s) as u32);
    for (k, f) in files.iter().enumerate() {
        let scene = Scene::from_slice(&std::fs::read(f).unwrap()).unwrap();
        println!(
            "{:?} {:?} L={:?} fit {:?}",
            f.file_stem().unwrap(),
            scene.metric(),
            scene.lipschitz(),
            scene.fit_domain().unwrap()
        );
        let l = scene.lipschitz().unwrap();
        let cam = glam::Vec3::new(1.6, -2.2, 1.5).normalize();
        let right = glam::Vec3::Z.cross(cam).normalize();
        let up = cam.cross(right);
        for py in 0..s {
            for px in 0..s {
                let (u, v) = ((px as f32 + 0.5) / s as f32 * 2.0 - 1.0, 1.0 - (py as f32 + 0.5) / s as f32 * 2.0);
                let o = cam * 3.0 + right * u * 1.2 + up * v * 1.2;
                let mut t = 0.0;
                let mut hit = false;
                for _ in 0..300 {
                    let p = o - cam * t;
                    let mut d = [0.0];
                    scene.values(Points { x: &[p.x], y: &[p.y], z: &[p.z] }, &mut d);
                    if d[0] < 5e-4 {
                        hit = true;
                        break;
                    }
                    t += d[0] / l;
                    if t > 6.0 {
                        break;
                    }
                }
                let c = if hit {
                    let p = o - cam * t;
                    let (mut v, mut x, mut y, mut z) = ([0.0], [0.0], [0.0], [0.0]);
                    scene.gradients(
                        Points { x: &[p.x], y: &[p.y], z: &[p.z] },
                        &mut v,
                        Gradients { x: &mut x, y: &mut y, z: &mut z },
                    );
                    let n = glam::Vec3::new(x[0], y[0], z[0]).normalize();
                    let l = 0.25 + 0.75 * n.dot(glam::Vec3::new(0.3, -0.5, 0.8).normalize()).max(0.0);
                    [(230.0 * l) as u8, (200.0 * l) as u8, (160.0 * l + 20.0 * n.x.abs()) as u8]
                } else {
                    [30, 34, 40]
                };
                img.put_pixel(((k % cols) * s + px) as u32, ((k / cols) * s + py) as u32, image::Rgb(c));
            }
        }
    }
    img.save("/tmp/scenes.png").unwrap();
    // curves
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let cancel = CancelToken::new();
    let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {} };
    let mut files: Vec<_> = std::fs::read_dir("examples/scenes/2d").unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    let mut img = image::RgbImage::from_pixel((files.len() * 400) as u32, 800, image::Rgb([255, 255, 255]));
    for (k, f) in files.iter().enumerate() {
        let scene = Scene::from_slice(&std::fs::read(f).unwrap()).unwrap();
        for (row, method) in [Method::Adaptive, Method::Paper].into_iter().enumerate() {
            let tally = Tally::new();
            let sampler = Sampler::new(&scene, settings, &tally);
            let t0 = std::time::Instant::now();
            let curve = match shrink_curve(&sampler, &CurveSpec { method, samples: 400 }) {
                Ok(c) => c,
                Err(e) => {
                    println!("{f:?} {e}");
                    continue;
                }
            };
            println!("{:?} {method:?} {:?} {:?}", f.file_stem().unwrap(), curve.report, t0.elapsed());
            if row == 0 {
                let name = f.file_stem().unwrap().to_string_lossy().into_owned();
                std::fs::write(format!("/tmp/{name}.svg"), shrinkd::surface::curve::to_svg(&curve)).unwrap();
                std::fs::write(format!("/tmp/{name}.glb"), shrinkd::surface::curve::to_glb(&curve)).unwrap();
            }
            let n = curve.positions.len();
            for i in 0..n {
                let (a, b) = (curve.positions[i], curve.positions[(i + 1) % n]);
                let steps = 30;
                for j in 0..steps {
                    let t = j as f64 / steps as f64;
                    let p = [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
                    let (x, y) = ((k * 400) as f64 + 200.0 + 190.0 * p[0], (row * 400) as f64 + 200.0 - 190.0 * p[1]);
                    let u = curve.parameters[i];
                    if x >= 0.0 && y >= 0.0 && (x as u32) < img.width() && (y as u32) < img.height() {
                        img.put_pixel(
                            x as u32,
                            y as u32,
                            image::Rgb([(255.0 * u) as u8, 40, (255.0 * (1.0 - u)) as u8]),
                        );
                    }
                }
            }
            for i in 0..n {
                if curve.corners[i] {
                    let p = curve.positions[i];
                    for d in -2i32..=2 {
                        for e in -2i32..=2 {
                            let (x, y) =
                                ((k * 400) as f64 + 200.0 + 190.0 * p[0], (row * 400) as f64 + 200.0 - 190.0 * p[1]);
                            img.put_pixel((x as i32 + d) as u32, (y as i32 + e) as u32, image::Rgb([0, 160, 0]));
                        }
                    }
                }
            }
        }
    }
    img.save("/tmp/curves.png").unwrap();
    // speed
    for k in [2usize, 8, 32] {
        let of: Vec<_> = (0..k).map(|i| { let a = i as f64 * 2.4; serde_json::json!({"translate": {"by": [0.5 * a.cos(), 0.5 * a.sin(), 0.01 * i as f64], "of": if i % 2 == 0 { serde_json::json!({"sphere": {"radius": 0.2}}) } else { serde_json::json!({"box": {"half_extents": [0.2, 0.1, 0.15]}}) }}}) }).collect();
        let scene = Scene::from_value(&serde_json::json!({"smooth_union": {"k": 0.1, "of": of}})).unwrap();
        let n = 512;
        let c = |k: usize| (0..n).map(|i| ((i * k) as f32 * 0.37).sin()).collect::<Vec<_>>();
        let (x, y, z) = (c(3), c(7), c(11));
        let (mut v, mut gx, mut gy, mut gz) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let mut best = (f64::MAX, f64::MAX);
        for _ in 0..300 {
            let t = std::time::Instant::now();
            scene.gradients(Points { x: &x, y: &y, z: &z }, &mut v, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
            best.0 = best.0.min(t.elapsed().as_secs_f64() / n as f64 * 1e9);
            let t = std::time::Instant::now();
            scene.values(Points { x: &x, y: &y, z: &z }, &mut v);
            best.1 = best.1.min(t.elapsed().as_secs_f64() / n as f64 * 1e9);
        }
        println!("k={k}: value+gradient {:.1} ns, value {:.1} ns per point", best.0, best.1);
    }
    for (name, v) in [
        ("ellipsoid", serde_json::json!({"ellipsoid": {"radii": [0.8, 0.55, 0.4]}})),
        ("torus", serde_json::json!({"torus": {"major": 0.5, "minor": 0.2}})),
        ("vase", serde_json::from_slice(&std::fs::read("examples/scenes/vase.json").unwrap()).unwrap()),
        ("bracket", serde_json::from_slice(&std::fs::read("examples/scenes/bracket.json").unwrap()).unwrap()),
    ] {
        let scene = Scene::from_value(&v).unwrap();
        let n = 512;
        let c = |k: usize| (0..n).map(|i| ((i * k) as f32 * 0.37).sin()).collect::<Vec<_>>();
        let (x, y, z) = (c(3), c(7), c(11));
        let (mut v, mut gx, mut gy, mut gz) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let mut best = f64::MAX;
        for _ in 0..100 {
            let t = std::time::Instant::now();
            scene.gradients(Points { x: &x, y: &y, z: &z }, &mut v, Gradients { x: &mut gx, y: &mut gy, z: &mut gz });
            best = best.min(t.elapsed().as_secs_f64() / n as f64 * 1e9);
        }
        println!("{name}: {best:.1} ns");
    }
}
