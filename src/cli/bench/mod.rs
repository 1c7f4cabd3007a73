//! `sci-recon bench`: the paper's experiments on clips of your own.

mod clips;
mod noise;
mod noise_chart;
mod tables;

use clap::{Args, Subcommand};

use super::CliError;

/// Repeat an experiment of the paper on clips of your own.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(subcommand)]
    experiment: Experiment,
}

#[derive(Debug, Subcommand)]
enum Experiment {
    Noise(noise::Arguments),
    Tables(Box<tables::Arguments>),
}

/// Runs the experiment.
///
/// # Errors
/// Clips that can't be used, or a failure on the way.
pub fn run(arguments: &Arguments) -> Result<(), CliError> {
    match &arguments.experiment {
        Experiment::Noise(arguments) => noise::run(arguments),
        Experiment::Tables(arguments) => tables::run(arguments),
    }
}
