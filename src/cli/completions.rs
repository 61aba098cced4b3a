//! `shrinkd completions`: scripts that complete commands, options and their values in a shell.

use super::Cli;
use clap::CommandFactory as _;
pub use clap_complete::Shell;
use std::process::ExitCode;

/// What `completions --help` ends with.
pub const EXAMPLES: &str = "\
Examples:
  shrinkd completions bash > ~/.local/share/bash-completion/completions/shrinkd
  shrinkd completions zsh > ~/.zfunc/_shrinkd
  shrinkd completions fish > ~/.config/fish/completions/shrinkd.fish";

/// Prints the script of a shell.
pub fn run(shell: Shell) -> ExitCode {
    clap_complete::generate(shell, &mut Cli::command(), env!("CARGO_PKG_NAME"), &mut std::io::stdout());
    ExitCode::SUCCESS
}
