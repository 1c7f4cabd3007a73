//! npz: NumPy's archive of several arrays, a ZIP of npy files.

use std::fs::File;
use std::sync::Arc;

use super::axes::Expected;
use super::member::{Member, MemberReader};
use super::npy;
use super::scene::{MAX_NAMES, SceneArray, list};
use super::{Format, FormatError, Limits, Reader};
use crate::error::Result;

/// Extension of all members.
pub(super) const EXTENSION: &str = ".npy";

/// Opens the array with this name. For `None`, opens the only array, or the one with a usual name of `array`.
///
/// Errors: [`FormatError::MissingArray`]; those of npy files.
pub(super) fn open(
    archive: Arc<File>,
    members: Vec<Member>,
    (array, name, expected): (SceneArray, Option<&str>, &Expected),
    limits: &Limits,
) -> Result<Reader> {
    let mut arrays: Vec<(String, Member)> = members
        .into_iter()
        .filter_map(|member| Some((member.name.strip_suffix(EXTENSION)?.to_owned(), member)))
        .collect();
    let position = |requested: &str| arrays.iter().position(|(name, _)| name == requested);
    let index = match name {
        Some(name) => position(name),
        None if arrays.len() == 1 => Some(0),
        None => array.names().iter().find_map(|name| position(name)),
    };
    let Some(index) = index else {
        let (format, name) = (Format::Npz, name.unwrap_or(array.name()).to_owned());
        let listed = arrays.into_iter().enumerate().map(|(index, (name, member))| {
            let length = member.size;
            let shape = || npy::shape(MemberReader::new(archive.clone(), member), length);
            (name, if index < MAX_NAMES { shape().unwrap_or_default() } else { Vec::new() })
        });
        let present = list(&listed.collect::<Vec<_>>());
        return Err(FormatError::MissingArray { format, name, present });
    };
    let (_, member) = arrays.swap_remove(index);
    let length = member.size;
    limits.check_file(Format::Npz, length)?;
    let reader = MemberReader::new(archive, member);
    Ok(Box::new(npy::open(reader, length, (Format::Npz, expected), limits)?))
}

#[cfg(test)]
pub(super) mod tests;
