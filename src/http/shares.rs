//! Limits on concurrent work that labs share, so that no lab can use all of it.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Instant;

use tokio::sync::{Mutex as AsyncMutex, OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

use super::error::{ApiError, Code, Result};
use super::turnover::Turnover;
use engine::job::Lab;

/// Places for requests that take long. A lab gets at most half of them. A lab without a place always gets one, even if
/// all are taken.
#[derive(Debug, Clone)]
pub(super) struct Places {
    most: usize,
    of_a_lab: usize,
    taken: Arc<Mutex<Taken>>,
}

#[derive(Debug, Default)]
struct Taken {
    by_lab: HashMap<Lab, usize>,
    turnover: Turnover,
}

/// No place is free for the lab.
#[derive(Debug, Clone, Copy)]
pub(super) struct Full {
    /// Estimated time until one is free.
    pub(super) seconds: u64,
}

/// A place. It is free again when this is dropped.
#[derive(Debug)]
pub(super) struct Place {
    places: Places,
    lab: Lab,
    since: Instant,
}

impl Places {
    pub(super) fn new(most: usize) -> Self {
        Self { most, of_a_lab: most.div_ceil(2).max(1), taken: Arc::default() }
    }

    /// Takes a place for this lab.
    ///
    /// Errors: [`Full`] if the lab has its share, or if all places are taken.
    pub(super) fn take(&self, lab: &Lab) -> Result<Place, Full> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let all = taken.by_lab.values().sum::<usize>();
        let own = taken.by_lab.get(lab).copied().unwrap_or_default();
        if own > 0 && (own >= self.of_a_lab || all >= self.most) {
            let held = if own >= self.of_a_lab { own } else { all };
            return Err(Full { seconds: taken.turnover.next_end(held) });
        }
        *taken.by_lab.entry(lab.clone()).or_default() += 1;
        Ok(Place { places: self.clone(), lab: lab.clone(), since: Instant::now() })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock().unwrap_or_else(PoisonError::into_inner);
        taken.turnover.record(self.since.elapsed());
        if let Some(own) = taken.by_lab.get_mut(&self.lab) {
            *own -= 1;
            if *own == 0 {
                taken.by_lab.remove(&self.lab);
            }
        }
    }
}

/// A queue of work with a limit on concurrency. Each lab has one item in the queue, so that labs take turns; its other
/// items wait for that one.
#[derive(Debug)]
pub(super) struct Turns {
    all: Arc<Semaphore>,
    of_labs: PerLab<Semaphore>,
    waiting: Places,
}

/// Permission to work. The turn ends when this is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    // Fields are dropped in this order: the next item of the lab enters the queue once this one has left it.
    _all: OwnedSemaphorePermit,
    _of_lab: OwnedSemaphorePermit,
    _waiting: Place,
}

impl Turns {
    /// `at_once` items run at the same time, and `waiting` items of a lab may wait or run.
    pub(super) fn new(at_once: usize, waiting: usize) -> Self {
        let waiting = Places { most: usize::MAX, of_a_lab: waiting, taken: Arc::default() };
        Self { all: Arc::new(Semaphore::new(at_once)), of_labs: PerLab::default(), waiting }
    }

    /// Waits for the lab's turn.
    ///
    /// Errors: 429 if too many items of the lab wait; 503 if the service stops.
    pub(super) async fn take(&self, lab: &Lab) -> Result<Turn> {
        let waiting = self.waiting.take(lab).map_err(|full| {
            let detail = "too many files of this lab wait for a check; try again later";
            ApiError::new(Code::TooManyChecks, detail).retry_after(full.seconds)
        })?;
        let stopped = |_| ApiError::new(Code::Unavailable, "the service is shutting down");
        let of_lab =
            self.of_labs.get(lab, || Semaphore::new(1)).acquire_owned().await.map_err(stopped)?;
        let all = self.all.clone().acquire_owned().await.map_err(stopped)?;
        Ok(Turn { _all: all, _of_lab: of_lab, _waiting: waiting })
    }
}

/// The locks of requests that change something, one for each lab. A request holds it from the check of its condition to
/// the change.
#[derive(Debug, Default)]
pub(super) struct Changes(PerLab<AsyncMutex<()>>);

impl Changes {
    /// Waits until no other request changes anything of this lab, and keeps others waiting until the guard is dropped.
    pub(super) async fn lock(&self, lab: &Lab) -> OwnedMutexGuard<()> {
        self.0.get(lab, AsyncMutex::default).lock_owned().await
    }
}

/// A value for each lab, while something holds it.
#[derive(Debug)]
struct PerLab<T>(Mutex<HashMap<Lab, Weak<T>>>);

impl<T> Default for PerLab<T> {
    fn default() -> Self {
        Self(Mutex::default())
    }
}

impl<T> PerLab<T> {
    fn get(&self, lab: &Lab, make: impl FnOnce() -> T) -> Arc<T> {
        let mut labs = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = labs.get(lab).and_then(Weak::upgrade) {
            return found;
        }
        labs.retain(|_, value| value.strong_count() > 0);
        let new = Arc::new(make());
        labs.insert(lab.clone(), Arc::downgrade(&new));
        new
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::{Changes, Lab, Places, Turns};

    fn lab(name: &str) -> Lab {
        name.parse().unwrap()
    }

    #[test]
    fn a_lab_leaves_places_for_others() {
        let places = Places::new(4);
        let (a, b, c) = (lab("a"), lab("b"), lab("c"));
        let of_a: Vec<_> = (0..3).map(|_| places.take(&a)).collect();
        assert!(of_a[1].is_ok() && of_a[2].is_err(), "a lab gets half of the places");
        let of_b = [places.take(&b), places.take(&b)];
        assert!(of_b.iter().all(Result::is_ok));
        let of_c = [places.take(&c), places.take(&c)];
        assert!(of_c[0].is_ok() && of_c[1].is_err(), "a lab gets one place although all are taken");
        drop(of_a);
        assert!(places.take(&c).is_ok());
        assert!(Places::new(1).take(&a).is_ok());
    }

    #[tokio::test]
    async fn labs_take_turns() {
        let turns = Turns::new(1, 3);
        let (a, b) = (lab("a"), lab("b"));
        let first = turns.take(&a).await.unwrap();
        let line = async {
            let (mut order, done) = (Vec::new(), std::sync::Mutex::new(Vec::new()));
            let go = |lab: Lab| {
                let (turns, done) = (&turns, &done);
                async move {
                    let _turn = turns.take(&lab).await.unwrap();
                    done.lock().unwrap().push(lab.to_string());
                }
            };
            tokio::join!(go(a.clone()), go(a.clone()), go(b.clone()), async {
                tokio::task::yield_now().await;
                assert!(turns.take(&a).await.is_err(), "three items of lab a wait or run");
                drop(first);
            });
            order.append(&mut done.lock().unwrap());
            order
        };
        let order = line.await;
        assert_eq!(order.len(), 3);
        assert!(
            order[0] == "b" || order[1] == "b",
            "lab b does not wait for all items of lab a: {order:?}"
        );
    }

    #[tokio::test]
    async fn changes_of_a_lab_wait_for_each_other_alone() {
        let (changes, a, b) = (Changes::default(), lab("a"), lab("b"));
        let first = changes.lock(&a).await;
        assert!(changes.lock(&a).now_or_never().is_none());
        assert!(changes.lock(&b).now_or_never().is_some());
        drop(first);
        assert!(changes.lock(&a).now_or_never().is_some());
    }
}
