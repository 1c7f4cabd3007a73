//! ZIP and tar archives of numbered pictures. Each picture, a PNG or a TIFF of one page, is a frame. True frames may be
//! JPEG, BMP or PNM.

use std::fs::File;
use std::io::Cursor;
use std::sync::Arc;

use ndarray::Array2;

use super::member::{Member, MemberReader, quoted};
use super::photo::{self, read_picture};
use super::{Format, FormatError, FrameReader, Limits, Reader, StackInfo, png, tiff};
use crate::error::Result;

/// Reads the pictures of an archive as frames.
pub(super) struct Pictures {
    archive: Arc<File>,
    /// The pictures in the order of their numbers.
    members: Vec<Member>,
    info: StackInfo,
    /// True if JPEG, BMP and PNM are accepted.
    photos: bool,
    limits: Limits,
    next: usize,
}

impl Pictures {
    /// A reader of the members of an archive. Only the first picture is opened here.
    pub(super) fn open(
        archive: Arc<File>,
        (format, members): (Format, Vec<Member>),
        photos: bool,
        limits: &Limits,
    ) -> Result<Self> {
        let members = in_order(format, members)?;
        let first = &members[0];
        let info = *picture(&archive, (format, first), photos, limits)?.info();
        let info = StackInfo { frames: members.len(), format, ..info };
        limits.check_info(&info)?;
        Ok(Self { archive, members, info, photos, limits: *limits, next: 0 })
    }
}

impl FrameReader for Pictures {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<Array2<f32>>> {
        let Some(member) = self.members.get(self.next) else { return Ok(None) };
        self.next += 1;
        let member_of = (self.info.format, member);
        let mut reader = picture(&self.archive, member_of, self.photos, &self.limits)?;
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
    photos: bool,
    limits: &Limits,
) -> Result<Reader> {
    let content = MemberReader::new(Arc::clone(archive), member.clone());
    let bytes = read_picture(content, (format, member.size)).map_err(in_member(&member.name))?;
    let length = bytes.len() as u64;
    let reader: Result<Reader> = match Format::sniff(&bytes) {
        Some(Format::Png) => png::open(Cursor::new(bytes), length, limits),
        Some(Format::Tiff) => tiff::open(Cursor::new(bytes), length, limits),
        Some(kind @ (Format::Jpeg | Format::Bmp | Format::Pnm)) if photos => {
            photo::open(&bytes, kind, limits)
        }
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

/// Sorts the pictures by their counter. Errors: names that differ in more than numbers; a gap in the counter; numbers
/// that rise in different orders.
fn in_order(format: Format, members: Vec<Member>) -> Result<Vec<Member>> {
    let mut numbered: Vec<(Vec<u128>, Member)> = Vec::with_capacity(members.len());
    let mut shared: Option<Vec<String>> = None;
    for member in members.into_iter().filter(|member| !is_ignored(&member.name)) {
        let Some(Parts { texts, numbers }) = Parts::of(&member.name) else {
            let found = format!("{}, whose name has no number", quoted(&member.name));
            return Err(unsupported(format, found));
        };
        let shared =
            shared.get_or_insert_with(|| texts.iter().map(|text| (*text).to_owned()).collect());
        if texts != *shared {
            let other = shared.join("N");
            let found = format!("{} among {}", quoted(&member.name), quoted(&other));
            return Err(unsupported(format, found));
        }
        numbered.push((numbers, member));
    }
    let Some((first, _)) = numbered.first() else {
        return Err(unsupported(format, "no pictures".to_owned()));
    };
    let varies =
        |place: &usize| numbered.iter().any(|(numbers, _)| numbers[*place] != first[*place]);
    let varying: Vec<usize> = (0..first.len()).filter(varies).collect();
    let Some(&last) = varying.last() else {
        return match &*numbered {
            [(_, first), (_, second), ..] => Err(unsupported(format, same_number(first, second))),
            _ => Ok(numbered.into_iter().map(|(_, member)| member).collect()),
        };
    };
    let by_place = |place: usize| move |(numbers, _): &(Vec<u128>, Member)| numbers[place];
    for &counter in varying.iter().rev() {
        numbered.sort_by_key(by_place(counter));
        if !numbered
            .windows(2)
            .all(|pair| pair[0].0[counter].checked_add(1) == Some(pair[1].0[counter]))
        {
            continue;
        }
        let others = |numbers: &[u128]| -> Vec<u128> {
            varying.iter().filter(|place| **place != counter).map(|place| numbers[*place]).collect()
        };
        if let Some(pair) = numbered.windows(2).find(|pair| others(&pair[0].0) > others(&pair[1].0))
        {
            let found = format!(
                "{} and {}: one number in the names rises where another falls",
                quoted(&pair[0].1.name),
                quoted(&pair[1].1.name)
            );
            return Err(unsupported(format, found));
        }
        return Ok(numbered.into_iter().map(|(_, member)| member).collect());
    }
    numbered.sort_by_key(by_place(last));
    let step =
        |pair: &&[(Vec<u128>, Member)]| pair[0].0[last].checked_add(1) != Some(pair[1].0[last]);
    let found = match numbered.windows(2).find(step) {
        Some([(number, member), (next, other)]) if number[last] == next[last] => {
            same_number(member, other)
        }
        Some([(_, member), (_, other)]) => format!(
            "{} after {}: the pictures in between are missing",
            quoted(&other.name),
            quoted(&member.name)
        ),
        _ => "pictures without a common counter".to_owned(),
    };
    Err(unsupported(format, found))
}

fn same_number(first: &Member, second: &Member) -> String {
    format!("{} and {}, which have the same number", quoted(&first.name), quoted(&second.name))
}

/// Extensions of texts and tables that people and programs put beside pictures.
const IGNORED_EXTENSIONS: [&str; 13] =
    ["txt", "md", "rst", "json", "xml", "csv", "ini", "log", "yaml", "yml", "html", "pdf", "db"];
/// Names of such files, without their extensions.
const IGNORED_STEMS: [&str; 3] = ["readme", "license", "licence"];

/// True for files that are not meant as frames: hidden files, those of operating systems, and texts.
fn is_ignored(name: &str) -> bool {
    let (folder, file) = name.rsplit_once('/').unwrap_or(("", name));
    let file = file.to_ascii_lowercase();
    let (stem, extension) = file.split_once('.').unwrap_or((&file, ""));
    let extension = extension.rsplit('.').next().unwrap_or_default();
    file.starts_with('.')
        || folder.split('/').any(|part| part == "__MACOSX")
        || IGNORED_STEMS.contains(&stem)
        || IGNORED_EXTENSIONS.contains(&extension)
}

/// The name of a picture, split at its numbers. Digits of folders and of the extension belong to the texts.
#[derive(Debug, PartialEq, Eq)]
struct Parts<'a> {
    /// One more than numbers.
    texts: Vec<&'a str>,
    numbers: Vec<u128>,
}

impl<'a> Parts<'a> {
    /// `None` for names without a number, or with one beyond 128 bits.
    fn of(name: &'a str) -> Option<Self> {
        let file = name.rfind('/').map_or(0, |slash| slash + 1);
        let end = name[file..].rfind('.').map_or(name.len(), |point| file + point);
        let (mut texts, mut numbers, mut text, mut place) = (Vec::new(), Vec::new(), 0, file);
        while let Some(start) = name[place..end].find(|c: char| c.is_ascii_digit()) {
            let start = place + start;
            let length = name[start..end].find(|c: char| !c.is_ascii_digit());
            let stop = length.map_or(end, |length| start + length);
            texts.push(&name[text..start]);
            numbers.push(name[start..stop].parse().ok()?);
            (text, place) = (stop, stop);
        }
        texts.push(&name[text..]);
        (!numbers.is_empty()).then_some(Self { texts, numbers })
    }
}

fn in_member(name: &str) -> impl FnOnce(FormatError) -> FormatError {
    let name = quoted(name);
    move |source| match source {
        source if !source.is_callers_fault() => source,
        source => FormatError::Member { name, source: Box::new(source) },
    }
}

/// Reads the pictures of an archive in natural order, which sorts the numbers of names by value.
macro_rules! conversion {
    ($module:literal, $open:literal, $names:literal, $read:literal) => {
        concat!(
            "PNG or TIFF pictures whose names differ only in consecutive numbers (to convert all pictures in the natural \
             order of their names: python -c \"import re, ",
            $module,
            ", numpy; from PIL import Image; ",
            $open,
            "; k = lambda n: [int(t) if i % 2 else t for i, t in enumerate(re.split('([0-9]+)', n))]; \
             numpy.save('out.npy', [numpy.asarray(Image.open(",
            $read,
            ")) for n in sorted(",
            $names,
            ", key=k) if n.lower().endswith(('.png', '.tif', '.tiff')) and '/._' not in '/' + n])\")"
        )
    };
}

fn unsupported(format: Format, found: String) -> FormatError {
    let accepted = match format {
        Format::Tar => {
            conversion!("tarfile", "a = tarfile.open('in.tar')", "a.getnames()", "a.extractfile(n)")
        }
        _ => conversion!("zipfile", "a = zipfile.ZipFile('in.zip')", "a.namelist()", "a.open(n)"),
    };
    FormatError::Unsupported { format, found, accepted }
}

#[cfg(test)]
mod tests;
