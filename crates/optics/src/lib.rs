//! The optics: aperture patterns, the masks that they project, and simulated measurements.
//!
//! Knows arrays only. Everything random comes from a ChaCha generator with a stated seed, so
//! that a simulation can be repeated bit for bit.

#![warn(missing_docs)]

mod axis;
mod calibration;
mod camera;
mod check;
mod findings;
mod geometry;
mod iid;
mod lens;
mod masks;
mod mosaic;
mod multiplex;
mod order;
mod patterns;
mod projection;
mod simulate;
mod squares;
mod study;

pub use calibration::{Average, Calibrator, RawMask, References, Repeats};
pub use camera::{Camera, illumination};
pub use check::{Digits, MeasurementFigures, MeasurementStudy, REACH, judge_measurement};
pub use findings::{
    CaptureFigures, Finding, PatternFigures, Severity, judge_captures, judge_masks,
};
pub use geometry::Geometry;
pub use iid::iid_masks;
pub use lens::soften;
pub use masks::{HybridAperture, Normalisation, ProjectedMasks};
pub use mosaic::{MARGIN, Mosaic};
pub use multiplex::{Draw, Multiplexing};
pub use order::{Expected, Reordered, pattern_likeness, reordered};
pub use patterns::{ApertureGrid, Circle, check_patterns, pattern_rank, single_apertures};
pub use projection::{Method, Placement, Projector};
pub use simulate::{measure, noisy};
pub use squares::random_squares;
pub use study::{MaskFigures, MaskStudy, flatness};

use thiserror::Error;

/// What the functions of this folder give.
pub type Result<T, E = OpticsError> = std::result::Result<T, E>;

/// What can't be built or simulated.
#[derive(Debug, Error, PartialEq)]
#[allow(missing_docs)] // the messages say what the fields are
pub enum OpticsError {
    /// A number that is out of its range.
    #[error("{name} is {value}; it must be {range}")]
    Parameter { name: &'static str, value: String, range: &'static str },
    /// Random patterns kept a rank below the largest possible one.
    #[error(
        "{tries} random draws of {frames} patterns with {open} of {apertures} sub-apertures open \
         reached rank {reached} at most; rank {wanted} is possible: use another seed or open \
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
    /// Patterns, or a lithography mask, that can't be used.
    #[error("{0}")]
    Pattern(String),
    /// Raw captures that can't be calibrated with.
    #[error("{0}")]
    Captures(String),
    /// Masks and frames that do not belong together.
    #[error("the frames are {frames}, the masks {masks}; both must have the same size")]
    Sizes { frames: String, masks: String },
}

/// The generator of everything random here: the same on every machine.
pub fn generator(seed: u64) -> rand_chacha::ChaCha8Rng {
    rand::SeedableRng::seed_from_u64(seed)
}

/// Refuses an empty stack.
fn check_size(frames: usize, height: usize, width: usize) -> Result<()> {
    for (name, value) in [("compression ratio", frames), ("height", height), ("width", width)] {
        if value == 0 {
            let range = "at least 1";
            return Err(OpticsError::Parameter { name, value: value.to_string(), range });
        }
    }
    Ok(())
}
