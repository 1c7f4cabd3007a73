//! `sci-recon backup`: copies a data folder consistently.

use std::path::{PathBuf, absolute};

use clap::Args;

use super::CliError;
use super::output::print_line;
use super::wait::with_store;
use crate::cli::error::Result;
use store::{Backup, Store};

/// Copy the data folder while the service runs.
///
/// Compares every file with its record. The copy is called NAME.unfinished until it is complete; no service accepts
/// an unfinished copy. To restore it, serve the copy (or a copy of it). Ends with 1 if a file is damaged or missing.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder of the service's data.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    data: PathBuf,
    /// Folder to copy to; it must not exist.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Makes the copy and prints its figures as one JSON line.
pub fn run(arguments: &Arguments) -> Result<()> {
    if arguments.out.exists() {
        let text = format!("{} already exists; choose a new folder", arguments.out.display());
        return Err(CliError::Input(text));
    }
    let folder = absolute(&arguments.out).ok().and_then(|out| out.parent()?.canonicalize().ok());
    let data = arguments.data.canonicalize().ok();
    if folder.zip(data).is_some_and(|(folder, data)| folder.starts_with(data)) {
        let text =
            format!("{} is inside the data folder; choose another place", arguments.out.display());
        return Err(CliError::Input(text));
    }
    let act = async |store: &Store| Ok(store.backup(&arguments.out).await?);
    let backup = with_store(&arguments.data, act)?;
    print_line(serde_json::json!(backup))?;
    let Backup { damaged, missing, .. } = backup;
    if damaged.is_empty() && missing.is_empty() {
        return Ok(());
    }
    let bad = [damaged, missing].concat().join(", ");
    Err(CliError::Failure(format!(
        "the copy is complete except for files that are damaged or missing: {bad}"
    )))
}
