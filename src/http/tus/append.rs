//! Receives a piece of an upload and appends it to the file. Memory holds a few chunks at a time.

use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use tokio::runtime::Handle;
use tokio::sync::mpsc;

use super::headers::Checksum;
use crate::http::admission::Reservation;
use crate::http::app::App;
use crate::http::error::{ApiError, Code, Result};
use crate::http::upload::{CHUNKS, Pace, next};
use store::{Partial, PartialFile, Store, StoreError};

/// Quotas are checked again after this number of bytes of a piece with a checksum. Other pieces are checked when they are
/// recorded.
const CHECKED_BYTES: u64 = 16 << 20;

/// Bytes and time after which the offset is recorded: a crash of the service costs at most these.
const RECORDED_BYTES: u64 = 16 << 20;
const RECORDED_TIME: Duration = Duration::from_secs(5);

/// Appends the body to the file. If the connection breaks or the service stops, the bytes received until then are kept.
/// A piece with a checksum is kept only if it is complete and the checksum matches. The file stays locked until the
/// database has the new offset.
pub(super) async fn append(
    app: &App,
    file: PartialFile,
    mut room: Reservation,
    checksum: Option<Checksum>,
    body: Body,
) -> Result<PartialFile> {
    let has_checksum = checksum.is_some();
    let upload = file.upload().clone();
    let (sender, receiver) = mpsc::channel(CHUNKS);
    let progress = Progress {
        store: app.store.clone(),
        age: app.settings.upload_age(),
        runtime: Handle::current(),
    };
    let writer = tokio::task::spawn_blocking(move || match checksum {
        None => write(file, receiver, &progress),
        Some(checksum) => write_checked(file, receiver, checksum),
    });
    let transfer = forward_chunks(app, &mut room, &upload, has_checksum, body, sender);
    let transfer = match has_checksum {
        // A part of the piece would not be kept, so it has the time of other requests to end.
        true => transfer.await,
        false => app.closing.run_until_cancelled(transfer).await.unwrap_or_else(|| {
            let detail =
                "the service is stopping; continue the upload at the offset that HEAD returns";
            Err(ApiError::new(Code::Unavailable, detail))
        }),
    };
    let mut written = writer.await.map_err(|_| StoreError::Interrupted)??;
    match (&transfer, written.checksum_matches) {
        (Err(_), _) if has_checksum => {}
        (Ok(()), Some(false)) => {
            let detail = "the received bytes do not match the checksum; send the piece again";
            return Err(ApiError::new(Code::ChecksumMismatch, detail));
        }
        _ => {
            app.store
                .advance_partial(&mut written.file, written.bytes, app.settings.upload_age())
                .await?;
            metrics::counter!("sci_recon_upload_bytes_total").increment(written.bytes);
        }
    }
    transfer.map(|()| written.file)
}

/// Passes the chunks of the body to the writer.
///
/// Errors: 413 if the body is longer than the rest of the upload; 403 if an upload of unknown length exceeds a quota.
async fn forward_chunks(
    app: &App,
    room: &mut Reservation,
    upload: &Partial,
    has_checksum: bool,
    body: Body,
    sender: mpsc::Sender<Bytes>,
) -> Result<()> {
    let facts = &upload.facts;
    let mut stream = body.into_data_stream();
    let mut pace = Pace::default();
    let (mut bytes, mut next_check) = (0, 0);
    while let Some(chunk) = next(app, &mut pace, &mut stream).await? {
        bytes += chunk.len() as u64;
        match facts.length {
            Some(length) if bytes > length - upload.received => {
                return Err(beyond_end(length));
            }
            Some(_) => {}
            None => {
                app.admission.check_size(upload.received + bytes)?;
                // The store decides in the end. This check ends a body early that can't be accepted.
                if has_checksum && bytes > next_check {
                    app.store.check_quota(&facts.lab, facts.token, bytes).await?;
                    next_check = bytes + CHECKED_BYTES;
                }
            }
        }
        app.admission.take(room, chunk.len() as u64).await?;
        // A closed channel means that the writer failed. The caller reports the writer's error.
        if sender.send(chunk).await.is_err() {
            break;
        }
    }
    Ok(())
}

/// Reads the body of a piece of a complete upload.
///
/// Errors: 413 if it has bytes.
pub(super) async fn expect_no_bytes(app: &App, length: u64, body: Body) -> Result<()> {
    let (mut stream, mut pace) = (body.into_data_stream(), Pace::default());
    while let Some(chunk) = next(app, &mut pace, &mut stream).await? {
        if !chunk.is_empty() {
            return Err(beyond_end(length));
        }
    }
    Ok(())
}

fn beyond_end(length: u64) -> ApiError {
    let detail = format!("the upload has {length} bytes; the body is longer");
    ApiError::new(Code::TooLarge, detail)
}

struct Written {
    file: PartialFile,
    /// Number of appended bytes that are not recorded yet.
    bytes: u64,
    /// `None` for a piece without a checksum.
    checksum_matches: Option<bool>,
}

/// Records how much of an upload is on the disk.
struct Progress {
    store: Store,
    age: Duration,
    runtime: Handle,
}

impl Progress {
    fn record(&self, file: &mut PartialFile, bytes: u64) -> Result<(), StoreError> {
        file.sync()?;
        self.runtime.block_on(self.store.advance_partial(file, bytes, self.age))?;
        metrics::counter!("sci_recon_upload_bytes_total").increment(bytes);
        Ok(())
    }

    /// The next chunk, if it arrives before the deadline.
    fn receive(&self, chunks: &mut mpsc::Receiver<Bytes>, deadline: Instant) -> Received {
        let next = self.runtime.block_on(tokio::time::timeout_at(deadline.into(), chunks.recv()));
        match next {
            Ok(Some(chunk)) => Received::Chunk(chunk),
            Ok(None) => Received::End,
            Err(_) => Received::Late,
        }
    }
}

enum Received {
    Chunk(Bytes),
    End,
    Late,
}

/// Appends the chunks, and records the offset on the way.
fn write(
    mut file: PartialFile,
    mut chunks: mpsc::Receiver<Bytes>,
    progress: &Progress,
) -> Result<Written, StoreError> {
    let (mut bytes, mut deadline) = (0, Instant::now() + RECORDED_TIME);
    loop {
        match progress.receive(&mut chunks, deadline) {
            Received::Chunk(chunk) => {
                file.append(&chunk)?;
                bytes += chunk.len() as u64;
            }
            Received::Late => {}
            Received::End => break,
        }
        if bytes >= RECORDED_BYTES || Instant::now() >= deadline {
            if bytes > 0 {
                progress.record(&mut file, bytes)?;
            }
            (bytes, deadline) = (0, Instant::now() + RECORDED_TIME);
        }
    }
    file.sync()?;
    Ok(Written { file, bytes, checksum_matches: None })
}

fn write_checked(
    mut file: PartialFile,
    mut chunks: mpsc::Receiver<Bytes>,
    mut checksum: Checksum,
) -> Result<Written, StoreError> {
    let mut bytes = 0;
    while let Some(chunk) = chunks.blocking_recv() {
        file.append(&chunk)?;
        bytes += chunk.len() as u64;
        checksum.update(&chunk);
    }
    file.sync()?;
    Ok(Written { file, bytes, checksum_matches: Some(checksum.matches()) })
}
