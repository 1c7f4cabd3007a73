//! Files in a stream, in chunks that fit into a message. The first chunk is written last: it marks a complete file.
//! A received file is accepted only if it has the stated hash.

use std::pin::pin;

use async_nats::jetstream::stream::DirectGetErrorKind;
use bytes::Bytes;
use futures_util::{Stream, StreamExt, TryStreamExt, stream};

use super::connection::{ClusterError, Connection};
use super::message::Input;
use super::names;
use engine::job::Sha256;

/// Bytes of a chunk: below the default limit of a message, 1 MiB, with room for its headers.
const CHUNK: usize = 512 * 1024;
/// Chunks in flight at a time.
const AT_ONCE: usize = 4;

/// Reason for which a file can't be fetched.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
    /// The stream has no such chunk, or a replica does not have it yet.
    #[error("a chunk is missing")]
    Missing,
    /// The bytes do not have the stated length or hash.
    #[error("its bytes are not those that were sent")]
    Damaged,
    /// The stream can't be read.
    #[error("{0}")]
    Failed(String),
}

impl Connection {
    /// Puts a file under `prefix`, a subject of a stream.
    /// Errors: the stream is full, or has no quorum.
    pub(super) async fn put(&self, prefix: &str, bytes: Bytes) -> Result<(), ClusterError> {
        let count = chunks(bytes.len());
        let rest = stream::iter((1..count).map(|n| self.put_chunk(prefix, &bytes, n)));
        rest.buffer_unordered(AT_ONCE).try_collect::<()>().await?;
        self.put_chunk(prefix, &bytes, 0).await
    }

    async fn put_chunk(&self, prefix: &str, bytes: &Bytes, n: usize) -> Result<(), ClusterError> {
        let chunk = bytes.slice(n * CHUNK..bytes.len().min((n + 1) * CHUNK));
        let sent = self.context.publish(format!("{prefix}.{n}"), chunk).await;
        let stored = sent.map_err(ClusterError::nats("put a file"))?.await;
        stored.map(|_| ()).map_err(ClusterError::nats("put a file"))
    }

    /// Gets the file under `prefix` out of a stream.
    /// Errors: see [`BlobError`].
    pub(super) async fn get(
        &self,
        stream: &str,
        prefix: &str,
        wanted: Input,
    ) -> Result<Vec<u8>, BlobError> {
        // Memory grows with the bytes that arrive; the stated size may be wrong.
        let mut bytes = Vec::new();
        let mut chunks = pin!(self.chunks(stream, prefix, wanted.bytes, 0));
        while let Some(chunk) = chunks.try_next().await? {
            bytes.extend_from_slice(&chunk);
        }
        let hashed = tokio::task::spawn_blocking(move || (Sha256::of(&bytes), bytes)).await;
        let (sha256, bytes) = hashed.map_err(|error| BlobError::Failed(error.to_string()))?;
        if sha256 == wanted.sha256 { Ok(bytes) } else { Err(BlobError::Damaged) }
    }

    /// Gets the chunks of a file in order, starting at number `first`. `bytes` is the size of the file. A chunk with a
    /// wrong length is [`BlobError::Damaged`]. The caller checks the hash.
    pub(super) fn chunks(
        &self,
        stream: &str,
        prefix: &str,
        bytes: u64,
        first: u64,
    ) -> impl Stream<Item = Result<Bytes, BlobError>> {
        let size = CHUNK as u64;
        let chunks = stream::iter(first..bytes.div_ceil(size).max(1)).map(move |n| async move {
            let chunk = self.get_chunk(stream, format!("{prefix}.{n}")).await?;
            let fits = chunk.len() as u64 == size.min(bytes - n * size);
            if fits { Ok(chunk) } else { Err(BlobError::Damaged) }
        });
        chunks.buffered(AT_ONCE)
    }

    async fn get_chunk(&self, stream: &str, subject: String) -> Result<Bytes, BlobError> {
        let stream = self.context.get_stream_no_info(stream).await;
        let stream = stream.map_err(|error| BlobError::Failed(error.to_string()))?;
        let message = stream.direct_get_last_for_subject(subject).await;
        message.map(|message| message.payload).map_err(|error| match error.kind() {
            DirectGetErrorKind::NotFound => BlobError::Missing,
            _ => BlobError::Failed(error.to_string()),
        })
    }

    /// Removes all messages of a stream whose subjects match.
    /// Errors: the server refuses, or has no quorum.
    pub(super) async fn purge(&self, stream: &str, subjects: String) -> Result<(), ClusterError> {
        let failed = ClusterError::nats("purge a stream");
        let stream = self.context.get_stream_no_info(stream).await;
        let stream = stream.map_err(ClusterError::nats("find a stream"))?;
        let purged = stream.purge().filter(subjects).await;
        purged.map(|_| ()).map_err(failed)
    }

    /// Removes a message of a tile. A message that was already removed is not an error.
    pub(super) async fn drop_task(&self, seq: i64) {
        if let Ok(stream) = self.context.get_stream_no_info(names::TASKS).await
            && let Err(error) = stream.delete_message(seq.cast_unsigned()).await
        {
            tracing::debug!(%error, seq, "a message can't be removed");
        }
    }
}

fn chunks(bytes: usize) -> usize {
    bytes.div_ceil(CHUNK).max(1)
}

#[cfg(test)]
mod tests {
    use super::{CHUNK, chunks};

    #[test]
    fn every_file_has_a_first_chunk() {
        assert_eq!([0, 1, CHUNK, CHUNK + 1].map(chunks), [1, 1, 1, 2]);
    }
}
