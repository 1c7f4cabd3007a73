//! Bounds the rate of log lines that strangers can cause.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Lines of one kind in a second; the others are counted.
const LINES: u32 = 5;
const SECOND: Duration = Duration::from_secs(1);

/// A limit on the lines of one kind.
#[derive(Debug, Clone, Default)]
pub(super) struct Throttle(Arc<Mutex<Lines>>);

#[derive(Debug, Default)]
struct Lines {
    /// Start of the current second.
    since: Option<Instant>,
    written: u32,
    left_out: u64,
}

#[derive(Debug, PartialEq, Eq)]
enum Verdict {
    Write,
    /// Left out, and the first one since lines were counted.
    LeaveOutFirst,
    LeaveOut,
}

impl Throttle {
    /// Calls `write`, unless enough lines were written in this second. Then a later call of `summarize` receives the
    /// number of the lines that were left out. Needs a runtime of tokio.
    pub(super) fn pass(&self, write: impl FnOnce(), summarize: impl FnOnce(u64) + Send + 'static) {
        match self.judge(Instant::now()) {
            Verdict::Write => write(),
            Verdict::LeaveOut => {}
            Verdict::LeaveOutFirst => {
                let throttle = self.clone();
                tokio::spawn(async move {
                    tokio::time::sleep(SECOND).await;
                    summarize(throttle.take_left_out());
                });
            }
        }
    }

    fn judge(&self, now: Instant) -> Verdict {
        let mut lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.since.is_none_or(|since| now.saturating_duration_since(since) >= SECOND) {
            (lines.since, lines.written) = (Some(now), 0);
        }
        if lines.written < LINES {
            lines.written += 1;
            return Verdict::Write;
        }
        lines.left_out += 1;
        if lines.left_out == 1 { Verdict::LeaveOutFirst } else { Verdict::LeaveOut }
    }

    fn take_left_out(&self) -> u64 {
        std::mem::take(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner).left_out)
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use super::{LINES, Throttle, Verdict};

    #[test]
    fn a_flood_leaves_a_few_lines_and_a_count() {
        let (throttle, start) = (Throttle::default(), Instant::now());
        let verdicts: Vec<_> = (0..1000).map(|_| throttle.judge(start)).collect();
        let written = verdicts.iter().filter(|verdict| **verdict == Verdict::Write).count();
        assert_eq!(written, LINES as usize);
        let first = verdicts.iter().filter(|verdict| **verdict == Verdict::LeaveOutFirst).count();
        assert_eq!(first, 1, "one summary counts the lines");
        assert_eq!(throttle.take_left_out(), 1000 - u64::from(LINES));
        assert_eq!(throttle.judge(start + Duration::from_secs(1)), Verdict::Write);
    }
}
