//! The command line: reads arguments, and hands over to the rooms.
//!
//! Exit codes: 0 done; 1 failed, or made a result that did not pass its own checks; 2 bad usage; 3 bad input; 4 the shape
//! could not be wrapped.

pub mod animate;
pub mod compare;
mod completions;
mod describe;
mod doctor;
pub mod evaluate;
pub mod extract;
pub mod first_job;
pub mod fit;
pub mod healthcheck;
mod interrupt;
mod keys;
mod open_engine;
mod options;
pub mod sensitivity;
pub mod serve;

use crate::config::Role;
use crate::field::Domain;
use crate::field::input::{DomainName, DomainOption, FieldOptions};
use crate::job::failure::Failure;
use crate::measure::chart::SphereChart;
use crate::shrink::lattice::LatticeSpec;
use clap::{Args, Parser, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use options::{ShrinkArgs, parse_lattice};
use std::io::Write as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Something failed that is neither usage nor input.
pub const FAILED: u8 = 1;
/// The arguments make no sense.
pub const BAD_USAGE: u8 = 2;
/// The input cannot be read as a field.
pub const BAD_INPUT: u8 = 3;
/// The shape could not be wrapped.
pub const NOT_WRAPPED: u8 = 4;

/// Signed distance fields in, parameterized surfaces out.
#[derive(Debug, Parser)]
#[command(version, about, arg_required_else_help = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service
    #[command(after_long_help = SERVE_EXAMPLES)]
    Serve(ServeArgs),
    /// Look at a set-up as `serve` would find it, and say what is wrong with it
    #[command(after_long_help = doctor::EXAMPLES)]
    Doctor(NodeArgs),
    /// Wrap one field: exits 0 when the result passed every check (closed, Euler characteristic 2, one chart, no flips, no
    /// self-intersections, nowhere farther than 1 % of the diagonal from the zero level set)
    #[command(after_long_help = EXTRACT_EXAMPLES)]
    Extract(ExtractArgs),
    /// Say what a file is taken for, and what was found in it, without wrapping it
    #[command(after_long_help = describe::EXAMPLES)]
    Describe(describe::DescribeArgs),
    /// Wrap a network along a path through its latent space: one GLB with a morph target for every frame and one set of UVs
    #[command(after_long_help = ANIMATE_EXAMPLES)]
    Animate(AnimateArgs),
    /// Measure a GLB or any mesh against a mesh or a field, beside marching cubes on the same field
    #[command(after_long_help = EVALUATE_EXAMPLES)]
    Evaluate(EvaluateArgs),
    /// Wrap every field of a folder and write a table of how good the results are
    #[command(after_long_help = COMPARE_EXAMPLES)]
    Compare(CompareArgs),
    /// Fit a network to meshes: one gives a SIREN, several an auto-decoder with a latent code each
    #[command(after_long_help = fit::EXAMPLES)]
    Fit(fit::FitArgs),
    /// Carry a gradient of a surface's vertices back to the latent code and the weights of its network
    #[command(after_long_help = sensitivity::EXAMPLES)]
    Sensitivity(sensitivity::SensitivityArgs),
    /// Make, list and revoke API keys
    #[command(after_long_help = keys::EXAMPLES)]
    Keys(keys::KeysArgs),
    /// Print the description of the service (OpenAPI 3.1, YAML)
    #[command(after_long_help = OPENAPI_EXAMPLES)]
    Openapi,
    /// Print a script that completes commands in a shell
    #[command(after_long_help = completions::EXAMPLES)]
    Completions {
        /// The shell
        #[arg(value_enum)]
        shell: completions::Shell,
    },
    /// Ask a service whether it is ready: exits 0 when it is
    #[command(after_long_help = HEALTHCHECK_EXAMPLES)]
    Healthcheck {
        /// Address of the service, such as http://127.0.0.1:8080
        url: String,
    },
}

/// What `serve --help` ends with.
const SERVE_EXAMPLES: &str = "\
Examples:
  shrinkd serve
  shrinkd serve --try examples/scenes/fork.json
  shrinkd serve --config /etc/shrinkd.toml
  shrinkd serve --engine nats://nats-1:4222 --blobs s3://surfaces/prod --role worker

Every setting is explained in docs/shrinkd.toml, and can be given as a variable: SHRINKD_WORKER__SLOTS=4. SIGTERM and Ctrl-C stop the
service; jobs that have not ended go back to the queue. Exits 0 when it was told to stop, 1 when it cannot start, 2 on bad usage or a
configuration that cannot be read.";

/// What `extract --help` ends with.
const EXTRACT_EXAMPLES: &str = "\
Examples:
  shrinkd extract examples/scenes/pawn.json -o pawn.glb --preview pawn.png --filmstrip pawn.strip.png
  shrinkd extract deepsdf_folder -o chair.glb --latent-row 12
  shrinkd extract bunny.ply -o bunny.glb --lattice octahedral:72 --report bunny.json
  shrinkd extract values.npy -o values.glb --domain=-1,-1,-1,1,1,1

Exits 0 when the result passed every check, 1 when it did not (it is written all the same), 2 on bad usage, 3 when the file is no field,
4 when the shape cannot be wrapped, with the cause.";

/// What `openapi --help` ends with.
const OPENAPI_EXAMPLES: &str = "\
Examples:
  shrinkd openapi > openapi.yaml";

/// What `healthcheck --help` ends with.
const HEALTHCHECK_EXAMPLES: &str = "\
Examples:
  shrinkd healthcheck http://127.0.0.1:8080

Exits 0 when the service is ready, 1 when it is not or does not answer, 2 on bad usage.";

/// Arguments of `serve`.
#[derive(Debug, Args)]
pub struct ServeArgs {
    /// What the node is.
    #[command(flatten)]
    pub node: NodeArgs,
    /// Wrap this field as a first job, and log where its outputs are
    #[arg(long = "try", value_name = "FIELD")]
    pub first: Option<PathBuf>,
}

/// What a node of the service is.
#[derive(Debug, Args)]
pub struct NodeArgs {
    /// Address to listen on [default: 127.0.0.1:8080]
    #[arg(long)]
    pub listen: Option<SocketAddr>,
    /// Folder of the database and the blobs [default: ./shrinkd-data]
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Where jobs are kept: sqlite, or nats://HOST:PORT for a cluster [default: sqlite]
    #[arg(long, value_name = "URL")]
    pub engine: Option<String>,
    /// Where inputs and outputs lie: folder, or s3://BUCKET/PREFIX [default: folder]
    #[arg(long, value_name = "URL")]
    pub blobs: Option<String>,
    /// What this node does [default: all]
    #[arg(long, value_enum)]
    pub role: Option<Role>,
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

/// Arguments of `extract`.
#[derive(Debug, Args)]
pub struct ExtractArgs {
    /// The field: a scene, a network, a mesh or a sampled grid, told by its content
    pub field: PathBuf,
    /// Where the GLB goes
    #[arg(short, long, value_name = "OUT.glb")]
    pub output: PathBuf,
    /// Where the sphere is sampled: latlong:N_THETAxN_PHI or octahedral:N
    #[arg(long, value_parser = parse_lattice, default_value = "latlong:200x100")]
    pub lattice: LatticeSpec,
    /// Samples of the curve that a 2-D scene gives [default: N_THETA of the lattice]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=100_000))]
    pub samples: Option<u32>,
    /// A field whose values say how closely samples are spaced where: in proportion, instead of --density
    #[arg(long, value_name = "FIELD", conflicts_with = "density")]
    pub weight: Option<PathBuf>,
    /// A surface that --surface wrote of a field nearby, on the same lattice: begin from it, and keep its UVs
    #[arg(long, value_name = "S.safetensors")]
    pub warm_start: Option<PathBuf>,
    /// How it is wrapped.
    #[command(flatten)]
    pub shrink: ShrinkArgs,
    /// What the field leaves open.
    #[command(flatten)]
    pub field_options: FieldArgs,
    /// Where the report goes (JSON)
    #[arg(long, value_name = "R.json")]
    pub report: Option<PathBuf>,
    /// Where the picture goes (PNG)
    #[arg(long, value_name = "P.png")]
    pub preview: Option<PathBuf>,
    /// Where the shrinking in six frames goes (PNG)
    #[arg(long, value_name = "F.png")]
    pub filmstrip: Option<PathBuf>,
    /// Where positions, normals, UVs and fundamental forms go (safetensors)
    #[arg(long, value_name = "S.safetensors")]
    pub surface: Option<PathBuf>,
    /// Write into --surface how the surface moves with the network's latent code: dv/dz is the normal times this
    #[arg(long, requires = "surface")]
    pub latent_motion: bool,
    /// Where the curve of a 2-D scene goes (SVG) [default: beside the GLB]
    #[arg(long, value_name = "C.svg")]
    pub svg: Option<PathBuf>,
    /// Threads; 0 is one per core. The result does not depend on it
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
}

/// What `animate --help` ends with.
const ANIMATE_EXAMPLES: &str = "\
The file of latent codes is JSON: a list with an entry for every frame, or the two ends of a straight way. An entry is
a latent code, or the row of one that comes with the network:
  [[0, 0], [0.1, 0.05], 3]
  {\"from\": 0, \"to\": [1, -1], \"frames\": 24}

Examples:
  shrinkd animate morph.safetensors --latents way.json -o way.glb --report way.report.json
  shrinkd animate morph.safetensors --latents way.json --cold --report cold.json

Exits 0 when every frame passed every check, 1 when one did not (the GLB is written, and the frame named), 2 on bad
usage, 3 when the network or the file of latent codes cannot be read, 4 when a frame's shape cannot be wrapped.";

/// Arguments of `animate`.
#[derive(Debug, Args)]
pub struct AnimateArgs {
    /// The network: of any kind that takes a latent code, told by its content
    pub net: PathBuf,
    /// The latent codes of the frames (JSON)
    #[arg(long, value_name = "FILE.json")]
    pub latents: PathBuf,
    /// Where the GLB goes
    #[arg(short, long, value_name = "OUT.glb", required_unless_present = "cold")]
    pub output: Option<PathBuf>,
    /// Where the sphere is sampled: latlong:N_THETAxN_PHI or octahedral:N
    #[arg(long, value_parser = parse_lattice, default_value = "latlong:200x100")]
    pub lattice: LatticeSpec,
    /// How the first frame is wrapped, and those that cannot be made from the one before.
    #[command(flatten)]
    pub shrink: ShrinkArgs,
    /// Box that holds the zero level sets of all frames: X0,Y0,Z0,X1,Y1,Z1
    #[arg(long, value_name = "BOX", value_parser = parse_domain, allow_hyphen_values = true)]
    pub domain: Option<DomainOption>,
    /// What the file does not say, as the members of a job's field: '{"w0": 25, "sign": "positive_inside"}'
    #[arg(long, value_name = "JSON", value_parser = parse_field_options)]
    pub field_options: Option<Box<FieldOptions>>,
    /// Where the report goes (JSON): evaluations, distances, flips and drift of every frame
    #[arg(long, value_name = "R.json")]
    pub report: Option<PathBuf>,
    /// Frames per second
    #[arg(long, default_value_t = 12.0, value_parser = parse_fps)]
    pub fps: f32,
    /// Make every frame from nothing and write no GLB, to see what warm starts save and how far UVs drift without them
    #[arg(long, conflicts_with = "output")]
    pub cold: bool,
    /// Threads; 0 is one per core. The result does not depend on it
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
}

/// Frames per second: more than none, at most a thousand.
fn parse_fps(text: &str) -> Result<f32, String> {
    let fps: Option<f32> = text.parse().ok();
    fps.filter(|fps| (0.01..=1000.0).contains(fps)).ok_or_else(|| "expected a number from 0.01 to 1000".to_owned())
}

/// What a file with a field in it leaves open.
#[derive(Debug, Args)]
pub struct FieldArgs {
    /// Latent code of an auto-decoder: a JSON list of numbers
    #[arg(long, value_name = "FILE.json", conflicts_with = "latent_row")]
    pub latent: Option<PathBuf>,
    /// Row of the field's own table of latent codes
    #[arg(long, value_name = "N")]
    pub latent_row: Option<u32>,
    /// Box that holds the field's zero level set (of a grid: that its samples span): fit, or X0,Y0,Z0,X1,Y1,Z1
    #[arg(long, value_name = "BOX", value_parser = parse_domain, allow_hyphen_values = true)]
    pub domain: Option<DomainOption>,
    /// What the file does not say, as the members of a job's field: '{"w0": 25, "sign": "positive_inside"}'
    #[arg(long, value_name = "JSON", value_parser = parse_field_options)]
    pub field_options: Option<Box<FieldOptions>>,
}

/// The options in a JSON object.
fn parse_field_options(text: &str) -> Result<Box<FieldOptions>, String> {
    let options: FieldOptions = serde_json::from_str(text).map_err(|e| e.to_string())?;
    options.check().map_err(|e| e.to_string())?;
    Ok(Box::new(options))
}

/// The bytes of a field's file; a folder of DeepSDF as the archive that would be uploaded.
fn read_field(path: &Path) -> std::io::Result<Vec<u8>> {
    if path.is_dir() { crate::field::network::folder::pack(path) } else { std::fs::read(path) }
}

/// What is wrong with an input: its faults a line each where they have places in it, or a sentence.
fn faults(failure: &Failure) -> String {
    if failure.errors.is_empty() {
        return failure.detail.clone();
    }
    let lines: String = failure.errors.iter().map(|fault| format!("\n  {}: {}", fault.pointer, fault.detail)).collect();
    format!("{}{lines}", failure.title)
}

impl FieldArgs {
    /// What they say of a field, the latent code read from its file.
    ///
    /// # Errors
    /// An exit code and what to say, when that file is no list of finite numbers.
    fn read(&self) -> Result<FieldOptions, (u8, String)> {
        let given = self.field_options.as_deref().cloned().unwrap_or_default();
        let latent = self.latent.as_deref().map(read_latent).transpose()?;
        Ok(FieldOptions {
            latent: latent.or(given.latent),
            latent_row: self.latent_row.or(given.latent_row),
            domain: self.domain.or(given.domain),
            ..given
        })
    }
}

/// A latent code from a file: a JSON list of finite numbers.
fn read_latent(path: &Path) -> Result<Vec<f32>, (u8, String)> {
    let wrong = |e: &dyn std::fmt::Display| (BAD_INPUT, format!("{}: {e}", path.display()));
    let text = std::fs::read(path).map_err(|e| wrong(&e))?;
    let latent: Vec<f32> = serde_json::from_slice(&text).map_err(|e| wrong(&e))?;
    if latent.iter().all(|z| z.is_finite()) { Ok(latent) } else { Err(wrong(&"a number is not finite")) }
}

/// What `evaluate --help` ends with.
const EVALUATE_EXAMPLES: &str = "\
Examples:
  shrinkd extract spot.ply -o spot.glb && shrinkd evaluate spot.glb --truth spot.ply
  shrinkd evaluate other_program.obj --truth spot.ply --json > spot.json
  shrinkd evaluate fork.glb --truth examples/scenes/fork.json --no-baseline --check

Exits 0 when it was measured, 1 when --check was asked for and a condition of success does not hold, 2 on bad usage, 3
when a file cannot be read as a mesh or a field.";

/// Arguments of `evaluate`.
#[derive(Debug, Args)]
pub struct EvaluateArgs {
    /// What is measured: a mesh (GLB, PLY, OBJ, STL, OFF), whoever made it
    pub mesh: PathBuf,
    /// What it is measured against: a mesh, a scene, a network or a sampled grid
    #[arg(long, value_name = "MESH|FIELD")]
    pub truth: PathBuf,
    /// Print JSON in place of the table
    #[arg(long)]
    pub json: bool,
    /// Exit 1 when it is not closed, of Euler number 2, one chart, without flips and self-intersections, and within 1 % of
    /// the diagonal
    #[arg(long)]
    pub check: bool,
    /// What the texture coordinates are, where the file does not say so itself
    #[arg(long, value_enum)]
    pub chart: Option<ChartArg>,
    /// Leave out marching cubes
    #[arg(long)]
    pub no_baseline: bool,
    /// What the truth leaves open.
    #[command(flatten)]
    pub truth_options: FieldArgs,
    /// Threads; 0 is one per core. The result does not depend on it
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
}

/// Charts in which every place is a direction on the sphere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ChartArg {
    /// u is the longitude, v the latitude from the north pole
    Latlong,
    /// The unfolded octahedron of equal areas
    Octahedral,
}

impl From<ChartArg> for SphereChart {
    fn from(chart: ChartArg) -> Self {
        match chart {
            ChartArg::Latlong => SphereChart::Latlong,
            ChartArg::Octahedral => SphereChart::Octahedral,
        }
    }
}

/// What `compare --help` ends with.
const COMPARE_EXAMPLES: &str = "\
Examples:
  shrinkd compare examples/scenes
  shrinkd compare meshes --out results --expect-refusal 'genus/*'
  shrinkd compare meshes --only spot --only bunny --lattice octahedral:144 --no-baseline
  shrinkd compare meshes --only 'genus/*' --on-topology wrap --density reach
  shrinkd compare examples/scenes --lattice octahedral:72 --side-by-side --out results

Exits 0 when every shape succeeded or was refused as expected, 1 when one did not or the run was interrupted, 2 on bad
usage, 3 when the folder cannot be read or holds no field.";

/// Arguments of `compare`.
#[derive(Debug, Args)]
pub struct CompareArgs {
    /// The folder; scenes, networks, meshes and grids in it and in the folders below are told by their content
    pub dir: PathBuf,
    /// Where the sphere is sampled: latlong:N_THETAxN_PHI or octahedral:N; several times for several
    /// [default: latlong:200x100 and octahedral:72]
    #[arg(long, value_parser = parse_lattice)]
    pub lattice: Vec<LatticeSpec>,
    /// How it is wrapped.
    #[command(flatten)]
    pub shrink: ShrinkArgs,
    /// Folder for compare.md and compare.json, written as results come, and a contact sheet of pictures for every lattice
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Where the JSON goes [default: compare.json in the folder of --out]
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Take only shapes whose path in the folder holds this text, or fits this pattern with `*`; may be repeated
    #[arg(long, value_name = "PATTERN")]
    pub only: Vec<String>,
    /// Shapes that a sphere cannot wrap and that must be refused, told as for --only; may be repeated
    #[arg(long, value_name = "PATTERN")]
    pub expect_refusal: Vec<String>,
    /// Leave out marching cubes of as many vertices
    #[arg(long)]
    pub no_baseline: bool,
    /// Run the paper's method, too, and draw marching cubes, the paper's method and ours side by side with their figures, in place of
    /// the contact sheets
    #[arg(long, requires = "out", conflicts_with = "no_baseline")]
    pub side_by_side: bool,
    /// Seconds that a shape may take on one lattice; over that it counts as failed
    #[arg(long, value_name = "SECONDS")]
    pub limit: Option<u64>,
    /// Keep the surfaces too, in the folder `glb` of --out
    #[arg(long, requires = "out")]
    pub glb: bool,
    /// Threads; 0 is one per core. The results do not depend on it
    #[arg(long, default_value_t = 0)]
    pub threads: usize,
}

/// `fit`, or six numbers.
fn parse_domain(text: &str) -> Result<DomainOption, String> {
    if text == "fit" {
        return Ok(DomainOption::Named(DomainName::Fit));
    }
    let expected = "expected fit or X0,Y0,Z0,X1,Y1,Z1";
    let corners: Vec<f64> = text.split(',').map(str::parse).collect::<Result<_, _>>().map_err(|_| expected)?;
    let [x0, y0, z0, x1, y1, z1] = corners[..] else { return Err(expected.to_owned()) };
    Ok(DomainOption::Box(Domain { min: [x0, y0, z0], max: [x1, y1, z1] }))
}

/// Runs the command line of this process.
pub fn run() -> ExitCode {
    match Cli::parse().command {
        Command::Serve(args) => serve::run(&args),
        Command::Extract(args) => extract::run(&args),
        Command::Describe(args) => describe::run(&args),
        Command::Animate(args) => animate::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Compare(args) => compare::run(&args),
        Command::Fit(args) => fit::run(&args),
        Command::Sensitivity(args) => sensitivity::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Openapi => openapi(),
        Command::Doctor(args) => doctor::run(&args),
        Command::Completions { shell } => completions::run(shell),
        Command::Healthcheck { url } => healthcheck::run(&url),
    }
}

/// Prints; a reader that has seen enough is no failure.
fn print(text: &str) {
    let _ = std::io::stdout().write_all(text.as_bytes());
}

fn openapi() -> ExitCode {
    match crate::http::document().to_yaml() {
        Ok(yaml) => {
            print(&yaml);
            ExitCode::SUCCESS
        }
        Err(error) => fail(FAILED, &error),
    }
}

/// Steps of a progress bar.
const STEPS: u64 = 1000;

/// A bar on a terminal, nothing elsewhere. It has no colours.
fn progress_bar() -> ProgressBar {
    let bar = ProgressBar::new(STEPS);
    if let Ok(style) = ProgressStyle::with_template("{bar:40} {percent:>3} % {msg} {elapsed}") {
        bar.set_style(style);
    }
    bar
}

/// Says on standard error what is wrong.
fn fail(code: u8, error: &dyn std::fmt::Display) -> ExitCode {
    eprintln!("shrinkd: {error}");
    ExitCode::from(code)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arguments_are_consistent() {
        use clap::CommandFactory as _;
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_shows_how_it_is_used() {
        use clap::CommandFactory as _;
        for command in Cli::command().get_subcommands() {
            let help = command.get_after_long_help().map(ToString::to_string).unwrap_or_default();
            let example = format!("\n  shrinkd {}", command.get_name());
            assert!(help.contains("Examples:") && help.contains(&example), "{} has no examples", command.get_name());
        }
    }
}
