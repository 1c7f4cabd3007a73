//! Places and turns that labs share, so that none of them can take all.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::error::{ApiError, Code, Result};
use engine::job::Lab;

/// Places for what takes long. A lab has half of them at most; one that has none always gets one, also if all
/// are taken.
#[derive(Debug, Clone)]
pub(super) struct Places {
    most: usize,
    of_a_lab: usize,
    taken: Arc<Mutex<HashMap<Lab, usize>>>,
}

/// A place, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    places: Places,
    lab: Lab,
}

impl Places {
    pub(super) fn new(most: usize) -> Self {
        Self { most, of_a_lab: most.div_ceil(2).max(1), taken: Arc::default() }
    }

    /// A place for this lab; none if it has its share, or all are taken.
    pub(super) fn take(&self, lab: &Lab) -> Option<Place> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let all = taken.values().sum::<usize>();
        let own = taken.get(lab).copied().unwrap_or_default();
        if own > 0 && (own >= self.of_a_lab || all >= self.most) {
            return None;
        }
        *taken.entry(lab.clone()).or_default() += 1;
        Some(Place { places: self.clone(), lab: lab.clone() })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(own) = taken.get_mut(&self.lab) {
            *own -= 1;
            if *own == 0 {
                taken.remove(&self.lab);
            }
        }
    }
}

/// Work of which only so much is done at a time. Each lab has one thing in the line, so that labs take turns;
/// its others wait behind that.
#[derive(Debug)]
pub(super) struct Turns {
    all: Arc<Semaphore>,
    of_labs: Mutex<HashMap<Lab, Weak<Semaphore>>>,
    waiting: Places,
}

/// Leave to work, until it is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    // Dropped in this order: the lab's next comes into the line when this one has left it.
    _all: OwnedSemaphorePermit,
    _of_lab: OwnedSemaphorePermit,
    _waiting: Place,
}

impl Turns {
    /// So much at a time, for which so many of a lab may wait.
    pub(super) fn new(at_once: usize, waiting: usize) -> Self {
        let waiting = Places { most: usize::MAX, of_a_lab: waiting, taken: Arc::default() };
        Self { all: Arc::new(Semaphore::new(at_once)), of_labs: Mutex::default(), waiting }
    }

    /// Waits for the lab's turn.
    /// Errors: 429 if enough of the lab's waits; 503 at the end of the service.
    pub(super) async fn take(&self, lab: &Lab) -> Result<Turn> {
        let waiting = self.waiting.take(lab).ok_or_else(|| {
            ApiError::new(Code::TooManyChecks, "enough files of this lab wait to be checked")
        })?;
        let stopped = |_| ApiError::new(Code::Unavailable, "the service is shutting down");
        let of_lab = self.of_lab(lab).acquire_owned().await.map_err(stopped)?;
        let all = self.all.clone().acquire_owned().await.map_err(stopped)?;
        Ok(Turn { _all: all, _of_lab: of_lab, _waiting: waiting })
    }

    fn of_lab(&self, lab: &Lab) -> Arc<Semaphore> {
        let mut labs = self.of_labs.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = labs.get(lab).and_then(Weak::upgrade) {
            return found;
        }
        labs.retain(|_, turns| turns.strong_count() > 0);
        let new = Arc::new(Semaphore::new(1));
        labs.insert(lab.clone(), Arc::downgrade(&new));
        new
    }
}

#[cfg(test)]
mod tests {
    use super::{Lab, Places, Turns};

    fn lab(name: &str) -> Lab {
        name.parse().unwrap()
    }

    #[test]
    fn a_lab_leaves_places_for_others() {
        let places = Places::new(4);
        let (a, b, c) = (lab("a"), lab("b"), lab("c"));
        let of_a: Vec<_> = (0..3).map(|_| places.take(&a)).collect();
        assert!(of_a[1].is_some() && of_a[2].is_none(), "half of them");
        let of_b = [places.take(&b), places.take(&b)];
        assert!(of_b.iter().all(Option::is_some));
        let of_c = [places.take(&c), places.take(&c)];
        assert!(of_c[0].is_some() && of_c[1].is_none(), "one, though all are taken");
        drop(of_a);
        assert!(places.take(&c).is_some());
        assert!(Places::new(1).take(&a).is_some());
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
                assert!(turns.take(&a).await.is_err(), "three of a wait or work");
                drop(first);
            });
            order.append(&mut done.lock().unwrap());
            order
        };
        let order = line.await;
        assert_eq!(order.len(), 3);
        assert!(order[0] == "b" || order[1] == "b", "b does not wait for all of a: {order:?}");
    }
}
