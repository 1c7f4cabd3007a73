//! `sci-recon verify`: compares the records of a data folder or a backup with its files.

use std::path::PathBuf;

use clap::Args;

use super::CliError;
use super::output::print_line;
use super::wait::with_store;
use crate::cli::error::Result;

/// Compare all stored files with their records.
///
/// Checks the hash of every file and the consistency of the database. The folder may be in use by a service, or
/// be a backup. Changes nothing. Ends with 1 if something is damaged or missing.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder of a service's data, or a backup of one.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    data: PathBuf,
}

/// Verifies the folder, and prints the result as one JSON line.
pub fn run(arguments: &Arguments) -> Result<()> {
    let audit = with_store(&arguments.data, async |store| Ok(store.verify().await?))?;
    print_line(serde_json::json!(audit))?;
    if audit.is_good() { Ok(()) } else { Err(CliError::Failure("the data are damaged".into())) }
}
