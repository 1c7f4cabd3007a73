//! Reads and checks the files of a lab: masks, measurements, ground truth, captures.
//!
//! The service (with uploads) and the commands (with paths) share this code. Stacks are read frame by frame and passed
//! on to a writer, so memory holds a few planes.

mod bad_pixels;
mod captures;
mod check;
mod error;
mod judge;
mod open;
mod read;
mod refusal;
mod report_page;
mod sample;
mod sizes;
mod spectral;

pub use bad_pixels::bad_pixels;
pub use captures::{Calibrated, CaptureFiles, Plan, Progress, Report, calibrate, plan, report};
pub use check::{Exposure, MaskLight, masks, measurement};
pub use error::IntakeError;
pub use judge::{causes_first, combined, judge};
pub use open::{Opened, Source};
pub use read::{
    Scaled, Snapshots, read_clip, read_colours, read_masks, read_snapshots, read_truth,
};
pub use refusal::{Refusal, RefusalCode};
pub use report_page::{html_page, report_page};
pub use sample::{Sample, sample};
pub use sizes::size_remedy;
pub use spectral::expected_size;
