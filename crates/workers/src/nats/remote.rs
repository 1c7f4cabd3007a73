//! The transport of a worker on another machine, which computes tiles only.

use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use async_nats::Subscriber;
use async_nats::jetstream::consumer::PullConsumer;
use async_nats::jetstream::message::PublishMessage;
use async_nats::jetstream::{AckKind, Message};
use futures_util::StreamExt;
use ndarray::Array3;
use serde::{Deserialize, Serialize};
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tokio_util::sync::CancellationToken;

use super::blobs::BlobError;
use super::cache::Cache;
use super::connection::{Access, ClusterError, Connection, Credential};
use super::message::{
    Beat, Begin, BeginAnswer, End, Event, Hello, HelloAnswer, Input, InputRequest, Notice, Program,
    TaskMessage, TileBeat,
};
use super::{arrays, names};
use crate::transport::{Claim, Done, Output, TaskInput, TileTask, Transport, TransportError};
use engine::job::{Pool, Sha256, TaskProgress, WorkerId};
use engine::pipeline::PipelineError;
use engine::pipeline::networks::ModelFile;
use engine::pipeline::tile::TileInput;
use formats::FormatError;
use store::{Heartbeat, Lease};

/// The supervisor's description of a process that was killed from outside.
const KILLED: &str = "killed";
/// Time that a request for a tile waits at the message server.
const PULL: Duration = Duration::from_secs(5);
/// Timeout of the question whether to begin. Workers go on while the server is down.
const BEGIN: Duration = Duration::from_secs(1);
/// Time between two signs of life of an idle worker.
const SIGN: Duration = Duration::from_secs(5);
/// Pause before a failed request or fetch is repeated.
const RETRY_PAUSE: Duration = Duration::from_millis(500);
/// Milliseconds until a tile that another worker must compute is offered again. The pause is random. Otherwise two
/// idle workers could exchange each other's refused tiles forever.
const REFUSAL_PAUSE: std::ops::Range<u64> = 200..2000;
/// Time for which the worker tries to report the end of a tile.
const REPORT_TIME: Duration = Duration::from_secs(600);
/// Time for which a worker that was asked to stop tries to report the end of a tile.
const STOP_REPORT_TIME: Duration = Duration::from_secs(3);

/// Settings of a worker on another machine.
#[derive(Debug, Clone)]
pub struct RemoteSettings {
    /// The build of this worker.
    pub program: Program,
    /// Addresses of the message server, separated by commas. The default is those in the credential.
    pub urls: Option<String>,
    /// The file with the credential. A server that is open to all needs none.
    pub credential: Option<PathBuf>,
    /// The pool. The default is that of the credential.
    pub pool: Option<Pool>,
    /// The folder of the cache, and its limit in bytes.
    pub cache: (PathBuf, u64),
    /// The device that computes, for the list of workers.
    pub device: String,
    /// Time to wait for a missing input.
    pub patience: Duration,
    /// Time without a tile after which the worker ends. The default is never.
    pub idle: Option<Duration>,
    /// The file that names the current tile, for the next process of this worker.
    pub hand: Option<PathBuf>,
    /// Cause of death of the previous process of this worker.
    pub died: Option<String>,
}

/// The current tile, as the next process reports it if this one dies.
#[derive(Debug, Serialize, Deserialize)]
struct Hand {
    event: Event,
    /// Subject that acknowledges the tile's message.
    acknowledge: String,
}

/// A worker's connection to the hub and its cache.
#[derive(Debug, Clone)]
pub struct Remote(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    connection: Connection,
    pool: Pool,
    hello: Hello,
    ack_wait: Duration,
    consumer: PullConsumer,
    cache: Mutex<Cache>,
    patience: Duration,
    idle: Option<Duration>,
    hand: Option<PathBuf>,
    stop: CancellationToken,
    runtime: Handle,
    /// The current tile, and the time of the last change from or to a tile.
    held: Mutex<(Option<Arc<Held>>, Instant)>,
}

/// The tile that this worker computes.
#[derive(Debug)]
struct Held {
    task: TaskMessage,
    /// The attempt number that the hub assigned.
    attempt: u32,
    begin: Begin,
    message: Message,
    /// The hub's last notice about the tile.
    notice: watch::Sender<Heartbeat>,
    /// The solver's history so far.
    history: Mutex<Option<String>>,
    /// Time of the last sign of work that the message server confirmed.
    confirmed: Mutex<Instant>,
    /// The task that sends signs of work.
    keeper: Mutex<Option<AbortHandle>>,
}

impl Drop for Held {
    fn drop(&mut self) {
        if let Some(keeper) = lock(&self.keeper).take() {
            keeper.abort();
        }
    }
}

/// The worker's right to its tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ownership {
    Held,
    /// This worker was silent for long, and the hub does not answer.
    Unknown,
    Lost,
}

impl Remote {
    /// Connects and introduces the worker. Waits for a server that has not started yet. Returns `None` if `stop` was
    /// cancelled, or the idle time is over, before the server answered.
    /// Errors: the settings are invalid, the message server does not answer, or the server refuses the worker.
    pub async fn open(
        settings: RemoteSettings,
        worker: WorkerId,
        stop: CancellationToken,
    ) -> Result<Option<Self>, ClusterError> {
        let credential = match &settings.credential {
            Some(path) => Credential::read(path)?,
            None => Credential::default(),
        };
        let pool =
            settings.pool.or(credential.pool().cloned()).ok_or(ClusterError::Credential {
                path: "file".into(),
                reason: "it names no pool: state one with --pool".into(),
            })?;
        let cache = Cache::open(&settings.cache.0, settings.cache.1)?;
        let hello = Hello::new(worker, settings.device, settings.program);
        let name = format!("sci-recon worker {}", hello.host);
        let connection =
            Access::new(settings.urls.as_deref(), &credential, &name)?.connect().await?;
        let notices = connection.client.subscribe(names::notice(&pool, worker)).await;
        let notices = notices.map_err(ClusterError::nats("listen to the server"))?;
        let (start, mut pause) = (Instant::now(), RETRY_PAUSE);
        let ack_wait = loop {
            if let Some(ack_wait) = introduce(&connection, &pool, &hello).await? {
                break ack_wait;
            }
            if let Some(refusal) = connection.refusal() {
                return Err(refusal);
            }
            if settings.idle.is_some_and(|idle| start.elapsed() > idle) {
                tracing::info!("no server has answered: the worker ends");
                return Ok(None);
            }
            tokio::select! {
                () = stop.cancelled() => return Ok(None),
                () = tokio::time::sleep(pause) => pause = SIGN.min(2 * pause),
            }
        };
        let consumer = connection.pool(&pool).await?;
        let inner = Inner {
            connection,
            pool,
            hello,
            ack_wait,
            consumer,
            cache: Mutex::new(cache),
            patience: settings.patience,
            idle: settings.idle,
            hand: settings.hand,
            stop,
            runtime: Handle::current(),
            held: Mutex::new((None, Instant::now())),
        };
        let remote = Self(Arc::new(inner));
        if let Some(how) = settings.died {
            remote.report_death(how).await;
        }
        tokio::spawn(remote.clone().listen(notices));
        tokio::spawn(remote.clone().send_signs());
        Ok(Some(remote))
    }

    /// Reports that the worker leaves.
    pub async fn leave(&self) {
        let beat = Beat { worker: self.0.hello.worker, tile: None, leaves: true };
        let sent = async {
            self.send("beat", &beat).await?;
            let flushed = self.0.connection.client.flush().await;
            flushed.map_err(ClusterError::nats("report that the worker leaves"))
        };
        // Without a connection, sending waits until there is one.
        if !tokio::time::timeout(BEGIN, sent).await.is_ok_and(|sent| sent.is_ok()) {
            tracing::debug!("the farewell was not sent: the server drops the worker after a while");
        }
    }

    /// Sends a message of this kind to the hub, outside the streams.
    async fn send(&self, kind: &str, message: &impl serde::Serialize) -> Result<(), ClusterError> {
        self.0.connection.publish(names::ask(kind, &self.0.pool), message).await
    }

    /// Handles the hub's notices.
    async fn listen(self, mut notices: Subscriber) {
        while let Some(message) = notices.next().await {
            let (about, answer) = match serde_json::from_slice(&message.payload) {
                Ok(Notice::Cancel { task, attempt }) => ((task, attempt), Heartbeat::Cancelled),
                Ok(Notice::Lost { task, attempt }) => ((task, attempt), Heartbeat::Lost),
                Ok(Notice::Introduce) => {
                    let Inner { connection, pool, hello, stop, .. } = &*self.0;
                    if let Err(error) = introduce(connection, pool, hello).await {
                        tracing::error!(%error, "the worker ends");
                        stop.cancel();
                    }
                    continue;
                }
                Err(error) => {
                    tracing::warn!(%error, "a notice of the server can't be read");
                    continue;
                }
            };
            if let Some(held) = self.held()
                && about == (held.task.task, held.attempt)
            {
                held.notice.send_replace(answer);
            }
        }
    }

    /// The reason why the worker has ended, if the message server refuses its credential.
    #[must_use]
    pub fn refusal(&self) -> Option<ClusterError> {
        self.0.connection.refusal()
    }

    async fn send_signs(self) {
        while !self.0.stop.is_cancelled() {
            if self.refusal().is_some() {
                return self.0.stop.cancel();
            }
            if self.held().is_none() {
                let beat = Beat { worker: self.0.hello.worker, tile: None, leaves: false };
                if let Err(error) = self.send("beat", &beat).await {
                    tracing::warn!(%error, "a sign of life could not be sent");
                }
            }
            tokio::time::sleep(SIGN).await;
        }
    }

    fn held(&self) -> Option<Arc<Held>> {
        lock(&self.0.held).0.clone()
    }

    /// Reports that the previous process died with a tile, and the cause.
    async fn report_death(&self, cause: String) {
        let Some(path) = &self.0.hand else { return };
        let text = std::fs::read(path).ok();
        let hand: Option<Hand> = text.and_then(|text| serde_json::from_slice(&text).ok());
        let Some(Hand { mut event, acknowledge }) = hand else { return };
        if let End::Died { how, fault } = &mut event.end {
            *fault = cause != KILLED;
            *how = cause;
        }
        let reported = self.publish(&event).await;
        let acked = self.0.connection.client.publish(acknowledge, "+ACK".into()).await;
        if reported.is_err() || acked.is_err() {
            tracing::warn!(
                "the death of the previous process is not reported: its tile is delivered again after a while"
            );
        }
        self.note_hand(None);
    }

    /// Records the current tile and its message in a file, for the next process.
    fn note_hand(&self, held: Option<(&Begin, &Message)>) {
        let Some(path) = &self.0.hand else { return };
        let noted = match held {
            None => match std::fs::remove_file(path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
                _ => Ok(()),
            },
            Some((&Begin { task, attempt, seq, delivery, worker }, message)) => {
                let end = End::Died { how: String::new(), fault: false };
                let event = Event { task, attempt, worker, seq, delivery, end };
                let acknowledge = message.reply.as_ref().map_or("", |to| to.as_str()).to_owned();
                let text = serde_json::to_vec(&Hand { event, acknowledge });
                text.map_err(io::Error::other).and_then(|text| std::fs::write(path, text))
            }
        };
        if let Err(error) = noted {
            tracing::warn!(%error, "the current tile can't be recorded");
        }
    }

    fn hold(&self, held: Option<Arc<Held>>) {
        let begin = held.as_ref().map(|held| Begin { attempt: held.attempt, ..held.begin });
        self.note_hand(begin.as_ref().zip(held.as_ref().map(|held| &held.message)));
        let mut current = lock(&self.0.held);
        if current.0.is_some() || held.is_some() {
            *current = (held, Instant::now());
        }
    }

    /// Pulls the next message. Returns `None` if none arrives within [`PULL`].
    async fn pull(&self) -> Result<Option<Message>, TransportError> {
        let batch = self.0.consumer.batch().max_messages(1).expires(PULL).messages();
        let next = async { batch.await?.next().await.transpose() };
        // The server may forget a pull when the stream's leader changes.
        match tokio::time::timeout(PULL + BEGIN, next).await {
            Ok(message) => message,
            Err(_) => Ok(None),
        }
    }

    /// Asks the hub whether to begin. Returns `None` if it does not answer.
    async fn ask(&self, begin: &Begin) -> Option<BeginAnswer> {
        let text = serde_json::to_vec(begin).ok()?;
        let asked =
            self.0.connection.client.request(names::ask("begin", &self.0.pool), text.into());
        let answer = tokio::time::timeout(BEGIN, asked).await.ok()?.ok()?;
        serde_json::from_slice(&answer.payload).ok()
    }

    /// Begins with the tile of a message, unless the hub declines.
    async fn begin(&self, message: Message) -> Result<Option<Claim>, TransportError> {
        let (seq, delivery) = {
            let info = message.info()?;
            (i64::try_from(info.stream_sequence)?, u32::try_from(info.delivered)?)
        };
        let task: TaskMessage = match serde_json::from_slice(&message.payload) {
            Ok(task) => task,
            Err(error) => {
                // The hub's sweep then finds the message missing.
                message.ack_with(AckKind::Term).await?;
                return Err(format!("a tile's message can't be read: {error}").into());
            }
        };
        let worker = self.0.hello.worker;
        let begin = Begin { task: task.task, attempt: task.attempt, seq, delivery, worker };
        // Recorded before the hub relies on this process. Otherwise its death would not be noticed.
        self.note_hand(Some((&begin, &message)));
        let attempt = match self.ask(&begin).await {
            Some(BeginAnswer::Go(attempt)) => attempt,
            Some(BeginAnswer::Lost) => {
                self.note_hand(None);
                return Ok(None);
            }
            Some(BeginAnswer::Another) => {
                self.note_hand(None);
                let pause = Duration::from_millis(rand::random_range(REFUSAL_PAUSE));
                message.ack_with(AckKind::Nak(Some(pause))).await?;
                return Ok(None);
            }
            Some(BeginAnswer::Over) => {
                self.note_hand(None);
                message.double_ack().await?;
                return Ok(None);
            }
            None => {
                tracing::warn!("the server does not answer: the worker continues without it");
                task.attempt
            }
        };
        let span = tracing::info_span!("task", job = %task.job, kind = "tile", task = %task.task);
        let lease = Lease { task: task.task, attempt, worker, length: self.0.ack_wait };
        let claim = Claim {
            lease,
            span,
            cost: task.cost,
            input: Ok(TaskInput::Tile(Box::new(task.tile.clone()))),
        };
        let held = Arc::new(Held {
            task,
            attempt,
            begin,
            message,
            notice: watch::Sender::new(Heartbeat::Continue),
            history: Mutex::default(),
            confirmed: Mutex::new(Instant::now()),
            keeper: Mutex::new(None),
        });
        let weak = Arc::downgrade(&held);
        let pause = self.0.ack_wait / 6;
        let keeper = tokio::spawn(async move {
            loop {
                tokio::time::sleep(pause).await;
                let Some(held) = weak.upgrade() else { return };
                let sent = Instant::now();
                match held.message.double_ack_with(AckKind::Progress).await {
                    Ok(()) => *lock(&held.confirmed) = sent,
                    Err(error) => tracing::warn!(%error, "a sign of work is not confirmed"),
                }
            }
        });
        *lock(&held.keeper) = Some(keeper.abort_handle());
        self.hold(Some(held));
        Ok(Some(claim))
    }

    /// The current tile, if the lease is for it.
    fn held_for(&self, lease: &Lease) -> Result<Arc<Held>, TransportError> {
        let held = self
            .held()
            .filter(|held| (held.task.task, held.attempt) == (lease.task, lease.attempt));
        held.ok_or_else(|| "this worker no longer holds the tile".into())
    }

    /// Determines whether the worker still owns its tile. After a long suspension, the message may have been delivered
    /// to another worker.
    async fn ownership(&self, held: &Held) -> Ownership {
        if lock(&held.confirmed).elapsed() < self.0.ack_wait {
            return Ownership::Held;
        }
        match self.ask(&held.begin).await {
            Some(BeginAnswer::Go(_) | BeginAnswer::Over) => Ownership::Held,
            Some(BeginAnswer::Lost | BeginAnswer::Another) => Ownership::Lost,
            None => Ownership::Unknown,
        }
    }

    /// Reports the end of a tile, and acknowledges its message.
    async fn end(&self, lease: &Lease, end: End) -> Result<Heartbeat, TransportError> {
        let held = self.held_for(lease)?;
        let ownership = self.ownership(&held).await;
        if ownership == Ownership::Lost {
            self.hold(None);
            return Ok(Heartbeat::Lost);
        }
        let Begin { seq, delivery, .. } = held.begin;
        let Lease { task, attempt, worker, .. } = *lease;
        let event = Event { task, attempt, worker, seq, delivery, end };
        self.publish(&event).await?;
        if ownership == Ownership::Held {
            let acknowledged = self.persist(|| async {
                let acked = held.message.double_ack().await;
                acked.map_err(ClusterError::nats("acknowledge the message"))
            });
            if let Err(error) = acknowledged.await {
                // The message is delivered again, and the hub answers that the tile is done.
                tracing::warn!(%error, "the tile's message is not acknowledged");
            }
        }
        self.hold(None);
        Ok(Heartbeat::Continue)
    }

    /// Publishes an event, and waits until it is stored.
    async fn publish(&self, event: &Event) -> Result<(), TransportError> {
        let text = serde_json::to_vec(event)?;
        let id = format!("{}.{}.{}", event.task, event.attempt, event.worker);
        self.persist(|| async {
            let message = PublishMessage::build().message_id(&id).payload(text.clone().into());
            let failed = ClusterError::nats("report the end of a tile");
            let context = &self.0.connection.context;
            let sent = context.send_publish(names::event(&self.0.pool), message).await;
            sent.map_err(&failed)?.await.map_err(&failed)
        })
        .await?;
        Ok(())
    }

    /// Repeats an action until it succeeds or the time is over.
    async fn persist<T, F>(&self, mut action: impl FnMut() -> F) -> Result<T, ClusterError>
    where
        F: Future<Output = Result<T, ClusterError>>,
    {
        let start = Instant::now();
        let mut stopped: Option<Instant> = None;
        loop {
            let error = match action().await {
                Ok(done) => return Ok(done),
                Err(error) => error,
            };
            if stopped.is_none() && self.0.stop.is_cancelled() {
                stopped = Some(Instant::now());
            }
            let stop_time_over = stopped.is_some_and(|since| since.elapsed() > STOP_REPORT_TIME);
            if start.elapsed() > REPORT_TIME || stop_time_over {
                return Err(error);
            }
            tracing::warn!(%error, "the worker tries again");
            tokio::time::sleep(RETRY_PAUSE).await;
        }
    }

    /// Fetches the inputs of a tile into the cache.
    async fn fetch(&self, held: &Held) -> Result<(), PipelineError> {
        let needed: Vec<Sha256> = held.task.inputs().map(|input| input.sha256).collect();
        for input in held.task.inputs() {
            if !lock(&self.0.cache).has(input.sha256) {
                let bytes = self.get(held, input).await?;
                let added = lock(&self.0.cache).add(input.sha256, &bytes, &needed);
                added.map_err(fetch_error)?;
            }
        }
        Ok(())
    }

    /// Gets an input. Asks the hub to send it again if it is missing or damaged.
    async fn get(&self, held: &Held, input: Input) -> Result<Vec<u8>, PipelineError> {
        let (start, mut missing) = (Instant::now(), 0);
        loop {
            let prefix = names::input(&self.0.pool, input.sha256);
            let error = match self.0.connection.get(names::INPUTS, &prefix, input).await {
                Ok(bytes) => return Ok(bytes),
                Err(error) => error,
            };
            if *held.notice.borrow() != Heartbeat::Continue || self.0.stop.is_cancelled() {
                return Err(PipelineError::Stopped);
            }
            if start.elapsed() > self.0.patience {
                let text = format!("input {} is missing: {error}", input.sha256);
                return Err(fetch_error(io::Error::other(text)));
            }
            missing += u32::from(!matches!(error, BlobError::Failed(_)));
            // The first failure may be due to a replica that lags.
            if missing % 4 == 2 {
                tracing::warn!(%error, sha256 = %input.sha256, "an input is requested again");
                let want = InputRequest { task: held.task.task, sha256: input.sha256 };
                if let Err(error) = self.send("want", &want).await {
                    tracing::warn!(%error, "an input can't be requested");
                }
            }
            tokio::time::sleep(RETRY_PAUSE).await;
        }
    }
}

/// Introduces the worker. Returns the time until redelivery, or `None` if no server answers.
async fn introduce(
    connection: &Connection,
    pool: &Pool,
    hello: &Hello,
) -> Result<Option<Duration>, ClusterError> {
    let text = serde_json::to_vec(hello).map_err(ClusterError::nats("write a message"))?;
    let asked = connection.client.request(names::ask("hello", pool), text.into()).await;
    let answer = match asked {
        Ok(answer) => answer.payload,
        Err(error) => {
            tracing::warn!(
                %error, %pool,
                "no server answers: is `sci-recon serve --nats` running, and may this credential \
                 work for this pool?"
            );
            return Ok(None);
        }
    };
    match serde_json::from_slice(&answer) {
        Ok(HelloAnswer::Welcome { ack_wait_ms, .. }) => {
            Ok(Some(Duration::from_millis(ack_wait_ms)))
        }
        Ok(HelloAnswer::Refused(reason)) => Err(ClusterError::Refused(reason)),
        Err(error) => Err(ClusterError::Refused(format!("its answer can't be read: {error}"))),
    }
}

impl Transport for Remote {
    async fn started(&self) -> Result<(), TransportError> {
        Ok(())
    }

    async fn report_alive(&self) -> Result<(), TransportError> {
        Ok(())
    }

    async fn claim(&self) -> Result<Option<Claim>, TransportError> {
        self.hold(None);
        let since = lock(&self.0.held).1;
        if self.0.idle.is_some_and(|idle| since.elapsed() > idle) {
            tracing::info!("no tile for {} seconds: the worker ends", since.elapsed().as_secs());
            self.0.stop.cancel();
            return Ok(None);
        }
        let message = tokio::select! {
            message = self.pull() => message?,
            () = self.0.stop.cancelled() => None,
        };
        match message {
            Some(message) if self.0.stop.is_cancelled() => {
                message.ack_with(AckKind::Nak(None)).await?;
                Ok(None)
            }
            Some(message) => self.begin(message).await,
            None => Ok(None),
        }
    }

    async fn heartbeat(
        &self,
        lease: &Lease,
        progress: TaskProgress,
        history: Option<&str>,
    ) -> Result<Heartbeat, TransportError> {
        let held = self.held_for(lease)?;
        let notice = *held.notice.borrow();
        if history.is_some() {
            *lock(&held.history) = history.map(str::to_owned);
        }
        let Lease { task, attempt, worker, .. } = *lease;
        let tile = TileBeat { task, attempt, progress, history: history.map(str::to_owned) };
        self.send("beat", &Beat { worker, tile: Some(tile), leaves: false }).await?;
        Ok(notice)
    }

    async fn called_off(&self, lease: &Lease) -> Heartbeat {
        let Ok(held) = self.held_for(lease) else { return std::future::pending().await };
        let mut notices = held.notice.subscribe();
        match notices.wait_for(|notice| *notice != Heartbeat::Continue).await {
            Ok(notice) => *notice,
            Err(_) => std::future::pending().await,
        }
    }

    async fn complete(&self, lease: &Lease, done: Done) -> Result<Heartbeat, TransportError> {
        let Done { progress, record, output } = done;
        let Output::Stack(frames) = output else {
            return Err("a tile's output must be frames".into());
        };
        let serialized = tokio::task::spawn_blocking(move || serialize(&frames)).await?;
        let (frames, bytes) = serialized?;
        let bytes = bytes::Bytes::from(bytes);
        let Lease { task, attempt, worker, .. } = *lease;
        let prefix = names::output(&self.0.pool, task, attempt, worker);
        self.persist(|| self.0.connection.put(&prefix, bytes.clone())).await?;
        let history = lock(&self.held_for(lease)?.history).take();
        self.end(lease, End::Done { frames, progress, record, history }).await
    }

    async fn fail(&self, lease: &Lease, reason: &str, retry: bool) -> Result<(), TransportError> {
        let end = End::Failed { reason: reason.to_owned(), retry };
        self.end(lease, end).await.map(|_| ())
    }

    async fn give_back(&self, lease: &Lease) -> Result<(), TransportError> {
        self.end(lease, End::GivenBack).await.map(|_| ())
    }

    async fn redo(&self, _: &Lease, _: &[(u32, u32)]) -> Result<(), TransportError> {
        Err("a worker on another machine assembles nothing".into())
    }

    fn window(&self, task: &TileTask) -> Result<TileInput, PipelineError> {
        let lost = || fetch_error(io::Error::other("this worker no longer holds the tile"));
        let held = self.held().ok_or_else(lost)?;
        self.0.runtime.block_on(self.fetch(&held))?;
        let path = |input: Input| lock(&self.0.cache).path(input.sha256);
        let masks = arrays::read(&path(held.task.masks))?;
        let y = arrays::read(&path(held.task.snapshots))?;
        let expected = (task.tile.height, task.tile.width);
        let size = |array: &Array3<f32>| (array.dim().1, array.dim().2);
        if size(&masks) != expected || size(&y) != expected {
            let (masks, y) = (size(&masks), size(&y));
            let problem = format!(
                "masks {masks:?} and snapshots {y:?} do not fit the tile's size {expected:?}"
            );
            return Err(PipelineError::Record { what: "tile's message", problem });
        }
        let pieces = task.pieces.clone();
        Ok(TileInput { masks, y, white: task.white, pieces })
    }

    fn model(&self, sha256: Sha256) -> ModelFile {
        ModelFile::new(lock(&self.0.cache).path(sha256), sha256)
    }
}

/// Serializes frames, and computes hash and size.
fn serialize(frames: &Array3<f32>) -> Result<(Input, Vec<u8>), FormatError> {
    let bytes = arrays::to_bytes(frames.view())?;
    Ok((Input { sha256: Sha256::of(&bytes), bytes: bytes.len() as u64 }, bytes))
}

fn fetch_error(source: io::Error) -> PipelineError {
    PipelineError::Format(FormatError::Io { action: "fetch what the tile needs", source })
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Every change is a single assignment, so the value is valid even if a thread panicked.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
