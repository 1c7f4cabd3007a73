//! From a lab's files to checked arrays: masks, measurements, true frames, captures.
//!
//! What the service does with uploads and the commands with paths is the same, and stands here.
//! Stacks are read frame by frame and handed on to a writer, so that memory holds a few planes.

mod captures;
mod check;
mod error;
mod open;
mod read;
mod refusal;
mod report_page;
mod sample;

pub use captures::{Calibrated, CaptureFiles, Plan, Progress, Report, calibrate, plan, report};
pub use check::{Exposure, Passed, judge, masks, measurement};
pub use error::IntakeError;
pub use open::{Opened, Source};
pub use read::{Scaled, read_clip, read_colours, read_masks, read_snapshots, read_truth};
pub use refusal::{Refusal, RefusalCode};
pub use report_page::report_page;
pub use sample::{Sample, sample};
