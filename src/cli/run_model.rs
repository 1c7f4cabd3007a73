//! `sci-recon run-model`: runs a user's network for the worker that started the process.

use std::io::ErrorKind;

use clap::Args;

use super::CliError;
use super::arguments::NetworkArguments;
use crate::cli::error::Result;
use workers::answer_worker;

/// Run a network for a worker, which sends all input to standard input.
#[derive(Debug, Args)]
#[command(hide = true)]
pub struct Arguments {
    /// Memory limit of the process [default: no limit].
    #[arg(long, value_name = "BYTES")]
    memory_bytes: Option<u64>,
    /// Do not restrict the files and connections of the process.
    #[arg(long)]
    unconfined: bool,
    #[command(flatten)]
    engine: NetworkArguments,
}

/// Answers until the worker closes standard input.
pub fn run(arguments: &Arguments) -> Result<()> {
    let Arguments { memory_bytes, unconfined, engine } = arguments;
    engine.confine(*memory_bytes, *unconfined, None)?;
    match answer_worker(&engine.network()?) {
        // The worker has ended.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        result => result.map_err(|error| CliError::Failure(error.to_string())),
    }
}
