//! Blocking work on files for the answer to a request. Each lab has one such task at a time, limited to `--check-seconds`.

use std::path::PathBuf;

use super::app::App;
use super::error::{ApiError, Code, Result};
use engine::intake::Refusal;
use engine::job::{Lab, Sha256};
use store::StoreError;

/// Waits for the lab's turn, then runs the work on a thread that may block.
///
/// Errors: 503 if the work takes too long.
pub(super) async fn run<T: Send + 'static>(
    app: &App,
    lab: &Lab,
    work: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    let turn = app.closing.run_until_cancelled(app.intake.take(lab)).await;
    let turn = turn.unwrap_or_else(|| Err(StoreError::Interrupted.into()))?;
    let task = tokio::task::spawn_blocking(move || {
        // Held until the work ends, even if the client disconnects.
        let _turn = turn;
        work()
    });
    let output = tokio::time::timeout(app.settings.check_time(), task).await;
    output.map_err(|_| Refusal::too_slow())?.map_err(|error| ApiError::internal(&error))?
}

/// The path of an upload.
///
/// Errors: 410 if its bytes are lost or damaged.
pub(super) async fn upload(app: &App, sha256: Sha256) -> Result<PathBuf> {
    app.store.intact_blob(sha256).await.map_err(|error| match error {
        StoreError::Damaged { .. } => ApiError::new(Code::UploadDamaged, error.to_string()),
        error => error.into(),
    })
}
