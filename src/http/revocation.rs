//! Ends answers that are still being sent when the access that they began with ends: the token was revoked or has
//! expired, the session was signed out, or a service without tokens got its first one.
//!
//! One task asks the database on behalf of all answers. A body must not ask: nobody polls it while its client is slow,
//! and a query that has begun keeps its connection until it is polled to its end.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use engine::job::{Secret, TokenId};
use store::{Store, StoreError};

/// Time between two looks at the accesses that answers depend on.
const LOOK: Duration = Duration::from_secs(3);

/// The reason for which a request was let in.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Grant {
    Session(Secret),
    Token(TokenId),
    /// The service has no tokens.
    Open,
}

impl Grant {
    async fn holds(&self, store: &Store) -> Result<bool, StoreError> {
        match self {
            Self::Session(secret) => Ok(store.token_of_session(secret).await?.is_some()),
            Self::Token(id) => store.token_holds(*id).await,
            Self::Open => store.is_open().await,
        }
    }
}

/// The grants that answers depend on. Each is asked for once, however many answers there are.
#[derive(Debug, Clone, Default)]
pub(super) struct Revocations(Arc<Mutex<HashMap<Grant, Weak<CancellationToken>>>>);

impl Revocations {
    /// Begins to look. Needs a runtime of tokio.
    pub(super) fn start(store: Store) -> Self {
        let revocations = Self::default();
        let looking = revocations.clone();
        tokio::spawn(async move {
            loop {
                tokio::time::sleep(LOOK).await;
                looking.look(&store).await;
            }
        });
        revocations
    }

    /// Waits until the grant holds no longer. Keeps no connection to the database.
    pub(super) fn end_of(&self, grant: Grant) -> impl Future<Output = ()> + Send + 'static {
        let mut watched = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let place = watched.entry(grant).or_default();
        let end = place.upgrade().unwrap_or_default();
        *place = Arc::downgrade(&end);
        async move { end.cancelled().await }
    }

    async fn look(&self, store: &Store) {
        for (grant, end) in self.watched() {
            // A failing database shows in every other answer, too.
            if matches!(grant.holds(store).await, Ok(false)) {
                self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&grant);
                end.cancel();
            }
        }
    }

    /// The grants on which an answer still depends.
    fn watched(&self) -> Vec<(Grant, Arc<CancellationToken>)> {
        let mut watched = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        watched.retain(|_, end| end.strong_count() > 0);
        watched.iter().filter_map(|(grant, end)| Some((grant.clone(), end.upgrade()?))).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use futures_util::FutureExt;

    use super::{Grant, Revocations};

    #[tokio::test]
    async fn answers_with_one_grant_are_asked_for_once_and_forgotten_with_the_last() {
        let revocations = Revocations::default();
        let (one, other) = (revocations.end_of(Grant::Open), revocations.end_of(Grant::Open));
        let mut one = Box::pin(one);
        let watched = revocations.watched();
        assert!(matches!(&watched[..], [(Grant::Open, _)]));
        assert!((&mut one).now_or_never().is_none());
        watched[0].1.cancel();
        assert!(one.now_or_never().is_some() && other.now_or_never().is_some());
        let ends = Arc::strong_count(&watched[0].1);
        assert_eq!(ends, 1, "the answers have let go");
        drop(watched);
        assert!(revocations.watched().is_empty());
    }
}
