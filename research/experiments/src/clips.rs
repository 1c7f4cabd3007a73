//! The clips of an experiment, read from a folder in which each is a folder of PNGs or a file.

use std::fs;
use std::path::{Path, PathBuf};

use engine::intake::read_clip;
use ndarray::{Array3, s};
use sci_recon::cli::CliError;

pub struct Clip {
    /// Name of its file or folder.
    pub name: String,
    /// \[B,H,W\] on \[0,1\].
    pub frames: Array3<f32>,
}

/// Reads the first `count` frames of every clip in a folder, sorted by name. With `side`, a square
/// of `side` pixels is cropped from the centre of each frame.
pub fn read_clips(
    folder: &Path,
    frames: usize,
    side: Option<usize>,
) -> Result<Vec<Clip>, CliError> {
    let unreadable = |error| CliError::Input(format!("cannot read {}: {error}", folder.display()));
    let entries = fs::read_dir(folder).map_err(unreadable)?;
    let mut paths = entries
        .map(|entry| entry.map(|entry| entry.path()))
        .filter(|path| path.as_ref().map_or(true, |path| is_clip(path)))
        .collect::<Result<Vec<PathBuf>, _>>()
        .map_err(unreadable)?;
    paths.sort();
    // A folder of pictures is one clip.
    if paths.is_empty() {
        paths.push(folder.to_owned());
    }
    paths.iter().map(|path| clip(path, frames, side)).collect()
}

fn is_clip(path: &Path) -> bool {
    let kinds = ["npy", "npz", "mat", "tif", "tiff"];
    let kind = path.extension().and_then(|kind| kind.to_str()).unwrap_or_default();
    path.is_dir() || kinds.iter().any(|known| kind.eq_ignore_ascii_case(known))
}

fn clip(path: &Path, frames: usize, side: Option<usize>) -> Result<Clip, CliError> {
    let all = read_clip(path, None)?;
    let (count, height, width) = all.dim();
    let refused = |what: String| CliError::Input(format!("clip {}: {what}", path.display()));
    if count < frames {
        return Err(refused(format!("{count} frames; {frames} are needed")));
    }
    if let Some(side) = side.filter(|side| *side > height.min(width)) {
        return Err(refused(format!("frames of {height}x{width} are smaller than {side}x{side}")));
    }
    let (rows, columns) = side.map_or((height, width), |side| (side, side));
    let (top, left) = ((height - rows) / 2, (width - columns) / 2);
    let frames = all.slice(s![..frames, top..top + rows, left..left + columns]).to_owned();
    if let Some(value) = frames.iter().find(|value| !(-1e-6..=1.0 + 1e-6).contains(*value)) {
        return Err(refused(format!("{value} times the full scale; a scene lies between 0 and 1")));
    }
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(Clip { name, frames })
}

#[cfg(test)]
mod tests {
    use super::read_clips;
    use formats::npy;
    use ndarray::Array3;

    #[test]
    fn clips_are_found_by_name_and_cut_to_the_middle() {
        let folder = tempfile::tempdir().unwrap();
        let value = |(k, i, j)| (100 * k + 10 * i + j) as f32 / 1000.0;
        let clip = Array3::from_shape_fn((3, 4, 6), value);
        for name in ["b.npy", "a.npy"] {
            npy::write_f32(&folder.path().join(name), clip.view()).unwrap();
        }
        std::fs::write(folder.path().join("notes.txt"), "no clip").unwrap();
        let clips = read_clips(folder.path(), 2, Some(2)).unwrap();
        assert_eq!(clips.iter().map(|clip| clip.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
        assert_eq!(clips[0].frames.dim(), (2, 2, 2));
        assert_eq!(clips[0].frames[[1, 0, 0]], value((1, 1, 2)));
        let message = |frames, side| match read_clips(folder.path(), frames, side) {
            Ok(_) => String::new(),
            Err(error) => error.to_string(),
        };
        assert!(message(4, None).contains("3 frames; 4 are needed"));
        assert!(message(2, Some(5)).contains("4x6 are smaller than 5x5"));
    }
}
