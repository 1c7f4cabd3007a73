//! ZIP and tar archives of numbered pictures. Each picture, a PNG or a TIFF of one page, is a frame.

use std::fs::File;
use std::io::{Cursor, Read};
use std::sync::Arc;

use ndarray::Array2;

use super::member::{Member, MemberReader, quoted};
use super::png::PngReader;
use super::samples::read_error;
use super::tiff;
use super::{Format, FormatError, FrameReader, Limits, StackInfo};
use crate::error::Result;

/// Largest size of a picture, which is read into memory as a whole: a frame of the largest sides in 16 bits, with a
/// margin.
const MAX_PICTURE_BYTES: u64 = 160 << 20;

/// Reads the pictures of an archive as frames.
pub(super) struct Pictures {
    archive: Arc<File>,
    /// The pictures in the order of their numbers.
    members: Vec<Member>,
    info: StackInfo,
    limits: Limits,
    next: usize,
}

impl Pictures {
    /// A reader of the members of an archive. Only the first picture is opened here.
    pub(super) fn open(
        archive: Arc<File>,
        (format, members): (Format, Vec<Member>),
        limits: &Limits,
    ) -> Result<Self> {
        let members = in_order(format, members)?;
        let first = &members[0];
        let info = *picture(&archive, (format, first), limits)?.info();
        let info = StackInfo { frames: members.len(), format, ..info };
        limits.check_info(&info)?;
        Ok(Self { archive, members, info, limits: *limits, next: 0 })
    }
}

impl FrameReader for Pictures {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let Some(member) = self.members.get(self.next) else { return Ok(None) };
        self.next += 1;
        let mut reader = picture(&self.archive, (self.info.format, member), &self.limits)?;
        let (info, first) = (*reader.info(), self.info);
        if (info.height, info.width, info.sample) != (first.height, first.width, first.sample) {
            let problem = format!(
                "{} is {}x{} {}, but {} is {}x{} {}; all pictures must have the same size and type",
                quoted(&member.name),
                info.height,
                info.width,
                info.sample,
                quoted(&self.members[0].name),
                first.height,
                first.width,
                first.sample
            );
            return Err(FormatError::malformed(first.format, problem));
        }
        reader.next_frame().map_err(in_member(&member.name))
    }
}

/// Opens a picture. Errors: neither PNG nor TIFF; several pages; too large.
fn picture(
    archive: &Arc<File>,
    (format, member): (Format, &Member),
    limits: &Limits,
) -> Result<Box<dyn FrameReader + Send>> {
    if member.size > MAX_PICTURE_BYTES {
        return Err(FormatError::OverLimit {
            format,
            what: "the length of a picture in bytes",
            value: member.size,
            limit: MAX_PICTURE_BYTES,
        });
    }
    let mut bytes = Vec::new();
    let read = MemberReader::new(Arc::clone(archive), member.clone()).read_to_end(&mut bytes);
    read.map_err(|error| in_member(&member.name)(read_error(format, error)))?;
    let length = bytes.len() as u64;
    let reader: Result<Box<dyn FrameReader + Send>> = match Format::sniff(&bytes) {
        Some(Format::Png) => PngReader::open(Cursor::new(bytes), length, limits)
            .map(|reader| Box::new(reader) as Box<dyn FrameReader + Send>),
        Some(Format::Tiff) => tiff::open(Cursor::new(bytes), length, limits),
        _ => Err(unsupported(
            format,
            format!("{}, which is neither PNG nor TIFF", quoted(&member.name)),
        )),
    };
    let reader = reader.map_err(in_member(&member.name))?;
    match reader.info().frames {
        1 => Ok(reader),
        pages => Err(unsupported(format, format!("{} with {pages} pages", quoted(&member.name)))),
    }
}

/// Sorts the pictures by number. Errors: names that differ in more than the number; missing or repeated numbers.
fn in_order(format: Format, members: Vec<Member>) -> Result<Vec<Member>> {
    let mut numbered = Vec::with_capacity(members.len());
    let mut shared: Option<(String, String)> = None;
    // Operating systems add hidden files to archives.
    let hidden = |name: &str| {
        let (folder, file) = name.rsplit_once('/').unwrap_or(("", name));
        file.starts_with('.') || folder.split('/').any(|part| part == "__MACOSX")
    };
    for member in members.into_iter().filter(|member| !hidden(&member.name)) {
        let Some((before, number, after)) = split(&member.name) else {
            let found = format!("{}, whose name has no number", quoted(&member.name));
            return Err(unsupported(format, found));
        };
        let (first_before, first_after) =
            shared.get_or_insert_with(|| (before.to_owned(), after.to_owned()));
        if (before, after) != (&**first_before, &**first_after) {
            let other = format!("{first_before}N{first_after}");
            let found = format!("{} among {}", quoted(&member.name), quoted(&other));
            return Err(unsupported(format, found));
        }
        numbered.push((number, member));
    }
    numbered.sort_by_key(|(number, _)| *number);
    for pair in numbered.windows(2) {
        let ((number, member), (next, other)) = (&pair[0], &pair[1]);
        if number == next {
            let found = format!(
                "{} and {}, which have the same number",
                quoted(&member.name),
                quoted(&other.name)
            );
            return Err(unsupported(format, found));
        }
        if number + 1 != *next {
            let found = format!(
                "{} after {}: the pictures in between are missing",
                quoted(&other.name),
                quoted(&member.name)
            );
            return Err(unsupported(format, found));
        }
    }
    if numbered.is_empty() {
        return Err(unsupported(format, "no pictures".to_owned()));
    }
    Ok(numbered.into_iter().map(|(_, member)| member).collect())
}

/// Splits a file name into the part before its last number, the number, and the part after it. Digits of the extension
/// do not count.
fn split(name: &str) -> Option<(&str, u64, &str)> {
    let stem = name.rfind('.').unwrap_or(name.len());
    let end = name[..stem].rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = name[..end].rfind(|c: char| !c.is_ascii_digit());
    let start = start.map_or(0, |at| at + name[at..].chars().next().map_or(1, char::len_utf8));
    // The number of a folder is not that of a frame.
    if name[end..stem].contains('/') {
        return None;
    }
    Some((&name[..start], name[start..end].parse().ok()?, &name[end..]))
}

fn in_member(name: &str) -> impl FnOnce(FormatError) -> FormatError {
    let name = quoted(name);
    move |source| match source {
        source if !source.is_callers_fault() => source,
        source => FormatError::Member { name, source: Box::new(source) },
    }
}

fn unsupported(format: Format, found: String) -> FormatError {
    let accepted = match format {
        Format::Tar => {
            "PNG or TIFF pictures whose names differ only in consecutive numbers (to convert all .png \
             files in the order of their names: python -c \"import tarfile, numpy; from PIL import Image; \
             t = tarfile.open('in.tar'); numpy.save('out.npy', [numpy.asarray(Image.open(t.extractfile(n))) \
             for n in sorted(t.getnames()) if n.endswith('.png')])\")"
        }
        _ => {
            "PNG or TIFF pictures whose names differ only in consecutive numbers (to convert all .png \
             files in the order of their names: python -c \"import zipfile, numpy; from PIL import Image; \
             z = zipfile.ZipFile('in.zip'); numpy.save('out.npy', [numpy.asarray(Image.open(z.open(n))) \
             for n in sorted(z.namelist()) if n.endswith('.png')])\")"
        }
    };
    FormatError::Unsupported { format, found, accepted }
}

#[cfg(test)]
mod tests;
