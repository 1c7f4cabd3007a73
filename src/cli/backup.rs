//! `sci-recon backup`: a consistent copy of a data folder.

use std::path::PathBuf;

use clap::Args;

use super::CliError;
use super::wait::wait;
use crate::cli::error::Result;
use crate::store::{Purpose, Store};

/// Copies a data folder while the service runs, and checks the hash of every file. To restore it,
/// serve the copy (or a copy of it).
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder of the service's data.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    data: PathBuf,
    /// Folder to copy to; it must not be there yet.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Makes the copy and prints its figures as one JSON line.
pub fn run(arguments: &Arguments) -> Result<()> {
    if arguments.out.exists() {
        let text = format!("{} is there already; name a new folder", arguments.out.display());
        return Err(CliError::Input(text));
    }
    let backup = wait(async {
        let store = Store::open(&arguments.data, Purpose::Use).await?;
        let backup = store.backup(&arguments.out).await?;
        store.close().await;
        Ok::<_, CliError>(backup)
    })?;
    let (files, bytes, damaged) = (backup.files, backup.bytes, backup.damaged);
    println!("{}", serde_json::json!({"files": files, "bytes": bytes, "damaged": damaged}));
    if damaged.is_empty() {
        return Ok(());
    }
    Err(CliError::Failure(format!("the copy is complete, but damaged: {}", damaged.join(", "))))
}
