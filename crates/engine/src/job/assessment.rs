//! The predicted quality of frames without ground truth.

use serde::{Deserialize, Serialize};

use super::report::{Finding, Grade};

/// The predicted quality of the frames of a snapshot or a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Assessment {
    pub grade: Grade,
    /// Predicted PSNR in dB relative to the white level of the job's frames, mean over the frames. Values above 40 dB are
    /// reported as 40 dB. `None`, like the interval, while a finding questions scale, dark or masks.
    pub psnr_db: Option<f64>,
    /// Lower end of the interval that contains the true PSNR in four of five cases, in dB.
    pub psnr_low_db: Option<f64>,
    /// Upper end of that interval, in dB.
    pub psnr_high_db: Option<f64>,
    /// Order of the masks, as far as the motion of the scene shows it; `None` without a test.
    #[serde(default)]
    pub order: Option<MaskOrder>,
    /// Findings that limit the quality or the reliability of the prediction.
    pub reasons: Vec<Finding>,
}

/// Evidence for the order of a snapshot's masks from its frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[derive(Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MaskOrder {
    /// The frames follow one another more steadily than with any two masks exchanged. The reversed order looks the same.
    Consistent,
    /// The scene does not show the order.
    NotVerifiable,
    /// With two masks exchanged the frames would follow one another much more steadily.
    Doubtful,
}

impl Assessment {
    /// Largest reported PSNR in dB. Differences above it are not visible.
    pub const MAX_PSNR_DB: f64 = 40.0;
    /// Expected PSNR in dB from which frames are graded good.
    pub const GOOD_DB: f64 = 28.0;
    /// Frames are graded bad if the upper end of the interval is below this PSNR in dB.
    pub const BAD_DB: f64 = 22.0;

    /// The assessment of a job: the means over its snapshots, and the worst grade. `None` if a snapshot has none. A PSNR is
    /// `None` if that of a snapshot is.
    pub fn combined<'a>(snapshots: impl Iterator<Item = Option<&'a Self>>) -> Option<Self> {
        let all = snapshots.collect::<Option<Vec<_>>>().filter(|all| !all.is_empty())?;
        let mean = |value: fn(&Self) -> Option<f64>| {
            let sum = all.iter().map(|one| value(one)).sum::<Option<f64>>();
            sum.map(|sum| Self::round(sum / all.len() as f64))
        };
        let mut reasons: Vec<Finding> = Vec::new();
        for reason in all.iter().flat_map(|one| &one.reasons) {
            if !reasons.iter().any(|present| present.code == reason.code) {
                reasons.push(reason.clone());
            }
        }
        Some(Self {
            grade: all.iter().map(|one| one.grade).max()?,
            psnr_db: mean(|one| one.psnr_db),
            psnr_low_db: mean(|one| one.psnr_low_db),
            psnr_high_db: mean(|one| one.psnr_high_db),
            order: all.iter().filter_map(|one| one.order).max(),
            reasons,
        })
    }

    /// Rounds to tenths of a decibel, the precision of the prediction.
    pub fn round(decibels: f64) -> f64 {
        (decibels * 10.0).round() / 10.0
    }
}
