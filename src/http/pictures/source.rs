//! Where pictures come from: prepared arrays, result files, and tiles that are done while others
//! are not.

use std::io::ErrorKind;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ndarray::{Array2, Array3, Axis, s};

use crate::http::rendering::Picture;
use engine::job::{MARGIN, Mosaic, Sha256};
use engine::pipeline::assessment::BLOCK;
use formats::{self, Channels, FormatError, Limits, StackInfo, npy, planar};

/// A stack of f32 \[frames, rows, columns\] of which windows are read.
#[derive(Debug, Clone)]
pub(super) struct Stack {
    pub(super) shape: (usize, usize, usize),
    pub(super) identity: String,
    pub(super) files: Files,
    /// Of frames that a colour sensor saw: result files have their colours, tiles have not.
    pub(super) mosaic: Option<Mosaic>,
    /// The white level of the job's frames; `None` before it is known, and for other stacks.
    pub(super) white: Option<f32>,
}

#[derive(Debug, Clone)]
pub(super) enum Files {
    Prepared(PathBuf),
    Frames(PathBuf),
    /// Tiles of an unfinished result, on the preview; NaN where there is neither.
    Tiles(Arc<Unfinished>),
}

/// What there is of a snapshot before it is assembled.
#[derive(Debug)]
pub(super) struct Unfinished {
    /// A prepared array of coarse frames.
    pub(super) preview: Option<PathBuf>,
    pub(super) tiles: Vec<DoneTile>,
}

/// A tile that is done, as a prepared array, the window that it covers, of which it has every `step`th pixel, and
/// which of its frames is the snapshot's first.
#[derive(Debug)]
pub(super) struct DoneTile {
    pub(super) rows: Range<usize>,
    pub(super) columns: Range<usize>,
    pub(super) step: usize,
    pub(super) first: usize,
    pub(super) path: PathBuf,
}

type Window = Result<Array3<f32>, FormatError>;

impl Stack {
    /// What is shown: \[frames, rows, columns\], of colours \[frames, rows, 3 columns\].
    fn window(&self, frames: Range<usize>, rows: Range<usize>, columns: Range<usize>) -> Window {
        match (self.mosaic, &self.files) {
            (None, _) => self.stored(frames, rows, columns),
            (Some(_), Files::Frames(_)) => {
                self.stored(frames, rows, 3 * columns.start..3 * columns.end)
            }
            (Some(mosaic), _) => {
                // The colours of a pixel follow from those around it.
                let wider = |range: &Range<usize>, end: usize| {
                    range.start.saturating_sub(MARGIN)..(range.end + MARGIN).min(end)
                };
                let (down, across) = (wider(&rows, self.shape.1), wider(&columns, self.shape.2));
                let first = (down.start, across.start);
                let (top, left) = (rows.start - down.start, 3 * (columns.start - across.start));
                let inside = s![top..top + rows.len(), left..left + 3 * columns.len()];
                let seen = self.stored(frames, down, across)?;
                let mut shown = Array3::zeros((seen.dim().0, rows.len(), 3 * columns.len()));
                for (seen, mut shown) in seen.outer_iter().zip(shown.outer_iter_mut()) {
                    shown.assign(&mosaic.demosaick(seen, first).slice(inside));
                }
                Ok(shown)
            }
        }
    }

    /// The frames as the sensor sees them: \[frames, rows, columns\].
    fn seen(&self, frames: Range<usize>, rows: Range<usize>, columns: Range<usize>) -> Window {
        let (Some(mosaic), Files::Frames(_)) = (self.mosaic, &self.files) else {
            return self.stored(frames, rows, columns);
        };
        let first = (rows.start, columns.start);
        let colours = self.window(frames, rows.clone(), columns.clone())?;
        let mut seen = Array3::zeros((colours.dim().0, rows.len(), columns.len()));
        for (colours, mut seen) in colours.outer_iter().zip(seen.outer_iter_mut()) {
            seen.assign(&mosaic.sample(colours, first));
        }
        Ok(seen)
    }

    fn channels(&self) -> Channels {
        if self.mosaic.is_some() { Channels::Rgb } else { Channels::Grey }
    }

    /// What the files have.
    fn stored(&self, frames: Range<usize>, rows: Range<usize>, columns: Range<usize>) -> Window {
        let limits = Limits::default();
        match &self.files {
            Files::Prepared(path) => {
                planar::Reader::open(path, &limits)?.read_window(frames, rows, columns)
            }
            Files::Frames(path) => {
                npy::open_windows(path, &limits)?.read_window(frames, rows, columns)
            }
            Files::Tiles(unfinished) => {
                let mut whole = match &unfinished.preview {
                    Some(path) => enlarged(path, self, frames.clone(), &rows, &columns)?,
                    None => Array3::from_elem((frames.len(), rows.len(), columns.len()), f32::NAN),
                };
                lay(&unfinished.tiles, frames, rows, columns, &mut whole)?;
                Ok(whole)
            }
        }
    }

    fn settled(&self) -> bool {
        !matches!(self.files, Files::Tiles(_))
    }

    fn picture<F>(&self, name: &str, depth: usize, read: F) -> Picture
    where
        F: Fn(&Self, Range<usize>, Range<usize>) -> Result<Array2<f32>, FormatError>
            + Send
            + Sync
            + 'static,
    {
        let (_, height, width) = self.shape;
        let stack = self.clone();
        Picture {
            height,
            width,
            identity: format!("{} {name}", self.identity),
            settled: self.settled(),
            channels: self.channels(),
            depth: depth * self.channels().count(),
            white: None,
            read: Box::new(move |rows, columns| read(&stack, rows, columns)),
        }
    }

    pub(super) fn frame(&self, k: usize) -> Picture {
        let picture = self.picture(&format!("frame {k}"), 1, move |stack, rows, columns| {
            Ok(first(stack.window(k..k + 1, rows, columns)?))
        });
        Picture { white: self.white, ..picture }
    }

    /// Frame `k` without the one before it.
    pub(super) fn difference(&self, k: usize) -> Picture {
        self.picture(&format!("difference {k}"), 2, move |stack, rows, columns| {
            let pair = stack.window(k - 1..k + 1, rows, columns)?;
            Ok(&pair.index_axis(Axis(0), 1) - &pair.index_axis(Axis(0), 0))
        })
    }

    /// All frames at one row: \[frames, columns\].
    pub(super) fn slice(&self, row: usize) -> Picture {
        let frames = self.shape.0;
        let picture = self.picture(&format!("slice {row}"), 1, move |stack, rows, columns| {
            Ok(stack.window(rows, row..row + 1, columns)?.index_axis_move(Axis(1), 0))
        });
        Picture { height: frames, white: self.white, ..picture }
    }

    pub(super) fn mean(&self) -> Picture {
        let frames = self.shape.0;
        self.picture("mean", frames, move |stack, rows, columns| {
            let window = stack.window(0..frames, rows, columns)?;
            Ok(window.sum_axis(Axis(0)) / frames as f32)
        })
    }

    /// The sum of the squares of all frames: of masks, the gram diagonal.
    pub(super) fn gram(&self) -> Picture {
        let frames = self.shape.0;
        self.picture("gram", frames, move |stack, rows, columns| {
            let window = stack.window(0..frames, rows, columns)?;
            Ok(window.map_axis(Axis(0), |line| line.iter().map(|c| c * c).sum()))
        })
    }

    /// 1 where all frames are 0, else 0.
    pub(super) fn dead(&self) -> Picture {
        let frames = self.shape.0;
        self.picture("dead", frames, move |stack, rows, columns| {
            let window = stack.window(0..frames, rows, columns)?;
            Ok(window.map_axis(Axis(0), |line| f32::from(line.iter().all(|&c| c == 0.0))))
        })
    }

    /// `|y - Hx|` of these frames `x`, with the masks of `H` and frame `snapshot` of `y`.
    pub(super) fn residual(&self, masks: &Self, measurement: &Self, snapshot: usize) -> Picture {
        let frames = self.shape.0;
        let name = format!("{} {} {snapshot} residual", masks.identity, measurement.identity);
        let (masks, measurement) = (masks.clone(), measurement.clone());
        let picture = self.picture(&name, 2 * frames, move |stack, rows, columns| {
            let y = measurement.window(snapshot..snapshot + 1, rows.clone(), columns.clone())?;
            let mut rest = first(y);
            let masks = masks.window(0..frames, rows.clone(), columns.clone())?;
            let x = stack.seen(0..frames, rows, columns)?;
            for (mask, frame) in masks.outer_iter().zip(x.outer_iter()) {
                ndarray::azip!((rest in &mut rest, &c in &mask, &x in &frame) *rest -= c * x);
            }
            rest.mapv_inplace(f32::abs);
            Ok(rest)
        });
        Picture { channels: Channels::Grey, ..picture }
    }
}

/// A frame, counted from 1, of a file as it was sent. Such files are read from their beginning, so the frame is read
/// once and kept as long as the picture.
pub(super) fn sent(
    path: PathBuf,
    limits: Limits,
    info: &StackInfo,
    (sha256, frame): (Sha256, usize),
) -> Picture {
    let kept: Mutex<Option<Array2<f32>>> = Mutex::default();
    Picture {
        height: info.height,
        width: info.width,
        identity: format!("{sha256} sent {frame}"),
        settled: true,
        channels: Channels::Grey,
        depth: 1,
        white: None,
        read: Box::new(move |rows, columns| {
            let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
            let whole = match &mut *kept {
                Some(whole) => whole,
                none => none.insert(nth_frame(&path, &limits, frame)?),
            };
            Ok(whole.slice(s![rows, columns]).to_owned())
        }),
    }
}

/// The expected error of frame `k`, from 0, of a picture of this size: each pixel has that of its block.
pub(super) fn errors(
    path: PathBuf,
    (height, width): (usize, usize),
    (sha256, k): (Sha256, usize),
) -> Picture {
    Picture {
        height,
        width,
        identity: format!("{sha256} error {k}"),
        settled: true,
        channels: Channels::Grey,
        depth: 1,
        white: None,
        read: Box::new(move |rows, columns| {
            let of_blocks = |range: &Range<usize>| range.start / BLOCK..range.end.div_ceil(BLOCK);
            let (down, across) = (of_blocks(&rows), of_blocks(&columns));
            let stored = npy::open_windows(&path, &Limits::default())?;
            let blocks = first(stored.read_window(k..k + 1, down.clone(), across.clone())?);
            Ok(Array2::from_shape_fn((rows.len(), columns.len()), |(i, j)| {
                blocks[[
                    (rows.start + i) / BLOCK - down.start,
                    (columns.start + j) / BLOCK - across.start,
                ]]
            }))
        }),
    }
}

fn nth_frame(path: &Path, limits: &Limits, frame: usize) -> Result<Array2<f32>, FormatError> {
    let mut reader = formats::open_stack(path, limits)?;
    let mut found = reader.next_frame()?;
    for _ in 1..frame {
        found = reader.next_frame()?;
    }
    let gone = || FormatError::io("read the frame")(ErrorKind::UnexpectedEof.into());
    found.ok_or_else(gone)
}

fn first(window: Array3<f32>) -> Array2<f32> {
    window.index_axis_move(Axis(0), 0)
}

/// A window of a preview as large as the frames: every pixel has the value of its place, of a mosaic that of its
/// sub-image.
fn enlarged(
    path: &Path,
    stack: &Stack,
    frames: Range<usize>,
    rows: &Range<usize>,
    columns: &Range<usize>,
) -> Window {
    let (_, height, width) = stack.shape;
    let step = if stack.mosaic.is_some() { 2 } else { 1 };
    let from = |at: usize, length: usize, coarse: usize| {
        at / step * (coarse / step) / (length / step) * step + at % step
    };
    let reader = planar::Reader::open(path, &Limits::default())?;
    let (h, w) = (reader.info().height, reader.info().width);
    let size = (frames.len(), rows.len(), columns.len());
    let coarse = reader.read_window(frames, 0..h, 0..w)?;
    Ok(Array3::from_shape_fn(size, |(k, i, j)| {
        coarse[[k, from(rows.start + i, height, h), from(columns.start + j, width, w)]]
    }))
}

/// Lays the tiles that are done over a window of a picture. Where they overlap the later one counts:
/// they are blended when all are done.
fn lay(
    tiles: &[DoneTile],
    frames: Range<usize>,
    rows: Range<usize>,
    columns: Range<usize>,
    whole: &mut Array3<f32>,
) -> Result<(), FormatError> {
    for tile in tiles {
        let step = tile.step;
        // From the first pixel that both have.
        let common = |shown: &Range<usize>, has: &Range<usize>| {
            let before = shown.start.saturating_sub(has.start).next_multiple_of(step);
            has.start + before..shown.end.min(has.end)
        };
        let (down, across) = (common(&rows, &tile.rows), common(&columns, &tile.columns));
        if down.is_empty() || across.is_empty() {
            continue;
        }
        let of_tile = |part: &Range<usize>, has: &Range<usize>| {
            (part.start - has.start) / step..(part.end - has.start).div_ceil(step)
        };
        let part = planar::Reader::open(&tile.path, &Limits::default())?.read_window(
            tile.first + frames.start..tile.first + frames.end,
            of_tile(&down, &tile.rows),
            of_tile(&across, &tile.columns),
        )?;
        let shown =
            |part: &Range<usize>, of: &Range<usize>| part.start - of.start..part.end - of.start;
        let (down, across, step) =
            (shown(&down, &rows), shown(&across, &columns), step.cast_signed());
        whole.slice_mut(s![.., down;step, across;step]).assign(&part);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::{DoneTile, Files, Mosaic, Stack, Unfinished};
    use formats::{npy, planar};
    use ndarray::{Array3, s};

    fn prepared(folder: &std::path::Path, name: &str, stack: &Array3<f32>) -> std::path::PathBuf {
        let (frames, height, width) = stack.dim();
        let path = folder.join(name);
        let mut writer =
            planar::writer(std::fs::File::create(&path).unwrap(), frames, height, width).unwrap();
        stack.outer_iter().for_each(|frame| writer.write_frame(frame).unwrap());
        writer.finish().unwrap();
        path
    }

    fn stack(shape: (usize, usize, usize), files: Files) -> Stack {
        Stack { shape, identity: "x".into(), files, mosaic: None, white: None }
    }

    #[test]
    fn the_residual_is_what_the_frames_leave_of_the_measurement() {
        let folder = tempfile::tempdir().unwrap();
        let value = |k: usize, i: usize, j: usize| ((k * 31 + i * 7 + j * 3) % 11) as f32 / 10.0;
        let x = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| value(k, i, j));
        let masks = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| value(j, k, i));
        let mut y = (&x * &masks).sum_axis(ndarray::Axis(0));
        y[[4, 5]] -= 0.25;
        let y = y.insert_axis(ndarray::Axis(0));
        let files = |name, of: &Array3<f32>| Files::Prepared(prepared(folder.path(), name, of));
        let frames = stack((3, 20, 24), files("x", &x));
        let masks = stack((3, 20, 24), files("masks", &masks));
        let picture = frames.residual(&masks, &stack((1, 20, 24), files("y", &y)), 0);
        let found = picture.reduce(&picture.whole(0)).unwrap();
        for ((i, j), &rest) in found.indexed_iter() {
            let expected = if (i, j) == (4, 5) { 0.25 } else { 0.0 };
            assert!((rest - expected).abs() < 1e-5, "{i} {j} {rest}");
        }
        let slice = frames.slice(7);
        let found = slice.reduce(&slice.whole(0)).unwrap();
        assert_eq!(found, x.slice(s![.., 7, ..]));
        let change = frames.difference(2);
        let found = change.reduce(&change.whole(0)).unwrap();
        assert_eq!(found, &x.slice(s![2, .., ..]) - &x.slice(s![1, .., ..]));
    }

    #[test]
    fn an_unfinished_mosaic_is_shown_in_the_colours_of_the_finished_one() {
        let folder = tempfile::tempdir().unwrap();
        let mosaic = Mosaic::Grbg;
        let seen =
            Array3::from_shape_fn((2, 16, 20), |(k, i, j)| ((k * 320 + i * 20 + j) as f32).sin());
        let mut colours = Array3::zeros((2, 16, 60));
        for (seen, mut colours) in seen.outer_iter().zip(colours.outer_iter_mut()) {
            colours.assign(&mosaic.demosaick(seen, (0, 0)));
        }
        let array = folder.path().join("frames.npy");
        npy::write_colours(&array, colours.view()).unwrap();
        // A preview of one pixel for each colour, and all tiles: each a sub-image.
        let coarse = Array3::from_shape_fn((2, 2, 2), |(k, i, j)| seen[[k, i, j]]);
        let preview = Some(prepared(folder.path(), "preview", &coarse));
        let tile = |plane: usize| {
            let (row, column) = (plane / 2, plane % 2);
            let part = seen.slice(s![.., row..;2, column..;2]).to_owned();
            let path = prepared(folder.path(), &format!("tile {plane}"), &part);
            DoneTile { rows: row..15 + row, columns: column..19 + column, step: 2, first: 0, path }
        };
        let unfinished =
            |tiles| Files::Tiles(Arc::new(Unfinished { preview: preview.clone(), tiles }));
        let of = |files| Stack { mosaic: Some(mosaic), ..stack((2, 16, 20), files) };
        let (done, all) = (of(Files::Frames(array)), of(unfinished((0..4).map(tile).collect())));
        for (rows, columns) in [(0..16, 0..20), (3..9, 5..8), (7..8, 0..20)] {
            let window = |stack: &Stack| stack.window(0..2, rows.clone(), columns.clone()).unwrap();
            let place = s![.., rows.clone(), 3 * columns.start..3 * columns.end];
            assert_eq!(window(&done), colours.slice(place));
            assert_eq!(window(&all), colours.slice(place));
            let sensor = |stack: &Stack| stack.seen(0..2, rows.clone(), columns.clone()).unwrap();
            let place = s![.., rows.clone(), columns.clone()];
            assert_eq!(
                (sensor(&done), sensor(&all)),
                (seen.slice(place).to_owned(), seen.slice(place).to_owned())
            );
        }
        let begun = of(unfinished(Vec::new())).seen(0..1, 0..16, 0..20).unwrap();
        assert_eq!((begun[[0, 14, 18]], begun[[0, 9, 3]]), (coarse[[0, 0, 0]], coarse[[0, 1, 1]]));
        let picture = done.frame(1);
        assert_eq!(picture.reduce(&picture.whole(0)).unwrap(), colours.slice(s![1, .., ..]));
    }

    #[test]
    fn tiles_that_are_done_stand_in_their_place_on_the_preview() {
        let folder = tempfile::tempdir().unwrap();
        let x = Array3::from_shape_fn((2, 40, 40), |(k, i, j)| (k * 1600 + i * 40 + j) as f32);
        let part = x.slice(s![.., 16..40, 20..40]).to_owned();
        let path = prepared(folder.path(), "tile", &part);
        let coarse = Array3::from_shape_fn((2, 5, 5), |(k, i, j)| (k + i * 5 + j) as f32);
        let coarse_path = prepared(folder.path(), "preview", &coarse);
        for preview in [None, Some(coarse_path)] {
            let below = |i: usize, j: usize| preview.as_ref().map(|_| coarse[[1, i / 8, j / 8]]);
            let tiles = vec![DoneTile {
                rows: 16..40,
                columns: 20..40,
                step: 1,
                first: 0,
                path: path.clone(),
            }];
            let unfinished = Unfinished { preview: preview.clone(), tiles };
            let picture = stack((2, 40, 40), Files::Tiles(Arc::new(unfinished))).frame(1);
            assert!(!picture.settled);
            let found = picture.reduce(&picture.whole(0)).unwrap();
            for ((i, j), &value) in found.indexed_iter() {
                let expected = (i >= 16 && j >= 20).then_some(x[[1, i, j]]).or(below(i, j));
                assert_eq!(value.is_finite().then_some(value), expected, "{i} {j}");
            }
        }
    }
}
