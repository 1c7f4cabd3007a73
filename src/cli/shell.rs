//! `sci-recon completions` and `sci-recon man`: print shell completions, and write man pages.

use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;

use super::CliError;
use super::output::print_text;
use crate::cli::error::Result;

/// Print the completions of a shell.
#[derive(Debug, Args)]
pub struct Completions {
    /// The shell.
    shell: Shell,
}

/// Write man pages for the program and its commands.
#[derive(Debug, Args)]
pub struct Man {
    /// Folder for the pages; it must exist.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub fn completions(arguments: &Completions, mut root: Command) -> Result<()> {
    // The generator panics if it can't write, so it writes to memory.
    let mut script = Vec::new();
    clap_complete::generate(arguments.shell, &mut root, "sci-recon", &mut script);
    print_text(String::from_utf8_lossy(&script))
}

pub fn man(arguments: &Man, root: Command) -> Result<()> {
    clap_mangen::generate_to(root, &arguments.out)
        .map_err(|error| CliError::file("write to", &arguments.out, &error))
}
