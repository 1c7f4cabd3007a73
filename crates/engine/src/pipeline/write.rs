//! Writes the folder of a result: frames as EXR, npy and PNG, and the manifest.

use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, Write};
use std::path::Path;

use flate2::Crc;
use ndarray::{Array2, ArrayView3, Axis};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::Value;
use sha2::Digest;

use super::derived::{ARRAY, Derived, FRAMES, RAW, STACK};
use super::error::{PipelineError, Result};
use super::manifest::{Manifest, SCHEMA_FAMILY, frame_attributes};
use crate::job::{ResultFile, Sha256, WrittenFile};
use formats::display::Picture;
use formats::exr::{Lines, Stack};
use formats::{Channels, FormatError, npy};

const PNGS: &str = "png";
/// The expected error of each block of the frames.
const ERROR: &str = "error.npy";
const MANIFEST: &str = "manifest.json";
/// All entries of a result folder, the manifest last.
const ENTRIES: [&str; 7] = [FRAMES, PNGS, STACK, ARRAY, RAW, ERROR, MANIFEST];

/// Bytes of lines that are written at a time, rounded to whole lines.
const BAND_BYTES: usize = 1 << 20;

/// The files of a result that are on the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnDisk {
    /// All files.
    All,
    /// All files except those that are derived from the stack of frames when they are read.
    Stored,
}

/// Writes the files of a result and returns their names, sizes and hashes, the manifest last.
///
/// - `stack.exr` with all frames
/// - `frames/frame_0001.exr` and so on, and `frames.npy` (float32 \[B,H,W\]), which are derived from the stack
/// - `png/frame_0001.png` and so on; white as in the manifest, black is 0
/// - `error.npy`: the expected error \[B, block rows, block columns\], if `error` is given
/// - the manifest, with the list of the other files
///
/// Behind a mosaic frames are demosaicked: EXR has the channels R, G and B, PNG is in colour, `frames.npy` is
/// \[B,H,W,3\], and `mosaic.npy` \[B,H,W\], also derived, has the raw values.
///
/// The bands of a spectral camera are moved to their place; EXR channels have the names of their wavelengths.
///
/// `frame(k)` \[H,W\] is called once per frame, in order; one frame at a time is in memory. All files are synced to disk on
/// return.
///
/// Errors: those of `frame` and of writing. An incomplete folder is left behind.
pub fn write_result(
    folder: &Path,
    mut manifest: Manifest,
    error: Option<ArrayView3<'_, f32>>,
    on_disk: OnDisk,
    mut frame: impl FnMut(usize) -> Result<Array2<f32>>,
) -> Result<Vec<WrittenFile>> {
    let folders = if on_disk == OnDisk::All { &[PNGS, FRAMES][..] } else { &[PNGS] };
    for name in folders {
        fs::create_dir_all(folder.join(name)).map_err(failed(name))?;
    }
    let (height, width) = (manifest.content.height, manifest.content.width);
    let (count, white) = (manifest.content.frames, manifest.content.recipe.scale.white_level);
    let recipe = manifest.content.recipe.clone();
    let channels = recipe.shape.channels();
    let stack = Stack::new((height, width), channels, &frame_attributes(&manifest.content))?;
    let open = |derived| Output::new(folder, derived, on_disk, &stack);
    let mut outputs = vec![open(None)?];
    for derived in [Derived::Array].into_iter().chain(recipe.shape.mosaic.map(Derived::Raw)) {
        outputs.push(open(Some(derived))?);
    }
    let lines = stack.lines();
    let band_rows = (BAND_BYTES / lines.stored_bytes()).max(1);
    let mut files = Vec::new();
    for k in 0..count {
        let mut frame = recipe.frame(k, frame(k)?);
        if let Some(mosaic) = recipe.shape.mosaic {
            frame = mosaic.demosaick(frame.view(), (0, 0));
        }
        if frame.dim() != (height, width * channels.count()) {
            let size = format!("frame {k} is {:?} in a result of {height}x{width}", frame.dim());
            return Err(FormatError::Internal(size).into());
        }
        let mut single = open(Some(Derived::Frame(k)))?;
        let mut band = Vec::new();
        for (index, rows) in frame.axis_chunks_iter(Axis(0), band_rows).enumerate() {
            let row = index * band_rows;
            band.clear();
            lines.encode((k, row), rows, &mut band);
            let outputs = outputs.par_iter_mut().chain([&mut single]);
            outputs.try_for_each(|output| output.write_lines(lines, row, &band))?;
        }
        files.push(single.finish()?);
        Picture::with_16_bits(frame.view(), channels, (0.0, white))?
            .write_png(&folder.join(png_name(k)))?;
    }
    let pictures = (0..count).into_par_iter().map(|k| hash(folder, png_name(k)));
    files.extend(pictures.collect::<Result<Vec<_>>>()?);
    for output in outputs {
        files.push(output.finish()?);
    }
    if let Some(error) = error {
        files.push(write_error(folder, error)?);
    }
    // In parallel, because disks sync many files in about the time of a few.
    let stored = files.par_iter().filter(|file| !file.is_derived);
    stored.try_for_each(|file| sync(folder, &file.file.name))?;
    folders.iter().try_for_each(|name| sync(folder, name))?;
    manifest.content.files = files.iter().map(|file| file.file.clone()).collect();
    files.push(write_manifest(folder, &manifest)?);
    Ok(files)
}

/// Writes `manifest.json`. The file and its folder are synced to disk on return.
pub fn write_manifest(folder: &Path, manifest: &impl Serialize) -> Result<WrittenFile> {
    let text =
        serde_json::to_string_pretty(manifest).map_err(|error| failed(MANIFEST)(error.into()))?;
    fs::write(folder.join(MANIFEST), text + "\n").map_err(failed(MANIFEST))?;
    let file = hash(folder, MANIFEST.to_owned())?;
    sync(folder, MANIFEST)?;
    sync(folder, "")?;
    Ok(file)
}

fn write_error(folder: &Path, error: ArrayView3<'_, f32>) -> Result<WrittenFile> {
    let file = BufWriter::new(File::create(folder.join(ERROR)).map_err(failed(ERROR))?);
    let mut writer = npy::writer(file, error.dim(), Channels::Grey)?;
    error.outer_iter().try_for_each(|frame| writer.write_frame(frame))?;
    writer.finish()?;
    hash(folder, ERROR.to_owned())
}

/// A file of frames that is hashed while it is written. A file that is not on the disk is only hashed.
struct Output {
    name: String,
    /// `None` for the stack.
    derived: Option<Derived>,
    file: Option<BufWriter<File>>,
    digester: Digester,
    lines: Vec<u8>,
}

impl Output {
    fn new(
        folder: &Path,
        derived: Option<Derived>,
        on_disk: OnDisk,
        stack: &Stack,
    ) -> Result<Self> {
        let name = derived.map_or(STACK.to_owned(), Derived::name);
        let head = derived.map_or_else(|| stack.head(), |derived| derived.head(stack));
        let file = match (derived, on_disk) {
            (Some(_), OnDisk::Stored) => None,
            _ => Some(BufWriter::new(File::create(folder.join(&name)).map_err(failed(&name))?)),
        };
        let (digester, lines) = (Digester::default(), Vec::new());
        let mut output = Self { name, derived, file, digester, lines };
        output.write(&head)?;
        Ok(output)
    }

    /// Writes consecutive lines, given those of the stack from `row` on.
    fn write_lines(&mut self, lines: Lines, row: usize, stored: &[u8]) -> Result<()> {
        let Some(derived) = self.derived else { return self.write(stored) };
        let mut composed = std::mem::take(&mut self.lines);
        composed.clear();
        for (index, line) in stored.chunks_exact(lines.stored_bytes()).enumerate() {
            derived.line(lines, row + index, line, &mut composed);
        }
        let written = self.write(&composed);
        self.lines = composed;
        written
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.digester.update(bytes);
        let written = self.file.as_mut().map_or(Ok(()), |file| file.write_all(bytes));
        written.map_err(failed(&self.name))
    }

    fn finish(mut self) -> Result<WrittenFile> {
        let flushed = self.file.as_mut().map_or(Ok(()), BufWriter::flush);
        flushed.map_err(failed(&self.name))?;
        Ok(self.digester.finish(self.name, self.file.is_none()))
    }
}

/// Size and checksums of bytes.
#[derive(Default)]
struct Digester {
    size: u64,
    sha256: sha2::Sha256,
    crc32: Crc,
}

impl Write for Digester {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Digester {
    fn update(&mut self, bytes: &[u8]) {
        self.size += bytes.len() as u64;
        self.sha256.update(bytes);
        self.crc32.update(bytes);
    }

    fn finish(self, name: String, is_derived: bool) -> WrittenFile {
        let sha256 = Sha256::new(self.sha256.finalize().into());
        let file = ResultFile { name, size: self.size, sha256 };
        WrittenFile { file, crc32: self.crc32.sum(), is_derived }
    }
}

/// Checks that a folder can receive a result: it has a manifest of this program, or no files with the names of a
/// result.
///
/// Errors: [`PipelineError::Foreign`].
pub fn check_output(folder: &Path) -> Result<()> {
    // Manifests of all versions of this program are accepted.
    let manifest = fs::read(folder.join(MANIFEST)).ok();
    let manifest = manifest.and_then(|text| serde_json::from_slice::<Value>(&text).ok());
    let schema = manifest.as_ref().and_then(|manifest| manifest["schema"].as_str());
    if schema.is_some_and(|schema| schema.starts_with(SCHEMA_FAMILY)) {
        return Ok(());
    }
    match ENTRIES.into_iter().find(|name| folder.join(name).exists()) {
        Some(name) => Err(PipelineError::Foreign { name: name.to_owned() }),
        None => Ok(()),
    }
}

/// Moves the result in `new` to `folder`, where it replaces an earlier result. Other files in `folder` are kept. Both
/// folders must be on one file system.
///
/// Errors: those of [`check_output`]; [`PipelineError::File`] if a file can't be moved.
pub fn replace_result(new: &Path, folder: &Path) -> Result<()> {
    check_output(folder)?;
    // The manifest is removed last and moved last, so it always describes the files in its folder.
    for name in ENTRIES {
        let old = folder.join(name);
        let removed = match old.symlink_metadata() {
            Ok(metadata) if metadata.is_dir() => fs::remove_dir_all(old),
            Ok(_) => fs::remove_file(old),
            Err(_) => Ok(()),
        };
        removed.map_err(failed(name))?;
    }
    for name in ENTRIES.into_iter().filter(|name| new.join(name).exists()) {
        fs::rename(new.join(name), folder.join(name)).map_err(failed(name))?;
    }
    Ok(())
}

fn png_name(k: usize) -> String {
    format!("{PNGS}/frame_{:04}.png", k + 1)
}

fn failed(name: &str) -> impl FnOnce(io::Error) -> PipelineError {
    move |source| PipelineError::File { name: name.to_owned(), source }
}

/// Size and checksums of a written file.
fn hash(folder: &Path, name: String) -> Result<WrittenFile> {
    let mut digester = Digester::default();
    let file = File::open(folder.join(&name)).map_err(failed(&name))?;
    let mut file = BufReader::with_capacity(256 * 1024, file);
    io::copy(&mut file, &mut digester).map_err(failed(&name))?;
    Ok(digester.finish(name, false))
}

/// Syncs a file or a folder to disk.
fn sync(folder: &Path, name: &str) -> Result<()> {
    File::open(folder.join(name)).and_then(|file| file.sync_all()).map_err(failed(name))
}

#[cfg(test)]
mod tests {
    use super::{OnDisk, check_output, replace_result, write_result};
    use crate::job::{Mosaic, Sha256, WrittenFile};
    use crate::pipeline::manifest::sample;
    use formats::{Limits, exr, npy, open_colours, read_stack};
    use ndarray::{Array2, Array3, Axis};
    use std::fs;
    use std::path::Path;

    fn frame(k: usize) -> Array2<f32> {
        Array2::from_shape_fn((20, 24), |(i, j)| (i * 24 + j) as f32 * 0.01 - k as f32)
    }

    fn write(folder: &Path, frames: usize) -> Vec<WrittenFile> {
        write_result(folder, sample(frames), None, OnDisk::All, |k| Ok(frame(k))).unwrap()
    }

    #[test]
    fn all_files_are_written_as_listed() {
        let folder = tempfile::tempdir().unwrap();
        let files = write(folder.path(), 3);
        assert!(files.iter().all(|file| !file.is_derived));
        let files: Vec<_> = files.into_iter().map(|file| file.file).collect();
        let names: Vec<&str> = files.iter().map(|file| file.name.as_str()).collect();
        assert_eq!(names.len(), 9);
        assert_eq!(names[0], "frames/frame_0001.exr");
        assert_eq!(names.last(), Some(&"manifest.json"));
        for file in &files {
            let path = folder.path().join(&file.name);
            assert_eq!(path.metadata().unwrap().len(), file.size);
            assert_eq!(Sha256::of(&fs::read(path).unwrap()), file.sha256);
        }
        let expected = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| frame(k)[[i, j]]);
        let array = folder.path().join("frames.npy");
        assert_eq!(read_stack(&array, &Limits::default()).unwrap().1, expected);
        let stack = folder.path().join("stack.exr");
        assert_eq!(exr::read_stack(&stack, &Limits::default()).unwrap().1, expected);
        let text = fs::read(folder.path().join("manifest.json")).unwrap();
        let manifest: serde_json::Value = serde_json::from_slice(&text).unwrap();
        assert_eq!(manifest["content"]["files"], serde_json::to_value(&files[..8]).unwrap());
    }

    #[test]
    fn derived_files_are_hashed_and_not_written() {
        let (all, stored) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let write = |folder: &Path, on_disk| {
            let mut manifest = sample(3);
            manifest.content.recipe.shape.mosaic = Some(Mosaic::Bggr);
            write_result(folder, manifest, None, on_disk, |k| Ok(frame(k))).unwrap()
        };
        let written = write(all.path(), OnDisk::All);
        let listed = write(stored.path(), OnDisk::Stored);
        let mut derived = Vec::new();
        // The manifests differ, because they have the time.
        for (written, listed) in written.iter().zip(&listed).take(written.len() - 1) {
            assert_eq!((&written.file, written.crc32), (&listed.file, listed.crc32));
            let exists = stored.path().join(&listed.file.name).exists();
            assert_eq!(exists, !listed.is_derived, "{listed:?}");
            derived.extend(listed.is_derived.then_some(&*listed.file.name));
        }
        derived.sort_unstable();
        let frames = [1, 2, 3].map(|k| format!("frames/frame_000{k}.exr"));
        assert_eq!(derived[..1], ["frames.npy"]);
        assert_eq!(derived[1..4], frames.each_ref().map(String::as_str));
        assert_eq!(derived[4..], ["mosaic.npy"]);
        assert!(!stored.path().join("frames").exists());
    }

    #[test]
    fn mosaic_frames_are_written_raw_and_demosaicked() {
        let folder = tempfile::tempdir().unwrap();
        let mut manifest = sample(2);
        manifest.content.recipe.shape.mosaic = Some(Mosaic::Gbrg);
        let files = write_result(folder.path(), manifest, None, OnDisk::All, |k| Ok(frame(k)));
        assert!(files.unwrap().iter().any(|file| file.file.name == "mosaic.npy"));
        let path = |name: &str| folder.path().join(name);
        let array = |name: &str| {
            let windows = npy::open_windows(&path(name), &Limits::default()).unwrap();
            let info = *windows.info();
            windows.read_window(0..info.frames, 0..info.height, 0..info.width).unwrap()
        };
        let (raw, colours) = (array("mosaic.npy"), array("frames.npy"));
        assert_eq!((raw.dim(), colours.dim()), ((2, 20, 24), (2, 20, 72)));
        for k in 0..2 {
            assert_eq!(raw.index_axis(Axis(0), k), frame(k));
            let expected = Mosaic::Gbrg.demosaick(frame(k).view(), (0, 0));
            assert_eq!(colours.index_axis(Axis(0), k), expected);
        }
        assert_eq!(exr::read_stack(&path("stack.exr"), &Limits::default()).unwrap().1, colours);
        let mut picture = open_colours(&path("png/frame_0001.png"), &Limits::default()).unwrap();
        assert_eq!(picture.as_mut().unwrap().info().width, 72);
        let text = fs::read(path("manifest.json")).unwrap();
        let manifest: serde_json::Value = serde_json::from_slice(&text).unwrap();
        let colour = serde_json::json!({"mosaic": "gbrg", "demosaicking": Mosaic::DEMOSAICKING});
        assert_eq!(manifest["content"]["colour"], colour);
        // A grey result removes the raw mosaic of the earlier one.
        let grey = tempfile::tempdir_in(folder.path()).unwrap();
        write(grey.path(), 2);
        replace_result(grey.path(), folder.path()).unwrap();
        assert!(!path("mosaic.npy").exists());
    }

    #[test]
    fn only_the_files_of_an_earlier_result_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let (first, second) = (folder.path().join("a"), folder.path().join("b"));
        fs::create_dir_all(&first).unwrap();
        fs::create_dir_all(&second).unwrap();
        write(&first, 5);
        fs::write(first.join("notes.txt"), "kept").unwrap();
        write(&second, 2);
        replace_result(&second, &first).unwrap();
        assert_eq!(fs::read_dir(first.join("frames")).unwrap().count(), 2);
        assert_eq!(fs::read_to_string(first.join("notes.txt")).unwrap(), "kept");
    }

    #[test]
    fn foreign_folders_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("frames")).unwrap();
        let error = check_output(folder.path()).unwrap_err().to_string();
        assert!(error.contains("\"frames\""), "{error}");
    }
}
