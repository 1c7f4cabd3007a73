//! The checks that go on after their requests were answered.

use std::collections::HashMap;
use std::fmt::Display;
use std::sync::{Arc, Mutex, PoisonError};

use tokio_util::sync::CancellationToken;

/// The checks that go on after their requests were answered, to be stopped.
#[derive(Debug, Clone, Default)]
pub(super) struct Checks(Arc<Mutex<HashMap<String, CancellationToken>>>);

/// A check among them, until it is dropped.
pub(super) struct Listed(Checks, String);

impl Checks {
    pub(super) fn list(&self, id: String, stop: CancellationToken) -> Listed {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(id.clone(), stop);
        Listed(self.clone(), id)
    }

    /// Stops the check for this thing, if there is one: it is wanted no more.
    pub(super) fn stop(&self, id: impl Display) {
        let checks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(stop) = checks.get(&id.to_string()) {
            stop.cancel();
        }
    }
}

impl Drop for Listed {
    fn drop(&mut self) {
        self.0.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&self.1);
    }
}
