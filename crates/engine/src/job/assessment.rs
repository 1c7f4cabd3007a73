//! A verdict on frames whose truth nobody knows.

use serde::{Deserialize, Serialize};

use super::report::{Finding, Grade};

/// How good frames are expected to be.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Assessment {
    pub grade: Grade,
    /// The PSNR that is expected, mean over the frames, of the full scale of the measurement; 40 dB for all that is
    /// better, too.
    pub psnr_db: f64,
    /// Four of five true values lie between this
    pub psnr_low_db: f64,
    /// and this.
    pub psnr_high_db: f64,
    /// Why no better, and what makes the figures doubtful.
    pub reasons: Vec<Finding>,
}

impl Assessment {
    /// Of a job: the mean over its snapshots, and the worst grade.
    pub fn of_all<'a>(snapshots: impl Iterator<Item = Option<&'a Self>>) -> Option<Self> {
        let all = snapshots.collect::<Option<Vec<_>>>().filter(|all| !all.is_empty())?;
        let mean = |value: fn(&Self) -> f64| {
            Self::round(all.iter().map(|one| value(one)).sum::<f64>() / all.len() as f64)
        };
        let mut reasons: Vec<Finding> = Vec::new();
        for reason in all.iter().flat_map(|one| &one.reasons) {
            if !reasons.iter().any(|known| known.code == reason.code) {
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

    /// Tenths of a decibel: more is not known.
    pub fn round(decibels: f64) -> f64 {
        (decibels * 10.0).round() / 10.0
    }
}
