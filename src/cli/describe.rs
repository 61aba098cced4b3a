//! `shrinkd describe`: what a file is taken for, as the service answers an upload.

use super::{BAD_INPUT, FAILED, FieldArgs, fail, faults, print};
use crate::job::failure::Failure;
use crate::job::pipeline;
use clap::Args;
use std::path::PathBuf;
use std::process::ExitCode;

/// What `describe --help` ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd describe bunny.ply
  shrinkd describe deepsdf_folder
  shrinkd describe weights.pth --field-options '{\"family\": \"siren\", \"w0\": 25}'

Prints JSON: the member `description` of what POST /v1/inputs answers. Exits 0 when the file is a field, 2 on bad usage, 3 when it is none,
with the cause.";

/// Arguments of `describe`.
#[derive(Debug, Args)]
pub struct DescribeArgs {
    /// A scene, a network, a mesh or a grid: a file, or a folder of DeepSDF
    pub field: PathBuf,
    #[command(flatten)]
    pub field_options: FieldArgs,
}

/// Describes one file.
pub fn run(args: &DescribeArgs) -> ExitCode {
    match describe(args) {
        Ok(text) => {
            print(&format!("{text}\n"));
            ExitCode::SUCCESS
        }
        Err((code, error)) => fail(code, &error),
    }
}

fn describe(args: &DescribeArgs) -> Result<String, (u8, String)> {
    let options = args.field_options.read()?;
    let wrong = |detail: &dyn std::fmt::Display| (BAD_INPUT, format!("{}: {detail}", args.field.display()));
    let bytes = super::read_field(&args.field).map_err(|error| wrong(&error))?;
    let description = pipeline::describe(&bytes, &options);
    let description = description.map_err(|error| wrong(&faults(&Failure::from_field(&error, ""))))?;
    serde_json::to_string_pretty(&description).map_err(|error| (FAILED, error.to_string()))
}
