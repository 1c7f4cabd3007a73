//! The next piece of an upload: from the network to the disk, a few chunks in memory.

use axum::body::{Body, Bytes};
use tokio::sync::mpsc;

use super::headers::Checksum;
use crate::http::app::App;
use crate::http::error::{ApiError, Code};
use crate::http::upload::{CHUNKS, next};
use crate::store::{Partial, PartialFile, StoreError};

/// Appends what comes. A cut connection keeps what has come before it, unless a checksum was named
/// for the piece: then all of the piece counts, or nothing.
pub(super) async fn append(
    app: &App,
    upload: &mut Partial,
    file: PartialFile,
    checksum: Option<Checksum>,
    body: Body,
) -> Result<(), ApiError> {
    let whole = checksum.is_some();
    let (sender, receiver) = mpsc::channel(CHUNKS);
    let writer = tokio::task::spawn_blocking(move || write(file, receiver, checksum));
    let received = pump(app, upload, body, sender).await;
    let written = writer.await.map_err(|_| StoreError::Interrupted)??;
    match (&received, written.sum_holds) {
        (Err(_), _) if whole => {}
        (Ok(()), Some(false)) => {
            let detail = "the bytes that came have another checksum; send the piece again";
            return Err(ApiError::new(Code::ChecksumMismatch, detail));
        }
        _ => {
            let end = upload.received + written.bytes;
            app.store.advance_partial(upload, end, app.upload_age).await?;
            metrics::counter!("sci_recon_upload_bytes_total").increment(written.bytes);
        }
    }
    received
}

/// Hands the chunks of the body on, no more than the upload still wants.
async fn pump(
    app: &App,
    upload: &Partial,
    body: Body,
    sender: mpsc::Sender<Bytes>,
) -> Result<(), ApiError> {
    let mut stream = body.into_data_stream();
    let mut left = upload.facts.length - upload.received;
    // What an upload in pieces still wants is promised to it by the database.
    while let Some(chunk) = next(app, &mut stream).await? {
        let Some(rest) = left.checked_sub(chunk.len() as u64) else {
            let detail = format!("the upload was begun with a length of {}", upload.facts.length);
            return Err(ApiError::new(Code::TooLarge, detail));
        };
        left = rest;
        // A writer that takes no more has failed, and says why itself.
        if sender.send(chunk).await.is_err() {
            break;
        }
    }
    Ok(())
}

struct Written {
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
    Ok(Written { bytes, sum_holds: checksum.map(Checksum::holds) })
}
