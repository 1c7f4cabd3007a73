//! The optics of a snapshot compressive camera: aperture patterns, the masks they project, calibration, checks, and
//! simulated measurements.
//!
//! The crate works on arrays and reads no files. Random numbers come from a seeded ChaCha generator, so simulations are
//! reproducible bit for bit.

#![warn(missing_docs)]

mod axis;
mod block_fit;
mod calibration;
mod calibration_check;
mod camera;
mod defects;
mod dispersion;
mod displacement;
mod distortion;
mod finding;
mod geometry;
mod iid;
mod lens;
mod mask_values;
mod masks;
mod measurement_check;
mod measurement_fit;
mod modulation;
mod mosaic;
mod multiplex;
mod order;
mod patterns;
mod projection;
mod simulate;
mod squares;
mod study;

pub use block_fit::{BLOCK_MARGIN, BlockFit, BlockStudy, judge_blocks};
pub use calibration::{Average, Calibrator, RawMask, References, Repeats};
pub use calibration_check::{CaptureFigures, PatternFigures, judge_captures, judge_masks};
pub use camera::{Camera, illumination};
pub use defects::{Defects, closed_pixels, judge_closed, judge_defects};
pub use dispersion::{Dispersion, DispersionAxis, DispersionError, MAX_BANDS, MaskExtent};
pub use displacement::{Displacement, Magnified, central, displacement, magnification, magnified};
pub use distortion::{Distortion, MovedParts};
pub use finding::{Doubt, Entry, Finding, FindingCode, Severity, Subject};
pub use geometry::Geometry;
pub use iid::iid_masks;
pub use lens::soften;
pub use mask_values::Alteration;
pub use masks::{HybridAperture, Normalisation, ProjectedMasks};
pub use measurement_check::{
    BitUsage, MeasurementFigures, MeasurementStudy, PhaseDifference, REACH, judge_dispersed,
    judge_measurement, with_means,
};
pub use mosaic::{MARGIN, Mosaic};
pub use multiplex::{Draw, Multiplexing};
pub use order::{ExpectedOrder, Reordering, pattern_overlap, reordering};
pub use patterns::{ApertureGrid, Circle, check_patterns, pattern_rank, single_apertures};
pub use projection::{Method, Placement, Projector};
pub use simulate::{measure, noisy};
pub use squares::random_squares;
pub use study::{Correlations, MaskFigures, MaskStudy, flatness};

use thiserror::Error;

/// The result type of this crate.
pub type Result<T, E = OpticsError> = std::result::Result<T, E>;

/// Errors of this crate.
#[derive(Debug, Error, PartialEq)]
#[allow(missing_docs)] // the messages describe the fields
pub enum OpticsError {
    /// A parameter is out of range.
    #[error("{name} is {value}; it must be {range}")]
    Parameter { name: &'static str, value: String, range: &'static str },
    /// Random patterns did not reach the required rank.
    #[error(
        "{tries} random draws of {frames} patterns with {open} of {apertures} sub-apertures open \
         reached at most rank {reached}, but rank {wanted} is possible: use another seed, or open \
         about half of the sub-apertures"
    )]
    Rank {
        tries: usize,
        frames: usize,
        open: usize,
        apertures: usize,
        reached: usize,
        wanted: usize,
    },
    /// Patterns or masks are unusable.
    #[error("{0}")]
    Pattern(String),
    /// Captures are unusable for a calibration.
    #[error("{0}")]
    Captures(String),
    /// Masks and frames differ in size.
    #[error("the frames are {frames}, but the masks are {masks}; both must have the same size")]
    Sizes { frames: String, masks: String },
}

/// The random number generator of this crate. It gives the same numbers on every machine.
pub fn generator(seed: u64) -> rand::rngs::ChaCha8Rng {
    rand::SeedableRng::seed_from_u64(seed)
}

/// Returns an error unless the value of a parameter `fits` its range.
fn check_parameter(
    fits: bool,
    name: &'static str,
    value: impl ToString,
    range: &'static str,
) -> Result<()> {
    if fits {
        Ok(())
    } else {
        Err(OpticsError::Parameter { name, value: value.to_string(), range })
    }
}

/// Returns an error if a size is 0.
fn check_size(frames: usize, height: usize, width: usize) -> Result<()> {
    let sizes = [("compression ratio", frames), ("height", height), ("width", width)];
    sizes
        .into_iter()
        .try_for_each(|(name, size)| check_parameter(size > 0, name, size, "at least 1"))
}
