//! ZIP archives of result files and exports, without compression. The layout depends only on names and sizes, so any
//! range can be composed separately. The crate `zip` can only write an archive from its beginning to its end.

use std::sync::Arc;

use axum::http::{HeaderMap, Method};
use axum::response::Response;

use super::super::error::Result;
use super::super::results::{attachment, result_file};
use super::clip::Clip;
use super::composed::{Composed, Content, Framing, Part, Source};
use engine::pipeline::derived::STACK;

/// Version 4.5 of the specification (APPNOTE 4.4.3), the first with files above 4 GiB.
const VERSION: u16 = 45;
/// Value of a 32-bit field whose number is in the ZIP64 extra field.
const IN_EXTRA_FIELD: u32 = u32::MAX;
/// 1 January 1980, the zero of the format. The time of the request must not change the bytes.
const DATE: u16 = 0x21;
/// Bit 11: names are UTF-8.
const FLAGS: u16 = 1 << 11;
// Signatures of the records.
const LOCAL: u32 = 0x0403_4b50;
const CENTRAL: u32 = 0x0201_4b50;
const END: u32 = 0x0605_4b50;
const END_64: u32 = 0x0606_4b50;
const LOCATOR_64: u32 = 0x0706_4b50;

/// `zip`: an archive of all results of a job.
pub(super) async fn archive(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    // A job writes the manifest last: if it is missing, the results are incomplete.
    let (manifest, _) = result_file(&clip.app, &clip.job, None, "manifest.json").await?;
    let mut members = Vec::new();
    for snapshot in clip.job.spec.snapshots.indices() {
        let files = clip.app.store.result_files(&clip.job, Some(snapshot)).await?;
        let stack = files.iter().find(|file| file.file.name == STACK);
        let stack = stack.map(|it| Source { snapshot: Some(snapshot), file: it.file.clone() });
        for file in files {
            let name = format!("snapshot_{snapshot:04}/{}", file.file.name);
            members.push((name, clip.content(Some(snapshot), file, stack.as_ref())?));
        }
    }
    members.push((manifest.file.name.clone(), clip.content(None, manifest, None)?));
    send(clip, members, "results.zip", request).await
}

/// `zarr_zip`: the OME-Zarr group as one file.
pub(super) async fn zarr(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let files = clip.zarr_files().await?;
    send(clip, files, "frames.zarr.zip", request).await
}

async fn send(
    clip: Clip,
    files: Vec<(String, Content)>,
    name: &str,
    request: (&Method, &HeaderMap),
) -> Result<Response> {
    let disposition = attachment(clip.job.id, clip.snapshot, name);
    let (parts, kind) = (parts(files), "application/zip");
    let composed = Composed { parts, sha256: None, kind, disposition };
    composed.send(&clip.app, clip.job, request).await
}

/// A file of the archive.
#[derive(Debug, Clone)]
struct Member {
    name: String,
    size: u64,
    /// Offset of its local header in the archive.
    offset: u64,
}

/// The parts of an archive of these files.
fn parts(files: Vec<(String, Content)>) -> Vec<Part> {
    let mut parts = Vec::new();
    let mut members = Vec::new();
    let mut offset = 0;
    let contents: Arc<[Content]> = files.iter().map(|(_, content)| content.clone()).collect();
    for (name, content) in files {
        let size = content.length();
        let member = Member { name, size, offset };
        let length = member.local_header(0).len() as u64;
        offset += length + size;
        members.push(member.clone());
        let make: Framing = Arc::new(move |sums: &[u32]| member.local_header(sums[0]));
        parts.push(Part::Framing { contents: [content.clone()].into(), length, make });
        parts.extend(content.pieces.into_iter().map(Part::Piece));
    }
    let length = directory(&members, &vec![0; members.len()], offset).len() as u64;
    let make: Framing = Arc::new(move |sums: &[u32]| directory(&members, sums, offset));
    parts.push(Part::Framing { contents, length, make });
    parts
}

impl Member {
    /// The header before the bytes of the file.
    fn local_header(&self, crc32: u32) -> Vec<u8> {
        let extra = zip64_extra(&[self.size, self.size]);
        let mut bytes = Vec::new();
        bytes.extend(LOCAL.to_le_bytes());
        self.push_common_fields(&mut bytes, crc32, &extra);
        bytes.extend(self.name.as_bytes());
        bytes.extend(extra);
        bytes
    }

    /// Appends the entry of the file in the central directory.
    fn push_central_header(&self, crc32: u32, bytes: &mut Vec<u8>) {
        let extra = zip64_extra(&[self.size, self.size, self.offset]);
        bytes.extend(CENTRAL.to_le_bytes());
        // Created on Unix (3), so that readers use the file mode.
        bytes.extend((3 << 8 | VERSION).to_le_bytes());
        self.push_common_fields(bytes, crc32, &extra);
        // No comment, disk number 0, no internal attributes.
        bytes.extend([0; 6]);
        // A regular file with mode 0644.
        bytes.extend((0o100_644_u32 << 16).to_le_bytes());
        bytes.extend(field_32(self.offset).to_le_bytes());
        bytes.extend(self.name.as_bytes());
        bytes.extend(extra);
    }

    /// Appends the fields of both headers, from the version to the length of the extra field.
    fn push_common_fields(&self, bytes: &mut Vec<u8>, crc32: u32, extra: &[u8]) {
        let size = field_32(self.size).to_le_bytes();
        // Method 0 means no compression. Time 0 is midnight.
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

/// Value of a 32-bit field for a number.
fn field_32(number: u64) -> u32 {
    u32::try_from(number).unwrap_or(IN_EXTRA_FIELD)
}

/// The ZIP64 extra field with those numbers that do not fit into 32 bits. Empty if all fit.
fn zip64_extra(numbers: &[u64]) -> Vec<u8> {
    let large = numbers.iter().filter(|number| field_32(**number) == IN_EXTRA_FIELD);
    let numbers: Vec<u8> = large.flat_map(|number| number.to_le_bytes()).collect();
    if numbers.is_empty() {
        return numbers;
    }
    let mut field = 1_u16.to_le_bytes().to_vec();
    field.extend((numbers.len() as u16).to_le_bytes());
    field.extend(numbers);
    field
}

/// The central directory at this offset, and the records at the end of the archive.
fn directory(members: &[Member], sums: &[u32], offset: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    for (member, crc32) in members.iter().zip(sums) {
        member.push_central_header(*crc32, &mut bytes);
    }
    let (count, size) = (members.len() as u64, bytes.len() as u64);
    let count_16 = u16::try_from(count).unwrap_or(u16::MAX);
    let is_zip64 =
        count_16 == u16::MAX || [size, offset].into_iter().any(|n| field_32(n) == IN_EXTRA_FIELD);
    if is_zip64 {
        let end = offset + size;
        bytes.extend(END_64.to_le_bytes());
        // Length of the rest of the record.
        bytes.extend(44_u64.to_le_bytes());
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend(VERSION.to_le_bytes());
        bytes.extend([0; 8]);
        for number in [count, count, size, offset] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(LOCATOR_64.to_le_bytes());
        bytes.extend([0; 4]);
        bytes.extend(end.to_le_bytes());
        bytes.extend(1_u32.to_le_bytes());
    }
    bytes.extend(END.to_le_bytes());
    bytes.extend([0; 4]);
    bytes.extend(count_16.to_le_bytes());
    bytes.extend(count_16.to_le_bytes());
    bytes.extend(field_32(size).to_le_bytes());
    bytes.extend(field_32(offset).to_le_bytes());
    bytes.extend([0; 2]);
    bytes
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Seek, SeekFrom};

    use flate2::Crc;

    use super::super::composed::{FileRange, Piece, Source};
    use super::{Content, Part, parts};
    use engine::job::{ResultFile, Sha256};

    fn files(sizes: &[u64]) -> Vec<(String, Content)> {
        let file = |(index, size): (usize, &u64)| {
            let name = format!("file_{index}");
            let file = ResultFile { name: name.clone(), size: *size, sha256: Sha256::of(b"") };
            let piece = Piece::File(FileRange::whole(Source { snapshot: None, file }));
            (name, Content { pieces: vec![piece], crc32: None })
        };
        sizes.iter().enumerate().map(file).collect()
    }

    /// A reader of an archive of files that contain only zeros.
    struct ArchiveOfZeros {
        /// The offset of each part, and its bytes. `None` for a file of zeros.
        parts: Vec<(u64, Option<Vec<u8>>)>,
        length: u64,
        position: u64,
    }

    impl ArchiveOfZeros {
        fn new(sizes: &[u64]) -> Self {
            let (mut length, mut placed) = (0, Vec::new());
            for part in parts(files(sizes)) {
                let bytes = match &part {
                    Part::Framing { contents, make, .. } => {
                        let sums = contents.iter().map(|content| crc(content.length()));
                        Some(make(&sums.collect::<Vec<_>>()))
                    }
                    _ => None,
                };
                placed.push((length, bytes));
                length += part.length();
            }
            Self { parts: placed, length, position: 0 }
        }
    }

    fn crc(size: u64) -> u32 {
        // The test reads only small files.
        let mut crc = Crc::new();
        crc.update(&vec![0; if size < 1000 { size as usize } else { 0 }]);
        crc.sum()
    }

    impl Read for ArchiveOfZeros {
        fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
            if self.position >= self.length {
                return Ok(0);
            }
            let next = self.parts.partition_point(|(start, _)| *start <= self.position);
            let end = self.parts.get(next).map_or(self.length, |(start, _)| *start);
            let (start, bytes) = &self.parts[next - 1];
            let count = buffer.len().min((end - self.position) as usize);
            match bytes {
                Some(bytes) => {
                    let skip = (self.position - start) as usize;
                    buffer[..count].copy_from_slice(&bytes[skip..skip + count]);
                }
                None => buffer[..count].fill(0),
            }
            self.position += count as u64;
            Ok(count)
        }
    }

    impl Seek for ArchiveOfZeros {
        fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
            let shifted = |base: u64, by: i64| base.checked_add_signed(by).unwrap();
            self.position = match to {
                SeekFrom::Start(position) => position,
                SeekFrom::End(by) => shifted(self.length, by),
                SeekFrom::Current(by) => shifted(self.position, by),
            };
            Ok(self.position)
        }
    }

    #[test]
    fn another_reader_finds_files_beyond_4_gib_and_beyond_65535() {
        let many = vec![1; 70_000];
        for sizes in [&[7, 0, 12][..], &[10, 5 << 30, 20, u64::from(u32::MAX), 30], &many] {
            let mut archive = zip::ZipArchive::new(ArchiveOfZeros::new(sizes)).unwrap();
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
