//! A file that lies nowhere: it is put together, as it is read, of result files and of the bytes between
//! them. What a byte of it is follows from the results alone, so that a download can go on where it was cut.

use std::fmt;
use std::io;
use std::sync::Arc;

use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, Method};
use axum::response::Response;
use futures_util::stream::{self, BoxStream, StreamExt, TryStreamExt};
use sha2::Digest;
use tokio::fs::File;
use tokio::io::Take;
use tokio_util::io::ReaderStream;

use super::super::app::App;
use super::super::download::{self, Download};
use super::super::error::{ApiError, Result};
use super::lines::Lines;
use engine::job::{ResultFile, Sha256};
use store::{Job, StoreError};

/// A result file of a snapshot, or of the whole job.
#[derive(Debug, Clone)]
pub(super) struct Piece {
    pub(super) snapshot: Option<u32>,
    pub(super) file: ResultFile,
}

/// What stands between result files and needs their check sums.
pub(super) type Framing = Arc<dyn Fn(&[u32]) -> Vec<u8> + Send + Sync>;

#[derive(Clone)]
pub(super) enum Part {
    Bytes(Bytes),
    /// Bytes of a result file.
    File {
        piece: Piece,
        start: u64,
        length: u64,
    },
    /// So many bytes, which follow from the CRC-32 of these files.
    Framing {
        pieces: Arc<[Piece]>,
        length: u64,
        make: Framing,
    },
    /// Lines that are made of those of a result file, and of bytes of another one: where they begin, and how many.
    Lines {
        piece: Piece,
        shared: (Piece, u64, u64),
        lines: Lines,
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
            Self::Bytes(bytes) => bytes.len() as u64,
            Self::File { length, .. } | Self::Framing { length, .. } => *length,
            Self::Lines { lines, .. } => lines.length(),
        }
    }

    /// The result files whose bytes are in it.
    fn pieces(&self) -> Vec<&Piece> {
        match self {
            Self::Bytes(_) | Self::Framing { .. } => Vec::new(),
            Self::File { piece, .. } => vec![piece],
            Self::Lines { piece, shared: (shared, ..), .. } => vec![piece, shared],
        }
    }

    /// Adds to a hash what the bytes follow from.
    fn describe(&self, hasher: &mut sha2::Sha256) {
        match self {
            Self::Bytes(bytes) => {
                hasher.update(format!("bytes {}\n", bytes.len()));
                hasher.update(bytes);
            }
            Self::File { piece, start, length } => {
                hasher.update(format!("{start} {length} {}\n", piece.file.sha256));
            }
            Self::Framing { pieces, length, .. } => {
                hasher.update(format!("framing {length}\n"));
                pieces.iter().for_each(|piece| hasher.update(format!("{}\n", piece.file.sha256)));
            }
            Self::Lines { piece, shared: (shared, start, length), lines } => {
                hasher.update(format!("{lines:?} {} {}\n", lines.start, piece.file.sha256));
                hasher.update(format!("{start} {length} {}\n", shared.file.sha256));
            }
        }
    }

    /// The bytes from `skip` on, `take` of them.
    async fn read(self, app: App, job: Arc<Job>, skip: u64, take: u64) -> io::Result<Bytewise> {
        match self {
            Self::Bytes(bytes) => Ok(once(&bytes, skip, take)),
            Self::File { piece, start, .. } => {
                Ok(part(&app, &job, (&piece, start + skip, take)).await?.boxed())
            }
            Self::Framing { pieces, length, make } => {
                let mut sums = Vec::with_capacity(pieces.len());
                for piece in pieces.iter() {
                    let name = &piece.file.name;
                    let sum = app.store.result_crc32(&job, piece.snapshot, name).await;
                    sums.push(sum.map_err(told)?);
                }
                let bytes = Bytes::from(make(&sums));
                debug_assert_eq!(bytes.len() as u64, length);
                Ok(once(&bytes, skip, take))
            }
            Self::Lines { piece, shared: (shared, start, length), lines } => {
                let shared = part(&app, &job, (&shared, start, length)).await?;
                let shared: Vec<Bytes> = shared.try_collect().await?;
                let file = open(&app, &job, &piece).await.map_err(told)?;
                Ok(lines.read(file, shared.concat().into(), (skip, take)).await?.boxed())
            }
        }
    }
}

type Bytewise = BoxStream<'static, io::Result<Bytes>>;

#[allow(clippy::cast_possible_truncation)] // within the bytes
fn once(bytes: &Bytes, skip: u64, take: u64) -> Bytewise {
    let bytes = bytes.slice(skip as usize..(skip + take) as usize);
    stream::iter([Ok(bytes)]).boxed()
}

/// Opens a result file, unless it is another one by now.
async fn open(app: &App, job: &Job, piece: &Piece) -> Result<std::fs::File, StoreError> {
    let (file, _, opened) = app.store.open_result(job, piece.snapshot, &piece.file.name).await?;
    if file.sha256 == piece.file.sha256 { Ok(opened) } else { Err(StoreError::Interrupted) }
}

/// Bytes of a result file: where they begin, and how many.
async fn part(
    app: &App,
    job: &Job,
    (piece, start, length): (&Piece, u64, u64),
) -> io::Result<ReaderStream<Take<File>>> {
    let file = open(app, job, piece).await.map_err(told)?;
    let bytes = download::part(file, start, length).await;
    bytes.map_err(|_| io::Error::other("a stored file can't be read"))
}

/// An answer that has begun can only break off; why, the log says.
fn told(error: StoreError) -> io::Error {
    tracing::error!(%error, "a download breaks off");
    io::Error::other(error)
}

/// A file of parts.
#[derive(Debug)]
pub(super) struct Composed {
    pub(super) parts: Vec<Part>,
    /// The media type.
    pub(super) kind: &'static str,
    pub(super) disposition: String,
}

impl Composed {
    /// Answers with the file or the part of it that is asked for.
    /// Errors: 500 if the first result files in it are damaged; where a later one is, the answer breaks off.
    pub(super) async fn send(
        self,
        app: &App,
        job: Job,
        request: (&Method, &HeaderMap),
    ) -> Result<Response> {
        let mut hasher = sha2::Sha256::new();
        self.parts.iter().for_each(|part| part.describe(&mut hasher));
        let download = Download {
            sha256: Sha256::new(hasher.finalize().into()),
            size: self.parts.iter().map(Part::length).sum(),
            kind: self.kind,
            disposition: self.disposition,
            in_parts: true,
        };
        let parts = self.parts;
        let read = async |start, length| {
            let wanted = within(parts, start, length);
            let first =
                wanted.iter().map(|(part, ..)| part.pieces()).find(|found| !found.is_empty());
            for piece in first.unwrap_or_default() {
                open(app, &job, piece).await?;
            }
            let (app, job) = (app.clone(), Arc::new(job));
            let streams = stream::iter(wanted).then(move |(part, skip, take)| {
                let (app, job) = (app.clone(), job.clone());
                async move {
                    // Runs as a separate task: nobody polls the body while the client is slow, and an unpolled
                    // query keeps its connection.
                    let read = tokio::spawn(part.read(app, job, skip, take));
                    read.await.unwrap_or_else(|error| Err(io::Error::other(error)))
                }
            });
            Ok::<_, ApiError>(Body::from_stream(streams.try_flatten()))
        };
        download.answer(read, request).await
    }
}

/// The parts that have bytes in a range, with what is left out of the first and what is taken of each.
fn within(parts: Vec<Part>, start: u64, length: u64) -> Vec<(Part, u64, u64)> {
    let (mut at, end) = (0, start + length);
    let mut found = Vec::new();
    for part in parts {
        let (from, to) = (at, at + part.length());
        at = to;
        let (first, last) = (start.max(from), end.min(to));
        if first < last {
            found.push((part, first - from, last - first));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use axum::body::Bytes;

    use super::{Part, within};

    #[test]
    fn a_range_takes_what_it_needs_of_each_part() {
        let parts = || ["abc", "", "defg"].map(|text| Part::Bytes(Bytes::from(text))).to_vec();
        let taken = |start, length| {
            let found = within(parts(), start, length);
            found.iter().map(|(_, skip, take)| (*skip, *take)).collect::<Vec<_>>()
        };
        assert_eq!(taken(0, 7), [(0, 3), (0, 4)]);
        assert_eq!(taken(2, 2), [(2, 1), (0, 1)]);
        assert_eq!(taken(3, 1), [(0, 1)]);
        assert_eq!(taken(7, 0), []);
    }
}
