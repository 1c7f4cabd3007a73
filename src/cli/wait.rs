//! Runs asynchronous work of commands on one thread.

use std::path::Path;

use super::CliError;
use store::{Purpose, Store};

/// Runs `work` to its end on this thread.
pub fn wait<T, E: Into<CliError>>(work: impl Future<Output = Result<T, E>>) -> Result<T, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| CliError::Failure(error.to_string()))?;
    runtime.block_on(work).map_err(Into::into)
}

/// Opens the store in `data` for `act`, and closes it.
pub fn with_store<T>(
    data: &Path,
    act: impl AsyncFnOnce(&Store) -> Result<T, CliError>,
) -> Result<T, CliError> {
    wait(async {
        let store = Store::open(data, Purpose::Use).await?;
        let acted = act(&store).await;
        store.close().await;
        acted
    })
}
