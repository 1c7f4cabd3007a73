//! The predicted quality of frames without ground truth.

use serde::{Deserialize, Serialize};

use super::report::{Finding, Grade};

/// The predicted quality of the frames of a snapshot or a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Assessment {
    pub grade: Grade,
    /// Predicted PSNR in dB relative to the full scale of the measurement, mean over the frames. Values above 40 dB are
    /// reported as 40 dB.
    pub psnr_db: f64,
    /// Lower end of the interval that contains the true PSNR in four of five cases, in dB.
    pub psnr_low_db: f64,
    /// Upper end of that interval, in dB.
    pub psnr_high_db: f64,
    /// Findings that limit the quality or the reliability of the prediction.
    pub reasons: Vec<Finding>,
}

impl Assessment {
    /// The assessment of a job: the means over its snapshots, and the worst grade. `None` if a snapshot has none.
    pub fn combined<'a>(snapshots: impl Iterator<Item = Option<&'a Self>>) -> Option<Self> {
        let all = snapshots.collect::<Option<Vec<_>>>().filter(|all| !all.is_empty())?;
        let mean = |value: fn(&Self) -> f64| {
            Self::round(all.iter().map(|one| value(one)).sum::<f64>() / all.len() as f64)
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
            reasons,
        })
    }

    /// Rounds to tenths of a decibel, the precision of the prediction.
    pub fn round(decibels: f64) -> f64 {
        (decibels * 10.0).round() / 10.0
    }
}
