//! One tile: the unit of work.

use ndarray::{Array2, Array3, ArrayView2, Axis};

use crate::recon::ReconError;
use crate::recon::learned::SnapshotNetwork;
use crate::recon::prior::Networks;
use crate::recon::schedule::Schedule;
use crate::recon::sensing::SensingOperator;
use crate::recon::solver::{self, Observer, Outcome, StopReason};

/// What a tile is made of: arrays alone, wherever they come from.
#[derive(Debug, Clone)]
pub struct TileInput {
    /// The masks' window \[B,h,w\] on \[0,1\].
    pub masks: Array3<f32>,
    /// The measurement's window \[S,h,w\]; one snapshot is solved at a time, so S is 1.
    pub y: Array3<f32>,
    /// The colour plane of the sensor that both were cut from; grey pictures have plane 0 alone.
    pub plane: usize,
    /// White level of the scene, above 0: the same for all tiles of a job, or seams would show.
    pub white: f32,
}

impl TileInput {
    /// The tile with the measurement divided by the white level, so that it is `sum_k C_k x_k` with
    /// frames on \[0,1\]; none if no light reaches it through any mask (a corner outside a round
    /// aperture, say).
    pub(super) fn on_unit_scale(
        self,
    ) -> Result<Option<(SensingOperator, Array2<f32>)>, ReconError> {
        if !(self.white.is_finite() && self.white > 0.0) {
            return Err(ReconError::Parameter {
                name: "white level",
                value: self.white.to_string(),
                range: "a finite number above 0",
            });
        }
        if (self.y.dim().0, self.plane) != (1, 0) {
            return Err(ReconError::Shape {
                what: "a tile",
                found: format!("{} snapshots of colour plane {}", self.y.dim().0, self.plane),
                expected: "one snapshot of plane 0".into(),
            });
        }
        let op = match SensingOperator::new(self.masks) {
            Err(ReconError::DarkMasks { .. }) => return Ok(None),
            other => other?,
        };
        Ok(Some((op, self.y.index_axis_move(Axis(0), 0) / self.white)))
    }

    /// Has the tile solved on the unit scale, and multiplies the frames by the white level again. A
    /// tile without light has frames of 0 and no iterations.
    fn solved(
        self,
        solve: impl FnOnce(SensingOperator, ArrayView2<'_, f32>) -> Result<Outcome, ReconError>,
    ) -> Result<Outcome, ReconError> {
        let (size, white) = (self.masks.raw_dim(), self.white);
        let Some((op, y)) = self.on_unit_scale()? else {
            return Ok(Outcome {
                frames: Array3::zeros(size),
                tv_iterations: 0,
                denoiser_passes: 0,
                residual: 0.0,
                stop_reason: StopReason::Converged,
            });
        };
        let mut outcome = solve(op, y.view())?;
        outcome.frames *= white;
        Ok(outcome)
    }
}

/// Reconstructs one tile by the iterations of a schedule. The frames \[B,h,w\] are on the scale of
/// the measurement.
/// Errors: as [`solver::reconstruct`]; [`ReconError::Cancelled`] when the observer says so.
pub fn reconstruct_tile(
    input: TileInput,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome, ReconError> {
    input.solved(|op, y| {
        let op = op.with_gamma(schedule.gamma)?;
        solver::reconstruct(&op, y, schedule, networks, observer)
    })
}

/// Reconstructs one tile in one run of an end-to-end network.
pub fn run_network(
    input: TileInput,
    network: &mut dyn SnapshotNetwork,
) -> Result<Outcome, ReconError> {
    input.solved(|op, y| {
        let frames = network.frames(y, op.masks())?;
        let rest = &y - &op.forward(frames.view())?;
        let norm = squares(y).max(f64::MIN_POSITIVE);
        Ok(Outcome {
            frames,
            tv_iterations: 0,
            denoiser_passes: 1,
            residual: (squares(rest.view()) / norm).sqrt() as f32,
            stop_reason: StopReason::MaxIterations,
        })
    })
}

fn squares(values: ArrayView2<'_, f32>) -> f64 {
    values.iter().map(|&value| f64::from(value) * f64::from(value)).sum()
}

#[cfg(test)]
mod tests {
    use super::{TileInput, reconstruct_tile, run_network};
    use crate::optics::{iid_masks, measure};
    use crate::recon::ReconError;
    use crate::recon::learned::SnapshotNetwork;
    use crate::recon::schedule::Schedule;
    use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis};

    /// One snapshot of plane 0.
    fn input(masks: Array3<f32>, y: Array2<f32>, white: f32) -> TileInput {
        TileInput { masks, y: y.insert_axis(Axis(0)), plane: 0, white }
    }

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
            let input = input(masks.clone(), y, white);
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
        let input = input(Array3::zeros((3, 16, 16)), Array2::from_elem((16, 16), 0.1), 1.0);
        let outcome = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap();
        assert!(outcome.frames.iter().all(|&v| v == 0.0));
        assert_eq!(outcome.tv_iterations, 0);
    }

    #[test]
    fn white_must_be_above_zero() {
        let (masks, _) = scene();
        for white in [0.0, -1.0, f32::NAN] {
            let input = input(masks.clone(), Array2::ones((32, 32)), white);
            let error = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap_err();
            assert!(error.to_string().contains("white level"), "{error}");
        }
    }

    /// Knows the frames already, and what it should be given for them.
    struct Oracle(Array3<f32>);

    impl SnapshotNetwork for Oracle {
        fn frames(
            &mut self,
            y: ArrayView2<'_, f32>,
            masks: ArrayView3<'_, f32>,
        ) -> Result<Array3<f32>, ReconError> {
            let expected = measure(masks, self.0.view()).unwrap();
            assert!(y.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5));
            Ok(self.0.clone())
        }
    }

    #[test]
    fn the_network_sees_a_scene_on_0_to_1_and_its_scale_is_undone() {
        let masks = iid_masks(3, 20, 24, 1).unwrap();
        let frames = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| (k + i + j) as f32 / 45.0);
        let measurement = measure(masks.view(), frames.view()).unwrap() * 4.0;
        let input = input(masks, measurement, 4.0);
        let outcome = run_network(input, &mut Oracle(frames.clone())).unwrap();
        assert_eq!(outcome.frames, frames * 4.0);
        assert_eq!(outcome.denoiser_passes, 1);
        assert!(outcome.residual < 1e-5);
    }

    #[test]
    fn sequences_and_colours_are_refused_until_they_can_be_solved() {
        let (masks, _) = scene();
        for (snapshots, plane) in [(2, 0), (1, 1)] {
            let y = Array3::ones((snapshots, 32, 32));
            let input = TileInput { masks: masks.clone(), y, plane, white: 1.0 };
            let error = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap_err();
            assert!(error.to_string().contains("one snapshot of plane 0"), "{error}");
        }
    }
}
