//! The paper's experiments on your own clips, with the library of the service.

mod assess;
mod clips;
mod markdown;
mod noise;
mod record;
mod tables;
mod trial;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Repeats the paper's experiments on your own clips.
#[derive(Debug, Parser)]
#[command(version, propagate_version = true)]
struct Arguments {
    #[command(subcommand)]
    experiment: Experiment,
}

#[derive(Debug, Subcommand)]
enum Experiment {
    Assess(Box<assess::Arguments>),
    Noise(noise::Arguments),
    Tables(Box<tables::Arguments>),
}

fn main() -> ExitCode {
    let outcome = match Arguments::parse().experiment {
        Experiment::Assess(arguments) => assess::run(&arguments),
        Experiment::Noise(arguments) => noise::run(&arguments),
        Experiment::Tables(arguments) => tables::run(&arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("sci-recon-experiments: {error}");
            error.exit_code()
        }
    }
}
