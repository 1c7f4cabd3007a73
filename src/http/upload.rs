//! Receiving a file: from the network to the disk, hashed on the way, a few chunks in memory.

use std::io::Write;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use futures_util::{Stream, StreamExt};
use tokio::sync::mpsc;

use super::admission::Reservation;
use super::app::App;
use super::error::{ApiError, Code, Result};
use store::{StagedBlob, Store, StoreError};

/// Chunks between the network and the disk.
pub(super) const CHUNKS: usize = 4;

/// What is read of a body that was refused.
const DRAINED_BYTES: usize = 8 << 20;
const DRAIN_TIME: Duration = Duration::from_secs(2);

/// Receives a stream into a file that is not yet in the store. What is broken off leaves nothing.
pub(super) async fn receive<S, E>(
    app: &App,
    mut room: Reservation,
    mut stream: S,
) -> Result<StagedBlob>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: std::fmt::Display,
{
    let (sender, receiver) = mpsc::channel(CHUNKS);
    let store = app.store.clone();
    let writer = tokio::task::spawn_blocking(move || write(&store, receiver));
    let received = pump(app, &mut room, &mut stream, sender).await;
    // Waited for in any case: what is refused is gone from the disk when the user hears of it.
    let staged = writer.await.map_err(|_| StoreError::Interrupted)?;
    if received.is_err() || staged.is_err() {
        drain(&mut stream).await;
    }
    received?;
    let staged = staged?;
    if staged.size() == 0 {
        return Err(ApiError::new(Code::EmptyBody, "the upload has no bytes"));
    }
    metrics::counter!("sci_recon_upload_bytes_total").increment(staged.size());
    Ok(staged)
}

/// Reads on for a moment. A client that is still sending when the connection closes may not get to
/// see why; a small file is soon through, and a large one is cut off.
pub(super) async fn drain<S, E>(stream: &mut S)
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
{
    let read = async {
        let mut size = 0;
        while let Some(Ok(chunk)) = stream.next().await {
            size += chunk.len();
            if size > DRAINED_BYTES {
                break;
            }
        }
    };
    // Late or not, the answer goes out.
    let _ = tokio::time::timeout(DRAIN_TIME, read).await;
}

/// Hands chunks on to the writer, for which there must be room.
async fn pump<S, E>(
    app: &App,
    room: &mut Reservation,
    stream: &mut S,
    sender: mpsc::Sender<Bytes>,
) -> Result<()>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: std::fmt::Display,
{
    let (mut size, mut pace) = (0, Pace::default());
    while let Some(chunk) = next(app, &mut pace, stream).await? {
        size += chunk.len() as u64;
        app.admission.check_size(size)?;
        app.admission.take(room, chunk.len() as u64).await?;
        // A writer that takes no more has failed, and says why itself.
        if sender.send(chunk).await.is_err() {
            break;
        }
    }
    Ok(())
}

/// How fast an upload comes: bytes, and the time that was waited for them; what our disk takes is not the
/// client's.
#[derive(Debug, Default)]
pub(super) struct Pace {
    waited: Duration,
    bytes: u64,
}

impl Pace {
    /// Refuses an upload that came too slowly for as long as one may be silent.
    fn check(&mut self, app: &App) -> Result<()> {
        let (window, least) = (app.settings.upload_idle(), app.settings.upload_bytes_per_second);
        if self.waited < window {
            return Ok(());
        }
        let seconds = self.waited.as_secs().max(1);
        if self.bytes < least.saturating_mul(seconds) {
            let detail = format!(
                "{} bytes came in {seconds} seconds, less than {least} in a second; send the file again \
                 by a faster way, or in pieces",
                self.bytes
            );
            return Err(ApiError::new(Code::UploadStalled, detail));
        }
        *self = Self::default();
        Ok(())
    }
}

pub(super) async fn next<S, E>(app: &App, pace: &mut Pace, stream: &mut S) -> Result<Option<Bytes>>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: std::fmt::Display,
{
    let before = Instant::now();
    let came = tokio::time::timeout(app.settings.upload_idle(), stream.next()).await;
    pace.waited += before.elapsed();
    match came {
        Ok(Some(Ok(chunk))) => {
            pace.bytes += chunk.len() as u64;
            pace.check(app)?;
            Ok(Some(chunk))
        }
        Ok(None) => Ok(None),
        Ok(Some(Err(error))) => {
            let detail = format!("the upload was broken off: {error}");
            Err(ApiError::new(Code::MalformedRequest, detail))
        }
        Err(_) => {
            let seconds = app.settings.upload_idle_seconds;
            let detail = format!("no byte came for {seconds} seconds; send the file again");
            Err(ApiError::new(Code::UploadStalled, detail))
        }
    }
}

fn write(store: &Store, mut chunks: mpsc::Receiver<Bytes>) -> Result<StagedBlob, StoreError> {
    let mut writer = store.blob_writer()?;
    while let Some(chunk) = chunks.blocking_recv() {
        writer.write_all(&chunk).map_err(|source| StoreError::Io {
            action: "write",
            path: store.dir().root().to_owned(),
            source,
        })?;
    }
    writer.finish()
}
