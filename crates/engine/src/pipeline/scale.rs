//! The white level that all tiles of a job share.

use ndarray::{ArrayView3, Axis};

use super::arrays::Arrays;
use super::error::{PipelineError, Result};
use super::progress::Monitor;
use crate::job::SnapshotRange;
use reconstruction::ReconError;
use reconstruction::scale::ScaleEstimator;

/// The typical white level of snapshots in memory: masks \[B,H,W\] and snapshots \[S,H,W\].
pub fn white(masks: ArrayView3<'_, f32>, y: ArrayView3<'_, f32>) -> Result<f32, ReconError> {
    let estimator = ScaleEstimator::new(masks.sum_axis(Axis(0)));
    let whites = y.outer_iter().map(|snapshot| estimator.white(snapshot));
    let none = || ReconError::Shape {
        what: "the measurement",
        found: "no snapshots".into(),
        expected: "at least one".into(),
    };
    typical_white(whites.collect::<Result<_, _>>()?).ok_or_else(none)
}

/// The typical white level of the snapshots of a job; memory holds a few planes, whatever the number
/// of frames.
pub fn white_of_job(arrays: &Arrays, snapshots: SnapshotRange, monitor: &Monitor) -> Result<f32> {
    let estimator = ScaleEstimator::new(arrays.light(monitor)?);
    let mut whites = Vec::with_capacity(snapshots.count as usize);
    for snapshot in snapshots.indices() {
        monitor.check()?;
        let white = estimator.white(arrays.snapshot(snapshot)?.view());
        whites.push(white.map_err(|source| PipelineError::Snapshot { snapshot, source })?);
    }
    let none = || PipelineError::Record { what: "job", problem: "it names no snapshots".into() };
    typical_white(whites).ok_or_else(none)
}

/// The white level of a job from those of its snapshots: their median (the lower of the two in
/// the middle). One flash among them then doesn't make all others dark for the denoiser, which
/// a maximum would, and all snapshots of a job share one scale.
///
/// None without snapshots.
fn typical_white(mut whites: Vec<f32>) -> Option<f32> {
    whites.sort_by(f32::total_cmp);
    let middle = whites.len().checked_sub(1)? / 2;
    whites.get(middle).copied()
}

#[cfg(test)]
mod tests {
    use super::typical_white;

    #[test]
    fn one_flash_does_not_set_the_scale() {
        assert_eq!(typical_white(vec![0.9, 40.0, 1.0]), Some(1.0));
        assert_eq!(typical_white(vec![2.0, 1.0]), Some(1.0));
        assert_eq!(typical_white(vec![]), None);
    }
}
