//! What is let in: a file or a job is taken only if the disk has room for all of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::access::Access;
use super::app::App;
use super::error::{ApiError, Code};

/// What an upload that does not say its length reserves at a time.
const STEP: u64 = 64 << 20;

/// Bytes promised to uploads that are coming in.
#[derive(Debug, Clone, Default)]
pub(super) struct Promises(Arc<AtomicU64>);

/// Room on the disk for an upload; what is not written is given back when this is dropped.
#[derive(Debug)]
pub(super) struct Room {
    promises: Promises,
    left: u64,
}

impl Drop for Room {
    fn drop(&mut self) {
        self.promises.0.fetch_sub(self.left, Ordering::AcqRel);
    }
}

impl Room {
    /// Reserves room for `length` bytes.
    pub(super) async fn reserve(app: &App, length: u64) -> Result<Self, ApiError> {
        let promises = app.promises.clone();
        // First the promise and then the look: of two that want the last room, none gets too much.
        promises.0.fetch_add(length, Ordering::AcqRel);
        let room = Self { promises, left: length };
        check_disk(app, 0, "the upload", length).await?;
        Ok(room)
    }

    /// Takes note of bytes that are about to be written; reserves more if they were not announced.
    pub(super) async fn take(&mut self, app: &App, bytes: u64) -> Result<(), ApiError> {
        if bytes > self.left {
            let more = Self::reserve(app, bytes.max(STEP)).await?;
            self.left += more.left;
            // The promise is this room's now.
            std::mem::forget(more);
        }
        self.left -= bytes;
        self.promises.0.fetch_sub(bytes, Ordering::AcqRel);
        Ok(())
    }
}

/// Refuses `what` if the disk has no room for its `needed` bytes beside what was promised to others.
/// Of the promises to uploads, `needed` is one unless `extra` says that it comes on top.
async fn check_disk(app: &App, extra: u64, what: &str, needed: u64) -> Result<(), ApiError> {
    let (free, _) = app.store.dir().disk()?;
    let promised = app.store.promised_bytes().await? + app.promises.0.load(Ordering::Acquire);
    let wanted = promised.saturating_add(extra).saturating_add(app.min_free_bytes);
    if free >= wanted {
        return Ok(());
    }
    let others = promised.saturating_sub(needed - extra);
    let detail = format!(
        "{what} needs {needed} bytes; {free} are free, of which {others} are promised to others \
         and {} are kept in reserve",
        app.min_free_bytes
    );
    Err(ApiError::new(Code::InsufficientStorage, detail))
}

/// Refuses a job, or an upload in pieces, that the disk has no room for. What is accepted is kept
/// count of by the database.
pub(super) async fn check_room(app: &App, what: &str, needed: u64) -> Result<(), ApiError> {
    check_disk(app, needed, what, needed).await
}

/// Refuses an upload that is too large, or with which the token would keep more than it may.
pub(super) async fn check_length(app: &App, access: &Access, length: u64) -> Result<(), ApiError> {
    if length > app.max_upload_bytes {
        return Err(too_large(app));
    }
    let (Some(token), Some(limit)) = (access.token, access.max_bytes) else { return Ok(()) };
    let kept = app.store.token_bytes(token).await?;
    if kept.saturating_add(length) <= limit {
        return Ok(());
    }
    let detail =
        format!("the upload has {length} bytes, and the token keeps {kept} of the {limit} it may");
    Err(ApiError::new(Code::QuotaExceeded, detail))
}

/// The refusal of an upload that is larger than any may be.
pub(super) fn too_large(app: &App) -> ApiError {
    let detail = format!("an upload has at most {} bytes", app.max_upload_bytes);
    ApiError::new(Code::TooLarge, detail)
}
