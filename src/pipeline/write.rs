//! The folder of a result: frames as EXR, npy and PNG, and the manifest.

use std::fs::{self, File};
use std::io::{self, BufWriter, Read};
use std::path::Path;

use ndarray::Array2;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};

use super::manifest::{Manifest, SCHEMA_FAMILY};
use crate::formats::{FormatError, exr, npy, png};

const FRAMES: &str = "frames";
const PNGS: &str = "png";
const STACK: &str = "stack.exr";
const ARRAY: &str = "frames.npy";
const MANIFEST: &str = "manifest.json";
/// All that a result's folder holds, the manifest last.
const NAMES: [&str; 5] = [FRAMES, PNGS, STACK, ARRAY, MANIFEST];

/// A file of a result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResultFile {
    /// Path below the result's folder, with `/`.
    pub name: String,
    /// Bytes.
    pub size: u64,
    /// SHA-256 in lower-case hexadecimal digits.
    pub sha256: String,
}

/// What a result looks like.
#[derive(Debug, Clone)]
pub struct ResultSpec {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// What each frame says about itself; there are as many as frames.
    pub attributes: Vec<exr::Attributes>,
    /// Value that the PNGs show as white; black is 0.
    pub white: f32,
}

/// Why a result was not written.
#[derive(Debug, thiserror::Error)]
pub enum ResultError {
    /// A file could not be written.
    #[error("the result's {name}: {source}")]
    File {
        /// Its name in the result's folder.
        name: String,
        /// What went wrong.
        source: io::Error,
    },
    /// A frame could not be written or was not there.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The folder holds something that is not an earlier result.
    #[error(
        "the output folder already holds {name:?}, which no earlier run of this program left \
         there: name a new folder"
    )]
    Foreign {
        /// What stands in the way.
        name: String,
    },
}

/// Writes `frames/frame_0001.exr` and so on, `png/frame_0001.png` and so on, `stack.exr`,
/// `frames.npy` (float32 \[B,H,W\]), and at last the `manifest.json` that `manifest` makes from
/// the list of these files. All of them are on the disk (fsync) when this returns.
///
/// `frame(k)` is asked once for each frame, in order; memory holds one.
///
/// Returns all files, the manifest last.
///
/// # Errors
/// Those of `frame`, and those of writing. A folder that was begun stays behind.
pub fn write_result<E: From<ResultError> + From<FormatError>>(
    folder: &Path,
    spec: &ResultSpec,
    mut frame: impl FnMut(usize) -> Result<Array2<f32>, E>,
    manifest: impl FnOnce(Vec<ResultFile>) -> Manifest,
) -> Result<Vec<ResultFile>, E> {
    for name in [FRAMES, PNGS] {
        fs::create_dir_all(folder.join(name)).map_err(failed(name))?;
    }
    let array = File::create(folder.join(ARRAY)).map_err(failed(ARRAY))?;
    let count = spec.attributes.len();
    let mut array = npy::writer(BufWriter::new(array), count, spec.height, spec.width)?;
    let stack = folder.join(STACK);
    exr::write_stack(&stack, spec.height, spec.width, &spec.attributes, |k| -> Result<_, E> {
        let frame = frame(k)?;
        let attributes = &spec.attributes[k];
        exr::write_frame(&folder.join(frame_name(k)), frame.view(), attributes)?;
        png::write_u16(&folder.join(png_name(k)), frame.view(), 0.0, spec.white)?;
        array.write_frame(frame.view())?;
        Ok(frame)
    })?;
    array.finish()?;
    let names = (0..count).map(frame_name).chain((0..count).map(png_name));
    let names = names.chain([STACK.to_owned(), ARRAY.to_owned()]);
    let mut files = names.map(|name| settle(folder, name)).collect::<Result<Vec<_>, _>>()?;
    let text = serde_json::to_string_pretty(&manifest(files.clone()))
        .map_err(|error| failed(MANIFEST)(error.into()))?;
    fs::write(folder.join(MANIFEST), text + "\n").map_err(failed(MANIFEST))?;
    files.push(settle(folder, MANIFEST.to_owned())?);
    for name in [FRAMES, PNGS, ""] {
        File::open(folder.join(name)).and_then(|f| f.sync_all()).map_err(failed(name))?;
    }
    Ok(files)
}

/// Refuses a folder that holds files with the names of a result, but no manifest of ours.
///
/// # Errors
/// [`ResultError::Foreign`].
pub fn check_output(folder: &Path) -> Result<(), ResultError> {
    // Of any version of this program: the form of manifests changes.
    let manifest = fs::read(folder.join(MANIFEST)).ok();
    let manifest = manifest.and_then(|text| serde_json::from_slice::<Value>(&text).ok());
    let schema = manifest.as_ref().and_then(|manifest| manifest["schema"].as_str());
    if schema.is_some_and(|schema| schema.starts_with(SCHEMA_FAMILY)) {
        return Ok(());
    }
    match NAMES.into_iter().find(|name| folder.join(name).exists()) {
        Some(name) => Err(ResultError::Foreign { name: name.to_owned() }),
        None => Ok(()),
    }
}

/// Moves the result in `made` to `folder`, in place of an earlier result; other files there
/// stay. Both must be on one file system.
///
/// # Errors
/// As [`check_output`], or a file can't be moved.
pub fn replace_result(made: &Path, folder: &Path) -> Result<(), ResultError> {
    check_output(folder)?;
    // The old manifest goes last and the new one comes last: what lies beside a manifest
    // is what it describes.
    for name in NAMES {
        let old = folder.join(name);
        let removed = match old.symlink_metadata() {
            Ok(old_one) if old_one.is_dir() => fs::remove_dir_all(old),
            Ok(_) => fs::remove_file(old),
            Err(_) => Ok(()),
        };
        removed.map_err(failed(name))?;
    }
    for name in NAMES {
        fs::rename(made.join(name), folder.join(name)).map_err(failed(name))?;
    }
    Ok(())
}

fn frame_name(k: usize) -> String {
    format!("{FRAMES}/frame_{:04}.exr", k + 1)
}

fn png_name(k: usize) -> String {
    format!("{PNGS}/frame_{:04}.png", k + 1)
}

fn failed(name: &str) -> impl FnOnce(io::Error) -> ResultError {
    move |source| ResultError::File { name: name.to_owned(), source }
}

/// Brings a file to the disk and takes its size and hash.
fn settle(folder: &Path, name: String) -> Result<ResultFile, ResultError> {
    let measured = || -> io::Result<(u64, String)> {
        let mut file = File::open(folder.join(&name))?;
        file.sync_all()?;
        hash(&mut file)
    };
    let (size, sha256) = measured().map_err(failed(&name))?;
    Ok(ResultFile { name, size, sha256 })
}

/// SHA-256 of what is left to read, in lower-case hexadecimal digits.
///
/// # Errors
/// Those of reading.
pub fn sha256_of(reader: &mut impl Read) -> io::Result<String> {
    Ok(hash(reader)?.1)
}

/// Length and SHA-256 of what is left to read.
fn hash(reader: &mut impl Read) -> io::Result<(u64, String)> {
    let mut digest = Sha256::new();
    let size = io::copy(reader, &mut digest)?;
    Ok((size, digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect()))
}

#[cfg(test)]
mod tests {
    use super::{ResultError, ResultSpec, check_output, replace_result, sha256_of, write_result};
    use crate::formats::{FormatError, Limits, exr, read_stack};
    use crate::pipeline::manifest::{Manifest, sample};
    use ndarray::{Array2, Array3};
    use std::fs::{self, File};
    use std::path::Path;

    #[derive(Debug, thiserror::Error)]
    enum TestError {
        #[error(transparent)]
        Result(#[from] ResultError),
        #[error(transparent)]
        Format(#[from] FormatError),
    }

    fn frame(k: usize) -> Array2<f32> {
        Array2::from_shape_fn((20, 24), |(i, j)| (i * 24 + j) as f32 * 0.01 - k as f32)
    }

    fn write(folder: &Path, frames: usize) -> Vec<super::ResultFile> {
        let attributes = vec![exr::Attributes::default(); frames];
        let spec = ResultSpec { height: 20, width: 24, attributes, white: 1.5 };
        let frame = |k| Ok::<_, TestError>(frame(k));
        write_result(folder, &spec, frame, |files| sample().with_files(files)).unwrap()
    }

    #[test]
    fn every_file_is_there_and_as_the_list_says() {
        let folder = tempfile::tempdir().unwrap();
        let files = write(folder.path(), 3);
        let names: Vec<&str> = files.iter().map(|file| file.name.as_str()).collect();
        assert_eq!(names.len(), 9);
        assert_eq!(names[0], "frames/frame_0001.exr");
        assert_eq!(names.last(), Some(&"manifest.json"));
        for file in &files {
            let path = folder.path().join(&file.name);
            assert_eq!(path.metadata().unwrap().len(), file.size);
            assert_eq!(sha256_of(&mut File::open(path).unwrap()).unwrap(), file.sha256);
        }
        let expected = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| frame(k)[[i, j]]);
        let array = folder.path().join("frames.npy");
        assert_eq!(read_stack(&array, &Limits::default()).unwrap().1, expected);
        let stack = folder.path().join("stack.exr");
        assert_eq!(exr::read_stack(&stack, &Limits::default()).unwrap().1, expected);
        let text = fs::read(folder.path().join("manifest.json")).unwrap();
        let manifest: Manifest = serde_json::from_slice(&text).unwrap();
        assert_eq!(manifest.content.files, files[..8]);
    }

    #[test]
    fn an_earlier_result_is_replaced_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("a"), folder.path().join("b"));
        fs::create_dir_all(&first).unwrap();
        fs::create_dir_all(&second).unwrap();
        write(&first, 5);
        fs::write(first.join("notes.txt"), "mine").unwrap();
        write(&second, 2);
        replace_result(&second, &first).unwrap();
        assert_eq!(fs::read_dir(first.join("frames")).unwrap().count(), 2);
        assert_eq!(fs::read_to_string(first.join("notes.txt")).unwrap(), "mine");
    }

    #[test]
    fn folders_with_frames_of_somebody_else_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("frames")).unwrap();
        let error = check_output(folder.path()).unwrap_err().to_string();
        assert!(error.contains("\"frames\""), "{error}");
    }
}
