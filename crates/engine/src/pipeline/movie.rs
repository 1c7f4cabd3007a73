//! Movies of the frames of one snapshot, or of several consecutive ones.

use std::fmt;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2, Axis, s};
use serde::{Deserialize, Serialize};

use super::derived::STACK;
use super::error::{PipelineError, Result};
use super::progress::Monitor;
use crate::job::{MovieFormat, SceneShape, Sha256, TaskStage, movie_step};
use formats::display::Picture;
use formats::gif::{self, GifWriter};
use formats::movie::{self, Clip, MovieWriter};
use formats::{Channels, FormatError, WindowReader, exr};

/// Number of samples that are read at a time: 16 MiB.
const BAND_SAMPLES: usize = 4 << 20;

/// The values that a picture shows as black and as white.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DisplayWindow {
    pub black: f32,
    pub white: f32,
}

/// The values of black and white do not span a range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub struct EmptyWindow {
    black: f32,
    white: f32,
}

impl fmt::Display for EmptyWindow {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // `Debug` has an exponent where `Display` has 39 digits.
        let Self { black, white } = self;
        write!(f, "black is {black:?} and white is {white:?}; ")?;
        if black < white {
            write!(f, "both and their difference must be at most {:?}", f32::MAX)
        } else {
            f.write_str("black must be below white")
        }
    }
}

impl DisplayWindow {
    /// Errors: [`EmptyWindow`] if black is not below white, or if a value or their difference is not finite.
    pub fn new(black: f32, white: f32) -> Result<Self, EmptyWindow> {
        // A finite positive difference implies finite values.
        if black < white && (white - black).is_finite() {
            return Ok(Self { black, white });
        }
        Err(EmptyWindow { black, white })
    }
}

/// The input of a movie.
#[derive(Debug)]
pub struct MovieTask {
    pub format: MovieFormat,
    pub shape: SceneShape,
    /// Values that are displayed as black and as white.
    pub window: DisplayWindow,
    /// True if the window was requested instead of the job's white level.
    pub requested: bool,
    /// Frames per second of the scene, if known.
    pub scene_fps: Option<f64>,
    /// The stack of frames of each snapshot, and its recorded hash.
    pub clips: Vec<(PathBuf, Sha256)>,
}

/// Writes the movie to `path`, an existing empty file. Pictures with sides above [`crate::job::MOVIE_SIDE`] are
/// reduced. One frame at a time is in memory.
///
/// Errors: [`PipelineError::Result`] if a file is damaged; I/O; a stop by the monitor.
pub fn write(path: &Path, task: &MovieTask, monitor: &Monitor) -> Result<()> {
    let SceneShape { frames, height, width, .. } = task.shape;
    let channels = task.shape.channels();
    let step = movie_step(height, width);
    let title = task.scene_fps.map_or(String::new(), |fps| {
        format!("{} frames/s, played at {}", (1e3 * fps).round() / 1e3, movie::FPS)
    });
    let count = frames * task.clips.len();
    let clip = Clip {
        shape: (count, height.div_ceil(step), width.div_ceil(step)),
        channels,
        title: &title,
    };
    let file = File::options().write(true).open(path);
    let file = file.map_err(|source| PipelineError::File { name: "movie".into(), source })?;
    let mut writer = Writer::new(task.format, BufWriter::new(file), &clip)?;
    for (index, (stack, sha256)) in task.clips.iter().enumerate() {
        let reader = open_checked(stack, *sha256, task.shape)?;
        monitor.check()?;
        for k in 0..frames {
            let frame = levels(&reader, k, channels, step, task.window)?;
            writer.write_frame(frame.view())?;
            monitor.check()?;
            let done = (index * frames + k + 1) as f64 / count as f64;
            monitor.reach(TaskStage::Writing, done);
        }
    }
    writer.finish()?;
    Ok(())
}

/// The writer of a format.
enum Writer {
    Mp4(Box<MovieWriter<BufWriter<File>>>),
    Gif(Box<GifWriter<BufWriter<File>>>),
}

impl Writer {
    fn new(
        format: MovieFormat,
        file: BufWriter<File>,
        clip: &Clip<'_>,
    ) -> Result<Self, FormatError> {
        Ok(match format {
            MovieFormat::Mp4 => Self::Mp4(Box::new(movie::writer(file, clip)?)),
            MovieFormat::Gif => Self::Gif(Box::new(gif::writer(file, clip)?)),
        })
    }

    fn write_frame(&mut self, frame: ArrayView2<'_, u8>) -> Result<(), FormatError> {
        match self {
            Self::Mp4(writer) => writer.write_frame(frame),
            Self::Gif(writer) => writer.write_frame(frame),
        }
    }

    fn finish(self) -> Result<(), FormatError> {
        match self {
            Self::Mp4(writer) => writer.finish().map(drop),
            Self::Gif(writer) => writer.finish().map(drop),
        }
    }
}

/// Opens the frames of a snapshot after a check of their hash.
fn open_checked(path: &Path, expected: Sha256, shape: SceneShape) -> Result<WindowReader> {
    let name = || STACK.to_owned();
    let unreadable = |source| PipelineError::File { name: name(), source };
    let hashed = Sha256::of_reader(&mut File::open(path).map_err(unreadable)?);
    if hashed.map_err(unreadable)?.0 != expected {
        return Err(PipelineError::Result(name()));
    }
    let size = (shape.frames, shape.height, shape.width);
    Ok(exr::open_windows(path, size, shape.channels())?)
}

/// Reads frame `k` in bands of rows, as levels from 0 to 255.
fn levels(
    reader: &WindowReader,
    k: usize,
    channels: Channels,
    step: usize,
    window: DisplayWindow,
) -> Result<Array2<u8>> {
    let DisplayWindow { black, white } = window;
    let (height, samples) = (reader.info().height, reader.info().width);
    let width = samples / channels.count();
    let size = (height.div_ceil(step), width.div_ceil(step) * channels.count());
    let mut levels = Array2::zeros(size);
    let band = (BAND_SAMPLES / (step * samples)).max(1);
    for start in (0..size.0).step_by(band) {
        let end = (start + band).min(size.0);
        let rows = start * step..(end * step).min(height);
        let values = reader.read_window(k..k + 1, rows, 0..samples)?;
        let values = values.index_axis(Axis(0), 0);
        let band = Picture::new(values, channels, (black, white))?.reduced(step).into_levels()?;
        levels.slice_mut(s![start..end, ..]).assign(&band);
    }
    Ok(levels)
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;
    use shiguredo_mp4::boxes::SampleEntry;
    use shiguredo_mp4::demux::{Input, Mp4FileDemuxer};

    use super::{DisplayWindow, MovieTask, write};
    use crate::job::{MovieFormat, SceneShape, Sha256};
    use crate::pipeline::PipelineError;
    use crate::pipeline::progress::Monitor;
    use formats::Channels;
    use formats::exr::{Attributes, Stack};

    #[test]
    fn large_pictures_are_reduced_and_damaged_files_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stack.exr");
        let frames = Array3::from_shape_fn((2, 77, 3841), |(k, i, j)| ((k + i + j) % 5) as f32);
        let parts = vec![Attributes::default(); 2];
        let stack = Stack::new((77, 3841), Channels::Grey, &parts).unwrap();
        let mut bytes = stack.head();
        for (k, frame) in frames.outer_iter().enumerate() {
            stack.lines().encode((k, 0), frame, &mut bytes);
        }
        std::fs::write(&path, &bytes).unwrap();
        let sha256 = Sha256::of(&bytes);
        let clip = path;
        let shape = SceneShape { frames: 2, height: 77, width: 3841, snapshots: 2, mosaic: None };
        let task = |sha256| MovieTask {
            format: MovieFormat::Mp4,
            shape,
            window: DisplayWindow { black: 0.0, white: 4.0 },
            requested: false,
            scene_fps: Some(100.0),
            clips: vec![(clip.clone(), sha256); 2],
        };
        let path = folder.path().join("movie.mp4");
        std::fs::write(&path, "").unwrap();
        let monitor = Monitor::default();
        write(&path, &task(sha256), &monitor).unwrap();
        assert_eq!(monitor.progress().fraction, 1.0);
        let bytes = std::fs::read(&path).unwrap();
        let mut demuxer = Mp4FileDemuxer::new();
        demuxer.handle_input(Input { position: 0, data: &bytes });
        let mut count = 0;
        while let Some(sample) = demuxer.next_sample().unwrap() {
            if let Some(SampleEntry::Av01(entry)) = sample.sample_entry {
                assert_eq!((entry.visual.height, entry.visual.width), (20, 961));
            }
            count += 1;
        }
        assert_eq!(count, 4);
        let damaged = write(&path, &task(Sha256::of(b"other")), &monitor);
        assert!(matches!(damaged, Err(PipelineError::Result(_))), "{damaged:?}");
        monitor.stop();
        let stopped = write(&path, &task(sha256), &monitor);
        assert!(matches!(stopped, Err(PipelineError::Stopped)), "{stopped:?}");
    }

    #[test]
    fn black_must_be_finite_and_below_white() {
        let window = DisplayWindow::new(-0.5, 2.0).unwrap();
        assert_eq!(window, DisplayWindow { black: -0.5, white: 2.0 });
        for (black, white) in [
            (1.0, 1.0),
            (1.0, 0.0),
            (f32::NAN, 1.0),
            (0.0, f32::INFINITY),
            (f32::NEG_INFINITY, 0.0),
            (f32::MIN, f32::MAX),
        ] {
            assert!(DisplayWindow::new(black, white).is_err(), "{black} {white}");
        }
    }
}
