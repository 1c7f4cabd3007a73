//! Writes the folder of a result: frames as EXR, npy and PNG, and the manifest.

use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::Path;

use ndarray::{Array2, ArrayView3};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::Value;

use super::error::{PipelineError, Result};
use super::manifest::{Manifest, SCHEMA_FAMILY, frame_attributes};
use crate::job::{ResultFile, Sha256};
use formats::display::Picture;
use formats::{Channels, exr, npy};

const FRAMES: &str = "frames";
const PNGS: &str = "png";
const STACK: &str = "stack.exr";
const ARRAY: &str = "frames.npy";
/// The raw frames of a colour sensor.
const RAW: &str = "mosaic.npy";
/// The expected error of each block of the frames.
const ERROR: &str = "error.npy";
const MANIFEST: &str = "manifest.json";
/// All entries of a result folder, the manifest last.
const ENTRIES: [&str; 7] = [FRAMES, PNGS, STACK, ARRAY, RAW, ERROR, MANIFEST];

/// Writes all files of a result and returns their names, sizes and hashes, the manifest last.
///
/// - `frames/frame_0001.exr` and so on
/// - `png/frame_0001.png` and so on; white as in the manifest, black is 0
/// - `stack.exr` and `frames.npy` (float32 \[B,H,W\])
/// - `error.npy`: the expected error \[B, block rows, block columns\], if `error` is given
/// - the manifest, with the list of the other files
///
/// Behind a mosaic frames are demosaicked: EXR has the channels R, G and B, PNG is in colour, `frames.npy` is
/// \[B,H,W,3\], and `mosaic.npy` \[B,H,W\] has the raw values.
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
    mut frame: impl FnMut(usize) -> Result<Array2<f32>>,
) -> Result<Vec<ResultFile>> {
    for name in [FRAMES, PNGS] {
        fs::create_dir_all(folder.join(name)).map_err(failed(name))?;
    }
    let attributes = frame_attributes(&manifest.content);
    let (height, width) = (manifest.content.height, manifest.content.width);
    let (count, white) = (manifest.content.frames, manifest.content.recipe.scale.white_level);
    let array = BufWriter::new(File::create(folder.join(ARRAY)).map_err(failed(ARRAY))?);
    let recipe = manifest.content.recipe.clone();
    let shape = recipe.shape;
    let channels = shape.channels();
    let mut array = npy::writer(array, (count, height, width), channels)?;
    let mut raw = match shape.mosaic {
        None => None,
        Some(mosaic) => {
            let file = BufWriter::new(File::create(folder.join(RAW)).map_err(failed(RAW))?);
            Some((mosaic, npy::writer(file, (count, height, width), Channels::Grey)?))
        }
    };
    let stack = folder.join(STACK);
    exr::write_stack(&stack, (height, width), channels, &attributes, |k| {
        let mut frame = recipe.frame(k, frame(k)?);
        if let Some((mosaic, raw)) = &mut raw {
            raw.write_frame(frame.view())?;
            frame = mosaic.demosaick(frame.view(), (0, 0));
        }
        exr::write_frame(&folder.join(frame_name(k)), frame.view(), channels, &attributes[k])?;
        Picture::with_16_bits(frame.view(), channels, (0.0, white))?
            .write_png(&folder.join(png_name(k)))?;
        array.write_frame(frame.view())?;
        Ok::<_, PipelineError>(frame)
    })?;
    array.finish()?;
    let names = (0..count).map(frame_name).chain((0..count).map(png_name));
    let mut names: Vec<_> = names.chain([STACK.to_owned(), ARRAY.to_owned()]).collect();
    if let Some((_, raw)) = raw {
        raw.finish()?;
        names.push(RAW.to_owned());
    }
    if let Some(error) = error {
        let file = BufWriter::new(File::create(folder.join(ERROR)).map_err(failed(ERROR))?);
        let mut writer = npy::writer(file, error.dim(), Channels::Grey)?;
        error.outer_iter().try_for_each(|frame| writer.write_frame(frame))?;
        writer.finish()?;
        names.push(ERROR.to_owned());
    }
    let files = &mut manifest.content.files;
    // In parallel, because disks sync many files in about the time of a few.
    *files =
        names.into_par_iter().map(|name| sync_and_hash(folder, name)).collect::<Result<_, _>>()?;
    let mut all = files.clone();
    for name in [FRAMES, PNGS] {
        sync_dir(folder, name)?;
    }
    all.push(write_manifest(folder, &manifest)?);
    Ok(all)
}

/// Writes `manifest.json`. The file and its folder are synced to disk on return.
pub fn write_manifest(folder: &Path, manifest: &impl Serialize) -> Result<ResultFile> {
    let text =
        serde_json::to_string_pretty(manifest).map_err(|error| failed(MANIFEST)(error.into()))?;
    fs::write(folder.join(MANIFEST), text + "\n").map_err(failed(MANIFEST))?;
    let file = sync_and_hash(folder, MANIFEST.to_owned())?;
    sync_dir(folder, "")?;
    Ok(file)
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

fn frame_name(k: usize) -> String {
    format!("{FRAMES}/frame_{:04}.exr", k + 1)
}

fn png_name(k: usize) -> String {
    format!("{PNGS}/frame_{:04}.png", k + 1)
}

fn failed(name: &str) -> impl FnOnce(io::Error) -> PipelineError {
    move |source| PipelineError::File { name: name.to_owned(), source }
}

/// Syncs a file to disk, and determines its size and hash.
fn sync_and_hash(folder: &Path, name: String) -> Result<ResultFile> {
    let hashed = || -> io::Result<(Sha256, u64)> {
        let mut file = File::open(folder.join(&name))?;
        file.sync_all()?;
        Sha256::of_reader(&mut file)
    };
    let (sha256, size) = hashed().map_err(failed(&name))?;
    Ok(ResultFile { name, size, sha256 })
}

fn sync_dir(folder: &Path, name: &str) -> Result<()> {
    File::open(folder.join(name)).and_then(|dir| dir.sync_all()).map_err(failed(name))
}

#[cfg(test)]
mod tests {
    use super::{check_output, replace_result, write_result};
    use crate::job::{Mosaic, ResultFile, Sha256};
    use crate::pipeline::manifest::sample;
    use formats::{Limits, exr, npy, open_colours, read_stack};
    use ndarray::{Array2, Array3, Axis};
    use std::fs;
    use std::path::Path;

    fn frame(k: usize) -> Array2<f32> {
        Array2::from_shape_fn((20, 24), |(i, j)| (i * 24 + j) as f32 * 0.01 - k as f32)
    }

    fn write(folder: &Path, frames: usize) -> Vec<ResultFile> {
        write_result(folder, sample(frames), None, |k| Ok(frame(k))).unwrap()
    }

    #[test]
    fn all_files_are_written_as_listed() {
        let folder = tempfile::tempdir().unwrap();
        let files = write(folder.path(), 3);
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
    fn mosaic_frames_are_written_raw_and_demosaicked() {
        let folder = tempfile::tempdir().unwrap();
        let mut manifest = sample(2);
        manifest.content.recipe.shape.mosaic = Some(Mosaic::Gbrg);
        let files = write_result(folder.path(), manifest, None, |k| Ok(frame(k))).unwrap();
        assert!(files.iter().any(|file| file.name == "mosaic.npy"));
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
