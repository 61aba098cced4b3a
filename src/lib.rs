//! `shrinkd` turns a signed distance field into a parameterized surface: it contracts a sphere onto the zero level set and
//! keeps the sphere's coordinates as UVs. The program is a service and a command line; this crate is what they are made of, and this page
//! is a tour of its rooms, from the ground floor up. `ARCHITECTURE.md` has the rules between them, `docs/` is for users.
//!
//! # From a field to a file
//!
//! The whole way, as `shrinkd extract` goes it:
//!
//! ```
//! use shrinkd::extract::{Budget, extract};
//! use shrinkd::field::sampler::Tally;
//! use shrinkd::field::scene::Scene;
//! use shrinkd::field::{Field, Metric, Sampler};
//! use shrinkd::settings::{CancelToken, Settings};
//! use shrinkd::shrink::ShrinkSpec;
//! use shrinkd::shrink::lattice::LatticeSpec;
//! use shrinkd::surface::gltf;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // a field: values and gradients by the batch, and what can be said of them
//! let pear = Scene::from_slice(br#"{"smooth_union": {"k": 0.1, "of": [
//!     {"sphere": {"radius": 0.45}},
//!     {"translate": {"by": [0.35, 0, 0.3], "of": {"sphere": {"radius": 0.25}}}}]}}"#)?;
//! assert_eq!(pear.metric(), Metric::Bound);
//!
//! // what numeric code gets in place of globals: a pool, a token that stops it, somebody who is told how far it is
//! let pool = rayon::ThreadPoolBuilder::new().build()?;
//! let cancel = CancelToken::new();
//! let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
//!
//! // a sampler evaluates the field in batches, and counts
//! let tally = Tally::new();
//! let sampler = Sampler::new(&pear, settings, &tally);
//!
//! // wraps, measures, and tries again where the result does not pass
//! let spec = ShrinkSpec { lattice: LatticeSpec::Octahedral { n: 24 }, ..ShrinkSpec::default() };
//! let made = extract(&sampler, &spec, None, Budget::default(), None, &|_| {})?;
//!
//! // the certificate: a closed sphere without folds, near enough to the zero level set
//! let report = &made.report;
//! assert!(report.verdict.passed, "{:?}", report.verdict.faults);
//! assert_eq!((report.closed, report.euler, report.charts), (true, 2, 1));
//! assert_eq!((report.flips.surface, report.flips.sphere, report.flips.uv), (0, 0, 0));
//! assert_eq!(report.self_intersections, 0);
//! assert!(report.closeness.distance.max < 0.01, "of the diagonal");
//! assert_eq!(report.vertices, made.surface.lattice.directions.len() as u64);
//!
//! // files: a GLB with the report inside, and everything on the lattice as tensors
//! let glb = gltf::to_glb(&made.surface, &serde_json::to_value(report)?, &serde_json::json!({"scene": "pear"}));
//! assert_eq!(&glb[..4], b"glTF");
//! # Ok(())
//! # }
//! ```
//!
//! # What is refused
//!
//! A sphere can wrap a solid of one piece without handles. What is none is told by name and with places, never answered wrongly:
//!
//! ```
//! use shrinkd::extract::{Budget, extract};
//! use shrinkd::field::Sampler;
//! use shrinkd::field::sampler::Tally;
//! use shrinkd::field::scene::Scene;
//! use shrinkd::settings::{CancelToken, Settings};
//! use shrinkd::shrink::{ShrinkError, ShrinkSpec};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let ring = Scene::from_slice(br#"{"torus": {"major": 0.5, "minor": 0.2}}"#)?;
//! let (pool, cancel, tally) = (rayon::ThreadPoolBuilder::new().build()?, CancelToken::new(), Tally::new());
//! let settings = Settings { pool: &pool, cancel: &cancel, progress: &|_| {}, watched: false };
//! let refused = extract(&Sampler::new(&ring, settings, &tally), &ShrinkSpec::default(), None, Budget::default(), None, &|_| {});
//! assert!(matches!(refused, Err(ShrinkError::Genus { genus: 1, .. })), "{:?}", refused.err());
//!
//! // and what is no scene is told with a JSON Pointer to every fault
//! let wrong = Scene::from_slice(br#"{"sphere": {"radios": 0.5}}"#).unwrap_err();
//! assert!(format!("{wrong:?}").contains("/sphere/radios"));
//! # Ok(())
//! # }
//! ```
//!
//! # The rooms
//!
//! **Numbers.** These know no clock, no environment, no network and no global pool; the same input gives the same bits for any number of
//! threads.
//!
//! - [`settings`]: what they are given in place of globals.
//! - [`field`]: the trait [`Field`](field::Field), and what implements it: scenes, networks, meshes, grids. [`field::input`] tells a file by
//!   its content. To add a kind of field, begin there.
//! - [`shrink`]: from the sphere to the surface, one file per stage. [`shrink::lattice`] is where the sphere is sampled.
//! - [`surface`]: the result, and its files: GLB, tensors with the fundamental forms, pictures, derivatives.
//! - [`measure`]: the certificate and every figure of a report. It shares no code with what made the surface.
//! - [`mod@extract`]: attempts with growing effort, until one passes; [`extract::path`] goes along a path of fields.
//! - [`fit`]: from meshes to networks.
//!
//! **Jobs.** What is asked of the service, who runs it and what is kept.
//!
//! - [`job`]: the request, its states and events; [`job::pipeline`] is where they meet the numbers, [`job::worker`] runs them.
//! - [`engine`]: the trait [`Engine`](engine::Engine) (submit, claim, renew, finish, events), one process or a cluster behind it, and the
//!   suite that both pass.
//! - [`blobs`]: inputs and outputs by the hash of their content.
//! - [`tenant`], [`quota`], [`auth`]: whose a job is, how much of the service that may be, and who asks.
//! - [`notify`]: who is told of an end.
//!
//! **Faces.** They translate, and never compute.
//!
//! - [HTTP](crate::http) and [gRPC](crate::grpc): the same service on one port.
//! - [`cli`]: a file per command; its `serve` puts the rooms together.
//! - [`config`], [`telemetry`]: settings, the log, metrics and traces.
//!
//! A module's first paragraph says what it guarantees and what it does not.

pub mod auth;
pub mod blobs;
pub mod cli;
pub mod config;
pub mod engine;
pub mod extract;
pub mod field;
pub mod fit;
pub mod grpc;
pub mod http;
pub mod job;
pub mod measure;
pub mod notify;
pub mod quota;
pub mod settings;
pub mod shrink;
pub mod surface;
pub mod telemetry;
pub mod tenant;
