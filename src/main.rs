//! The command line.

use std::process::ExitCode;

fn main() -> ExitCode {
    shrinkd::cli::run()
}
