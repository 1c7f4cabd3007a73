//! The checks of `sci-recon cluster check`: they report what a server or a worker lacks.

use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;

use super::connection::{Access, ClusterError, Connection, Credential};
use super::message::{Hello, HelloAnswer, Input, Program};
use super::names;
use engine::job::{Pool, Sha256, TaskId, WorkerId};

/// Bytes of a typical window: 10 frames of about 330x330 pixels.
const WINDOW: usize = 4_400_000;
/// Largest message in bytes that the transfer of files needs: a chunk of 512 KiB with headers.
const PAYLOAD: usize = 600_000;
/// First version of nats-server without known losses in work queues.
const RECOMMENDED: (i64, i64, i64) = (2, 12, 5);
/// Oldest version that was tested.
const OLDEST: (i64, i64, i64) = (2, 9, 10);
/// Largest difference of clocks that does not confuse the times that people read.
const CLOCKS: Duration = Duration::from_secs(2);

/// The result of one check.
#[derive(Debug)]
pub struct Check {
    /// The subject of the check.
    pub what: &'static str,
    /// True if the check has passed.
    pub good: bool,
    /// The observation, for people.
    pub found: String,
}

impl Check {
    fn new(what: &'static str, good: bool, found: impl Into<String>) -> Self {
        Self { what, good, found: found.into() }
    }

    fn of<T>(
        what: &'static str,
        result: Result<T, ClusterError>,
        show: impl FnOnce(T) -> String,
    ) -> Self {
        match result {
            Ok(found) => Self::new(what, true, show(found)),
            Err(error) => Self::new(what, false, error.to_string()),
        }
    }

    /// Checks what a server needs. With the credential of a pool, it checks what a worker of the pool needs.
    /// Errors: no message server can be reached.
    pub async fn run(
        urls: Option<&str>,
        credential: Option<&Path>,
        program: Program,
    ) -> Result<Vec<Self>, ClusterError> {
        let credential = credential.map(Credential::read).transpose()?.unwrap_or_default();
        let connection =
            Access::new(urls, &credential, "sci-recon cluster check")?.connect().await?;
        let mut checks =
            vec![version(&connection), payload(&connection), round_trip(&connection).await];
        match credential.pool() {
            Some(pool) => checks.extend(worker(&connection, pool, program).await),
            None => checks.extend(server(&connection).await),
        }
        Ok(checks)
    }
}

fn version(connection: &Connection) -> Check {
    let info = connection.client.server_info();
    let at_least =
        |(major, minor, patch)| connection.client.is_server_compatible(major, minor, patch);
    let found = format!("nats-server {}", info.version);
    let (major, minor, patch) = RECOMMENDED;
    if !info.jetstream {
        return Check::new(
            "server",
            false,
            format!("{found} without JetStream: start it with -js"),
        );
    }
    if !at_least(OLDEST) {
        return Check::new("server", false, format!("{found}: 2.9.10 or later is needed"));
    }
    let hint = format!(" ({major}.{minor}.{patch} or later is recommended)");
    Check::new("server", true, if at_least(RECOMMENDED) { found } else { found + &hint })
}

fn payload(connection: &Connection) -> Check {
    let limit = connection.client.max_payload();
    let good = limit >= PAYLOAD;
    let hint = if good { String::new() } else { format!(": set max_payload to {PAYLOAD} or more") };
    Check::new("payload of a message", good, format!("{limit} bytes{hint}"))
}

async fn round_trip(connection: &Connection) -> Check {
    let mut times = Vec::new();
    for _ in 0..5 {
        let start = Instant::now();
        if let Err(error) = connection.client.flush().await {
            return Check::new("round trip", false, error.to_string());
        }
        times.push(start.elapsed());
    }
    times.sort_unstable();
    Check::new("round trip", true, format!("{:.1} ms", times[2].as_secs_f64() * 1e3))
}

/// Checks what `sci-recon serve` needs.
async fn server(connection: &Connection) -> Vec<Check> {
    let streams = connection.make_streams().await;
    let mut checks =
        vec![Check::of("streams", streams, |_| "exist, with the right to change them".into())];
    if checks.iter().any(|check| !check.good) {
        return checks;
    }
    for name in [names::TASKS, names::EVENTS, names::INPUTS, names::OUTPUTS] {
        if let Ok(found) = connection.context.get_stream(name).await {
            let info = found.cached_info();
            let copies = info.config.num_replicas;
            let nodes = info.cluster.as_ref().map_or(1, |cluster| 1 + cluster.replicas.len());
            let replicas = info.cluster.iter().flat_map(|cluster| &cluster.replicas);
            let late = replicas.filter(|peer| !peer.current).count();
            let text = format!("{copies} copies on {nodes} nodes, {late} of them late");
            checks.push(Check::new(name, late == 0, text));
        }
    }
    checks.extend(throughput(connection).await);
    checks
}

/// Sends a window and fetches it. Also compares the clock with the message server's.
async fn throughput(connection: &Connection) -> Vec<Check> {
    let bytes: Vec<u8> = (0..WINDOW).map(|n| (n.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    let input = Input { sha256: Sha256::of(&bytes), bytes: WINDOW as u64 };
    let Ok(pool) = "check".parse::<Pool>() else { return Vec::new() };
    let prefix = names::input(&pool, input.sha256);
    let start = Instant::now();
    let put = connection.put(&prefix, Bytes::from(bytes)).await;
    let mut checks = vec![Check::of("a window out", put, |()| rate(start))];
    let start = Instant::now();
    let mut got = connection.get(names::INPUTS, &prefix, input).await;
    if got.is_err() {
        // A replica may lag.
        tokio::time::sleep(Duration::from_millis(500)).await;
        got = connection.get(names::INPUTS, &prefix, input).await;
    }
    let got = got.map_err(ClusterError::nats("get a window"));
    checks.push(Check::of("a window in", got, |_| rate(start)));
    checks.push(clocks(connection, &format!("{prefix}.0")).await);
    if let Err(error) = connection.purge(names::INPUTS, format!("{prefix}.>")).await {
        checks.push(Check::new("purge", false, error.to_string()));
    }
    checks
}

/// Time and rate of a window that was sent or fetched since `start`.
fn rate(start: Instant) -> String {
    let seconds = start.elapsed().as_secs_f64();
    format!("4.4 MB in {:.0} ms, {:.0} MB/s", seconds * 1e3, WINDOW as f64 / 1e6 / seconds)
}

async fn clocks(connection: &Connection, subject: &str) -> Check {
    let what = "clocks";
    let stream = match connection.context.get_stream_no_info(names::INPUTS).await {
        Ok(stream) => stream,
        Err(error) => return Check::new(what, false, error.to_string()),
    };
    // The server's time of this message must lie between the two local times.
    let before = SystemTime::now();
    let sent = connection.context.publish(subject.to_owned(), Bytes::from_static(b"now")).await;
    if let Err(error) = sent.map_err(ClusterError::nats("put")) {
        return Check::new(what, false, error.to_string());
    }
    tokio::time::sleep(Duration::from_millis(200)).await;
    let after = SystemTime::now();
    match stream.get_last_raw_message_by_subject(subject).await {
        Err(error) => Check::new(what, false, error.to_string()),
        Ok(message) => {
            let time: SystemTime = message.time.into();
            compared(time, before, after)
        }
    }
}

/// Compares another machine's time of an event with the local times before and after it.
fn compared(time: SystemTime, before: SystemTime, after: SystemTime) -> Check {
    let early = before.duration_since(time).unwrap_or_default();
    let late = time.duration_since(after).unwrap_or_default();
    let difference = early.max(late);
    let hint = if difference <= CLOCKS { "" } else { ": synchronise both, for example by NTP" };
    let text = format!("{:.1} s apart{hint}", difference.as_secs_f64());
    Check::new("clocks", difference <= CLOCKS, text)
}

/// Checks what a worker of a pool needs.
async fn worker(connection: &Connection, pool: &Pool, program: Program) -> Vec<Check> {
    let worker = WorkerId::new();
    let hello = Hello::new(worker, "check".into(), program);
    let mut checks = welcome(connection, pool, &hello).await;
    let consumer = connection.pool(pool).await;
    checks.push(Check::of("the pool's tiles", consumer, |consumer| {
        let info = consumer.cached_info();
        format!("{} waiting, {} in progress", info.num_pending, info.num_ack_pending)
    }));
    let prefix = names::output(pool, TaskId::new(), 0, worker);
    let bytes = vec![7; WINDOW];
    let start = Instant::now();
    let put = connection.put(&prefix, Bytes::from(bytes)).await;
    checks.push(Check::of("frames of a tile out", put, |()| rate(start)));
    // No input has this name. A worker without the right to read gets a different error.
    let absent = Input { sha256: Sha256::of(b"nothing"), bytes: 1 };
    let got = connection.get(names::INPUTS, &names::input(pool, absent.sha256), absent).await;
    checks.push(match got {
        Err(super::blobs::BlobError::Failed(reason)) => {
            Check::new("the pool's inputs", false, format!("no right, or no server: {reason}"))
        }
        _ => Check::new("the pool's inputs", true, "can be read"),
    });
    checks
}

async fn welcome(connection: &Connection, pool: &Pool, hello: &Hello) -> Vec<Check> {
    let welcome = |good, found: String| vec![Check::new("welcome", good, found)];
    let text = match serde_json::to_vec(hello) {
        Ok(text) => text,
        Err(error) => return welcome(false, format!("the message can't be written: {error}")),
    };
    let before = SystemTime::now();
    let answer = match connection.client.request(names::ask("hello", pool), text.into()).await {
        Ok(answer) => answer,
        Err(error) => {
            let causes = "no `sci-recon serve` answers, or the credential has no right to ask";
            return welcome(false, format!("{causes}: {error}"));
        }
    };
    let after = SystemTime::now();
    match serde_json::from_slice(&answer.payload) {
        Ok(HelloAnswer::Welcome { now_ms, .. }) => {
            let now = SystemTime::UNIX_EPOCH + Duration::from_millis(now_ms);
            let leave = super::message::Beat { worker: hello.worker, tile: None, leaves: true };
            // If this fails, the hub drops the worker after a while.
            let _ = connection.publish(names::ask("beat", pool), &leave).await;
            let mut checks = welcome(true, "the server takes workers of this version".into());
            checks.push(compared(now, before, after));
            checks
        }
        Ok(HelloAnswer::Refused(reason)) => welcome(false, reason),
        Err(error) => welcome(false, format!("the answer can't be read: {error}")),
    }
}
