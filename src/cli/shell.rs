//! What shells and man want: `sci-recon completions` and `sci-recon man`.

use std::io;
use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;

use super::CliError;
use crate::cli::error::Result;

/// Prints what a shell needs to complete commands and options.
#[derive(Debug, Args)]
pub struct Completions {
    /// The shell.
    shell: Shell,
}

/// Writes a man page for the program and each of its commands.
#[derive(Debug, Args)]
pub struct Man {
    /// Folder for the pages; it must be there.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub fn completions(arguments: &Completions, mut root: Command) {
    clap_complete::generate(arguments.shell, &mut root, "sci-recon", &mut io::stdout());
}

pub fn man(arguments: &Man, root: Command) -> Result<()> {
    clap_mangen::generate_to(root, &arguments.out)
        .map_err(|error| CliError::file("write to", &arguments.out, &error))
}
