//! Estimates of the time until one of several places is free, for `Retry-After`.

use std::time::Duration;

use super::error::MAX_RETRY_SECONDS;

/// Seconds if no place has become free yet.
const UNKNOWN: u64 = 5;
/// Weight of the newest time.
const WEIGHT: f64 = 0.2;

/// The mean time for which places are held. Recent times have more weight.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Turnover {
    mean_seconds: Option<f64>,
}

impl Turnover {
    /// Counts the time for which a place was held.
    pub(super) fn record(&mut self, held: Duration) {
        let seconds = held.as_secs_f64();
        let mean = self.mean_seconds.map_or(seconds, |mean| mean + WEIGHT * (seconds - mean));
        self.mean_seconds = Some(mean);
    }

    /// Whole seconds until one of `held` places is expected to be free: the mean time, divided by the number of places
    /// that become free independently.
    pub(super) fn next_end(&self, held: usize) -> u64 {
        let Some(mean) = self.mean_seconds else { return UNKNOWN };
        (mean / held.max(1) as f64).clamp(1.0, MAX_RETRY_SECONDS).ceil() as u64
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::{Turnover, UNKNOWN};

    #[test]
    fn the_estimate_follows_the_times_and_the_number_of_places() {
        let mut turnover = Turnover::default();
        assert_eq!(turnover.next_end(3), UNKNOWN);
        turnover.record(Duration::from_secs(40));
        assert_eq!([1, 4, 100].map(|held| turnover.next_end(held)), [40, 10, 1]);
        for _ in 0..50 {
            turnover.record(Duration::from_secs(10));
        }
        assert_eq!(turnover.next_end(1), 11);
        turnover.record(Duration::from_secs(100_000));
        assert_eq!(turnover.next_end(1), 600);
    }
}
