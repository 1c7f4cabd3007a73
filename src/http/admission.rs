//! What is let in: a file or a job is taken only if the disk has room for all of it, and only so many
//! uploads at a time.
//!
//! Slots for uploads are no limit of `tower`: its answer would come before the body is read, and a
//! client that is still sending would not see it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::Mutex;

use super::access::Access;
use super::error::{ApiError, Code, Result};
use super::shares::{Place, Places};
use crate::config::ServeArguments;
use engine::job::Lab;
use store::{Store, StoreError};

/// What an upload that does not say its length reserves at a time.
const STEP: u64 = 64 << 20;

#[derive(Debug)]
pub(super) struct Admission {
    store: Store,
    max_upload_bytes: u64,
    min_free_bytes: u64,
    /// Bytes reserved for uploads that are coming in.
    reserved: Arc<AtomicU64>,
    places: Places,
    /// Held from the look at the disk until what was let in is on record: of two that want the last room one
    /// gets it.
    gate: Mutex<()>,
}

/// Bytes of the disk reserved for an upload; what is not written is given back when this is dropped.
#[derive(Debug)]
pub(super) struct Reservation {
    reserved: Arc<AtomicU64>,
    left: u64,
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.reserved.fetch_sub(self.left, Ordering::AcqRel);
    }
}

impl Admission {
    pub(super) fn new(store: Store, settings: &ServeArguments) -> Self {
        Self {
            store,
            max_upload_bytes: settings.max_upload_bytes,
            min_free_bytes: settings.min_free_bytes,
            reserved: Arc::default(),
            places: Places::new(settings.max_uploads),
            gate: Mutex::default(),
        }
    }

    /// Takes one of the places for uploads.
    pub(super) fn place(&self, lab: &Lab) -> Result<Place> {
        self.places.take(lab).ok_or_else(|| {
            let detail =
                "all places for uploads are taken, or this lab has its share; try again soon";
            ApiError::new(Code::TooManyUploads, detail)
        })
    }

    pub(super) async fn reserve(&self, length: u64) -> Result<Reservation> {
        let _gate = self.gate.lock().await;
        let reserved = self.reserved.clone();
        // First the reservation and then the look: of two that want the last room, none gets too
        // much.
        reserved.fetch_add(length, Ordering::AcqRel);
        let reservation = Reservation { reserved, left: length };
        self.check_disk(0, "the upload", length).await?;
        Ok(reservation)
    }

    /// Takes bytes that are about to be written from a reservation; reserves more if they were not
    /// announced.
    pub(super) async fn take(&self, reservation: &mut Reservation, bytes: u64) -> Result<()> {
        if bytes > reservation.left {
            let mut more = self.reserve(bytes.max(STEP)).await?;
            reservation.left += std::mem::take(&mut more.left);
        }
        reservation.left -= bytes;
        self.reserved.fetch_sub(bytes, Ordering::AcqRel);
        Ok(())
    }

    /// Refuses `what` if the disk has no room for its `needed` bytes beside what is reserved for
    /// others. They are part of what is reserved unless `extra` says that they come on top.
    async fn check_disk(&self, extra: u64, what: &'static str, needed: u64) -> Result<()> {
        let reserved = self.store.promised_bytes().await? + self.reserved.load(Ordering::Acquire);
        let others = reserved.saturating_sub(needed - extra);
        Ok(self.store.dir().check_room(what, needed, others, self.min_free_bytes)?)
    }

    /// Has `accept` put on record what the disk has room for, and by that reserve it: a job, an upload in
    /// pieces.
    pub(super) async fn with_room<T>(
        &self,
        what: &'static str,
        needed: u64,
        accept: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T> {
        let _gate = self.gate.lock().await;
        self.check_disk(needed, what, needed).await?;
        Ok(accept.await?)
    }

    pub(super) fn check_size(&self, length: u64) -> Result<()> {
        if length <= self.max_upload_bytes {
            return Ok(());
        }
        let detail = format!("an upload has at most {} bytes", self.max_upload_bytes);
        Err(ApiError::new(Code::TooLarge, detail))
    }

    /// Refuses an upload that is too large, or with which lab or token would keep more than they may.
    pub(super) async fn check_length(&self, access: &Access, length: u64) -> Result<()> {
        self.check_size(length)?;
        Ok(self.store.check_quota(&access.lab, access.token, length).await?)
    }
}
