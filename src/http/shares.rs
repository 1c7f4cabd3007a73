//! Limits on concurrent work, so that no lab and no client can use all of it.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Instant;

use tokio::sync::{Mutex as AsyncMutex, OwnedMutexGuard, OwnedSemaphorePermit, Semaphore};

use super::error::{ApiError, Code, Result};
use super::turnover::Turnover;
use engine::job::Lab;

/// Places for work that takes long, or for connections. Each is taken by a holder: a lab, or the network of a client.
#[derive(Debug, Clone)]
pub(super) struct Places<Holder: Eq + Hash> {
    pub(super) most: usize,
    /// Most places of one holder.
    pub(super) share: usize,
    /// True if a holder without a place gets one although all are taken.
    pub(super) always_one: bool,
    pub(super) taken: Arc<Mutex<Taken<Holder>>>,
}

#[derive(Debug)]
pub(super) struct Taken<Holder> {
    pub(super) by_holder: HashMap<Holder, usize>,
    turnover: Turnover,
}

impl<Holder> Default for Taken<Holder> {
    fn default() -> Self {
        Self { by_holder: HashMap::new(), turnover: Turnover::default() }
    }
}

/// No place is free for the holder.
#[derive(Debug, Clone, Copy)]
pub(super) struct Full {
    /// Estimated time until one is free.
    pub(super) seconds: u64,
}

/// A place. It is free again when this is dropped.
#[derive(Debug)]
pub(super) struct Place<Holder: Eq + Hash> {
    places: Places<Holder>,
    holder: Holder,
    since: Instant,
}

impl Places<Lab> {
    /// Places for requests that take long. A lab gets at most half of them.
    pub(super) fn for_labs(most: usize) -> Self {
        let share = most.div_ceil(2).max(1);
        Self { most, share, always_one: true, taken: Arc::default() }
    }
}

impl<Holder: Eq + Hash + Clone> Places<Holder> {
    /// Takes a place for this holder.
    ///
    /// Errors: [`Full`] if the holder has its share, or if all places are taken.
    pub(super) fn take(&self, holder: &Holder) -> Result<Place<Holder>, Full> {
        self.take_within(holder, self.share)
    }

    /// Takes a place for a holder whose share is `share`.
    pub(super) fn take_within(&self, holder: &Holder, share: usize) -> Result<Place<Holder>, Full> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let all = taken.by_holder.values().sum::<usize>();
        let own = taken.by_holder.get(holder).copied().unwrap_or_default();
        let gets_its_first = own == 0 && self.always_one;
        if !gets_its_first && (own >= share || all >= self.most) {
            let held = if own >= share { own } else { all };
            return Err(Full { seconds: taken.turnover.next_end(held, Instant::now()) });
        }
        *taken.by_holder.entry(holder.clone()).or_default() += 1;
        let since = Instant::now();
        taken.turnover.begin(since);
        Ok(Place { places: self.clone(), holder: holder.clone(), since })
    }
}

impl<Holder: Eq + Hash> Drop for Place<Holder> {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock().unwrap_or_else(PoisonError::into_inner);
        taken.turnover.record(self.since.elapsed());
        if let Some(own) = taken.by_holder.get_mut(&self.holder) {
            *own -= 1;
            if *own == 0 {
                taken.by_holder.remove(&self.holder);
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
    waiting: Places<Lab>,
}

/// Permission to work. The turn ends when this is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    // Fields are dropped in this order: the next item of the lab enters the queue once this one has left it.
    _all: OwnedSemaphorePermit,
    _of_lab: OwnedSemaphorePermit,
    _waiting: Place<Lab>,
}

impl Turns {
    /// `at_once` items run at the same time, and `waiting` items of a lab may wait or run.
    pub(super) fn new(at_once: usize, waiting: usize) -> Self {
        let waiting = Places { share: waiting, ..Places::for_labs(usize::MAX) };
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
        let places = Places::for_labs(4);
        let (a, b, c) = (lab("a"), lab("b"), lab("c"));
        let of_a: Vec<_> = (0..3).map(|_| places.take(&a)).collect();
        assert!(of_a[1].is_ok() && of_a[2].is_err(), "a lab gets half of the places");
        let of_b = [places.take(&b), places.take(&b)];
        assert!(of_b.iter().all(Result::is_ok));
        let of_c = [places.take(&c), places.take(&c)];
        assert!(of_c[0].is_ok() && of_c[1].is_err(), "a lab gets one place although all are taken");
        drop(of_a);
        assert!(places.take(&c).is_ok());
        assert!(Places::for_labs(1).take(&a).is_ok());
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
