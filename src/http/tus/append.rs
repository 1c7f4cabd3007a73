//! Receives a piece of an upload and appends it to the file. Memory holds a few chunks at a time.

use axum::body::{Body, Bytes};
use tokio::sync::mpsc;

use super::headers::Checksum;
use crate::http::admission::Reservation;
use crate::http::app::App;
use crate::http::error::{ApiError, Code, Result};
use crate::http::upload::{CHUNKS, Pace, next};
use store::{Partial, PartialFile, StoreError};

/// Bytes of a piece between two checks of the quotas.
const CHECKED_BYTES: u64 = 16 << 20;

/// Appends the body to the file. If the connection breaks, the bytes received until then are kept. A piece with a
/// checksum is kept only if it is complete and the checksum matches. The file stays locked until the database has the
/// new offset.
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
    let writer = tokio::task::spawn_blocking(move || write(file, receiver, checksum));
    let transfer = forward_chunks(app, &mut room, &upload, body, sender).await;
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
                let detail = format!("the upload has {length} bytes; the body is longer");
                return Err(ApiError::new(Code::TooLarge, detail));
            }
            Some(_) => {}
            None => {
                app.admission.check_size(upload.received + bytes)?;
                // The store decides in the end. This check ends a body early that can't be accepted.
                if bytes > next_check {
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

struct Written {
    file: PartialFile,
    /// Number of bytes that were appended.
    bytes: u64,
    /// `None` for a piece without a checksum.
    checksum_matches: Option<bool>,
}

fn write(
    mut file: PartialFile,
    mut chunks: mpsc::Receiver<Bytes>,
    mut checksum: Option<Checksum>,
) -> Result<Written, StoreError> {
    let mut bytes = 0;
    while let Some(chunk) = chunks.blocking_recv() {
        file.append(&chunk)?;
        bytes += chunk.len() as u64;
        if let Some(checksum) = &mut checksum {
            checksum.update(&chunk);
        }
    }
    file.sync()?;
    Ok(Written { file, bytes, checksum_matches: checksum.map(Checksum::matches) })
}
