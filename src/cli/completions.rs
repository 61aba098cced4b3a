//! `shrinkd completions`: scripts that complete commands, options and their values in a shell.

use super::Cli;
use clap::CommandFactory as _;
pub use clap_complete::Shell;
use std::io::Write as _;
use std::process::ExitCode;

/// What `completions --help` ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd completions bash > ~/.local/share/bash-completion/completions/shrinkd
  shrinkd completions zsh > ~/.zfunc/_shrinkd
  shrinkd completions fish > ~/.config/fish/completions/shrinkd.fish";

/// Prints the script of a shell.
pub fn run(shell: Shell) -> ExitCode {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), env!("CARGO_PKG_NAME"), &mut script);
    // a reader that has seen enough is no failure
    let _ = std::io::stdout().write_all(&script);
    ExitCode::SUCCESS
}
