//! Checks the frames of a tile that another machine has computed.

use std::path::Path;

use ndarray::Array2;

use super::arrays::plane;
use super::residual::residual;
use super::tile::TileInput;
use formats::planar::Reader;
use formats::{FormatError, Limits};
use reconstruction::ReconError;
use reconstruction::operator::SensingOperator;

/// Largest frame value, in units of the white level or of the largest value after one projection.
///
/// The first projection of GAP returns `C y / (H H^T)`. Later ones correct it by less, but the accelerated residual
/// may wind up, and networks overshoot. The largest value in tests was 9 times the white level; the limit is about 100
/// times that, so it accepts every tile that a solver can produce.
const MARGIN: f32 = 1000.0;

/// The reason why the frames of a tile are rejected.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // the messages describe the variants
pub enum Unfit {
    #[error("the frames are {found}, but the tile needs {expected}")]
    Shape { found: String, expected: String },
    #[error(
        "frame {frame}, row {row}, column {column} is {value}; finite values up to {largest:.3e} are possible"
    )]
    Value { frame: usize, row: usize, column: usize, value: f32, largest: f32 },
    #[error("frame {frame} belongs to another run and must be 0")]
    Unsolved { frame: usize },
    #[error(transparent)]
    Format(#[from] FormatError),
    #[error(transparent)]
    Recon(#[from] ReconError),
}

impl Unfit {
    /// True if the frames are invalid. False if this machine or its arrays are the cause.
    pub fn is_of_frames(&self) -> bool {
        match self {
            Self::Shape { .. } | Self::Value { .. } | Self::Unsolved { .. } => true,
            Self::Format(error) => error.is_callers_fault(),
            Self::Recon(_) => false,
        }
    }
}

/// Reads the frames \[S B,h,w\] of a tile from a prepared array and returns their relative residual
/// ([`residual`]) against the measurement. Memory holds one frame at a time.
///
/// # Errors
/// Another shape, values that no solver returns, or a file that can't be read.
pub fn verify(path: &Path, input: &TileInput) -> Result<f32, Unfit> {
    let (masks, height, width) = input.masks.dim();
    let snapshots = input.y.dim().0;
    let reader = Reader::open(path, &Limits::default())?;
    let info = reader.info();
    let (found, expected) =
        ([info.frames, info.height, info.width], [snapshots * masks, height, width]);
    if found != expected {
        let text = |[frames, height, width]: [usize; 3]| {
            format!("{frames} frames of {height}x{width} pixels")
        };
        return Err(Unfit::Shape { found: text(found), expected: text(expected) });
    }
    let largest = largest(input)?;
    let is_solved = |snapshot| input.pieces.iter().any(|piece| piece.contains(&snapshot));
    for frame in (0..expected[0]).filter(|frame| !is_solved(frame / masks)) {
        if plane(&reader, frame)?.iter().any(|&value| value != 0.0) {
            return Err(Unfit::Unsolved { frame });
        }
    }
    let checked = |frame: usize| -> Result<Array2<f32>, Unfit> {
        let values = plane(&reader, frame)?;
        let is_wrong = |value: &f32| !value.is_finite() || value.abs() > largest;
        match values.indexed_iter().find(|(_, value)| is_wrong(value)) {
            Some(((row, column), &value)) => {
                Err(Unfit::Value { frame, row, column, value, largest })
            }
            None => Ok(values),
        }
    };
    if largest == 0.0 {
        // Without light, the residual does not read the frames, so this does. All must be 0.
        (0..expected[0]).try_for_each(|frame| checked(frame).map(|_| ()))?;
    }
    residual(input.masks.view(), input.y.view(), &input.pieces, checked)
}

/// Largest value that a frame can have; 0 if no light reaches the tile.
fn largest(input: &TileInput) -> Result<f32, ReconError> {
    let op = match SensingOperator::new(input.masks.clone()) {
        Err(ReconError::DarkMasks { .. }) => return Ok(0.0),
        other => other?,
    };
    let brightest = input.y.iter().fold(0.0f32, |most, value| most.max(value.abs()));
    Ok(MARGIN * input.white.max(op.largest_gain() * brightest))
}

/// Root of the mean squared difference of two tiles' frames in prepared arrays of one shape, relative to the
/// white level. Memory holds two frames at a time.
///
/// # Errors
/// Files that can't be read, or that differ in shape.
pub fn relative_difference(one: &Path, other: &Path, white: f32) -> Result<f64, FormatError> {
    let open = |path| Reader::open(path, &Limits::default());
    let (one, other) = (open(one)?, open(other)?);
    let (mut squares, mut count) = (0.0f64, 0usize);
    for frame in 0..one.info().frames {
        let (a, b) = (plane(&one, frame)?, plane(&other, frame)?);
        if a.dim() != b.dim() {
            return Err(FormatError::Internal("tiles of two shapes are compared".into()));
        }
        count += a.len();
        let difference = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
        squares += a.iter().zip(b.iter()).map(difference).sum::<f64>();
    }
    Ok((squares / count.max(1) as f64).sqrt() / f64::from(white))
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)] // lists of ranges, some of one
mod tests {
    use std::fs::File;
    use std::path::PathBuf;

    use ndarray::{Array3, Axis, concatenate, s};

    use super::{Unfit, relative_difference, verify};
    use crate::pipeline::tile::{TileInput, reconstruct_tile};
    use formats::planar;
    use optics::{iid_masks, measure};
    use reconstruction::schedule::Schedule;

    /// A run of two snapshots whose second one is solved, its frames, and their residual.
    fn solved() -> (TileInput, Array3<f32>, f32) {
        let masks = iid_masks(4, 32, 24, 1).unwrap();
        let truth = Array3::from_shape_fn((4, 32, 24), |(k, i, j)| {
            0.5 + 0.3 * ((i + k) as f32 * 0.2).sin() * (j as f32 * 0.1).cos()
        });
        let y = measure(masks.view(), truth.view()).unwrap().insert_axis(Axis(0)) * 3.0;
        let y = concatenate![Axis(0), y, y];
        let input = TileInput { masks, y, white: 2.4, pieces: vec![1..2] };
        let schedule = Schedule::gap_tv();
        let outcome = reconstruct_tile(input.clone(), &schedule, &mut (), &mut ()).unwrap();
        (input, outcome.frames, outcome.residual)
    }

    fn stored(frames: &Array3<f32>) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("frames");
        let (count, height, width) = frames.dim();
        let file = File::create(&path).unwrap();
        let mut writer = planar::writer(file, count, height, width).unwrap();
        frames.outer_iter().try_for_each(|frame| writer.write_frame(frame)).unwrap();
        writer.finish().unwrap();
        (folder, path)
    }

    #[test]
    fn the_residual_of_a_stored_tile_is_that_of_its_record() {
        let (input, frames, stated) = solved();
        let (_folder, path) = stored(&frames);
        assert!(stated > 0.0 && stated < 0.2, "{stated}");
        assert_eq!(verify(&path, &input).unwrap(), stated);
    }

    #[test]
    fn frames_that_no_solver_returns_are_refused() {
        let (input, good, _) = solved();
        let refusal = |frames: &Array3<f32>| {
            let (_folder, path) = stored(frames);
            let error = verify(&path, &input).unwrap_err();
            assert!(error.is_of_frames());
            error.to_string()
        };
        for bad in [f32::NAN, f32::INFINITY, 3e38, -3e38] {
            let mut frames = good.clone();
            frames[[5, 3, 2]] = bad;
            assert!(refusal(&frames).starts_with("frame 5, row 3, column 2 is "), "{bad}");
        }
        let mut frames = good.clone();
        frames[[1, 3, 2]] = 0.1;
        assert!(refusal(&frames).starts_with("frame 1 belongs to another run"));
        let twice = concatenate![Axis(0), good, good];
        assert!(refusal(&twice).contains("16 frames of 32x24"));
        let narrow = good.slice(s![.., .., ..23]).to_owned();
        assert!(refusal(&narrow).contains("8 frames of 32x23"));
        // Specks of 20 times the white level are possible.
        let mut frames = good;
        frames[[5, 3, 2]] = -50.0;
        let (_folder, path) = stored(&frames);
        assert!(verify(&path, &input).unwrap() > 0.2);
    }

    #[test]
    fn a_tile_without_light_is_black() {
        let (input, good, _) = solved();
        let dark = TileInput { masks: Array3::zeros(input.masks.raw_dim()), ..input };
        let (_folder, path) = stored(&Array3::zeros(good.raw_dim()));
        assert_eq!(verify(&path, &dark).unwrap(), 0.0);
        let (_folder, path) = stored(&good);
        assert!(matches!(verify(&path, &dark), Err(Unfit::Value { .. })));
    }

    #[test]
    fn the_difference_is_relative_to_white() {
        let (_, good, _) = solved();
        let (_one, one) = stored(&good);
        let (_other, other) = stored(&(&good + 0.1));
        assert_eq!(relative_difference(&one, &one, 2.0).unwrap(), 0.0);
        assert!((relative_difference(&one, &other, 2.0).unwrap() - 0.05).abs() < 1e-5);
    }
}
