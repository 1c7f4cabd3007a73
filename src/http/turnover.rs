//! Estimates of the time until one of several places is free, for `Retry-After`.

use std::time::{Duration, Instant};

use super::error::retry_seconds;

/// Weight of the newest time.
const WEIGHT: f64 = 0.2;

/// The mean time for which places are held. Recent times have more weight.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Turnover {
    mean_seconds: Option<f64>,
    /// Time at which the first place was taken.
    first: Option<Instant>,
}

impl Turnover {
    /// Notes that a place is taken.
    pub(super) fn begin(&mut self, now: Instant) {
        self.first.get_or_insert(now);
    }

    /// Counts the time for which a place was held.
    pub(super) fn record(&mut self, held: Duration) {
        let seconds = held.as_secs_f64();
        let mean = self.mean_seconds.map_or(seconds, |mean| mean + WEIGHT * (seconds - mean));
        self.mean_seconds = Some(mean);
    }

    /// Whole seconds until one of `held` places is expected to be free: the mean time, divided by the number of places
    /// that become free independently. Before any has become free, the first one is expected to be held for as long
    /// again as it has been.
    pub(super) fn next_end(&self, held: usize, now: Instant) -> u64 {
        let so_far = || self.first.map_or(Duration::ZERO, |first| now.duration_since(first));
        retry_seconds(match self.mean_seconds {
            Some(mean) => mean / held.max(1) as f64,
            None => so_far().as_secs_f64(),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::Turnover;

    #[test]
    fn the_estimate_follows_the_times_and_the_number_of_places() {
        let (mut turnover, start) = (Turnover::default(), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        turnover.begin(start);
        turnover.begin(after(7));
        assert_eq!([0, 9, 5000].map(|time| turnover.next_end(3, after(time))), [1, 9, 600]);
        turnover.record(Duration::from_secs(40));
        assert_eq!([1, 4, 100].map(|held| turnover.next_end(held, start)), [40, 10, 1]);
        for _ in 0..50 {
            turnover.record(Duration::from_secs(10));
        }
        assert_eq!(turnover.next_end(1, start), 11);
        turnover.record(Duration::from_secs(100_000));
        assert_eq!(turnover.next_end(1, start), 600);
    }
}
