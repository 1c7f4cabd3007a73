//! `sci-recon run-model`: a network of a user's, for the worker that started this.

use std::io::ErrorKind;

use clap::Args;

use super::CliError;
use super::arguments::NetworkArguments;
use crate::cli::error::Result;
use workers::answer_worker;

/// Runs a network for a worker, which tells it all on standard input.
#[derive(Debug, Args)]
#[command(hide = true)]
pub struct Arguments {
    /// The most memory that it may take [default: no limit].
    #[arg(long, value_name = "BYTES")]
    memory_bytes: Option<u64>,
    /// Leaves it all files and connections that its user may have.
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
        // The worker is gone.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        ended => ended.map_err(|error| CliError::Failure(error.to_string())),
    }
}
