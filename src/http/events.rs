//! `/v1/events`: says which jobs, calibrations and measurements have changed, for those who would poll otherwise.
//!
//! Workers are other processes, so the server looks at the database once a second, as long as
//! somebody listens, and compares what it sees with what it saw before.

use std::collections::{HashMap, HashSet, VecDeque};
use std::convert::Infallible;
use std::hash::Hash;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::HeaderName;
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use serde::Serialize;
use tokio::sync::broadcast;
use tokio_util::sync::CancellationToken;

use super::access::Access;
use super::error::{ApiError, Code, Result};
use super::shares::{Place, Places};
use engine::job::{CalibrationId, JobId, Lab, MeasurementId, ModelId, ThingId};
use store::{JobMark, Made, RequestMark, Store, StoreError};

/// The longest time between two looks at all jobs.
const LOOK: Duration = Duration::from_secs(1);
/// The shortest. Where looking takes long, a fifth of the time is spent on it at most.
const SPACING: Duration = Duration::from_millis(40);
/// Listeners at the same time: each holds a connection.
const LISTENERS: usize = 128;
/// The most jobs that an event names; beyond that a list is cheaper to read again.
const NAMED: usize = 200;

/// Requests of one lab that wait for the end of something at the same time: each holds a connection.
const WAITERS: usize = 64;
/// What an event says that does not name all jobs.
const MORE: &str = "\"more\":true";

/// What listeners are told.
#[derive(Debug, Serialize)]
struct Change<Id> {
    changed: Vec<Id>,
    deleted: Vec<Id>,
    /// True if there are more than are named: read the list again.
    more: bool,
}

/// A mark of each thing that may change.
type Versions<Id, Mark> = HashMap<(Lab, Id), Mark>;

/// What each lab is told.
#[derive(Debug, Default)]
struct Told {
    jobs: HashMap<Lab, String>,
    calibrations: HashMap<Lab, String>,
    measurements: HashMap<Lab, String>,
    /// For requests that wait for the check of a model.
    models: HashMap<Lab, String>,
}

/// Which of what labs are told.
type Kind = fn(&Told) -> &HashMap<Lab, String>;

fn kind(what: Made) -> Kind {
    match what {
        Made::Job => |told| &told.jobs,
        Made::Calibration => |told| &told.calibrations,
        Made::Measurement => |told| &told.measurements,
        Made::Model | Made::Upload => |told| &told.models,
    }
}

type Changes = Arc<Told>;

/// The stream of changes to which listeners subscribe.
#[derive(Debug, Clone)]
pub(super) struct Events {
    sender: broadcast::Sender<Changes>,
    places: Places,
    waiters: Waiters,
    closing: CancellationToken,
}

impl Events {
    /// Begins to look, until `closing`.
    pub(super) fn start(store: Store, closing: CancellationToken) -> Self {
        let (sender, _) = broadcast::channel(16);
        let looking = look(store, sender.clone());
        tokio::spawn(closing.clone().run_until_cancelled_owned(looking));
        let (places, waiters) = (Places::new(LISTENERS), Waiters::default());
        Self { sender, places, waiters, closing }
    }
}

impl Events {
    /// Waits until a job of the lab has ended.
    pub(super) async fn ended(
        &self,
        store: &Store,
        lab: &Lab,
        job: JobId,
        time: Duration,
    ) -> Result<()> {
        let ended = || async { Ok(store.job_state(lab, job).await?.is_final()) };
        self.until(lab, time, (|told| &told.jobs, job.to_string()), ended).await
    }

    /// Waits until a calibration, measurement or model is there, or was refused.
    pub(super) async fn settled(
        &self,
        store: &Store,
        lab: &Lab,
        (what, id): (Made, ThingId),
        time: Duration,
    ) -> Result<()> {
        let settled = || async { Ok(store.is_settled(lab, id).await?) };
        self.until(lab, time, (kind(what), id.to_string()), settled).await
    }

    /// Waits until the uploads for a calibration, measurement or model are checked.
    pub(super) async fn checked(
        &self,
        store: &Store,
        lab: &Lab,
        (what, id): (Made, ThingId),
        time: Duration,
    ) -> Result<()> {
        let checked = || async { Ok(store.is_checked(id).await?) };
        self.until(lab, time, (kind(what), id.to_string()), checked).await
    }

    /// Waits until something of this kind and name is `settled`, at most for `time` and until the service stops. No
    /// connection to the database is held meanwhile: the looks that listeners need serve all who wait.
    async fn until<F: Future<Output = Result<bool>>>(
        &self,
        lab: &Lab,
        time: Duration,
        (kind, name): (Kind, String),
        settled: impl Fn() -> F,
    ) -> Result<()> {
        let _place = self.waiters.take(lab)?;
        // Before the first look at it, so that no change falls between them.
        let mut receiver = self.sender.subscribe();
        let ended = async {
            while !settled().await? {
                loop {
                    match receiver.recv().await {
                        Ok(changes) => {
                            let text = kind(&changes).get(lab);
                            if text.is_some_and(|text| text.contains(&name) || text.contains(MORE))
                            {
                                break;
                            }
                        }
                        Err(broadcast::error::RecvError::Lagged(_)) => break,
                        Err(broadcast::error::RecvError::Closed) => return Ok(()),
                    }
                }
            }
            Ok(())
        };
        tokio::select! {
            ended = ended => ended,
            () = tokio::time::sleep(time) => Ok(()),
            () = self.closing.cancelled() => Ok(()),
        }
    }
}

/// How many requests of each lab wait for the end of something.
#[derive(Debug, Clone, Default)]
struct Waiters(Arc<Mutex<HashMap<Lab, usize>>>);

/// The place of a request that waits, until it is dropped.
#[derive(Debug)]
struct Waiter(Waiters, Lab);

impl Waiters {
    fn take(&self, lab: &Lab) -> Result<Waiter> {
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let own = waiting.entry(lab.clone()).or_default();
        if *own >= WAITERS {
            let detail = format!("{WAITERS} requests of this lab wait; ask without wait");
            return Err(ApiError::new(Code::TooManyWaiters, detail));
        }
        *own += 1;
        Ok(Waiter(self.clone(), lab.clone()))
    }
}

impl Drop for Waiter {
    fn drop(&mut self) {
        let mut waiting = self.0.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(own) = waiting.get_mut(&self.1) {
            *own -= 1;
            if *own == 0 {
                waiting.remove(&self.1);
            }
        }
    }
}

/// What was last seen.
struct Marks {
    jobs: Versions<JobId, JobMark>,
    calibrations: Versions<CalibrationId, RequestMark>,
    measurements: Versions<MeasurementId, RequestMark>,
    models: Versions<ModelId, RequestMark>,
}

async fn marks(store: &Store) -> Result<Marks, StoreError> {
    Ok(Marks {
        jobs: store.job_marks().await?,
        calibrations: store.request_marks(Made::Calibration).await?,
        measurements: store.request_marks(Made::Measurement).await?,
        models: store.request_marks(Made::Model).await?,
    })
}

async fn look(store: Store, sender: broadcast::Sender<Changes>) {
    let mut before: Option<Marks> = None;
    let mut watcher = store.watcher().ok();
    loop {
        let change = async {
            match &mut watcher {
                Some(watcher) => watcher.changed(LOOK).await.is_ok(),
                None => false,
            }
        };
        if !change.await {
            watcher = store.watcher().ok();
            tokio::time::sleep(LOOK).await;
        }
        let start = Instant::now();
        if sender.receiver_count() == 0 {
            before = None;
            continue;
        }
        // A failing database shows in every other answer, too.
        let Ok(now) = marks(&store).await else { continue };
        let told = match &before {
            Some(before) => Told {
                jobs: changes(&before.jobs, &now.jobs),
                calibrations: changes(&before.calibrations, &now.calibrations),
                measurements: changes(&before.measurements, &now.measurements),
                models: changes(&before.models, &now.models),
            },
            // What changed between the greeting and this first look is not known.
            None => Told {
                jobs: everything(&now.jobs),
                calibrations: everything(&now.calibrations),
                measurements: everything(&now.measurements),
                models: everything(&now.models),
            },
        };
        if [&told.jobs, &told.calibrations, &told.measurements, &told.models]
            .iter()
            .any(|told| !told.is_empty())
        {
            // Fails only if the last listener has just gone.
            let _ = sender.send(told.into());
        }
        before = Some(now);
        tokio::time::sleep(SPACING.max(4 * start.elapsed())).await;
    }
}

/// What differs, for each lab for which anything does.
fn changes<Id: Copy + Ord + Hash + Serialize, Mark: PartialEq>(
    before: &Versions<Id, Mark>,
    now: &Versions<Id, Mark>,
) -> HashMap<Lab, String> {
    let mut changes: HashMap<&Lab, Change<Id>> = HashMap::new();
    for ((lab, id), _) in now.iter().filter(|(id, version)| before.get(id) != Some(version)) {
        changes.entry(lab).or_default().changed.push(*id);
    }
    for (lab, id) in before.keys().filter(|id| !now.contains_key(id)) {
        changes.entry(lab).or_default().deleted.push(*id);
    }
    told(changes.into_iter().map(|(lab, change)| (lab, change.cut())))
}

/// Has every lab that has such things read its list again.
fn everything<Id: Serialize, Mark>(now: &Versions<Id, Mark>) -> HashMap<Lab, String> {
    let labs: HashSet<&Lab> = now.keys().map(|(lab, _)| lab).collect();
    told(labs.into_iter().map(|lab| (lab, Change::<Id> { more: true, ..Change::default() })))
}

fn told<'a, Id: Serialize>(
    changes: impl Iterator<Item = (&'a Lab, Change<Id>)>,
) -> HashMap<Lab, String> {
    let text = |(lab, change): (&Lab, Change<Id>)| {
        Some((lab.clone(), serde_json::to_string(&change).ok()?))
    };
    changes.filter_map(text).collect()
}

impl<Id> Default for Change<Id> {
    fn default() -> Self {
        Self { changed: Vec::new(), deleted: Vec::new(), more: false }
    }
}

impl<Id: Ord> Change<Id> {
    /// Newest first, and no more than are named.
    fn cut(mut self) -> Self {
        self.more = self.changed.len() > NAMED || self.deleted.len() > NAMED;
        for list in [&mut self.changed, &mut self.deleted] {
            list.sort_unstable_by(|a, b| b.cmp(a));
            list.truncate(NAMED);
        }
        self
    }
}

pub(super) async fn listen(State(events): State<Events>, access: Access) -> Result<Response> {
    let place = events.places.take(&access.lab).ok_or_else(|| {
        let detail = "all places for listeners are taken, or this lab has its share; poll instead";
        ApiError::new(Code::Unavailable, detail)
    })?;
    let listener = Listener {
        lab: access.lab,
        receiver: events.sender.subscribe(),
        closing: events.closing.clone(),
        waiting: VecDeque::from([hello()]),
        _place: place,
    };
    let events = stream::unfold(listener, Listener::next);
    // Proxies must not gather events into larger packets.
    let unbuffered: (HeaderName, &str) = (HeaderName::from_static("x-accel-buffering"), "no");
    Ok(([unbuffered], Sse::new(events).keep_alive(KeepAlive::default())).into_response())
}

struct Listener {
    lab: Lab,
    receiver: broadcast::Receiver<Changes>,
    closing: CancellationToken,
    /// What it is told next.
    waiting: VecDeque<Event>,
    _place: Place,
}

impl Listener {
    async fn next(mut self) -> Option<(Result<Event, Infallible>, Self)> {
        loop {
            if let Some(event) = self.waiting.pop_front() {
                return Some((Ok(event), self));
            }
            let received = tokio::select! {
                received = self.receiver.recv() => received,
                () = self.closing.cancelled() => return None,
            };
            match received {
                Ok(changes) => {
                    let kinds = [
                        ("jobs", &changes.jobs),
                        ("calibrations", &changes.calibrations),
                        ("measurements", &changes.measurements),
                    ];
                    for (name, told) in kinds {
                        let text = told.get(&self.lab);
                        self.waiting
                            .extend(text.map(|text| Event::default().event(name).data(text)));
                    }
                }
                // A slow listener has missed some: it must read the list again.
                Err(broadcast::error::RecvError::Lagged(_)) => {
                    self.waiting.push_back(hello());
                }
                Err(broadcast::error::RecvError::Closed) => return None,
            }
        }
    }
}

/// Has a listener read the lists.
fn hello() -> Event {
    Event::default().event("hello").data("{}")
}
