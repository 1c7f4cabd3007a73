//! Aborts answers that are still being sent when their access ends: the token was revoked or has expired, the user signed
//! out, or a service without tokens got its first token.
//!
//! One task queries the database for all answers. The body of an answer must not query it: a body is not polled while its
//! client is slow, and an unpolled query keeps its connection.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use engine::job::{Secret, TokenId};
use store::{Store, StoreError};

/// Time between two checks of the grants.
const INTERVAL: Duration = Duration::from_secs(3);

/// The reason why a request was authorized.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Grant {
    Session(Secret),
    Token(TokenId),
    /// The service has no tokens.
    Open,
}

impl Grant {
    async fn is_valid(&self, store: &Store) -> Result<bool, StoreError> {
        match self {
            Self::Session(secret) => Ok(store.token_of_session(secret).await?.is_some()),
            Self::Token(id) => store.token_holds(*id).await,
            Self::Open => store.is_open().await,
        }
    }
}

/// The grants of all answers that are being sent. Answers with the same grant share a check.
#[derive(Debug, Clone, Default)]
pub(super) struct Revocations(Arc<Mutex<HashMap<Grant, Weak<CancellationToken>>>>);

impl Revocations {
    /// Starts the checks. Must be called in a Tokio runtime.
    pub(super) fn start(store: Store) -> Self {
        let revocations = Self::default();
        let checked = revocations.clone();
        tokio::spawn(async move {
            loop {
                tokio::time::sleep(INTERVAL).await;
                checked.check(&store).await;
            }
        });
        revocations
    }

    /// Waits until the grant ends, without a connection to the database.
    pub(super) fn end_of(&self, grant: Grant) -> impl Future<Output = ()> + Send + 'static {
        let mut watched = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let token = watched.entry(grant).or_default();
        let end = token.upgrade().unwrap_or_default();
        *token = Arc::downgrade(&end);
        async move { end.cancelled().await }
    }

    async fn check(&self, store: &Store) {
        for (grant, end) in self.watched() {
            // A database error does not end a grant; other requests report it.
            if matches!(grant.is_valid(store).await, Ok(false)) {
                self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&grant);
                end.cancel();
            }
        }
    }

    /// The grants of answers that are still being sent.
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
    async fn answers_share_the_check_of_a_grant() {
        let revocations = Revocations::default();
        let (one, other) = (revocations.end_of(Grant::Open), revocations.end_of(Grant::Open));
        let mut one = Box::pin(one);
        let watched = revocations.watched();
        assert!(matches!(&watched[..], [(Grant::Open, _)]));
        assert!((&mut one).now_or_never().is_none());
        watched[0].1.cancel();
        assert!(one.now_or_never().is_some() && other.now_or_never().is_some());
        let ends = Arc::strong_count(&watched[0].1);
        assert_eq!(ends, 1, "finished answers must release the grant");
        drop(watched);
        assert!(revocations.watched().is_empty());
    }
}
