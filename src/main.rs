//! The `sci-recon` program.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use sci_recon::cli::{self, CliError};
use sci_recon::config;

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
    Worker(config::WorkerArguments),
    Reconstruct(cli::reconstruct::Arguments),
    Simulate(cli::simulate::Arguments),
    Schedule(cli::schedule::Arguments),
    Optics(cli::optics::Arguments),
    Calibrate(cli::calibrate::Arguments),
    Demo(cli::demo::Arguments),
    Token(cli::token::Arguments),
    Lab(cli::lab::Arguments),
    Backup(cli::backup::Arguments),
    CheckModel(cli::check_model::Arguments),
    #[cfg(feature = "nats")]
    Cluster(cli::cluster::Arguments),
}

fn main() -> ExitCode {
    let outcome = match Arguments::parse().command {
        Command::Serve(arguments) => cli::serve::run(&arguments).map_err(CliError::from),
        Command::Worker(arguments) => cli::worker::run(&arguments),
        Command::Reconstruct(arguments) => cli::reconstruct::run(&arguments),
        Command::Schedule(arguments) => cli::schedule::run(&arguments),
        Command::Optics(arguments) => cli::optics::run(&arguments),
        Command::Calibrate(arguments) => cli::calibrate::run(&arguments),
        Command::Simulate(arguments) => cli::simulate::run(&arguments),
        Command::Demo(arguments) => cli::demo::run(&arguments),
        Command::Token(arguments) => cli::token::run(&arguments),
        Command::Lab(arguments) => cli::lab::run(&arguments),
        Command::Backup(arguments) => cli::backup::run(&arguments),
        Command::CheckModel(arguments) => cli::check_model::run(&arguments),
        #[cfg(feature = "nats")]
        Command::Cluster(arguments) => cli::cluster::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("sci-recon: {error}");
            error.exit_code()
        }
    }
}
