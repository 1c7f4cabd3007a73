//! `/v1/events`: reports changes of jobs, calibrations and measurements, so that clients do not have to poll.
//!
//! Workers are other processes. Triggers of the database record each change, and the server reads these records when the
//! database is written to, and at least once a second.

use std::collections::{HashMap, VecDeque};
use std::convert::Infallible;
use std::sync::atomic::{AtomicI64, Ordering};
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
use engine::job::{JobId, Lab, ResourceId};
use store::{Changes, ResourceKind, Store, StoreError};

/// Longest time between two reads of the changes.
const MAX_INTERVAL: Duration = Duration::from_secs(1);
/// Shortest pause between two reads. After a slow read the pause is longer, so that reading takes at most a fifth of the time.
const MIN_PAUSE: Duration = Duration::from_millis(40);
/// Largest number of concurrent listeners. Each holds a connection.
const LISTENERS: usize = 128;
/// Largest number of identifiers in an event. With more changes, reading the list again is cheaper.
const MAX_NAMED: usize = 200;

/// Largest number of concurrent requests of a lab that wait for a result. Each holds a connection.
const WAITERS: usize = 64;
/// Part of the data of an event that does not name all changes.
const MORE: &str = "\"more\":true";

/// The data of an event.
#[derive(Debug, Default, Serialize, schemars::JsonSchema)]
pub(super) struct Change {
    changed: Vec<String>,
    deleted: Vec<String>,
    /// True if more than these have changed: read the list again.
    more: bool,
}

/// The data of the events of each lab, as JSON, for each of [`KINDS`].
type LabEvents = [HashMap<Lab, String>; 4];

/// The kinds of resources that events are about. Listeners do not get those of models; requests wait for the check of a
/// model with them.
const KINDS: [ResourceKind; 4] =
    [ResourceKind::Job, ResourceKind::Calibration, ResourceKind::Measurement, ResourceKind::Model];
/// The names of the events that listeners get, in the order of [`KINDS`].
const NAMES: [&str; 3] = ["jobs", "calibrations", "measurements"];

/// The events of all labs, with the number of the last change in them.
type Message = (i64, Arc<LabEvents>);

/// The stream of changes to which listeners subscribe.
#[derive(Debug, Clone)]
pub(super) struct Events {
    sender: broadcast::Sender<Message>,
    /// Number of the last change for which events were sent.
    last: Arc<AtomicI64>,
    store: Store,
    places: Places<Lab>,
    waiters: Waiters,
    closing: CancellationToken,
}

impl Events {
    /// Starts to watch the changes, until `closing` is cancelled.
    pub(super) fn start(store: Store, closing: CancellationToken) -> Self {
        let (sender, _) = broadcast::channel(16);
        let last = Arc::default();
        let watching = watch(store.clone(), sender.clone(), Arc::clone(&last));
        tokio::spawn(closing.clone().run_until_cancelled_owned(watching));
        let (places, waiters) = (Places::for_labs(LISTENERS), Waiters::default());
        Self { sender, last, store, places, waiters, closing }
    }

    /// Waits until a job of the lab has ended.
    pub(super) async fn ended(
        &self,
        store: &Store,
        lab: &Lab,
        job: JobId,
        time: Duration,
    ) -> Result<()> {
        let ended = || async { Ok(store.job_state(lab, job).await?.is_final()) };
        self.until(lab, time, (ResourceKind::Job, job.to_string()), ended).await
    }

    /// Waits until a calibration, measurement or model is ready or rejected.
    pub(super) async fn settled(
        &self,
        store: &Store,
        lab: &Lab,
        (what, id): (ResourceKind, ResourceId),
        time: Duration,
    ) -> Result<()> {
        let settled = || async { Ok(store.is_settled(lab, id).await?) };
        self.until(lab, time, (what, id.to_string()), settled).await
    }

    /// Waits until the uploads for a calibration, measurement or model are checked.
    pub(super) async fn checked(
        &self,
        store: &Store,
        lab: &Lab,
        (what, id): (ResourceKind, ResourceId),
        time: Duration,
    ) -> Result<()> {
        let checked = || async { Ok(store.is_checked(id).await?) };
        self.until(lab, time, (what, id.to_string()), checked).await
    }

    /// Waits until `settled` is true of the resource with this name. Returns after `time` or when the service stops, too.
    /// Checks `settled` again only after a change, so that a waiting request holds no connection to the database.
    async fn until<F: Future<Output = Result<bool>>>(
        &self,
        lab: &Lab,
        time: Duration,
        (what, name): (ResourceKind, String),
        settled: impl Fn() -> F,
    ) -> Result<()> {
        let _place = self.waiters.take(lab, time)?;
        // Subscribes before the first check, so that no change is missed in between.
        let mut receiver = self.sender.subscribe();
        let ended = async {
            while !settled().await? {
                loop {
                    match receiver.recv().await {
                        Ok((_, changes)) => {
                            let mut kinds = KINDS.iter().zip(&*changes);
                            let labs = kinds.find(|(kind, _)| **kind == what);
                            let text = labs.and_then(|(_, labs)| labs.get(lab));
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

/// The latest ends of the waiting requests of each lab.
#[derive(Debug, Clone, Default)]
struct Waiters(Arc<Mutex<HashMap<Lab, Vec<Instant>>>>);

/// A waiting request. It is counted until this is dropped.
#[derive(Debug)]
struct Waiter(Waiters, Lab, Instant);

impl Waiters {
    /// Counts a request that waits for `time` at most.
    ///
    /// Errors: 429 if enough requests of the lab wait; one of them ends within the seconds of `Retry-After`.
    fn take(&self, lab: &Lab, time: Duration) -> Result<Waiter> {
        let now = Instant::now();
        let mut waiting = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let ends = waiting.entry(lab.clone()).or_default();
        if ends.len() >= WAITERS {
            let detail = format!(
                "{WAITERS} requests of this lab are waiting already; send the request without wait"
            );
            let next = ends.iter().min().map(|end| end.saturating_duration_since(now));
            let seconds = next.unwrap_or_default().as_secs_f64().ceil().max(1.0) as u64;
            return Err(ApiError::new(Code::TooManyWaiters, detail).retry_after(seconds));
        }
        let end = now + time;
        ends.push(end);
        Ok(Waiter(self.clone(), lab.clone(), end))
    }
}

impl Drop for Waiter {
    fn drop(&mut self) {
        let mut waiting = self.0.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(ends) = waiting.get_mut(&self.1) {
            if let Some(own) = ends.iter().position(|end| *end == self.2) {
                ends.swap_remove(own);
            }
            if ends.is_empty() {
                waiting.remove(&self.1);
            }
        }
    }
}

/// Sends events of changes. `last` is the number of the last change that listeners have.
async fn watch(store: Store, sender: broadcast::Sender<Message>, last: Arc<AtomicI64>) {
    let mut watcher = store.watcher().ok();
    loop {
        let change = async {
            match &mut watcher {
                Some(watcher) => watcher.changed(MAX_INTERVAL).await.is_ok(),
                None => false,
            }
        };
        if !change.await {
            watcher = store.watcher().ok();
            tokio::time::sleep(MAX_INTERVAL).await;
        }
        let start = Instant::now();
        match send_changes(&store, &sender, last.load(Ordering::Relaxed)).await {
            Ok(number) => last.store(number, Ordering::Relaxed),
            // Other requests report a failing database.
            Err(error) => tracing::debug!(%error, "the changes can't be read"),
        }
        tokio::time::sleep(MIN_PAUSE.max(4 * start.elapsed())).await;
    }
}

/// Sends events of the changes after number `last`, and returns the number of the last change.
async fn send_changes(
    store: &Store,
    sender: &broadcast::Sender<Message>,
    last: i64,
) -> Result<i64, StoreError> {
    // The order matters: a client that subscribes after the count of receivers reads lists that include these changes.
    let newest = store.last_change().await?;
    if newest == last || sender.receiver_count() == 0 {
        return Ok(newest);
    }
    let changes = store.changes(last).await?;
    let newest = changes.last;
    // Fails only if the last listener has just disconnected.
    let _ = sender.send((newest, lab_events(store, changes).await?.into()));
    Ok(newest)
}

/// The events of all labs for these changes.
async fn lab_events(store: &Store, changes: Changes) -> Result<LabEvents, StoreError> {
    let mut by_kind: [HashMap<Lab, Change>; 4] = Default::default();
    let Some(items) = changes.items else {
        for lab in store.lab_names().await? {
            for labs in &mut by_kind {
                labs.entry(lab.clone()).or_default().more = true;
            }
        }
        return Ok(to_json(by_kind));
    };
    for item in items {
        let is_of = |kind: &ResourceKind| kind.into_str() == item.what;
        let Some(kind) = KINDS.iter().position(is_of) else { continue };
        let change = by_kind[kind].entry(item.lab).or_default();
        if item.exists { &mut change.changed } else { &mut change.deleted }.push(item.id);
    }
    Ok(to_json(by_kind))
}

/// Serializes the changes of each kind.
fn to_json(by_kind: [HashMap<Lab, Change>; 4]) -> LabEvents {
    by_kind.map(|labs| {
        let text = |(lab, change): (Lab, Change)| {
            Some((lab, serde_json::to_string(&change.limited()).ok()?))
        };
        labs.into_iter().filter_map(text).collect()
    })
}

impl Change {
    /// Sorts the identifiers, newest first, and limits their number.
    fn limited(mut self) -> Self {
        self.more |= self.changed.len() > MAX_NAMED || self.deleted.len() > MAX_NAMED;
        for list in [&mut self.changed, &mut self.deleted] {
            list.sort_unstable_by(|a, b| b.cmp(a));
            list.truncate(MAX_NAMED);
        }
        self
    }
}

pub(super) async fn listen(
    State(events): State<Events>,
    access: Access,
    headers: HeaderMap,
) -> Result<Response> {
    let place = events.places.take(&access.lab).map_err(|full| {
        let detail = "the service or this lab has too many listeners; poll the lists instead";
        ApiError::new(Code::Unavailable, detail).retry_after(full.seconds)
    })?;
    let mut listener = Listener {
        lab: access.lab,
        // Subscribes before the changes are read, so that none is missed in between.
        receiver: events.sender.subscribe(),
        last: Arc::clone(&events.last),
        last_sent: events.last.load(Ordering::Relaxed),
        closing: events.closing.clone(),
        waiting: VecDeque::new(),
        _place: place,
    };
    let last_received = headers.get("last-event-id").and_then(|id| id.to_str().ok()?.parse().ok());
    listener.start(&events.store, last_received).await?;
    let events = stream::unfold(listener, Listener::next);
    // Keeps nginx from buffering the events.
    let unbuffered: (HeaderName, &str) = (HeaderName::from_static("x-accel-buffering"), "no");
    Ok(([unbuffered], Sse::new(events).keep_alive(KeepAlive::default())).into_response())
}

struct Listener {
    lab: Lab,
    receiver: broadcast::Receiver<Message>,
    last: Arc<AtomicI64>,
    /// Number of the last change that is sent or queued.
    last_sent: i64,
    closing: CancellationToken,
    /// Events to send next.
    waiting: VecDeque<Event>,
    _place: Place<Lab>,
}

impl Listener {
    /// Queues the changes after number `last_received`, or a greeting if the database no longer has all of them.
    async fn start(&mut self, store: &Store, last_received: Option<i64>) -> Result<()> {
        if let Some(last_received) = last_received {
            let changes = store.changes(last_received).await?;
            if changes.items.is_some() {
                let last = changes.last;
                let events = lab_events(store, changes).await?;
                self.last_sent = last_received;
                self.queue(last, &events);
                return Ok(());
            }
        }
        self.waiting.push_back(hello(self.last_sent));
        Ok(())
    }

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
                Ok((number, events)) if number > self.last_sent => self.queue(number, &events),
                Ok(_) => {}
                // A slow listener has missed changes. The greeting makes it read the lists again.
                Err(broadcast::error::RecvError::Lagged(_)) => {
                    self.receiver = self.receiver.resubscribe();
                    self.last_sent = self.last.load(Ordering::Relaxed);
                    self.waiting.push_back(hello(self.last_sent));
                }
                Err(broadcast::error::RecvError::Closed) => return None,
            }
        }
    }

    /// Queues the events of the lab. Those before the last one have the number of the change before them, so that a client
    /// that reconnects before the last one gets all of them again.
    fn queue(&mut self, number: i64, lab_events: &LabEvents) {
        let before = std::mem::replace(&mut self.last_sent, number);
        let named = NAMES.into_iter().zip(lab_events);
        let mut events = named
            .filter_map(|(name, labs)| {
                Some(Event::default().event(name).data(labs.get(&self.lab)?))
            })
            .peekable();
        while let Some(event) = events.next() {
            let id = if events.peek().is_some() { before } else { number };
            self.waiting.push_back(event.id(id.to_string()));
        }
    }
}

/// The greeting, which makes a client read the lists. They include the changes up to this number.
fn hello(number: i64) -> Event {
    let change = Change { more: true, ..Change::default() };
    let text = serde_json::to_string(&change).unwrap_or_default();
    Event::default().event("hello").data(text).id(number.to_string())
}
