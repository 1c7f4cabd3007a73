//! Estimation of the white level that all tiles of a job share.

use ndarray::{ArrayView3, Axis};

use super::arrays::Arrays;
use super::error::{PipelineError, Result};
use super::progress::Monitor;
use crate::job::SnapshotRange;
use reconstruction::ReconError;
use reconstruction::scale::ScaleEstimator;

/// The white level of snapshots \[S,H,W\] behind masks \[B,H,W\], both in memory.
///
/// Errors: those of [`ScaleEstimator::white`]; [`ReconError::Shape`] without snapshots.
pub fn white(masks: ArrayView3<'_, f32>, y: ArrayView3<'_, f32>) -> Result<f32, ReconError> {
    let estimator = ScaleEstimator::new(masks.sum_axis(Axis(0)));
    let whites = y.outer_iter().map(|snapshot| estimator.white(snapshot));
    let no_snapshots = || ReconError::Shape {
        what: "the measurement",
        found: "no snapshots".into(),
        expected: "at least one".into(),
    };
    median_white(whites.collect::<Result<_, _>>()?).ok_or_else(no_snapshots)
}

/// The white level of the stored snapshots of a job. It reads one plane at a time.
///
/// Errors: those of reading and of [`ScaleEstimator::white`]; a stop by the monitor.
pub fn job_white_level(
    arrays: &Arrays,
    snapshots: SnapshotRange,
    monitor: &Monitor,
) -> Result<f32> {
    let estimator = ScaleEstimator::new(arrays.light(monitor)?);
    let mut whites = Vec::with_capacity(snapshots.count as usize);
    for snapshot in snapshots.indices() {
        monitor.check()?;
        let white = estimator.white(arrays.snapshot(snapshot)?.view());
        whites.push(white.map_err(|source| PipelineError::Snapshot { snapshot, source })?);
    }
    let no_snapshots =
        || PipelineError::Record { what: "job", problem: "it has no snapshots".into() };
    median_white(whites).ok_or_else(no_snapshots)
}

/// The median (the lower one of two) of the snapshots' white levels; `None` without snapshots. Unlike the maximum, the
/// median is not set by a single flash, which would make all other snapshots dark for the denoiser.
fn median_white(mut whites: Vec<f32>) -> Option<f32> {
    whites.sort_by(f32::total_cmp);
    let middle = whites.len().checked_sub(1)? / 2;
    whites.get(middle).copied()
}

#[cfg(test)]
mod tests {
    use super::median_white;

    #[test]
    fn single_flashes_do_not_set_the_scale() {
        assert_eq!(median_white(vec![0.9, 40.0, 1.0]), Some(1.0));
        assert_eq!(median_white(vec![2.0, 1.0]), Some(1.0));
        assert_eq!(median_white(vec![]), None);
    }
}
