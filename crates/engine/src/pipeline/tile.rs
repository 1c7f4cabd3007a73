//! One tile: the unit of work.

use std::ops::Range;

use ndarray::{Array3, Array4, ArrayView3, Axis, s};

use reconstruction::ReconError;
use reconstruction::assessment::Model;
use reconstruction::evidence;
use reconstruction::learned::SnapshotNetwork;
use reconstruction::operator::SensingOperator;
use reconstruction::priors::Networks;
use reconstruction::schedule::Schedule;
use reconstruction::solver::{self, Observer, Outcome, StopReason};

/// What a tile is made of: arrays alone, wherever they come from.
#[derive(Debug, Clone)]
pub struct TileInput {
    /// The masks' window \[B,h,w\] on \[0,1\].
    pub masks: Array3<f32>,
    /// The measurement's window \[S,h,w\] of a run of snapshots.
    pub y: Array3<f32>,
    /// White level of the scene, above 0: the same for all tiles of a job, or seams would show.
    pub white: f32,
    /// Which snapshots of the run are solved together, by their place in it. The frames of those that are in
    /// no piece are 0.
    pub pieces: Vec<Range<usize>>,
}

impl TileInput {
    /// The tile with the measurement divided by the white level, so that it is `sum_k C_k x_k` with
    /// frames on \[0,1\], and the operator of one snapshot; none if no light reaches it through any mask (a
    /// corner outside a round aperture, say).
    pub(super) fn on_unit_scale(
        self,
    ) -> Result<Option<(SensingOperator, Array3<f32>)>, ReconError> {
        if !(self.white.is_finite() && self.white > 0.0) {
            return Err(ReconError::Parameter {
                name: "white level".into(),
                value: self.white.to_string(),
                range: "a finite number above 0".into(),
            });
        }
        let snapshots = self.y.dim().0;
        let within = |piece: &Range<usize>| !piece.is_empty() && piece.end <= snapshots;
        if !self.pieces.iter().all(within) {
            return Err(ReconError::Shape {
                what: "a tile",
                found: format!("{snapshots} snapshots, to be solved as {:?}", self.pieces),
                expected: "pieces of these snapshots".into(),
            });
        }
        let op = match SensingOperator::new(self.masks) {
            Err(ReconError::DarkMasks { .. }) => return Ok(None),
            other => other?,
        };
        Ok(Some((op, self.y / self.white)))
    }

    /// Has the pieces of the tile solved on the unit scale, one after the other, and multiplies the frames
    /// by the white level again. `solve` is told which share of all the work a piece is. A tile without
    /// light has frames of 0 and no iterations.
    fn solved<F>(self, mut solve: F) -> Result<Outcome, ReconError>
    where
        F: FnMut(&SensingOperator, ArrayView3<'_, f32>, Range<f64>) -> Result<Outcome, ReconError>,
    {
        let ((frames, height, width), white) = (self.masks.dim(), self.white);
        let pieces = self.pieces.clone();
        let mut whole = Outcome {
            frames: Array3::zeros((self.y.dim().0 * frames, height, width)),
            iterations: 0,
            tv_iterations: 0,
            denoiser_passes: 0,
            residual: 0.0,
            stop_reason: StopReason::Converged,
            features: None,
            evidence: None,
        };
        let Some((mut op, y)) = self.on_unit_scale()? else { return Ok(whole) };
        let all: usize = pieces.iter().map(Range::len).sum();
        let share = |snapshots: usize| snapshots as f64 / all as f64;
        let mut done = 0;
        for piece in pieces {
            op = op.over(piece.len())?;
            let part = share(done)..share(done + piece.len());
            done += piece.len();
            let outcome = solve(&op, y.slice(s![piece.clone(), .., ..]), part)?;
            if piece.len() == y.dim().0 {
                whole = outcome;
                continue;
            }
            let place = s![piece.start * frames..piece.end * frames, .., ..];
            whole.frames.slice_mut(place).assign(&outcome.frames);
            if let Some(seen) = outcome.features {
                let (features, _, rows, columns) = seen.dim();
                let none = || Array4::zeros((features, whole.frames.dim().0, rows, columns));
                let place = s![.., piece.start * frames..piece.end * frames, .., ..];
                whole.features.get_or_insert_with(none).slice_mut(place).assign(&seen);
            }
            whole.iterations = whole.iterations.max(outcome.iterations);
            whole.tv_iterations = whole.tv_iterations.max(outcome.tv_iterations);
            whole.denoiser_passes = whole.denoiser_passes.max(outcome.denoiser_passes);
            whole.residual = whole.residual.max(outcome.residual);
            if outcome.stop_reason == StopReason::MaxIterations {
                whole.stop_reason = StopReason::MaxIterations;
            }
        }
        whole.frames *= white;
        Ok(whole)
    }
}

/// Iterations of total variation after which its error hardly changes. More would hold up those who cancel the job.
const MOST_FOR_EVIDENCE: usize = 200;

/// Reconstructs one tile by the iterations of a schedule. The frames \[S B,h,w\] are on the scale of
/// the measurement.
/// Errors: as [`solver::reconstruct`]; [`ReconError::Cancelled`] when the observer says so.
pub fn reconstruct_tile(
    input: TileInput,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome, ReconError> {
    let assessed = Model::of(schedule).is_some();
    // Of more than total variation the pilot tells.
    let quick = schedule.stages.len() == 1;
    let mut evidence = None;
    let mut outcome = input.solved(|op, y, part| {
        observer.part(part);
        if !assessed {
            return solver::reconstruct(op, y, schedule, networks, observer);
        }
        if quick && evidence.is_none() {
            let bounded = match schedule.planned_iterations() {
                ..=MOST_FOR_EVIDENCE => schedule.clone(),
                _ => schedule.clone().with_iterations(MOST_FOR_EVIDENCE),
            };
            evidence = evidence::collect(op, y, &bounded, networks)?;
        }
        solver::reconstruct_assessed(op, y, schedule, networks, observer)
    })?;
    outcome.evidence = evidence;
    Ok(outcome)
}

/// Reconstructs one tile by an end-to-end network, snapshot by snapshot.
pub fn run_network(
    input: TileInput,
    network: &mut dyn SnapshotNetwork,
) -> Result<Outcome, ReconError> {
    let pieces = (0..input.y.dim().0).map(|snapshot| snapshot..snapshot + 1).collect();
    TileInput { pieces, ..input }.solved(|op, y, _| {
        let frames = network.frames(y.index_axis(Axis(0), 0), op.masks())?;
        let rest = &y - &op.forward(frames.view())?;
        let norm = squares(y).max(f64::MIN_POSITIVE);
        Ok(Outcome {
            features: None,
            evidence: None,
            frames,
            iterations: 0,
            tv_iterations: 0,
            denoiser_passes: 1,
            residual: (squares(rest.view()) / norm).sqrt() as f32,
            stop_reason: StopReason::MaxIterations,
        })
    })
}

fn squares(values: ArrayView3<'_, f32>) -> f64 {
    values.iter().map(|&value| f64::from(value) * f64::from(value)).sum()
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)] // lists of ranges, some of one
mod tests {
    use super::{TileInput, reconstruct_tile, run_network};
    use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, concatenate, s};
    use optics::{iid_masks, measure};
    use reconstruction::ReconError;
    use reconstruction::learned::SnapshotNetwork;
    use reconstruction::schedule::Schedule;

    /// One snapshot.
    fn input(masks: Array3<f32>, y: Array2<f32>, white: f32) -> TileInput {
        TileInput { masks, y: y.insert_axis(Axis(0)), white, pieces: vec![0..1] }
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
    fn a_run_is_solved_in_its_pieces() {
        let (masks, frames) = scene();
        let y = measure(masks.view(), frames.view()).unwrap().insert_axis(Axis(0));
        let y = concatenate(Axis(0), &[y.view(), (0.5 * &y).view(), (0.8 * &y).view()]).unwrap();
        let solve = |y: Array3<f32>, pieces| {
            let input = TileInput { masks: masks.clone(), y, white: 0.9, pieces };
            reconstruct_tile(input, &Schedule::gap_tv3d(), &mut (), &mut ()).unwrap().frames
        };
        let part = |snapshots: std::ops::Range<usize>| {
            let alone = y.slice(s![snapshots, .., ..]).to_owned();
            let whole = 0..alone.dim().0;
            solve(alone, vec![whole])
        };
        let taken_apart = solve(y.clone(), vec![0..2, 2..3]);
        assert_eq!(taken_apart, concatenate![Axis(0), part(0..2), part(2..3)]);
        let left_out = solve(y.clone(), vec![1..3]);
        assert!(left_out.slice(s![..4, .., ..]).iter().all(|&value| value == 0.0));
        assert_eq!(left_out.slice(s![4.., .., ..]), part(1..3));
    }

    #[test]
    fn pieces_of_other_snapshots_are_refused() {
        let (masks, _) = scene();
        for pieces in [vec![0..2], vec![1..1]] {
            let y = Array3::ones((1, 32, 32));
            let input = TileInput { masks: masks.clone(), y, white: 1.0, pieces };
            let error = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap_err();
            assert!(error.to_string().contains("pieces of these snapshots"), "{error}");
        }
    }
}
