//! One tile: the unit of work.

use ndarray::{Array2, Array3, ArrayView2};

use crate::recon::ReconError;
use crate::recon::prior::Networks;
use crate::recon::schedule::Schedule;
use crate::recon::sensing::SensingOperator;
use crate::recon::solver::{self, Observer, StopReason};

/// What one tile is made of.
#[derive(Debug, Clone)]
pub struct TileInput {
    /// The masks' window \[B,h,w\] on \[0,1\].
    pub masks: Array3<f32>,
    /// The measurement's window \[h,w\].
    pub measurement: Array2<f32>,
    /// White level of the scene, above 0: the same for all tiles of a job, or seams would show.
    pub white: f32,
}

impl TileInput {
    fn check_white(&self) -> Result<(), ReconError> {
        if self.white.is_finite() && self.white > 0.0 {
            return Ok(());
        }
        Err(ReconError::Parameter {
            name: "white level",
            value: self.white.to_string(),
            range: "a finite number above 0",
        })
    }

    /// The tile with the measurement divided by the white level, so that it is `sum_k C_k x_k` with
    /// frames on \[0,1\]; none if no light reaches it through any mask (a corner outside a round
    /// aperture, say).
    pub fn on_unit_scale(self) -> Result<Option<(SensingOperator, Array2<f32>)>, ReconError> {
        self.check_white()?;
        let op = match SensingOperator::new(self.masks) {
            Err(ReconError::DarkMasks { .. }) => return Ok(None),
            other => other?,
        };
        Ok(Some((op, self.measurement / self.white)))
    }

    /// Has the tile solved on the unit scale, and multiplies the frames by the white level again. A
    /// tile without light has frames of 0 and no iterations.
    pub(super) fn solved(
        self,
        solve: impl FnOnce(SensingOperator, ArrayView2<'_, f32>) -> Result<TileOutcome, ReconError>,
    ) -> Result<TileOutcome, ReconError> {
        let (size, white) = (self.masks.raw_dim(), self.white);
        let Some((op, measurement)) = self.on_unit_scale()? else {
            return Ok(dark(Array3::zeros(size)));
        };
        let mut outcome = solve(op, measurement.view())?;
        outcome.frames *= white;
        Ok(outcome)
    }
}

/// A reconstructed tile and how it came about.
#[derive(Debug, Clone)]
pub struct TileOutcome {
    /// The frames \[B,h,w\] on the measurement's own scale.
    pub frames: Array3<f32>,
    /// Iterations whose prior had a total-variation part.
    pub tv_iterations: usize,
    /// Passes of learned denoisers.
    pub denoiser_passes: usize,
    /// `||y - H v|| / ||y||` of the result.
    pub residual: f32,
    /// Why it ended.
    pub stop_reason: StopReason,
}

/// Reconstructs one tile: runs the schedule on it, brought to \[0,1\] by its white level.
///
/// # Errors
/// As [`solver::reconstruct`]; [`ReconError::Cancelled`] when the observer says so.
pub fn reconstruct_tile(
    input: TileInput,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<TileOutcome, ReconError> {
    input.solved(|op, measurement| {
        let op = op.with_gamma(schedule.gamma)?;
        let outcome = solver::reconstruct(&op, measurement, schedule, networks, observer)?;
        Ok(TileOutcome {
            frames: outcome.frames,
            tv_iterations: outcome.tv_iterations,
            denoiser_passes: outcome.denoiser_passes,
            residual: outcome.residual,
            stop_reason: outcome.stop_reason,
        })
    })
}

/// The outcome of a tile without light.
fn dark(frames: Array3<f32>) -> TileOutcome {
    TileOutcome {
        frames,
        tv_iterations: 0,
        denoiser_passes: 0,
        residual: 0.0,
        stop_reason: StopReason::Converged,
    }
}

/// The white level of a job from those of its snapshots: their median (the lower of the two in
/// the middle). One flash among them then doesn't make all others dark for the denoiser, which
/// a maximum would, and all snapshots of a job share one scale.
///
/// None without snapshots.
pub fn typical_white(mut whites: Vec<f32>) -> Option<f32> {
    whites.sort_by(f32::total_cmp);
    let middle = whites.len().checked_sub(1)? / 2;
    whites.get(middle).copied()
}

#[cfg(test)]
mod tests {
    use super::{TileInput, reconstruct_tile, typical_white};
    use crate::optics::{iid_masks, measure};
    use crate::recon::schedule::Schedule;
    use ndarray::{Array2, Array3};

    fn scene() -> (Array3<f32>, Array3<f32>) {
        let masks = iid_masks(4, 32, 32, 1).unwrap();
        let frames = Array3::from_shape_fn((4, 32, 32), |(k, i, j)| {
            0.5 + 0.3 * ((i + k) as f32 * 0.2).sin() * (j as f32 * 0.1).cos()
        });
        (masks, frames)
    }

    #[test]
    fn frames_come_back_on_the_scale_of_the_measurement() {
        let (masks, truth) = scene();
        let y = measure(masks.view(), truth.view()).unwrap();
        let solve = |y: Array2<f32>, white| {
            let input = TileInput { masks: masks.clone(), measurement: y, white };
            reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap().frames
        };
        let plain = solve(y.clone(), 0.8);
        let error = (&plain - &truth).mapv(|d| d * d).mean().unwrap();
        assert!(error < 2e-3, "{error}");
        // 64 times as bright: powers of two change no bit of a float's fraction.
        let bright = solve(y * 64.0, 0.8 * 64.0);
        assert_eq!(bright, plain * 64.0);
    }

    #[test]
    fn a_tile_without_light_is_black() {
        let input = TileInput {
            masks: Array3::zeros((3, 16, 16)),
            measurement: Array2::from_elem((16, 16), 0.1),
            white: 1.0,
        };
        let outcome = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap();
        assert!(outcome.frames.iter().all(|&v| v == 0.0));
        assert_eq!(outcome.tv_iterations, 0);
    }

    #[test]
    fn white_must_be_above_zero() {
        let (masks, _) = scene();
        for white in [0.0, -1.0, f32::NAN] {
            let input =
                TileInput { masks: masks.clone(), measurement: Array2::ones((32, 32)), white };
            let error = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap_err();
            assert!(error.to_string().contains("white level"), "{error}");
        }
    }

    #[test]
    fn one_flash_does_not_set_the_scale() {
        assert_eq!(typical_white(vec![0.9, 40.0, 1.0]), Some(1.0));
        assert_eq!(typical_white(vec![2.0, 1.0]), Some(1.0));
        assert_eq!(typical_white(vec![]), None);
    }
}
