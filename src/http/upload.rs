//! Receiving a file: from the network to the disk, hashed on the way, a few chunks in memory.

use std::io::Write;
use std::time::Duration;

use axum::body::Bytes;
use axum::http::{HeaderMap, header};
use futures_util::{Stream, StreamExt};
use tokio::sync::{OwnedSemaphorePermit, mpsc};

use super::access::Access;
use super::admission::{self, Room};
use super::app::App;
use super::error::{ApiError, Code};
use crate::store::{StagedBlob, Store, StoreError};

/// Chunks between the network and the disk.
pub(super) const CHUNKS: usize = 4;

/// What is read of a body that was refused.
const DRAINED_BYTES: usize = 8 << 20;
const DRAIN_TIME: Duration = Duration::from_secs(2);

/// Receives a stream into a file that is not yet in the store. What is broken off leaves nothing.
pub(super) async fn receive<S, E>(
    app: &App,
    mut room: Room,
    mut stream: S,
) -> Result<StagedBlob, ApiError>
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
    room: &mut Room,
    stream: &mut S,
    sender: mpsc::Sender<Bytes>,
) -> Result<(), ApiError>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: std::fmt::Display,
{
    let mut size = 0;
    while let Some(chunk) = next(app, stream).await? {
        size += chunk.len() as u64;
        if size > app.max_upload_bytes {
            return Err(admission::too_large(app));
        }
        room.take(app, chunk.len() as u64).await?;
        // A writer that takes no more has failed, and says why itself.
        if sender.send(chunk).await.is_err() {
            break;
        }
    }
    Ok(())
}

/// The next chunk, if there is one and it comes in time.
pub(super) async fn next<S, E>(app: &App, stream: &mut S) -> Result<Option<Bytes>, ApiError>
where
    S: Stream<Item = Result<Bytes, E>> + Unpin,
    E: std::fmt::Display,
{
    match tokio::time::timeout(app.upload_idle, stream.next()).await {
        Ok(Some(Ok(chunk))) => Ok(Some(chunk)),
        Ok(None) => Ok(None),
        Ok(Some(Err(error))) => {
            let detail = format!("the upload was broken off: {error}");
            Err(ApiError::new(Code::MalformedRequest, detail))
        }
        Err(_) => {
            let seconds = app.upload_idle.as_secs();
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

/// Refuses an upload that says by its length that it can't be taken, before its first byte; gives
/// the room that was reserved for it.
pub(super) async fn admit(
    app: &App,
    access: &Access,
    headers: &HeaderMap,
) -> Result<Room, ApiError> {
    let length = headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok());
    let length: u64 = length.and_then(|text| text.parse().ok()).unwrap_or(0);
    admission::check_length(app, access, length).await?;
    Room::reserve(app, length).await
}

/// Takes one of the places for uploads.
pub(super) fn place(app: &App) -> Result<OwnedSemaphorePermit, ApiError> {
    app.uploads.clone().try_acquire_owned().map_err(|_| {
        ApiError::new(Code::TooManyUploads, "all places for uploads are taken; try again soon")
    })
}
