//! Runs asynchronous work of commands on one thread.

use std::path::Path;

use super::CliError;
use super::output::print_line;
use store::{Purpose, Store};

/// Runs `work` to its end on this thread.
pub fn wait<T, E: Into<CliError>>(work: impl Future<Output = Result<T, E>>) -> Result<T, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| CliError::Failure(error.to_string()))?;
    runtime.block_on(work).map_err(Into::into)
}

/// Opens the store in `data`, and prints the text that `act` returns.
pub fn print_of_store(
    data: &Path,
    act: impl AsyncFnOnce(&Store) -> Result<String, CliError>,
) -> Result<(), CliError> {
    wait(async {
        let store = Store::open(data, Purpose::Use).await?;
        let acted = act(&store).await;
        store.close().await;
        let text = acted?;
        print_line(text)
    })
}
