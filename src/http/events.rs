//! `/v1/events`: says which jobs, calibrations and measurements have changed, for those who would poll otherwise.
//!
//! Workers are other processes, so the server reads the changes that triggers note in the database: when it is
//! written, and once a second.

use std::collections::{HashMap, VecDeque};
use std::convert::Infallible;
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
use engine::job::{JobId, Lab, ThingId};
use store::{Changes, Made, Store, StoreError};

/// The longest time between two looks at the changes.
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

/// The data of an event.
#[derive(Debug, Default, Serialize)]
struct Change {
    changed: Vec<String>,
    deleted: Vec<String>,
    /// True if there are more than are named: read the list again.
    more: bool,
}

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

type Message = Arc<Told>;

/// The stream of changes to which listeners subscribe.
#[derive(Debug, Clone)]
pub(super) struct Events {
    sender: broadcast::Sender<Message>,
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

async fn look(store: Store, sender: broadcast::Sender<Message>) {
    // Number of the last change that needs no event.
    let mut last = 0;
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
        match next(&store, &sender, last).await {
            Ok(seen) => last = seen,
            // A failing database shows in every other answer, too.
            Err(error) => tracing::debug!(%error, "the changes can't be read"),
        }
        tokio::time::sleep(SPACING.max(4 * start.elapsed())).await;
    }
}

/// Sends the changes after the one with the number `last`; returns the number of the last change that it has seen.
async fn next(
    store: &Store,
    sender: &broadcast::Sender<Message>,
    last: i64,
) -> Result<i64, StoreError> {
    // In this order: a listener that subscribes after the second line has read lists with these changes.
    let seen = store.last_change().await?;
    if seen == last || sender.receiver_count() == 0 {
        return Ok(seen);
    }
    let changes = store.changes(last).await?;
    let seen = changes.last;
    // Fails only if the last listener has just left.
    let _ = sender.send(message(store, changes).await?.into());
    Ok(seen)
}

/// The events of all labs.
async fn message(store: &Store, changes: Changes) -> Result<Told, StoreError> {
    let mut by_kind: [HashMap<Lab, Change>; 4] = Default::default();
    let Some(items) = changes.items else {
        for lab in store.lab_names().await? {
            for labs in &mut by_kind {
                labs.entry(lab.clone()).or_default().more = true;
            }
        }
        return Ok(texts(by_kind));
    };
    for item in items {
        let kind = match item.what.as_str() {
            "job" => 0,
            "calibration" => 1,
            "measurement" => 2,
            _ => 3,
        };
        let change = by_kind[kind].entry(item.lab).or_default();
        if item.exists { &mut change.changed } else { &mut change.deleted }.push(item.id);
    }
    Ok(texts(by_kind))
}

fn texts(by_kind: [HashMap<Lab, Change>; 4]) -> Told {
    let [jobs, calibrations, measurements, models] = by_kind.map(|labs| {
        let text =
            |(lab, change): (Lab, Change)| Some((lab, serde_json::to_string(&change.cut()).ok()?));
        labs.into_iter().filter_map(text).collect()
    });
    Told { jobs, calibrations, measurements, models }
}

impl Change {
    /// Newest first, and no more than are named.
    fn cut(mut self) -> Self {
        self.more |= self.changed.len() > NAMED || self.deleted.len() > NAMED;
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
    receiver: broadcast::Receiver<Message>,
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
