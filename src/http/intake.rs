//! Work on files that is part of an answer: one piece for each lab at a time, where blocking is allowed, and no longer
//! than `--check-seconds`.

use std::path::PathBuf;

use super::app::App;
use super::error::{ApiError, Code, Result};
use engine::intake::Refusal;
use engine::job::{Lab, Sha256};
use store::StoreError;

/// Does a piece of work where it may block, when it is the lab's turn.
/// Errors: 503 if it takes too long.
pub(super) async fn run<T: Send + 'static>(
    app: &App,
    lab: &Lab,
    work: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    let turn = app.closing.run_until_cancelled(app.intake.take(lab)).await;
    let turn = turn.unwrap_or_else(|| Err(StoreError::Interrupted.into()))?;
    let done = tokio::task::spawn_blocking(move || {
        // Held until the work ends, even if the client disconnects.
        let _turn = turn;
        work()
    });
    let done = tokio::time::timeout(app.settings.check_time(), done).await;
    done.map_err(|_| Refusal::too_slow())?.map_err(|error| ApiError::internal(&error))?
}

/// Where an upload lies, if its bytes are those that were sent.
/// Errors: 410 if they are not any more.
pub(super) async fn upload(app: &App, sha256: Sha256) -> Result<PathBuf> {
    app.store.intact_blob(sha256).await.map_err(|error| match error {
        StoreError::Damaged { .. } => ApiError::new(Code::UploadDamaged, error.to_string()),
        error => error.into(),
    })
}
