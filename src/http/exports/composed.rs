//! Files that are composed of result files while a client reads them. Their bytes depend only on the results, so a client
//! can resume a download that broke off.

use std::fmt;
use std::io::{self, BufReader};
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, Method};
use axum::response::Response;
use flate2::Crc;
use futures_util::stream::{self, BoxStream, StreamExt, TryStreamExt};
use sha2::Digest;
use tokio::fs::File;
use tokio::io::Take;
use tokio::task::JoinError;
use tokio_util::io::ReaderStream;

use super::super::app::App;
use super::super::download::{self, Download};
use super::super::error::{ApiError, Result};
use super::lines::Lines;
use engine::job::{ResultFile, SceneShape, Sha256};
use formats::FormatError;
use formats::exr::Stack;
use store::{Job, StoreError};

/// A result file that an export reads. `snapshot` is `None` for a file of the whole job.
#[derive(Debug, Clone)]
pub(super) struct Source {
    pub(super) snapshot: Option<u32>,
    pub(super) file: ResultFile,
}

/// A range of bytes of a result file.
#[derive(Debug, Clone)]
pub(super) struct FileRange {
    pub(super) source: Source,
    pub(super) start: u64,
    pub(super) length: u64,
}

/// Makes the head of a derived file from that of the stack.
pub(super) type MakeHead = Arc<dyn Fn(&Stack) -> Vec<u8> + Send + Sync>;

/// Bytes that exist, or are derived from the stack of frames, when a client reads them.
#[derive(Clone)]
pub(super) enum Piece {
    Bytes(Bytes),
    File(FileRange),
    /// The `length` bytes before the lines of a derived file.
    Head {
        source: Source,
        shape: SceneShape,
        length: u64,
        make: MakeHead,
    },
    /// Lines of a result file, each composed with bytes that all lines share.
    Lines {
        source: Source,
        shared: Option<FileRange>,
        lines: Lines,
    },
}

/// A file as an export or an archive offers it.
#[derive(Clone)]
pub(super) struct Content {
    pub(super) pieces: Vec<Piece>,
    /// The recorded CRC-32; `None` for content without a record.
    pub(super) crc32: Option<u32>,
}

/// Composes the bytes between contents, such as headers of an archive, from the CRC-32 of the contents.
pub(super) type Framing = Arc<dyn Fn(&[u32]) -> Vec<u8> + Send + Sync>;

#[derive(Clone)]
pub(super) enum Part {
    Piece(Piece),
    /// `length` bytes, which `make` composes from the CRC-32 of the contents.
    Framing {
        contents: Arc<[Content]>,
        length: u64,
        make: Framing,
    },
}

impl fmt::Debug for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Part of {} bytes", self.length())
    }
}

impl Part {
    pub(super) fn length(&self) -> u64 {
        match self {
            Self::Piece(piece) => piece.length(),
            Self::Framing { length, .. } => *length,
        }
    }

    /// The result files whose bytes are in the part.
    fn sources(&self) -> Vec<&Source> {
        match self {
            Self::Piece(piece) => piece.sources(),
            Self::Framing { .. } => Vec::new(),
        }
    }

    /// Adds everything that determines the bytes to a hash.
    fn hash_inputs(&self, hasher: &mut sha2::Sha256) {
        match self {
            Self::Piece(piece) => piece.hash_inputs(hasher),
            Self::Framing { contents, length, .. } => {
                hasher.update(format!("framing {length}\n"));
                let pieces = contents.iter().flat_map(|content| &content.pieces);
                pieces.for_each(|piece| piece.hash_inputs(hasher));
            }
        }
    }

    /// Reads `take` bytes of the part after the first `skip` bytes.
    async fn read(self, app: App, job: Arc<Job>, skip: u64, take: u64) -> io::Result<ByteStream> {
        match self {
            Self::Piece(piece) => piece.read(&app, &job, skip, take).await,
            Self::Framing { contents, length, make } => {
                let mut sums = Vec::with_capacity(contents.len());
                for content in contents.iter() {
                    sums.push(content.crc32(&app, &job).await?);
                }
                let bytes = Bytes::from(make(&sums));
                debug_assert_eq!(bytes.len() as u64, length);
                Ok(slice_stream(&bytes, skip, take))
            }
        }
    }
}

impl Content {
    pub(super) fn length(&self) -> u64 {
        self.pieces.iter().map(Piece::length).sum()
    }

    async fn crc32(&self, app: &App, job: &Job) -> io::Result<u32> {
        if let Some(sum) = self.crc32 {
            return Ok(sum);
        }
        let mut crc = Crc::new();
        for piece in &self.pieces {
            let mut bytes = piece.clone().read(app, job, 0, piece.length()).await?;
            while let Some(bytes) = bytes.try_next().await? {
                crc.update(&bytes);
            }
        }
        Ok(crc.sum())
    }
}

impl Piece {
    pub(super) fn length(&self) -> u64 {
        match self {
            Self::Bytes(bytes) => bytes.len() as u64,
            Self::File(section) => section.length,
            Self::Head { length, .. } => *length,
            Self::Lines { lines, .. } => lines.length(),
        }
    }

    fn sources(&self) -> Vec<&Source> {
        match self {
            Self::Bytes(_) => Vec::new(),
            Self::File(section) => vec![&section.source],
            Self::Head { source, .. } => vec![source],
            Self::Lines { source, shared, .. } => {
                [source].into_iter().chain(shared.as_ref().map(|shared| &shared.source)).collect()
            }
        }
    }

    fn hash_inputs(&self, hasher: &mut sha2::Sha256) {
        match self {
            Self::Bytes(bytes) => {
                hasher.update(format!("bytes {}\n", bytes.len()));
                hasher.update(bytes);
            }
            Self::File(section) => section.hash_inputs(hasher),
            Self::Head { source, length, .. } => {
                hasher.update(format!("head {length} {}\n", source.file.sha256));
            }
            Self::Lines { source, shared, lines } => {
                hasher.update(format!("{lines:?} {} {}\n", lines.start, source.file.sha256));
                shared.iter().for_each(|shared| shared.hash_inputs(hasher));
            }
        }
    }

    /// Reads `take` bytes of the piece after the first `skip` bytes.
    async fn read(self, app: &App, job: &Job, skip: u64, take: u64) -> io::Result<ByteStream> {
        match self {
            Self::Bytes(bytes) => Ok(slice_stream(&bytes, skip, take)),
            Self::File(FileRange { source, start, .. }) => {
                let section = FileRange { source, start: start + skip, length: take };
                Ok(section.read(app, job).await?.boxed())
            }
            Self::Head { source, shape, length, make } => {
                let stack = open(app, job, &source).await.map_err(abort)?;
                let stack = read_stack(stack, shape).await.map_err(io::Error::other)?;
                let bytes = Bytes::from(make(&stack));
                debug_assert_eq!(bytes.len() as u64, length);
                Ok(slice_stream(&bytes, skip, take))
            }
            Self::Lines { source, shared, lines } => {
                let shared = match shared {
                    Some(section) => section.read(app, job).await?.try_collect().await?,
                    None => Vec::<Bytes>::new(),
                };
                let file = open(app, job, &source).await.map_err(abort)?;
                Ok(lines.read(file, shared.concat().into(), skip, take).await?.boxed())
            }
        }
    }
}

impl FileRange {
    /// All bytes of a file.
    pub(super) fn whole(source: Source) -> Self {
        let length = source.file.size;
        Self { source, start: 0, length }
    }

    fn hash_inputs(&self, hasher: &mut sha2::Sha256) {
        let Self { source, start, length } = self;
        hasher.update(format!("{start} {length} {}\n", source.file.sha256));
    }

    async fn read(&self, app: &App, job: &Job) -> io::Result<ReaderStream<Take<File>>> {
        let file = open(app, job, &self.source).await.map_err(abort)?;
        let bytes = download::stream_range(file, self.start, self.length).await;
        bytes.map_err(|_| io::Error::other("a stored file can't be read"))
    }
}

/// Reads the head of a stored stack.
pub(super) async fn read_stack(
    stored: std::fs::File,
    shape: SceneShape,
) -> Result<Stack, FormatError> {
    let size = (shape.frames, shape.height, shape.width);
    let read = move || Stack::read(BufReader::new(stored), size, shape.channels());
    let failed = |error: JoinError| FormatError::Internal(error.to_string());
    tokio::task::spawn_blocking(read).await.map_err(failed)?
}

type ByteStream = BoxStream<'static, io::Result<Bytes>>;

/// Streams `take` bytes after the first `skip` bytes.
#[allow(clippy::cast_possible_truncation)] // within the bytes
fn slice_stream(bytes: &Bytes, skip: u64, take: u64) -> ByteStream {
    let bytes = bytes.slice(skip as usize..(skip + take) as usize);
    stream::iter([Ok(bytes)]).boxed()
}

/// Opens a result file.
///
/// Errors: [`StoreError::Interrupted`] if a retried job has replaced the file since the request began.
async fn open(app: &App, job: &Job, source: &Source) -> Result<std::fs::File, StoreError> {
    let (file, _, opened) = app.store.open_result(job, source.snapshot, &source.file.name).await?;
    if file.sha256 == source.file.sha256 { Ok(opened) } else { Err(StoreError::Interrupted) }
}

/// Logs an error that occurs after the status was sent. The answer can only be aborted then.
fn abort(error: StoreError) -> io::Error {
    tracing::error!(%error, "a download is aborted");
    io::Error::other(error)
}

/// A file composed of parts.
#[derive(Debug)]
pub(super) struct Composed {
    pub(super) parts: Vec<Part>,
    /// The recorded hash of the bytes; `None` for a file without a record.
    pub(super) sha256: Option<Sha256>,
    /// The media type.
    pub(super) kind: &'static str,
    pub(super) disposition: String,
}

impl Composed {
    /// Answers with the file or the requested range.
    ///
    /// Errors: 500 if the first result file of the range is damaged. A damaged file further on aborts the answer.
    pub(super) async fn send(
        self,
        app: &App,
        job: Job,
        request: (&Method, &HeaderMap),
    ) -> Result<Response> {
        let sha256 = self.sha256.unwrap_or_else(|| {
            let mut hasher = sha2::Sha256::new();
            self.parts.iter().for_each(|part| part.hash_inputs(&mut hasher));
            Sha256::new(hasher.finalize().into())
        });
        let download = Download {
            sha256,
            size: self.parts.iter().map(Part::length).sum(),
            kind: self.kind,
            disposition: self.disposition,
            // A range of a JSON document is not valid JSON.
            accepts_ranges: self.kind != "application/json",
        };
        let parts = self.parts;
        let read = async |start, length| {
            let selection = select(parts, start, length);
            let mut sources = selection.iter().map(|selected| selected.part.sources());
            let first_sources = sources.find(|sources| !sources.is_empty());
            for source in first_sources.unwrap_or_default() {
                open(app, &job, source).await?;
            }
            let (app, job) = (app.clone(), Arc::new(job));
            let streams = stream::iter(selection).then(move |Selected { part, skip, take }| {
                let (app, job) = (app.clone(), job.clone());
                async move {
                    // The body is not polled while the client is slow, and an unpolled query keeps its connection
                    // to the database. A separate task completes the query anyway.
                    let read = tokio::spawn(part.read(app, job, skip, take));
                    read.await.unwrap_or_else(|error| Err(io::Error::other(error)))
                }
            });
            Ok::<_, ApiError>(Body::from_stream(streams.try_flatten()))
        };
        download.answer(read, request).await
    }
}

/// The bytes of a part that are in a range of the file.
struct Selected {
    part: Part,
    /// Number of bytes before the range.
    skip: u64,
    /// Number of bytes in the range.
    take: u64,
}

/// Selects the parts with bytes in a range of the file.
fn select(parts: Vec<Part>, start: u64, length: u64) -> Vec<Selected> {
    let end = start + length;
    let mut part_end = 0;
    let mut selection = Vec::new();
    for part in parts {
        let part_start = part_end;
        part_end += part.length();
        let (from, to) = (start.max(part_start), end.min(part_end));
        if from < to {
            selection.push(Selected { part, skip: from - part_start, take: to - from });
        }
    }
    selection
}

#[cfg(test)]
mod tests {
    use axum::body::Bytes;

    use super::{Part, Piece, select};

    #[test]
    fn a_range_selects_bytes_of_each_part() {
        let part = |text| Part::Piece(Piece::Bytes(Bytes::from(text)));
        let parts = || ["abc", "", "defg"].map(part).to_vec();
        let ranges = |start, length| {
            let selection = select(parts(), start, length);
            selection.iter().map(|selected| (selected.skip, selected.take)).collect::<Vec<_>>()
        };
        assert_eq!(ranges(0, 7), [(0, 3), (0, 4)]);
        assert_eq!(ranges(2, 2), [(2, 1), (0, 1)]);
        assert_eq!(ranges(3, 1), [(0, 1)]);
        assert_eq!(ranges(7, 0), []);
    }
}
