//! What is let in: a file or a job is taken only if the disk has room for all of it, and only so many
//! uploads at a time.
//!
//! Slots for uploads are no limit of `tower`: its answer would come before the body is read, and a
//! client that is still sending would not see it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex as BlockingMutex, MutexGuard, PoisonError};

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
    incoming: Incoming,
    places: Places<Lab>,
    /// Held from the look at the disk until what was let in is on record: of two that want the last room one
    /// gets it.
    gate: Mutex<()>,
}

/// Bytes reserved for uploads that are coming in, by lab.
#[derive(Debug, Clone, Default)]
struct Incoming(Arc<BlockingMutex<HashMap<Lab, u64>>>);

impl Incoming {
    fn by_lab(&self) -> MutexGuard<'_, HashMap<Lab, u64>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, lab: &Lab, bytes: u64) {
        *self.by_lab().entry(lab.clone()).or_default() += bytes;
    }

    fn remove(&self, lab: &Lab, bytes: u64) {
        let mut by_lab = self.by_lab();
        if let Some(own) = by_lab.get_mut(lab) {
            *own = own.saturating_sub(bytes);
            if *own == 0 {
                by_lab.remove(lab);
            }
        }
    }
}

/// Bytes of the disk reserved for an upload of a lab. Dropping it releases the bytes that were not written.
#[derive(Debug)]
pub(super) struct Reservation {
    incoming: Incoming,
    lab: Lab,
    left: u64,
}

impl Drop for Reservation {
    fn drop(&mut self) {
        self.incoming.remove(&self.lab, self.left);
    }
}

impl Admission {
    pub(super) fn new(store: Store, settings: &ServeArguments) -> Self {
        Self {
            store,
            max_upload_bytes: settings.max_upload_bytes,
            min_free_bytes: settings.min_free_bytes,
            incoming: Incoming::default(),
            places: Places::for_labs(settings.max_uploads),
            gate: Mutex::default(),
        }
    }

    /// Takes one of the places for uploads.
    pub(super) fn place(&self, lab: &Lab) -> Result<Place<Lab>> {
        self.places.take(lab).map_err(|full| {
            let detail =
                "all places for uploads are taken, or this lab has its share; try again soon";
            ApiError::new(Code::TooManyUploads, detail).retry_after(full.seconds)
        })
    }

    pub(super) async fn reserve(&self, lab: &Lab, length: u64) -> Result<Reservation> {
        let _gate = self.gate.lock().await;
        self.check_disk(lab, "the upload", length).await?;
        self.incoming.add(lab, length);
        Ok(Reservation { incoming: self.incoming.clone(), lab: lab.clone(), left: length })
    }

    /// Takes bytes that are about to be written from a reservation; reserves more if they were not
    /// announced.
    pub(super) async fn take(&self, reservation: &mut Reservation, bytes: u64) -> Result<()> {
        if bytes > reservation.left {
            let mut more = self.reserve(&reservation.lab, bytes.max(STEP)).await?;
            reservation.left += std::mem::take(&mut more.left);
        }
        reservation.left -= bytes;
        self.incoming.remove(&reservation.lab, bytes);
        Ok(())
    }

    /// Refuses `what` if the disk has no room for its `needed` bytes beside what is reserved, or if the lab would
    /// reserve more than its share.
    async fn check_disk(&self, lab: &Lab, what: &'static str, needed: u64) -> Result<()> {
        let mut reservations = self.store.reservations().await?;
        for (owner, bytes) in self.incoming.by_lab().iter() {
            reservations.add(owner, *bytes);
        }
        let reserved = reservations.seen_by(lab);
        Ok(self.store.dir().check_room(what, needed, reserved, self.min_free_bytes)?)
    }

    /// Has `accept` put on record what the disk has room for, and by that reserve it: a job, an upload in
    /// pieces.
    pub(super) async fn with_room<T>(
        &self,
        lab: &Lab,
        what: &'static str,
        needed: u64,
        accept: impl Future<Output = Result<T, StoreError>>,
    ) -> Result<T> {
        let _gate = self.gate.lock().await;
        self.check_disk(lab, what, needed).await?;
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
