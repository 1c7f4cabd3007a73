//! The `sci-recon` program.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use sci_recon::{cli, config};

/// Reconstructs video from snapshot compressive measurements, over HTTP or right here.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(config::ServeArguments),
}

fn main() -> ExitCode {
    let outcome = match Arguments::parse().command {
        Command::Serve(arguments) => cli::serve::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("sci-recon: {error}");
            ExitCode::FAILURE
        }
    }
}
