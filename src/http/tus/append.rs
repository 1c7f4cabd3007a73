//! The next piece of an upload: from the network to the disk, a few chunks in memory.

use axum::body::{Body, Bytes};
use tokio::sync::mpsc;

use super::headers::Checksum;
use crate::http::admission::Reservation;
use crate::http::app::App;
use crate::http::error::{ApiError, Code, Result};
use crate::http::upload::{CHUNKS, Pace, next};
use store::{PartialFile, StoreError};

/// Appends what comes. A cut connection keeps what has come before it, unless a checksum was named
/// for the piece: then all of the piece counts, or nothing. The file stays locked until its row says so.
pub(super) async fn append(
    app: &App,
    file: PartialFile,
    mut room: Reservation,
    checksum: Option<Checksum>,
    body: Body,
) -> Result<PartialFile> {
    let whole = checksum.is_some();
    let (length, received) = (file.upload().facts.length, file.upload().received);
    let (sender, receiver) = mpsc::channel(CHUNKS);
    let writer = tokio::task::spawn_blocking(move || write(file, receiver, checksum));
    let pumped = pump(app, &mut room, (length, length - received), body, sender).await;
    let mut written = writer.await.map_err(|_| StoreError::Interrupted)??;
    match (&pumped, written.sum_holds) {
        (Err(_), _) if whole => {}
        (Ok(()), Some(false)) => {
            let detail = "the bytes that came have another checksum; send the piece again";
            return Err(ApiError::new(Code::ChecksumMismatch, detail));
        }
        _ => {
            app.store
                .advance_partial(&mut written.file, written.bytes, app.settings.upload_age())
                .await?;
            metrics::counter!("sci_recon_upload_bytes_total").increment(written.bytes);
        }
    }
    pumped.map(|()| written.file)
}

/// Hands the chunks of the body on, no more than the upload still wants.
async fn pump(
    app: &App,
    room: &mut Reservation,
    (length, mut left): (u64, u64),
    body: Body,
    sender: mpsc::Sender<Bytes>,
) -> Result<()> {
    let mut stream = body.into_data_stream();
    let mut pace = Pace::default();
    while let Some(chunk) = next(app, &mut pace, &mut stream).await? {
        let Some(rest) = left.checked_sub(chunk.len() as u64) else {
            let detail = format!("the upload was begun with a length of {length}");
            return Err(ApiError::new(Code::TooLarge, detail));
        };
        left = rest;
        app.admission.take(room, chunk.len() as u64).await?;
        // A writer that takes no more has failed, and says why itself.
        if sender.send(chunk).await.is_err() {
            break;
        }
    }
    Ok(())
}

struct Written {
    file: PartialFile,
    bytes: u64,
    sum_holds: Option<bool>,
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
    Ok(Written { file, bytes, sum_holds: checksum.map(Checksum::holds) })
}
