//! The rate of requests of each token or address: a bucket that fills steadily and from which every request takes one.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::http::{HeaderMap, HeaderName, HeaderValue};

use super::error::{ApiError, Code};

const LIMIT: HeaderName = HeaderName::from_static("ratelimit");
const POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");
/// The time in which an empty bucket fills.
const WINDOW: Duration = Duration::from_secs(60);
/// Buckets above which full ones are forgotten.
const MANY: usize = 1000;

/// Requests that each client, identified by `K`, may send in a minute; 0: no limit.
#[derive(Debug, Clone)]
pub(super) struct Rates<K> {
    quota: u32,
    buckets: Arc<Mutex<HashMap<K, Bucket>>>,
}

#[derive(Debug, Clone, Copy)]
struct Bucket {
    /// Requests that are left.
    level: f64,
    at: Instant,
}

/// The state of a client's bucket after a request.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rate {
    quota: u32,
    level: f64,
}

impl<K: Eq + Hash> Rates<K> {
    pub(super) fn new(quota: u32) -> Self {
        Self { quota, buckets: Arc::default() }
    }

    /// Takes a request of this client from its bucket; `None` if requests are not limited.
    pub(super) fn take(&self, client: K, now: Instant) -> Option<Rate> {
        if self.quota == 0 {
            return None;
        }
        let quota = f64::from(self.quota);
        let filled = |bucket: &Bucket| {
            let time = now.saturating_duration_since(bucket.at);
            (bucket.level + quota * time.as_secs_f64() / WINDOW.as_secs_f64()).min(quota)
        };
        let mut buckets = self.buckets.lock().unwrap_or_else(PoisonError::into_inner);
        if buckets.len() > MANY {
            buckets.retain(|_, bucket| filled(bucket) < quota);
        }
        let bucket = buckets.entry(client).or_insert(Bucket { level: quota, at: now });
        let level = filled(bucket) - 1.0;
        // A refused request takes nothing, so that a client that goes on asking gets its turn.
        *bucket = Bucket { level: if level < 0.0 { level + 1.0 } else { level }, at: now };
        Some(Rate { quota: self.quota, level })
    }
}

impl Rate {
    /// Refuses the request if the bucket is empty, with the time until it has one. `what` phrases the quota, such as
    /// "the token may send 10 requests".
    pub(super) fn check(self, what: impl FnOnce(u32) -> String) -> Result<(), ApiError> {
        if self.level >= 0.0 {
            return Ok(());
        }
        let seconds = self.seconds_to(0.0);
        let what = what(self.quota);
        let detail = format!("{what} in a minute; the next one is accepted in {seconds} seconds");
        Err(ApiError::new(Code::RateLimited, detail).retry_after(seconds))
    }

    /// Whole seconds until the bucket has this level.
    fn seconds_to(self, level: f64) -> u64 {
        let missing = (level - self.level).max(0.0);
        (missing * WINDOW.as_secs_f64() / f64::from(self.quota)).ceil() as u64
    }

    /// States quota and rest in an answer (draft-ietf-httpapi-ratelimit-headers).
    pub(super) fn state(self, fields: &mut HeaderMap) {
        let left = self.level.max(0.0).floor();
        let full = Self { level: left, ..self }.seconds_to(f64::from(self.quota));
        let policy = format!("\"token\";q={};w={}", self.quota, WINDOW.as_secs());
        for (name, text) in [(POLICY, policy), (LIMIT, format!("\"token\";r={left};t={full}"))] {
            if let Ok(value) = HeaderValue::try_from(text) {
                fields.insert(name, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use axum::http::HeaderMap;

    use super::Rates;
    use engine::job::TokenId;

    #[test]
    fn a_bucket_empties_and_fills() {
        let (rates, one, other) = (Rates::new(60), TokenId::new(), TokenId::new());
        let start = Instant::now();
        let allowed =
            |token, at| rates.take(token, at).unwrap().check(|quota| quota.to_string()).is_ok();
        assert_eq!((0..100).filter(|_| allowed(one, start)).count(), 60);
        assert!(allowed(other, start), "each token has its own");
        let mut fields = HeaderMap::new();
        rates.take(one, start).unwrap().state(&mut fields);
        assert_eq!(fields["ratelimit-policy"], "\"token\";q=60;w=60");
        assert_eq!(fields["ratelimit"], "\"token\";r=0;t=60");
        let later = start + Duration::from_secs(3);
        assert_eq!((0..100).filter(|_| allowed(one, later)).count(), 3);
        let much_later = start + Duration::from_secs(1000);
        assert_eq!((0..100).filter(|_| allowed(one, much_later)).count(), 60);
        assert_eq!(Rates::new(0).take(one, start), None);
    }
}
