//! The way to queue and files from a worker on another machine: the second implementation of
//! [`Transport`].

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

use super::arrays;
use super::blobs::BlobError;
use super::cache::Cache;
use super::connection::{Access, ClusterError, Connection, Credential};
use super::message::{
    Beat, Begin, BeginAnswer, End, Event, Hello, HelloAnswer, Input, Program, TaskMessage, Tell,
    TileBeat, Want,
};
use super::names;
use crate::formats::FormatError;
use crate::job::{Pool, Sha256, TaskId, TaskProgress, WorkerId};
use crate::pipeline::PipelineError;
use crate::pipeline::networks::ModelFile;
use crate::pipeline::tile::TileInput;
use crate::store::{Heartbeat, Lease};
use crate::worker::{Claim, Done, Output, TaskInput, TileTask, Transport, TransportError};

/// How the process died that was killed from outside.
const KILLED: &str = "killed";
/// How long a request for a tile waits at the message server.
const PULL: Duration = Duration::from_secs(5);
/// How long the hub may take to say whether to begin; a server that is down does not stop its workers.
const BEGIN: Duration = Duration::from_secs(1);
/// Time between two signs of life of a worker that has nothing to do.
const SIGN: Duration = Duration::from_secs(5);
/// Time between two looks for an input that is missing.
const LOOK: Duration = Duration::from_millis(500);
/// How long the end of a tile is tried to be told, and how long once the worker is to end.
const TELL: (Duration, Duration) = (Duration::from_secs(600), Duration::from_secs(3));

/// What a worker on another machine is told when it starts.
#[derive(Debug, Clone)]
pub struct RemoteSettings {
    /// What this worker is.
    pub program: Program,
    /// Addresses of the message server, separated by commas; none for those of the credential.
    pub urls: Option<String>,
    /// The file with the credential; none for a server that is open to all.
    pub credential: Option<PathBuf>,
    /// The pool; none for that of the credential.
    pub pool: Option<Pool>,
    /// The folder of the cache, and the most bytes in it.
    pub cache: (PathBuf, u64),
    /// Where it computes, for the list of workers.
    pub device: String,
    /// How long to look for an input that is missing.
    pub patience: Duration,
    /// How long to go on without a tile; none for ever.
    pub idle: Option<Duration>,
    /// The file for what is in hand, for the process after this one.
    pub hand: Option<PathBuf>,
    /// How the process before this one died.
    pub died: Option<String>,
}

/// What is in hand, for the process after this one.
#[derive(Debug, Serialize, Deserialize)]
struct Hand {
    event: Event,
    /// Where the message is let go.
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
    /// The tile in hand, and since when there is one or none.
    held: Mutex<(Option<Arc<Held>>, Instant)>,
}

/// A tile in hand.
#[derive(Debug)]
struct Held {
    task: TaskMessage,
    /// The attempt as which the hub knows it.
    attempt: u32,
    begin: Begin,
    message: Message,
    /// What the hub has told of it.
    told: watch::Sender<Heartbeat>,
    /// How the solver went so far.
    history: Mutex<Option<String>>,
    /// The last answer to a sign that the tile is worked on.
    answered: Mutex<Instant>,
    /// Gives these signs.
    keeper: Mutex<Option<AbortHandle>>,
}

impl Drop for Held {
    fn drop(&mut self) {
        if let Some(keeper) = lock(&self.keeper).take() {
            keeper.abort();
        }
    }
}

/// Whose a tile is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Standing {
    Mine,
    /// This worker was silent for long, and nobody says.
    Unsure,
    Anothers,
}

impl Remote {
    /// Connects and introduces the worker; waits for a server that is not there yet.
    ///
    /// # Errors
    /// Settings that can't be, a message server that does not answer, a server that refuses the worker.
    /// None if `stop` was called, or the time without a tile is over, before the server answered.
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
                reason: "it names no pool: name one with --pool".into(),
            })?;
        let cache = Cache::open(&settings.cache.0, settings.cache.1)?;
        let host = rustix::system::uname().nodename().to_string_lossy().into_owned();
        let name = format!("sci-recon worker {host}");
        let connection =
            Access::new(settings.urls.as_deref(), &credential, &name)?.connect().await?;
        let told = connection.client.subscribe(names::tell(&pool, worker)).await;
        let told = told.map_err(ClusterError::nats("listen to the server"))?;
        let device = settings.device;
        let hello =
            Hello { worker, host, pid: std::process::id(), device, program: settings.program };
        let (start, mut pause) = (Instant::now(), LOOK);
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
            remote.tell_of_death(how).await;
        }
        tokio::spawn(remote.clone().listen(told));
        tokio::spawn(remote.clone().give_signs());
        Ok(Some(remote))
    }

    /// Says goodbye.
    pub async fn leave(&self) {
        let beat = Beat { worker: self.0.hello.worker, tile: None, leaves: true };
        let said = async {
            self.say("beat", &beat).await?;
            let flushed = self.0.connection.client.flush().await;
            flushed.map_err(ClusterError::nats("say goodbye"))
        };
        // Without a connection it is not sent, and waits for one.
        if !tokio::time::timeout(BEGIN, said).await.is_ok_and(|said| said.is_ok()) {
            tracing::debug!("the goodbye was not heard: the worker is forgotten after a while");
        }
    }

    async fn say(&self, what: &str, message: &impl serde::Serialize) -> Result<(), ClusterError> {
        self.0.connection.say(names::ask(what, &self.0.pool), message).await
    }

    /// Hears what the hub tells.
    async fn listen(self, mut told: Subscriber) {
        while let Some(message) = told.next().await {
            let (about, answer) = match serde_json::from_slice(&message.payload) {
                Ok(Tell::Cancel { task, attempt }) => ((task, attempt), Heartbeat::Cancelled),
                Ok(Tell::Lost { task, attempt }) => ((task, attempt), Heartbeat::Lost),
                Ok(Tell::Introduce) => {
                    let Inner { connection, pool, hello, stop, .. } = &*self.0;
                    if let Err(error) = introduce(connection, pool, hello).await {
                        tracing::error!(%error, "the worker ends");
                        stop.cancel();
                    }
                    continue;
                }
                Err(error) => {
                    tracing::warn!(%error, "the server says what this worker can't read");
                    continue;
                }
            };
            if let Some(held) = self.held()
                && about == (held.task.task, held.attempt)
            {
                held.told.send_replace(answer);
            }
        }
    }

    /// Why the worker has ended, if the message server refuses its credential.
    #[must_use]
    pub fn refusal(&self) -> Option<ClusterError> {
        self.0.connection.refusal()
    }

    async fn give_signs(self) {
        while !self.0.stop.is_cancelled() {
            if self.refusal().is_some() {
                return self.0.stop.cancel();
            }
            if self.held().is_none() {
                let beat = Beat { worker: self.0.hello.worker, tile: None, leaves: false };
                if let Err(error) = self.say("beat", &beat).await {
                    tracing::warn!(%error, "no sign of life could be given");
                }
            }
            tokio::time::sleep(SIGN).await;
        }
    }

    fn held(&self) -> Option<Arc<Held>> {
        lock(&self.0.held).0.clone()
    }

    /// Tells how the process before this one died, with what it had in hand.
    async fn tell_of_death(&self, how: String) {
        let Some(path) = &self.0.hand else { return };
        let found = std::fs::read(path).ok();
        let hand: Option<Hand> = found.and_then(|text| serde_json::from_slice(&text).ok());
        let Some(Hand { mut event, acknowledge }) = hand else { return };
        if let End::Died { how: told, fault } = &mut event.end {
            *fault = how != KILLED;
            *told = how;
        }
        let told = self.publish(&event).await;
        let acked = self.0.connection.client.publish(acknowledge, "+ACK".into()).await;
        if told.is_err() || acked.is_err() {
            tracing::warn!("it could not be told: the tile is delivered again after a while");
        }
        self.note_hand(None);
    }

    /// Notes what is in hand, a task's attempt and its message, for the process after this one.
    fn note_hand(&self, held: Option<(TaskId, u32, &Message)>) {
        let Some(path) = &self.0.hand else { return };
        let noted = match held {
            None => match std::fs::remove_file(path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
                _ => Ok(()),
            },
            Some((task, attempt, message)) => {
                let end = End::Died { how: String::new(), fault: false };
                let event = Event { task, attempt, worker: self.0.hello.worker, end };
                let acknowledge = message.reply.as_ref().map_or("", |to| to.as_str()).to_owned();
                let text = serde_json::to_vec(&Hand { event, acknowledge });
                text.map_err(io::Error::other).and_then(|text| std::fs::write(path, text))
            }
        };
        if let Err(error) = noted {
            tracing::warn!(%error, "what is in hand can't be noted");
        }
    }

    fn hold(&self, held: Option<Arc<Held>>) {
        self.note_hand(held.as_ref().map(|held| (held.task.task, held.attempt, &held.message)));
        let mut place = lock(&self.0.held);
        if place.0.is_some() || held.is_some() {
            *place = (held, Instant::now());
        }
    }

    /// The next message, if one comes soon.
    async fn pull(&self) -> Result<Option<Message>, TransportError> {
        let batch = self.0.consumer.batch().max_messages(1).expires(PULL).messages();
        let next = async { batch.await?.next().await.transpose() };
        // A pull may be forgotten when the stream's leader changes.
        match tokio::time::timeout(PULL + BEGIN, next).await {
            Ok(found) => found,
            Err(_) => Ok(None),
        }
    }

    /// Asks the hub whether to begin; none if it does not answer.
    async fn ask(&self, begin: &Begin) -> Option<BeginAnswer> {
        let text = serde_json::to_vec(begin).ok()?;
        let asked =
            self.0.connection.client.request(names::ask("begin", &self.0.pool), text.into());
        let answer = tokio::time::timeout(BEGIN, asked).await.ok()?.ok()?;
        serde_json::from_slice(&answer.payload).ok()
    }

    /// Begins with a message, unless it is of no use.
    async fn begin(&self, message: Message) -> Result<Option<Claim>, TransportError> {
        let (seq, delivery) = {
            let info = message.info()?;
            (i64::try_from(info.stream_sequence)?, u32::try_from(info.delivered)?)
        };
        let task: TaskMessage = match serde_json::from_slice(&message.payload) {
            Ok(task) => task,
            Err(error) => {
                // The hub finds that it is gone.
                message.ack_with(AckKind::Term).await?;
                return Err(format!("a tile's message can't be read: {error}").into());
            }
        };
        let worker = self.0.hello.worker;
        let begin = Begin { task: task.task, attempt: task.attempt, seq, delivery, worker };
        // Before the hub counts on this process: nobody else would know that it died with the message.
        self.note_hand(Some((task.task, task.attempt, &message)));
        let attempt = match self.ask(&begin).await {
            Some(BeginAnswer::Go(attempt)) => attempt,
            Some(BeginAnswer::Lost) => {
                self.note_hand(None);
                return Ok(None);
            }
            Some(BeginAnswer::Over) => {
                self.note_hand(None);
                message.double_ack().await?;
                return Ok(None);
            }
            None => {
                tracing::warn!("the server does not answer: the worker goes on without it");
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
            told: watch::Sender::new(Heartbeat::Continue),
            history: Mutex::default(),
            answered: Mutex::new(Instant::now()),
            keeper: Mutex::new(None),
        });
        let kept = Arc::downgrade(&held);
        let pause = self.0.ack_wait / 6;
        let keeper = tokio::spawn(async move {
            loop {
                tokio::time::sleep(pause).await;
                let Some(held) = kept.upgrade() else { return };
                let asked = Instant::now();
                match held.message.double_ack_with(AckKind::Progress).await {
                    Ok(()) => *lock(&held.answered) = asked,
                    Err(error) => tracing::warn!(%error, "a sign of work is not answered"),
                }
            }
        });
        *lock(&held.keeper) = Some(keeper.abort_handle());
        self.hold(Some(held));
        Ok(Some(claim))
    }

    /// The tile in hand, if the lease is for it.
    fn held_for(&self, lease: &Lease) -> Result<Arc<Held>, TransportError> {
        let held = self
            .held()
            .filter(|held| (held.task.task, held.attempt) == (lease.task, lease.attempt));
        held.ok_or_else(|| "the tile is not in hand any more".into())
    }

    /// Whose a tile is: that of a worker which was suspended for long may be another's, and the message
    /// with it.
    async fn standing(&self, held: &Held) -> Standing {
        if lock(&held.answered).elapsed() < self.0.ack_wait {
            return Standing::Mine;
        }
        match self.ask(&held.begin).await {
            Some(BeginAnswer::Go(_) | BeginAnswer::Over) => Standing::Mine,
            Some(BeginAnswer::Lost) => Standing::Anothers,
            None => Standing::Unsure,
        }
    }

    /// Tells how a tile ended, and lets its message go.
    async fn end(&self, lease: &Lease, end: End) -> Result<Heartbeat, TransportError> {
        let held = self.held_for(lease)?;
        let standing = self.standing(&held).await;
        if standing == Standing::Anothers {
            self.hold(None);
            return Ok(Heartbeat::Lost);
        }
        let event = Event { task: lease.task, attempt: lease.attempt, worker: lease.worker, end };
        self.publish(&event).await?;
        if standing == Standing::Mine {
            let let_go = self.persist(|| async {
                let acked = held.message.double_ack().await;
                acked.map_err(ClusterError::nats("let the message go"))
            });
            if let Err(error) = let_go.await {
                // It is delivered again, and the hub says that the tile is done.
                tracing::warn!(%error, "the tile's message stays");
            }
        }
        self.hold(None);
        Ok(Heartbeat::Continue)
    }

    /// Publishes how a tile ended, and waits until that is stored.
    async fn publish(&self, event: &Event) -> Result<(), TransportError> {
        let text = serde_json::to_vec(event)?;
        let id = format!("{}.{}.{}", event.task, event.attempt, event.worker);
        self.persist(|| async {
            let message = PublishMessage::build().message_id(&id).payload(text.clone().into());
            let message = message.outbound_message(names::event(&self.0.pool));
            let context = &self.0.connection.context;
            let headers = message.headers.unwrap_or_default();
            let sent =
                context.publish_with_headers(message.subject, headers, message.payload).await;
            sent.map_err(ClusterError::nats("tell the end"))?
                .await
                .map_err(ClusterError::nats("tell the end"))
        })
        .await?;
        Ok(())
    }

    /// Does something again and again until it succeeds or the time is over.
    async fn persist<T, F>(&self, mut what: impl FnMut() -> F) -> Result<T, ClusterError>
    where
        F: Future<Output = Result<T, ClusterError>>,
    {
        let start = Instant::now();
        let mut stopped: Option<Instant> = None;
        loop {
            let error = match what().await {
                Ok(done) => return Ok(done),
                Err(error) => error,
            };
            if stopped.is_none() && self.0.stop.is_cancelled() {
                stopped = Some(Instant::now());
            }
            if start.elapsed() > TELL.0 || stopped.is_some_and(|since| since.elapsed() > TELL.1) {
                return Err(error);
            }
            tracing::warn!(%error, "it is tried again");
            tokio::time::sleep(LOOK).await;
        }
    }

    /// Brings all that a tile needs into the cache.
    async fn fetch(&self, held: &Held) -> Result<(), PipelineError> {
        let needed: Vec<Sha256> = held.task.inputs().map(|input| input.sha256).collect();
        for input in held.task.inputs() {
            if !lock(&self.0.cache).has(input.sha256) {
                let bytes = self.get(held, input).await?;
                let added = lock(&self.0.cache).add(input.sha256, &bytes, &needed);
                added.map_err(unread)?;
            }
        }
        Ok(())
    }

    /// Gets an input; asks for it if it is missing or damaged.
    async fn get(&self, held: &Held, input: Input) -> Result<Vec<u8>, PipelineError> {
        let (start, mut missing) = (Instant::now(), 0);
        loop {
            let prefix = names::input(&self.0.pool, input.sha256);
            let error = match self.0.connection.get(names::INPUTS, &prefix, input).await {
                Ok(bytes) => return Ok(bytes),
                Err(error) => error,
            };
            if *held.told.borrow() != Heartbeat::Continue || self.0.stop.is_cancelled() {
                return Err(PipelineError::Stopped);
            }
            if start.elapsed() > self.0.patience {
                let text = format!("input {} can't be had: {error}", input.sha256);
                return Err(unread(io::Error::other(text)));
            }
            missing += u32::from(!matches!(error, BlobError::Failed(_)));
            // A replica may only be late, once.
            if missing % 4 == 2 {
                tracing::warn!(%error, sha256 = %input.sha256, "an input is asked for");
                let want = Want { task: held.task.task, sha256: input.sha256 };
                if let Err(error) = self.say("want", &want).await {
                    tracing::warn!(%error, "an input can't be asked for");
                }
            }
            tokio::time::sleep(LOOK).await;
        }
    }
}

/// Says hello; none if no server answers.
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
        Ok(HelloAnswer::Welcome { ack_wait_ms }) => Ok(Some(Duration::from_millis(ack_wait_ms))),
        Ok(HelloAnswer::Refused(reason)) => Err(ClusterError::Refused(reason)),
        Err(error) => Err(ClusterError::Refused(format!("it answers what can't be read: {error}"))),
    }
}

impl Transport for Remote {
    async fn started(&self) -> Result<(), TransportError> {
        Ok(())
    }

    async fn seen(&self) -> Result<(), TransportError> {
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
        let told = *held.told.borrow();
        if history.is_some() {
            *lock(&held.history) = history.map(str::to_owned);
        }
        let Lease { task, attempt, worker, .. } = *lease;
        let tile = TileBeat { task, attempt, progress, history: history.map(str::to_owned) };
        self.say("beat", &Beat { worker, tile: Some(tile), leaves: false }).await?;
        Ok(told)
    }

    async fn called_off(&self, lease: &Lease) -> Heartbeat {
        let Ok(held) = self.held_for(lease) else { return std::future::pending().await };
        let mut told = held.told.subscribe();
        match told.wait_for(|told| *told != Heartbeat::Continue).await {
            Ok(told) => *told,
            Err(_) => std::future::pending().await,
        }
    }

    async fn complete(&self, lease: &Lease, done: Done) -> Result<Heartbeat, TransportError> {
        let Done { progress, record, output } = done;
        let Output::Stack(frames) = output else {
            return Err("a tile has made something else than frames".into());
        };
        let made = tokio::task::spawn_blocking(move || file_of(&frames)).await?;
        let (frames, bytes) = made?;
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
        let gone = || unread(io::Error::other("the tile is not in hand any more"));
        let held = self.held().ok_or_else(gone)?;
        self.0.runtime.block_on(self.fetch(&held))?;
        let path = |input: Input| lock(&self.0.cache).path(input.sha256);
        let masks = arrays::read(&path(held.task.masks))?;
        let y = arrays::read(&path(held.task.snapshots))?;
        let place = (task.tile.height, task.tile.width);
        let of = |array: &Array3<f32>| (array.dim().1, array.dim().2);
        if of(&masks) != place || of(&y) != place {
            let problem =
                format!("masks {:?} and snapshots {:?} of a tile {place:?}", of(&masks), of(&y));
            return Err(PipelineError::Record { what: "tile's message", problem });
        }
        let pieces = task.pieces.clone();
        Ok(TileInput { masks, y, white: task.white, pieces })
    }

    fn model(&self, sha256: Sha256) -> ModelFile {
        ModelFile::new(lock(&self.0.cache).path(sha256), sha256)
    }
}

/// Frames as a file, and its name.
fn file_of(frames: &Array3<f32>) -> Result<(Input, Vec<u8>), FormatError> {
    let bytes = arrays::to_bytes(frames.view())?;
    Ok((Input { sha256: Sha256::of(&bytes), bytes: bytes.len() as u64 }, bytes))
}

fn unread(source: io::Error) -> PipelineError {
    PipelineError::Format(FormatError::Io { action: "fetch what the tile needs", source })
}

fn lock<T>(place: &Mutex<T>) -> MutexGuard<'_, T> {
    // Whole values are stored: a poisoned lock holds a good one.
    place.lock().unwrap_or_else(PoisonError::into_inner)
}
