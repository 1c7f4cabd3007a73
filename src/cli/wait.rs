//! Commands that wait for asynchronous work, without a pool of threads.

use super::CliError;

/// Runs `work` to its end on this thread.
pub fn wait<T, E: Into<CliError>>(work: impl Future<Output = Result<T, E>>) -> Result<T, CliError> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| CliError::Failure(error.to_string()))?;
    runtime.block_on(work).map_err(Into::into)
}
