//! NumPy's archives: a zip of arrays.

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;

use tempfile::NamedTempFile;
use zip::ZipArchive;

use super::CliError;
use crate::formats::Limits;

/// Whether the file is an archive by its name.
pub(super) fn is_npz(path: &Path) -> bool {
    path.extension().is_some_and(|kind| kind.eq_ignore_ascii_case("npz"))
}

/// The only array of an archive, or the one called `frames`, as an npy file of its own.
///
/// # Errors
/// No archive, none or several arrays, or one larger than is read.
pub(super) fn extract(path: &Path) -> Result<NamedTempFile, CliError> {
    let refused = |error: &dyn std::fmt::Display| {
        CliError::Input(format!("frames {}: {error}", path.display()))
    };
    let file = File::open(path).map_err(|error| refused(&error))?;
    let mut archive = ZipArchive::new(file).map_err(|error| refused(&error))?;
    let names = archive.file_names().map(|name| name.map(std::borrow::Cow::into_owned));
    let names = names.collect::<Result<Vec<String>, _>>().map_err(|error| refused(&error))?;
    let name = match names.as_slice() {
        [only] => only.clone(),
        several => several.iter().find(|name| *name == "frames.npy").cloned().ok_or_else(|| {
            refused(&format!("arrays {several:?}; it must hold one, or one called frames"))
        })?,
    };
    let limit = Limits::default().max_file_bytes;
    let array = archive.by_name(&name).map_err(|error| refused(&error))?;
    let mut copy = NamedTempFile::new().map_err(|error| refused(&error))?;
    // A header may promise less than there is: what is read is bounded, too.
    let read = std::io::copy(&mut array.take(limit + 1), &mut copy);
    if read.map_err(|error| refused(&error))? > limit {
        return Err(refused(&format!("array {name} has more than {limit} bytes")));
    }
    copy.flush().map_err(|error| refused(&error))?;
    Ok(copy)
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use zip::ZipWriter;
    use zip::write::SimpleFileOptions;

    use super::extract;

    #[test]
    fn the_only_array_or_the_frames_are_taken() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("clip.npz");
        let write = |arrays: &[(&str, &[u8])]| {
            let mut archive = ZipWriter::new(std::fs::File::create(&path).unwrap());
            for (name, bytes) in arrays {
                archive.start_file(*name, SimpleFileOptions::default()).unwrap();
                archive.write_all(bytes).unwrap();
            }
            archive.finish().unwrap();
        };
        let content = || extract(&path).map(|file| std::fs::read(file.path()).unwrap());
        write(&[("arr_0.npy", b"one")]);
        assert_eq!(content().unwrap(), b"one");
        write(&[("masks.npy", b"one"), ("frames.npy", b"two")]);
        assert_eq!(content().unwrap(), b"two");
        write(&[("a.npy", b"one"), ("b.npy", b"two")]);
        let error = content().unwrap_err().to_string();
        assert!(error.contains("a.npy") && error.contains("clip.npz"), "{error}");
        std::fs::write(&path, "no archive").unwrap();
        assert!(content().is_err());
    }
}
