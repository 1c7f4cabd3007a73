//! `/v1/events`: names jobs, calibrations and measurements that have changed, in place of polling.
//!
//! Workers are other processes, so the server looks at the database once a second, as long as
//! somebody listens, and compares what it sees with what it saw before.

use std::collections::{HashMap, HashSet, VecDeque};
use std::convert::Infallible;
use std::fmt;
use std::hash::Hash;
use std::str::FromStr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::{HeaderMap, HeaderName};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream;
use serde::Serialize;
use tokio::sync::broadcast;
use tokio_util::sync::CancellationToken;

use super::access::Access;
use super::error::{ApiError, Code, Result};
use super::shares::{Place, Places};
use engine::job::{CalibrationId, JobId, Lab, MeasurementId, ModelId, ThingId, Timestamp};
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
/// Looks with changes that are remembered for listeners that come back.
const REMEMBERED: usize = 256;
/// Time without a listener after which changes are no longer followed.
const GRACE: Duration = Duration::from_secs(60);
/// What an event says that does not name all jobs.
const MORE: &str = "\"more\":true";

/// The data of an event.
#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "Change")]
pub(super) struct Change<Id> {
    changed: Vec<Id>,
    deleted: Vec<Id>,
    /// True if more than these have changed: read the list again.
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

/// The place of changes in the stream. The epoch differs between streams that have a gap between them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Position {
    epoch: i64,
    number: u64,
}

impl fmt::Display for Position {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.epoch, self.number)
    }
}

impl FromStr for Position {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        let (epoch, number) = text.split_once('-').ok_or(())?;
        let epoch = epoch.parse().map_err(|_| ())?;
        Ok(Self { epoch, number: number.parse().map_err(|_| ())? })
    }
}

/// The changes of the last minutes, for listeners that come back.
#[derive(Debug)]
struct History {
    /// The position of the last changes.
    last: Position,
    changes: VecDeque<Changes>,
}

impl History {
    fn new() -> Self {
        let last = Position { epoch: Timestamp::now().0, number: 0 };
        Self { last, changes: VecDeque::new() }
    }

    fn push(&mut self, changes: Changes) -> Position {
        self.last.number += 1;
        self.changes.push_back(changes);
        if self.changes.len() > REMEMBERED {
            self.changes.pop_front();
        }
        self.last
    }

    /// The changes after a position, each with its own; none if some of them are forgotten.
    fn since(&self, seen: Position) -> Option<Vec<(Position, Changes)>> {
        let missed = self.last.number.checked_sub(seen.number)?;
        let missed = usize::try_from(missed).ok()?;
        let known = seen.epoch == self.last.epoch && missed <= self.changes.len();
        let first = self.changes.len().checked_sub(missed).filter(|_| known)?;
        let numbered = (seen.number + 1..).zip(self.changes.iter().skip(first));
        let place = |number| Position { number, ..self.last };
        Some(numbered.map(|(number, changes)| (place(number), changes.clone())).collect())
    }
}

/// The stream of changes to which listeners subscribe.
#[derive(Debug, Clone)]
pub(super) struct Events {
    sender: broadcast::Sender<(Position, Changes)>,
    history: Arc<Mutex<History>>,
    places: Places,
    waiters: Waiters,
    closing: CancellationToken,
}

impl Events {
    /// Begins to look, until `closing`.
    pub(super) fn start(store: Store, closing: CancellationToken) -> Self {
        let (sender, _) = broadcast::channel(16);
        let history = Arc::new(Mutex::new(History::new()));
        let looking = look(store, sender.clone(), history.clone());
        tokio::spawn(closing.clone().run_until_cancelled_owned(looking));
        let (places, waiters) = (Places::new(LISTENERS), Waiters::default());
        Self { sender, history, places, waiters, closing }
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
                        Ok((_, changes)) => {
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

async fn look(
    store: Store,
    sender: broadcast::Sender<(Position, Changes)>,
    history: Arc<Mutex<History>>,
) {
    let mut before: Option<Marks> = None;
    let mut heard: Option<Instant> = None;
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
        if sender.receiver_count() > 0 {
            heard = Some(start);
        } else if heard.is_none_or(|heard| heard.elapsed() > GRACE) {
            // Changes are no longer followed, so nobody can go on from here.
            if before.take().is_some() {
                *history.lock().unwrap_or_else(PoisonError::into_inner) = History::new();
            }
            continue;
        }
        // A failing database shows in every other answer, too.
        let Ok(now) = marks(&store).await else { continue };
        let news = match &before {
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
        if [&news.jobs, &news.calibrations, &news.measurements, &news.models]
            .iter()
            .any(|told| !told.is_empty())
        {
            let news: Changes = news.into();
            // Under the lock, so that a new listener gets each change once.
            let mut history = history.lock().unwrap_or_else(PoisonError::into_inner);
            let position = history.push(news.clone());
            // Fails only if nobody listens at the moment.
            let _ = sender.send((position, news));
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

pub(super) async fn listen(
    State(events): State<Events>,
    access: Access,
    headers: HeaderMap,
) -> Result<Response> {
    let place = events.places.take(&access.lab).ok_or_else(|| {
        let detail = "all places for listeners are taken, or this lab has its share; poll instead";
        ApiError::new(Code::Unavailable, detail)
    })?;
    let seen = headers.get("last-event-id").and_then(|id| id.to_str().ok()?.parse().ok());
    let (receiver, last, missed) = {
        let history = events.history.lock().unwrap_or_else(PoisonError::into_inner);
        (events.sender.subscribe(), history.last, seen.and_then(|seen| history.since(seen)))
    };
    let mut listener = Listener {
        lab: access.lab,
        receiver,
        history: events.history.clone(),
        closing: events.closing.clone(),
        waiting: VecDeque::new(),
        _place: place,
    };
    match missed {
        Some(missed) => {
            missed.iter().for_each(|(position, changes)| listener.queue(*position, changes));
        }
        None => listener.waiting.push_back(hello(last)),
    }
    let events = stream::unfold(listener, Listener::next);
    // Proxies must not gather events into larger packets.
    let unbuffered: (HeaderName, &str) = (HeaderName::from_static("x-accel-buffering"), "no");
    Ok(([unbuffered], Sse::new(events).keep_alive(KeepAlive::default())).into_response())
}

struct Listener {
    lab: Lab,
    receiver: broadcast::Receiver<(Position, Changes)>,
    history: Arc<Mutex<History>>,
    closing: CancellationToken,
    /// Events to send next.
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
                Ok((position, changes)) => self.queue(position, &changes),
                // A slow listener has missed some changes: it must read the lists again.
                Err(broadcast::error::RecvError::Lagged(_)) => {
                    let last = {
                        let history = self.history.lock().unwrap_or_else(PoisonError::into_inner);
                        self.receiver = self.receiver.resubscribe();
                        history.last
                    };
                    self.waiting.push_back(hello(last));
                }
                Err(broadcast::error::RecvError::Closed) => return None,
            }
        }
    }

    /// Queues the events of the lab. The last one has the position: a connection that breaks between them gets all
    /// of them again.
    fn queue(&mut self, position: Position, changes: &Told) {
        let kinds = [
            ("jobs", &changes.jobs),
            ("calibrations", &changes.calibrations),
            ("measurements", &changes.measurements),
        ];
        let events = kinds.into_iter().filter_map(|(name, told)| {
            Some(Event::default().event(name).data(told.get(&self.lab)?))
        });
        let mut events: Vec<Event> = events.collect();
        if let Some(last) = events.pop() {
            events.push(last.id(position.to_string()));
        }
        self.waiting.extend(events);
    }
}

/// Has a listener read the lists, which are at least as new as `position`.
fn hello(position: Position) -> Event {
    Event::default().event("hello").data("{}").id(position.to_string())
}

#[cfg(test)]
mod tests {
    use super::{History, Position, Told};

    #[test]
    fn a_listener_resumes_or_starts_again() {
        let mut history = History::new();
        let start = history.last;
        for _ in 0..super::REMEMBERED + 2 {
            history.push(Told::default().into());
        }
        let last = history.last;
        let numbers = |seen| {
            let since = history.since(seen)?;
            Some(since.into_iter().map(|(at, _)| at.number).collect::<Vec<_>>())
        };
        assert_eq!(numbers(last), Some(vec![]));
        let two_before = Position { number: last.number - 2, ..last };
        assert_eq!(numbers(two_before), Some(vec![last.number - 1, last.number]));
        assert_eq!(numbers(start), None, "some changes are forgotten");
        assert_eq!(numbers(Position { epoch: last.epoch - 1, ..last }), None);
        assert_eq!(numbers(Position { number: last.number + 1, ..last }), None);
        assert_eq!(last.to_string().parse(), Ok(last));
    }
}
