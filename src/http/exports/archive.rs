//! `results.zip`: all that a job has made, stored and not compressed. Its layout follows from names and sizes
//! alone, so that any range of it can be made by itself; the `zip` crate writes from the front to the end.

use std::sync::Arc;

use axum::http::{HeaderMap, Method};
use axum::response::Response;

use super::super::error::Result;
use super::super::results::{attachment, result_file};
use super::clip::Clip;
use super::composed::{Composed, Framing, Part, Piece};

/// 45 stands for version 4.5, the first with files above 4 GiB.
const VERSION: u16 = 45;
/// In the field of 32 bits: the number stands in the extra field, in 64.
const ELSEWHERE: u32 = u32::MAX;
/// 1 January 1980: the archive is made of the results alone.
const DATE: u16 = 0x21;
/// Names are UTF-8.
const FLAGS: u16 = 1 << 11;
const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
const END_64: u32 = 0x0606_4b50;
const LOCATOR_64: u32 = 0x0706_4b50;

/// `zip` of a job.
pub(super) async fn archive(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let Clip { app, job, .. } = clip;
    // The last file that a job makes.
    let (manifest, _) = result_file(&app, &job, None, "manifest.json").await?;
    let mut members = Vec::new();
    for snapshot in job.spec.snapshots.indices() {
        for file in app.store.result_files(&job, Some(snapshot)).await? {
            let name = format!("snapshot_{snapshot:04}/{}", file.name);
            members.push((name, Piece { snapshot: Some(snapshot), file }));
        }
    }
    members.push((manifest.name.clone(), Piece { snapshot: None, file: manifest }));
    let disposition = attachment(job.id, None, "results.zip");
    let composed = Composed { parts: parts(members), kind: "application/zip", disposition };
    composed.send(&app, job, request).await
}

/// A file of the archive and where it begins.
#[derive(Debug, Clone)]
struct Member {
    name: String,
    size: u64,
    at: u64,
}

/// The archive of these files.
fn parts(files: Vec<(String, Piece)>) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut members = Vec::new();
    let mut at = 0;
    let pieces: Arc<[Piece]> = files.iter().map(|(_, piece)| piece.clone()).collect();
    for (name, piece) in files {
        let size = piece.file.size;
        let member = Member { name, size, at };
        let length = member.local(0).len() as u64;
        at += length + size;
        members.push(member.clone());
        let make: Framing = Arc::new(move |sums: &[u32]| member.local(sums[0]));
        parts.push(Part::Framing { pieces: [piece.clone()].into(), length, make });
        parts.push(Part::File { piece, start: 0, length: size });
    }
    let length = directory(&members, &vec![0; members.len()], at).len() as u64;
    let make: Framing = Arc::new(move |sums: &[u32]| directory(&members, sums, at));
    parts.push(Part::Framing { pieces, length, make });
    parts
}

impl Member {
    /// The header before its bytes.
    fn local(&self, crc32: u32) -> Vec<u8> {
        let extra = extra(&[self.size, self.size]);
        let mut bytes = Vec::new();
        bytes.extend(LOCAL.to_le_bytes());
        self.common(&mut bytes, crc32, &extra);
        bytes.extend(self.name.as_bytes());
        bytes.extend(extra);
        bytes
    }

    /// Its entry in the directory.
    fn central(&self, crc32: u32, bytes: &mut Vec<u8>) {
        let extra = extra(&[self.size, self.size, self.at]);
        bytes.extend(CENTRAL.to_le_bytes());
        // Made on Unix, for its modes.
        bytes.extend((3 << 8 | VERSION).to_le_bytes());
        self.common(bytes, crc32, &extra);
        // No comment, first disk, no attributes inside.
        bytes.extend([0; 6]);
        // A regular file that all may read.
        bytes.extend((0o100_644_u32 << 16).to_le_bytes());
        bytes.extend(short(self.at).to_le_bytes());
        bytes.extend(self.name.as_bytes());
        bytes.extend(extra);
    }

    /// What both have: from the version to the length of the extra field.
    fn common(&self, bytes: &mut Vec<u8>, crc32: u32, extra: &[u8]) {
        let size = short(self.size).to_le_bytes();
        // Method 0 is stored; midnight.
        for field in [VERSION, FLAGS, 0, 0, DATE] {
            bytes.extend(field.to_le_bytes());
        }
        bytes.extend(crc32.to_le_bytes());
        bytes.extend(size);
        bytes.extend(size);
        bytes.extend((self.name.len() as u16).to_le_bytes());
        bytes.extend((extra.len() as u16).to_le_bytes());
    }
}

/// A number in a field of 32 bits.
fn short(number: u64) -> u32 {
    u32::try_from(number).unwrap_or(ELSEWHERE)
}

/// The field for numbers of which another field says that they stand elsewhere.
fn extra(numbers: &[u64]) -> Vec<u8> {
    let large = numbers.iter().filter(|number| short(**number) == ELSEWHERE);
    let numbers: Vec<u8> = large.flat_map(|number| number.to_le_bytes()).collect();
    if numbers.is_empty() {
        return numbers;
    }
    let mut field = 1_u16.to_le_bytes().to_vec();
    field.extend((numbers.len() as u16).to_le_bytes());
    field.extend(numbers);
    field
}

/// The directory, which begins at this place, and the end.
fn directory(members: &[Member], sums: &[u32], at: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (member, crc32) in members.iter().zip(sums) {
        member.central(*crc32, &mut bytes);
    }
    let (count, size) = (members.len() as u64, bytes.len() as u64);
    let few = u16::try_from(count).unwrap_or(u16::MAX);
    if few == u16::MAX || short(size) == ELSEWHERE || short(at) == ELSEWHERE {
        let end = at + size;
        bytes.extend(END_64.to_le_bytes());
        // Bytes of the record behind this field.
        bytes.extend(44_u64.to_le_bytes());
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend([0; 8]);
        for number in [count, count, size, at] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(LOCATOR_64.to_le_bytes());
        bytes.extend([0; 4]);
        bytes.extend(end.to_le_bytes());
        bytes.extend(1_u32.to_le_bytes());
    }
    bytes.extend(END.to_le_bytes());
    bytes.extend([0; 4]);
    bytes.extend(few.to_le_bytes());
    bytes.extend(few.to_le_bytes());
    bytes.extend(short(size).to_le_bytes());
    bytes.extend(short(at).to_le_bytes());
    bytes.extend([0; 2]);
    bytes
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Seek, SeekFrom};

    use flate2::Crc;

    use super::{Part, Piece, parts};
    use engine::job::{ResultFile, Sha256};

    fn files(sizes: &[u64]) -> Vec<(String, Piece)> {
        let file = |(index, size): (usize, &u64)| {
            let name = format!("file_{index}");
            let file = ResultFile { name: name.clone(), size: *size, sha256: Sha256::of(b"") };
            (name, Piece { snapshot: None, file })
        };
        sizes.iter().enumerate().map(file).collect()
    }

    /// The archive of files of zeros, as something to read: where each part begins, and its bytes if they are
    /// no zeros.
    struct Zeros {
        parts: Vec<(u64, Option<Vec<u8>>)>,
        length: u64,
        at: u64,
    }

    impl Zeros {
        fn new(sizes: &[u64]) -> Self {
            let (mut length, mut found) = (0, Vec::new());
            for part in parts(files(sizes)) {
                let bytes = match &part {
                    Part::Framing { pieces, make, .. } => {
                        let sums = pieces.iter().map(|piece| crc(piece.file.size));
                        Some(make(&sums.collect::<Vec<_>>()))
                    }
                    _ => None,
                };
                found.push((length, bytes));
                length += part.length();
            }
            Self { parts: found, length, at: 0 }
        }
    }

    fn crc(size: u64) -> u32 {
        // Only small files are read.
        let mut crc = Crc::new();
        crc.update(&vec![0; if size < 1000 { size as usize } else { 0 }]);
        crc.sum()
    }

    impl Read for Zeros {
        fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
            if self.at >= self.length {
                return Ok(0);
            }
            let next = self.parts.partition_point(|(begin, _)| *begin <= self.at);
            let end = self.parts.get(next).map_or(self.length, |(begin, _)| *begin);
            let (begin, bytes) = &self.parts[next - 1];
            let count = buffer.len().min((end - self.at) as usize);
            match bytes {
                Some(bytes) => {
                    let skip = (self.at - begin) as usize;
                    buffer[..count].copy_from_slice(&bytes[skip..skip + count]);
                }
                None => buffer[..count].fill(0),
            }
            self.at += count as u64;
            Ok(count)
        }
    }

    impl Seek for Zeros {
        fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
            let base = |base: u64, by: i64| base.checked_add_signed(by).unwrap();
            self.at = match to {
                SeekFrom::Start(at) => at,
                SeekFrom::End(by) => base(self.length, by),
                SeekFrom::Current(by) => base(self.at, by),
            };
            Ok(self.at)
        }
    }

    #[test]
    fn another_reader_finds_files_beyond_4_gib_and_beyond_65535() {
        let many = vec![1; 70_000];
        for sizes in [&[7, 0, 12][..], &[10, 5 << 30, 20, u64::from(u32::MAX), 30], &many] {
            let mut archive = zip::ZipArchive::new(Zeros::new(sizes)).unwrap();
            assert_eq!(archive.len(), sizes.len());
            let step = sizes.len().div_ceil(10);
            for (index, size) in sizes.iter().enumerate().step_by(step) {
                let mut file = archive.by_index(index).unwrap();
                assert_eq!(file.name().unwrap(), format!("file_{index}"));
                assert_eq!(file.size(), *size);
                if *size < 1000 {
                    let mut bytes = Vec::new();
                    file.read_to_end(&mut bytes).unwrap();
                    assert_eq!(bytes, vec![0; *size as usize]);
                }
            }
        }
    }
}
