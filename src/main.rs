//! The `sci-recon` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    sci_recon::cli::run(std::env::args_os().collect())
}
