//! Sources of pictures: prepared arrays, result files, uploads, and the finished tiles of a snapshot that is still being
//! reconstructed.

use std::io::ErrorKind;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use ndarray::{Array2, Array3, Axis, s};

use crate::http::rendering::Picture;
use engine::job::{Dispersion, MARGIN, Mosaic, Sha256};
use engine::pipeline::assessment::BLOCK;
use formats::{self, Channels, FormatError, Limits, npy, planar};

/// A stack of f32 \[frames, rows, columns\] that is read in windows.
#[derive(Debug, Clone)]
pub(super) struct Stack {
    pub(super) shape: (usize, usize, usize),
    /// Identifies the values, as in [`Picture::identity`].
    pub(super) identity: String,
    pub(super) files: Files,
    /// The mosaic of a colour sensor, for frames. Result files are demosaicked; tiles and previews are not.
    pub(super) mosaic: Option<Mosaic>,
    /// The displacement of the bands of a spectral camera, for frames. Result files are in place; tiles and previews are as
    /// on the sensor.
    pub(super) dispersion: Option<Arc<Dispersed>>,
    /// The white level of a job's frames; `None` before it is known, and for other stacks.
    pub(super) white: Option<f32>,
}

/// The displacement of bands, and the rows and columns of the sensor.
#[derive(Debug)]
pub(super) struct Dispersed {
    pub(super) bands: Dispersion,
    pub(super) sensor: (usize, usize),
}

/// A true frame \[rows, columns\], or \[rows, 3 columns\] for colours.
pub(super) struct TrueFrame {
    /// Identifies the values, as in [`Picture::identity`].
    pub(super) identity: String,
    pub(super) channels: Channels,
    pub(super) values: Arc<Array2<f32>>,
}

#[derive(Debug, Clone)]
pub(super) enum Files {
    /// A prepared array of an upload.
    Prepared(PathBuf),
    /// The result file `frames.npy`.
    Frames(PathBuf),
    /// Finished tiles on top of the preview. Pixels without either are NaN.
    Tiles(Arc<Unfinished>),
}

/// Files of a snapshot that is not assembled yet.
#[derive(Debug)]
pub(super) struct Unfinished {
    /// A prepared array of frames at low resolution.
    pub(super) preview: Option<PathBuf>,
    pub(super) tiles: Vec<FinishedTile>,
}

/// A finished tile of a run of snapshots, as a prepared array.
#[derive(Debug)]
pub(super) struct FinishedTile {
    /// Rows and columns of the frames that the tile covers.
    pub(super) rows: Range<usize>,
    pub(super) columns: Range<usize>,
    /// The tile has every `step`th row and column: 2 for a sub-image of a mosaic, otherwise 1.
    pub(super) step: usize,
    /// Index of the snapshot's first frame in the array.
    pub(super) first_frame: usize,
    pub(super) path: PathBuf,
}

type Window = Result<Array3<f32>, FormatError>;

impl Stack {
    /// The frames for display: \[frames, rows, columns\], or \[frames, rows, 3 columns\] for colours.
    fn window(&self, frames: Range<usize>, rows: Range<usize>, columns: Range<usize>) -> Window {
        if let (Some(dispersed), Files::Tiles(_)) = (&self.dispersion, &self.files) {
            return each_band(frames, (rows.len(), columns.len()), |band| {
                let place = (rows.clone(), columns.clone());
                let (rows, columns) = dispersed.bands.sensor_window(band, place);
                let sensor = first_frame(self.stored(band..band + 1, rows, columns)?);
                Ok(dispersed.bands.interpolate(sensor.view(), band))
            });
        }
        match (self.mosaic, &self.files) {
            (None, _) => self.stored(frames, rows, columns),
            (Some(_), Files::Frames(_)) => {
                self.stored(frames, rows, 3 * columns.start..3 * columns.end)
            }
            (Some(mosaic), _) => {
                // Demosaicking needs the pixels around the window, too.
                let widened = |range: &Range<usize>, end: usize| {
                    range.start.saturating_sub(MARGIN)..(range.end + MARGIN).min(end)
                };
                let (_, height, width) = self.shape;
                let (down, across) = (widened(&rows, height), widened(&columns, width));
                let first_pixel = (down.start, across.start);
                let top = rows.start - down.start;
                let first_sample = 3 * (columns.start - across.start);
                let inside =
                    s![top..top + rows.len(), first_sample..first_sample + 3 * columns.len()];
                let raw = self.stored(frames, down, across)?;
                let mut colours = Array3::zeros((raw.dim().0, rows.len(), 3 * columns.len()));
                for (raw, mut colours) in raw.outer_iter().zip(colours.outer_iter_mut()) {
                    colours.assign(&mosaic.demosaick(raw, first_pixel).slice(inside));
                }
                Ok(colours)
            }
        }
    }

    /// The frames as the sensor records them, one colour for each pixel, or each band where it arrives: \[frames, rows,
    /// columns\].
    fn raw(&self, frames: Range<usize>, rows: Range<usize>, columns: Range<usize>) -> Window {
        if let (Some(dispersed), Files::Frames(_)) = (&self.dispersion, &self.files) {
            let (_, height, width) = self.shape;
            return each_band(frames, (rows.len(), columns.len()), |band| {
                let place = (rows.clone(), columns.clone());
                dispersed.bands.sheared_window(band, (height, width), place, |rows, columns| {
                    Ok(first_frame(self.stored(band..band + 1, rows, columns)?))
                })
            });
        }
        let (Some(mosaic), Files::Frames(_)) = (self.mosaic, &self.files) else {
            return self.stored(frames, rows, columns);
        };
        let first_pixel = (rows.start, columns.start);
        let colours = self.window(frames, rows.clone(), columns.clone())?;
        let mut raw = Array3::zeros((colours.dim().0, rows.len(), columns.len()));
        for (colours, mut raw) in colours.outer_iter().zip(raw.outer_iter_mut()) {
            raw.assign(&mosaic.sample(colours, first_pixel));
        }
        Ok(raw)
    }

    fn channels(&self) -> Channels {
        if self.mosaic.is_some() { Channels::Rgb } else { Channels::Grey }
    }

    /// The values in the files.
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
                let mut window = match &unfinished.preview {
                    Some(path) => enlarge_preview(path, self, frames.clone(), &rows, &columns)?,
                    None => Array3::from_elem((frames.len(), rows.len(), columns.len()), f32::NAN),
                };
                overlay_tiles(&unfinished.tiles, frames, rows, columns, &mut window)?;
                Ok(window)
            }
        }
    }

    /// A picture of values that `read` computes from `depth` frames.
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
            channels: self.channels(),
            depth: depth * self.channels().count(),
            white: None,
            read: Box::new(move |rows, columns| read(&stack, rows, columns)),
        }
    }

    /// Frame `k`, from 0.
    pub(super) fn frame(&self, k: usize) -> Picture {
        let picture = self.picture(&format!("frame {k}"), 1, move |stack, rows, columns| {
            Ok(first_frame(stack.window(k..k + 1, rows, columns)?))
        });
        Picture { white: self.white, ..picture }
    }

    /// Frame `k` minus the previous frame; `k` is at least 1.
    pub(super) fn difference(&self, k: usize) -> Picture {
        self.picture(&format!("difference {k}"), 2, move |stack, rows, columns| {
            let pair = stack.window(k - 1..k + 1, rows, columns)?;
            Ok(&pair.index_axis(Axis(0), 1) - &pair.index_axis(Axis(0), 0))
        })
    }

    /// Frame `k`, from 0, minus the true frame. Colours are compared with colours, and sensor values with sensor values.
    pub(super) fn deviation(&self, k: usize, truth: TrueFrame) -> Picture {
        let TrueFrame { identity, channels, values } = truth;
        let picture = self.picture(&format!("minus {identity}"), 2, move |stack, rows, columns| {
            let samples = channels.count() * columns.start..channels.count() * columns.end;
            let truth = values.slice(s![rows.clone(), samples]);
            let as_stored = stack.channels() == channels;
            let frame = if as_stored { Self::window } else { Self::raw };
            Ok(first_frame(frame(stack, k..k + 1, rows, columns)?) - truth)
        });
        Picture { channels, ..picture }
    }

    /// All bands in false colours; `None` without wavelengths.
    pub(super) fn false_colours(&self) -> Option<Picture> {
        let shares = shares(self.dispersion.as_ref()?.bands.wavelengths.as_ref()?);
        let bands = self.shape.0;
        let picture = self.picture("false colours", bands, move |stack, rows, columns| {
            let window = stack.window(0..bands, rows, columns)?;
            let (_, height, width) = window.dim();
            let mut colours = Array2::zeros((height, 3 * width));
            for (band, shares) in window.outer_iter().zip(&shares) {
                for (colour, share) in shares.iter().enumerate() {
                    colours.slice_mut(s![.., colour..;3]).scaled_add(*share, &band);
                }
            }
            Ok(colours)
        });
        Some(Picture { channels: Channels::Rgb, white: self.white, ..picture })
    }

    /// One row of all frames: \[frames, columns\].
    pub(super) fn slice(&self, row: usize) -> Picture {
        let frames = self.shape.0;
        let picture = self.picture(&format!("slice {row}"), 1, move |stack, rows, columns| {
            Ok(stack.window(rows, row..row + 1, columns)?.index_axis_move(Axis(1), 0))
        });
        Picture { height: frames, white: self.white, ..picture }
    }

    /// The mean of all frames.
    pub(super) fn mean(&self) -> Picture {
        let frames = self.shape.0;
        self.picture("mean", frames, move |stack, rows, columns| {
            let window = stack.window(0..frames, rows, columns)?;
            Ok(window.sum_axis(Axis(0)) / frames as f32)
        })
    }

    /// The sum of the squares of all frames. For masks, this is the diagonal of the Gram matrix `H Hᵀ`.
    pub(super) fn gram(&self) -> Picture {
        let frames = self.shape.0;
        self.picture("gram", frames, move |stack, rows, columns| {
            let window = stack.window(0..frames, rows, columns)?;
            Ok(window.map_axis(Axis(0), |line| line.iter().map(|c| c * c).sum()))
        })
    }

    /// 1 at pixels where all frames are 0, otherwise 0.
    pub(super) fn dead(&self) -> Picture {
        let frames = self.shape.0;
        self.picture("dead", frames, move |stack, rows, columns| {
            let window = stack.window(0..frames, rows, columns)?;
            Ok(window.map_axis(Axis(0), |line| f32::from(line.iter().all(|&c| c == 0.0))))
        })
    }

    /// The residual `|y - H x|`: `x` are these frames, `H` has the masks, and `y` is a snapshot of the measurement.
    pub(super) fn residual(&self, masks: &Self, measurement: &Self, snapshot: usize) -> Picture {
        let frames = self.shape.0;
        let name = format!("{} {} {snapshot} residual", masks.identity, measurement.identity);
        let measured = measurement.shape;
        let (masks, measurement) = (masks.clone(), measurement.clone());
        let picture = self.picture(&name, 2 * frames, move |stack, rows, columns| {
            let y = measurement.window(snapshot..snapshot + 1, rows.clone(), columns.clone())?;
            let mut residual = first_frame(y);
            let masks = masks.window(0..frames, rows.clone(), columns.clone())?;
            let x = stack.raw(0..frames, rows, columns)?;
            for (mask, frame) in masks.outer_iter().zip(x.outer_iter()) {
                ndarray::azip!((r in &mut residual, &c in &mask, &x in &frame) *r -= c * x);
            }
            residual.mapv_inplace(f32::abs);
            Ok(residual)
        });
        let (_, height, width) = measured;
        Picture { channels: Channels::Grey, height, width, ..picture }
    }
}

/// Reads frames one by one and stacks them.
fn each_band(
    bands: Range<usize>,
    (height, width): (usize, usize),
    read: impl Fn(usize) -> Result<Array2<f32>, FormatError>,
) -> Window {
    let mut stack = Array3::zeros((bands.len(), height, width));
    for (band, mut frame) in bands.zip(stack.outer_iter_mut()) {
        frame.assign(&read(band)?);
    }
    Ok(stack)
}

/// A frame of an uploaded file, which `read` returns. Most formats can only be read from the beginning, so the frame is read
/// once and cached in the picture.
pub(super) fn sent_frame(
    identity: String,
    (height, width): (usize, usize),
    channels: Channels,
    read: impl FnMut() -> Result<Array2<f32>, FormatError> + Send + 'static,
) -> Picture {
    let source = Mutex::new((None, read));
    Picture {
        height,
        width,
        identity,
        channels,
        depth: channels.count(),
        white: None,
        read: Box::new(move |rows, columns| {
            let (cached, read) = &mut *source.lock().unwrap_or_else(PoisonError::into_inner);
            let values: &Array2<f32> = match cached {
                Some(values) => values,
                empty => empty.insert(read()?),
            };
            let samples = channels.count() * columns.start..channels.count() * columns.end;
            Ok(values.slice(s![rows, samples]).to_owned())
        }),
    }
}

/// The expected error of frame `k`, from 0. The file has one value for each block of pixels.
pub(super) fn expected_error(
    path: PathBuf,
    height: usize,
    width: usize,
    sha256: Sha256,
    k: usize,
) -> Picture {
    Picture {
        height,
        width,
        identity: format!("{sha256} error {k}"),
        channels: Channels::Grey,
        depth: 1,
        white: None,
        read: Box::new(move |rows, columns| {
            let to_blocks = |range: &Range<usize>| range.start / BLOCK..range.end.div_ceil(BLOCK);
            let (down, across) = (to_blocks(&rows), to_blocks(&columns));
            let stored = npy::open_windows(&path, &Limits::default())?;
            let blocks = first_frame(stored.read_window(k..k + 1, down.clone(), across.clone())?);
            Ok(Array2::from_shape_fn((rows.len(), columns.len()), |(i, j)| {
                blocks[[
                    (rows.start + i) / BLOCK - down.start,
                    (columns.start + j) / BLOCK - across.start,
                ]]
            }))
        }),
    }
}

/// The last of the next `count` frames.
pub(super) fn nth_frame(
    count: usize,
    mut next: impl FnMut() -> Result<Option<Array2<f32>>, FormatError>,
) -> Result<Array2<f32>, FormatError> {
    let mut current = next()?;
    for _ in 1..count {
        current = next()?;
    }
    current.ok_or_else(|| FormatError::io("read the frame")(ErrorKind::UnexpectedEof.into()))
}

/// Shares of the bands in red, green and blue. The shortest wavelength is blue, the longest red. Each colour is a weighted
/// mean, so equal bands are grey.
fn shares(wavelengths: &[f64]) -> Vec<[f32; 3]> {
    let (shortest, longest) =
        wavelengths.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &one| {
            (low.min(one), high.max(one))
        });
    let span = (longest - shortest).max(f64::MIN_POSITIVE);
    let share = |wavelength: &f64| {
        let place = ((wavelength - shortest) / span) as f32;
        [2.0 * place - 1.0, 1.0 - (2.0 * place - 1.0).abs(), 1.0 - 2.0 * place]
            .map(|share| share.max(0.0))
    };
    let mut shares: Vec<[f32; 3]> = wavelengths.iter().map(share).collect();
    for colour in 0..3 {
        let sum: f32 = shares.iter().map(|share| share[colour]).sum();
        for share in &mut shares {
            // Few bands may leave a colour without one.
            share[colour] =
                if sum > 0.0 { share[colour] / sum } else { 1.0 / wavelengths.len() as f32 };
        }
    }
    shares
}

fn first_frame(window: Array3<f32>) -> Array2<f32> {
    window.index_axis_move(Axis(0), 0)
}

/// A window of the preview, enlarged to the size of the frames without interpolation. In a mosaic, each pixel has the value
/// of its sub-image.
fn enlarge_preview(
    path: &Path,
    stack: &Stack,
    frames: Range<usize>,
    rows: &Range<usize>,
    columns: &Range<usize>,
) -> Window {
    let (_, height, width) = stack.shape;
    let (height, width) = stack.dispersion.as_ref().map_or((height, width), |one| one.sensor);
    let step = if stack.mosaic.is_some() { 2 } else { 1 };
    let coarse_index = |index: usize, length: usize, coarse_length: usize| {
        index / step * (coarse_length / step) / (length / step) * step + index % step
    };
    let reader = planar::Reader::open(path, &Limits::default())?;
    let (h, w) = (reader.info().height, reader.info().width);
    let size = (frames.len(), rows.len(), columns.len());
    let coarse = reader.read_window(frames, 0..h, 0..w)?;
    Ok(Array3::from_shape_fn(size, |(k, i, j)| {
        let row = coarse_index(rows.start + i, height, h);
        coarse[[k, row, coarse_index(columns.start + j, width, w)]]
    }))
}

/// Copies the finished tiles into a window of the picture. Where tiles overlap, the last one wins: they are blended when
/// the frames are assembled.
fn overlay_tiles(
    tiles: &[FinishedTile],
    frames: Range<usize>,
    rows: Range<usize>,
    columns: Range<usize>,
    window: &mut Array3<f32>,
) -> Result<(), FormatError> {
    for tile in tiles {
        let step = tile.step;
        // The first common pixel must be one that the tile has.
        let common = |window: &Range<usize>, tile: &Range<usize>| {
            let skipped = window.start.saturating_sub(tile.start).next_multiple_of(step);
            tile.start + skipped..window.end.min(tile.end)
        };
        let (common_rows, common_columns) =
            (common(&rows, &tile.rows), common(&columns, &tile.columns));
        if common_rows.is_empty() || common_columns.is_empty() {
            continue;
        }
        let in_tile = |common: &Range<usize>, tile: &Range<usize>| {
            (common.start - tile.start) / step..(common.end - tile.start).div_ceil(step)
        };
        let values = planar::Reader::open(&tile.path, &Limits::default())?.read_window(
            tile.first_frame + frames.start..tile.first_frame + frames.end,
            in_tile(&common_rows, &tile.rows),
            in_tile(&common_columns, &tile.columns),
        )?;
        let in_window = |common: &Range<usize>, window: &Range<usize>| {
            common.start - window.start..common.end - window.start
        };
        let (down, across) = (in_window(&common_rows, &rows), in_window(&common_columns, &columns));
        let step = step.cast_signed();
        window.slice_mut(s![.., down;step, across;step]).assign(&values);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::{
        Channels, Dispersed, Dispersion, Files, FinishedTile, Mosaic, Stack, TrueFrame, Unfinished,
    };
    use engine::job::{DispersionAxis, MaskExtent};
    use formats::{npy, planar};
    use ndarray::{Array2, Array3, Axis, s};

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
        Stack { shape, identity: "x".into(), files, mosaic: None, dispersion: None, white: None }
    }

    #[test]
    fn bands_are_shown_in_their_place_before_and_after_their_assembly() {
        let folder = tempfile::tempdir().unwrap();
        let bands = Dispersion {
            axis: DispersionAxis::Column,
            offsets: vec![0.0, 2.0, 3.5],
            wavelengths: None,
            mask: MaskExtent::Scene,
        };
        let cube =
            Array3::from_shape_fn((3, 10, 12), |(k, i, j)| (k * 7 + i * 3 + j) as f32 / 40.0);
        let mut sensor = Array3::zeros((3, 10, 16));
        for (k, frame) in cube.outer_iter().enumerate() {
            sensor.index_axis_mut(Axis(0), k).assign(&bands.shear(frame, k));
        }
        let dispersed = |files| {
            let dispersed = Dispersed { bands: bands.clone(), sensor: (10, 16) };
            Stack { dispersion: Some(Arc::new(dispersed)), ..stack((3, 10, 12), files) }
        };
        let preview = Some(prepared(folder.path(), "preview", &sensor));
        let before = dispersed(Files::Tiles(Arc::new(Unfinished { preview, tiles: Vec::new() })));
        let path = folder.path().join("frames.npy");
        npy::write_f32(&path, cube.view()).unwrap();
        let after = dispersed(Files::Frames(path));
        for (k, frame) in cube.outer_iter().enumerate() {
            let shown = |stack: &Stack| {
                let picture = stack.frame(k);
                picture.reduce(&picture.whole(0)).unwrap()
            };
            assert_eq!(shown(&after), frame);
            assert_eq!(shown(&before), bands.unshear(sensor.index_axis(Axis(0), k), k));
        }
        // Without wavelengths there are no colours. The middle band is green, the others are blue and red.
        assert!(after.false_colours().is_none());
        let mut named = bands.clone();
        named.wavelengths = Some(vec![450.0, 550.0, 650.0]);
        let dispersion = Some(Arc::new(Dispersed { bands: named, sensor: (10, 16) }));
        let colours = Stack { dispersion, ..after.clone() }.false_colours().unwrap();
        let colours = colours.reduce(&colours.whole(0)).unwrap();
        for (colour, band) in [(0, 2), (1, 1), (2, 0)] {
            assert_eq!(colours.slice(s![.., colour..;3]), cube.index_axis(Axis(0), band));
        }
        assert_eq!(super::shares(&[500.0, 500.0]), [[0.5; 3]; 2]);
        // The residual lies on the sensor.
        let y = sensor.sum_axis(Axis(0)).insert_axis(Axis(0));
        let measurement = stack((1, 10, 16), Files::Prepared(prepared(folder.path(), "y", &y)));
        let open = Array3::ones((3, 10, 16));
        let masks = stack((3, 10, 16), Files::Prepared(prepared(folder.path(), "masks", &open)));
        let picture = after.residual(&masks, &measurement, 0);
        let residual = picture.reduce(&picture.whole(0)).unwrap();
        assert_eq!(residual.dim(), (10, 16));
        assert!(residual.iter().all(|value| *value < 1e-5), "{residual}");
    }

    #[test]
    fn the_residual_is_the_unexplained_part_of_the_measurement() {
        let folder = tempfile::tempdir().unwrap();
        let value = |k: usize, i: usize, j: usize| ((k * 31 + i * 7 + j * 3) % 11) as f32 / 10.0;
        let x = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| value(k, i, j));
        let masks = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| value(j, k, i));
        let mut y = (&x * &masks).sum_axis(ndarray::Axis(0));
        y[[4, 5]] -= 0.25;
        let y = y.insert_axis(ndarray::Axis(0));
        let files =
            |name, values: &Array3<f32>| Files::Prepared(prepared(folder.path(), name, values));
        let frames = stack((3, 20, 24), files("x", &x));
        let masks = stack((3, 20, 24), files("masks", &masks));
        let picture = frames.residual(&masks, &stack((1, 20, 24), files("y", &y)), 0);
        let residual = picture.reduce(&picture.whole(0)).unwrap();
        for ((i, j), &value) in residual.indexed_iter() {
            let expected = if (i, j) == (4, 5) { 0.25 } else { 0.0 };
            assert!((value - expected).abs() < 1e-5, "{i} {j} {value}");
        }
        let slice = frames.slice(7);
        assert_eq!(slice.reduce(&slice.whole(0)).unwrap(), x.slice(s![.., 7, ..]));
        let truth = TrueFrame {
            identity: "t".into(),
            channels: Channels::Grey,
            values: Arc::new(x.index_axis(Axis(0), 1).to_owned() * 0.5),
        };
        let deviation = frames.deviation(1, truth);
        let values = deviation.reduce(&deviation.whole(0)).unwrap();
        assert_eq!(values, &x.index_axis(Axis(0), 1) * 0.5);
        let change = frames.difference(2);
        let values = change.reduce(&change.whole(0)).unwrap();
        assert_eq!(values, &x.slice(s![2, .., ..]) - &x.slice(s![1, .., ..]));
    }

    #[test]
    fn an_unfinished_mosaic_is_shown_in_the_colours_of_the_finished_one() {
        let folder = tempfile::tempdir().unwrap();
        let mosaic = Mosaic::Grbg;
        let raw =
            Array3::from_shape_fn((2, 16, 20), |(k, i, j)| ((k * 320 + i * 20 + j) as f32).sin());
        let mut colours = Array3::zeros((2, 16, 60));
        for (raw, mut colours) in raw.outer_iter().zip(colours.outer_iter_mut()) {
            colours.assign(&mosaic.demosaick(raw, (0, 0)));
        }
        let array = folder.path().join("frames.npy");
        npy::write_colours(&array, colours.view()).unwrap();
        // The preview has one pixel for each colour. Each tile is a sub-image.
        let coarse = Array3::from_shape_fn((2, 2, 2), |(k, i, j)| raw[[k, i, j]]);
        let preview = Some(prepared(folder.path(), "preview", &coarse));
        let tile = |plane: usize| {
            let (row, column) = (plane / 2, plane % 2);
            let part = raw.slice(s![.., row..;2, column..;2]).to_owned();
            let path = prepared(folder.path(), &format!("tile {plane}"), &part);
            let (rows, columns) = (row..15 + row, column..19 + column);
            FinishedTile { rows, columns, step: 2, first_frame: 0, path }
        };
        let unfinished =
            |tiles| Files::Tiles(Arc::new(Unfinished { preview: preview.clone(), tiles }));
        let mosaic_stack = |files| Stack { mosaic: Some(mosaic), ..stack((2, 16, 20), files) };
        let assembled = mosaic_stack(Files::Frames(array));
        let all_tiles = mosaic_stack(unfinished((0..4).map(tile).collect()));
        for (rows, columns) in [(0..16, 0..20), (3..9, 5..8), (7..8, 0..20)] {
            let window = |stack: &Stack| stack.window(0..2, rows.clone(), columns.clone()).unwrap();
            let place = s![.., rows.clone(), 3 * columns.start..3 * columns.end];
            assert_eq!(window(&assembled), colours.slice(place));
            assert_eq!(window(&all_tiles), colours.slice(place));
            let sensor = |stack: &Stack| stack.raw(0..2, rows.clone(), columns.clone()).unwrap();
            let place = s![.., rows.clone(), columns.clone()];
            assert_eq!(sensor(&assembled), raw.slice(place));
            assert_eq!(sensor(&all_tiles), raw.slice(place));
        }
        let no_tiles = mosaic_stack(unfinished(Vec::new())).raw(0..1, 0..16, 0..20).unwrap();
        assert_eq!(no_tiles[[0, 14, 18]], coarse[[0, 0, 0]]);
        assert_eq!(no_tiles[[0, 9, 3]], coarse[[0, 1, 1]]);
        // A truth has colours, or is as the sensor sees it.
        for (channels, truth) in [(Channels::Rgb, &colours), (Channels::Grey, &raw)] {
            let values = Arc::new(truth.index_axis(Axis(0), 1).to_owned());
            let truth = TrueFrame { identity: "t".into(), channels, values };
            let picture = assembled.deviation(1, truth);
            let deviation = picture.reduce(&picture.whole(0)).unwrap();
            assert_eq!(deviation, Array2::<f32>::zeros((16, 20 * channels.count())));
        }
        let picture = assembled.frame(1);
        assert_eq!(picture.reduce(&picture.whole(0)).unwrap(), colours.slice(s![1, .., ..]));
    }

    #[test]
    fn finished_tiles_are_shown_on_the_preview() {
        let folder = tempfile::tempdir().unwrap();
        let x = Array3::from_shape_fn((2, 40, 40), |(k, i, j)| (k * 1600 + i * 40 + j) as f32);
        let part = x.slice(s![.., 16..40, 20..40]).to_owned();
        let path = prepared(folder.path(), "tile", &part);
        let coarse = Array3::from_shape_fn((2, 5, 5), |(k, i, j)| (k + i * 5 + j) as f32);
        let coarse_path = prepared(folder.path(), "preview", &coarse);
        for preview in [None, Some(coarse_path)] {
            let below = |i: usize, j: usize| preview.as_ref().map(|_| coarse[[1, i / 8, j / 8]]);
            let tiles = vec![FinishedTile {
                rows: 16..40,
                columns: 20..40,
                step: 1,
                first_frame: 0,
                path: path.clone(),
            }];
            let unfinished = Unfinished { preview: preview.clone(), tiles };
            let picture = stack((2, 40, 40), Files::Tiles(Arc::new(unfinished))).frame(1);
            let values = picture.reduce(&picture.whole(0)).unwrap();
            for ((i, j), &value) in values.indexed_iter() {
                let expected = (i >= 16 && j >= 20).then_some(x[[1, i, j]]).or(below(i, j));
                assert_eq!(value.is_finite().then_some(value), expected, "{i} {j}");
            }
        }
    }
}
