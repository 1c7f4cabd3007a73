//! The processor cores of a reconstruction. No other file of this crate uses `rayon`.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Largest number of cores for one reconstruction. Each thread of a network's session takes memory for its stack.
const MAX_CORES: usize = 8;

/// The number of cores that a reconstruction may use now. Clones share it, and it may change during the reconstruction. No
/// result depends on it.
#[derive(Debug, Clone)]
pub struct Cores(Arc<AtomicUsize>);

/// Starts the threads that the reconstructions of this process share: no more than one of them may use.
pub fn start_threads(cores: usize) {
    // A pool that has started already does the same work.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(cores.clamp(1, MAX_CORES)).build_global();
}

impl Default for Cores {
    /// One core.
    fn default() -> Self {
        Self::new(1)
    }
}

impl Cores {
    /// As [`Cores::set`].
    pub fn new(count: usize) -> Self {
        let cores = Self(Arc::default());
        cores.set(count);
        cores
    }

    /// Number of cores, at least 1.
    pub fn count(&self) -> usize {
        self.0.load(Ordering::Relaxed)
    }

    /// Changes the number to the nearest one from 1 to 8.
    pub fn set(&self, count: usize) {
        self.0.store(count.clamp(1, MAX_CORES), Ordering::Relaxed);
    }

    /// As [`share_with`], for work that needs no memory of its thread.
    pub(crate) fn share<T>(&self, parts: impl Iterator<Item = T> + Send, work: impl Fn(T) + Sync) {
        share_with(&mut vec![(); self.count()], parts, |(), part| work(part));
    }
}

/// Works on all parts, on a thread for each element of `memories`. Each thread takes the next part when it is ready, so a slow
/// one delays the others little. The caller's thread is the first; the others belong to the pool of the process.
pub(crate) fn share_with<M: Send, T>(
    memories: &mut [M],
    parts: impl Iterator<Item = T> + Send,
    work: impl Fn(&mut M, T) + Sync,
) {
    let Some((first, others)) = memories.split_first_mut() else { return };
    if others.is_empty() {
        return parts.for_each(|part| work(first, part));
    }
    let parts = Mutex::new(parts);
    let next = || parts.lock().unwrap_or_else(PoisonError::into_inner).next();
    let take_parts = |memory: &mut M| {
        while let Some(part) = next() {
            work(memory, part);
        }
    };
    rayon::in_place_scope(|scope| {
        for memory in others {
            scope.spawn(|_| take_parts(memory));
        }
        take_parts(first);
    });
}

#[cfg(test)]
mod tests {
    use super::{Cores, share_with};

    #[test]
    fn every_part_is_done_once_on_any_number_of_cores() {
        for count in [0, 1, 2, 5, 100] {
            let cores = Cores::new(count);
            assert_eq!(cores.count(), count.clamp(1, 8));
            let mut values = [0; 17];
            cores.share(values.iter_mut().enumerate(), |(at, value)| *value += at);
            assert!(values.iter().enumerate().all(|(at, value)| *value == at));
            let mut sums = vec![0; cores.count()];
            share_with(&mut sums, 0..100, |sum, part| *sum += part);
            assert_eq!(sums.iter().sum::<i32>(), 4950);
        }
    }

    #[test]
    fn clones_share_their_number() {
        let cores = Cores::default();
        let clone = cores.clone();
        cores.set(3);
        assert_eq!(clone.count(), 3);
    }
}
