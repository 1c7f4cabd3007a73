//! Reconstruction of one tile, the unit of work.

use std::ops::Range;

use ndarray::{Array3, ArrayView3, Axis, s};

use super::residual::residual;
use reconstruction::ReconError;
use reconstruction::assessment::{Features, coverage};
use reconstruction::error::{check_parameter, check_shape};
use reconstruction::evidence;
use reconstruction::learned::SnapshotNetwork;
use reconstruction::operator::SensingOperator;
use reconstruction::priors::Networks;
use reconstruction::quality::Model;
use reconstruction::schedule::Schedule;
use reconstruction::solver::{self, Observer, Outcome, StopReason};
use reconstruction::unmeasured::filled;

/// The input of a tile.
#[derive(Debug, Clone)]
pub struct TileInput {
    /// Window of the masks \[B,h,w\] on \[0,1\]; NaN were not measured, and neither were the snapshots there.
    pub masks: Array3<f32>,
    /// Window of a run of snapshots \[S,h,w\]; NaN were not measured.
    pub y: Array3<f32>,
    /// White level of the scene, above 0. It is the same for all tiles of a job, so that no seams appear.
    pub white: f32,
    /// Ranges of snapshots that are solved together, relative to the run. Frames of snapshots outside all pieces are 0.
    pub pieces: Vec<Range<usize>>,
}

impl TileInput {
    /// Returns the operator of one snapshot, and the measurement divided by the white level: `sum_k C_k x_k` with
    /// frames x on \[0,1\]. `None` if no mask lets light through, for example in a corner outside a round aperture.
    ///
    /// Errors: [`ReconError::Parameter`] for an invalid white level, [`ReconError::Shape`] for pieces outside the run.
    pub(super) fn on_unit_scale(
        self,
    ) -> Result<Option<(SensingOperator, Array3<f32>)>, ReconError> {
        let is_level = self.white.is_finite() && self.white > 0.0;
        check_parameter(is_level, "white level", self.white, "a finite number above 0")?;
        let snapshots = self.y.dim().0;
        let within = |piece: &Range<usize>| !piece.is_empty() && piece.end <= snapshots;
        let found = format!("{snapshots} snapshots with the pieces {:?}", self.pieces);
        let expected = "non-empty pieces of these snapshots";
        check_shape(self.pieces.iter().all(within), "a tile", found, expected)?;
        let masks = self.masks.mapv_into(|mask| if mask.is_nan() { 0.0 } else { mask });
        let op = match SensingOperator::new(masks) {
            Err(ReconError::DarkMasks { .. }) => return Ok(None),
            other => other?,
        };
        Ok(Some((op, self.y / self.white)))
    }

    /// Makes every snapshot a piece.
    #[must_use]
    pub fn snapshot_by_snapshot(self) -> Self {
        let pieces = (0..self.y.dim().0).map(|snapshot| snapshot..snapshot + 1).collect();
        Self { pieces, ..self }
    }

    /// Solves the pieces of the tile one after another on the unit scale, and scales the frames back by the white
    /// level. `solve` gets the range of each piece on \[0,1\], as a share of all the work. A tile without light has
    /// frames of 0 and no iterations.
    fn solve_pieces<F>(self, mut solve: F) -> Result<Outcome, ReconError>
    where
        F: FnMut(&SensingOperator, ArrayView3<'_, f32>, Range<f64>) -> Result<Outcome, ReconError>,
    {
        let ((frames, height, width), white) = (self.masks.dim(), self.white);
        let (pieces, measured) = (self.pieces.clone(), self.y.clone());
        let mut combined = Outcome {
            frames: Array3::zeros((self.y.dim().0 * frames, height, width)),
            iterations: 0,
            tv_iterations: 0,
            denoiser_passes: 0,
            residual: 0.0,
            stop_reason: StopReason::Converged,
            features: Vec::new(),
            evidence: None,
            coverage: None,
        };
        let Some((mut op, y)) = self.on_unit_scale()? else { return Ok(combined) };
        let total: usize = pieces.iter().map(Range::len).sum();
        let share = |snapshots: usize| snapshots as f64 / total as f64;
        let mut done = 0;
        for piece in pieces.iter().cloned() {
            op = op.over(piece.len())?;
            let work = share(done)..share(done + piece.len());
            done += piece.len();
            let outcome = solve(&op, y.slice(s![piece.clone(), .., ..]), work)?;
            if piece.len() == y.dim().0 {
                combined = outcome;
                continue;
            }
            let range = s![piece.start * frames..piece.end * frames, .., ..];
            combined.frames.slice_mut(range).assign(&outcome.frames);
            let first_frame = piece.start * frames;
            let features = outcome.features.into_iter();
            combined.features.extend(features.map(|part| Features { first_frame, ..part }));
            combined.iterations = combined.iterations.max(outcome.iterations);
            combined.tv_iterations = combined.tv_iterations.max(outcome.tv_iterations);
            combined.denoiser_passes = combined.denoiser_passes.max(outcome.denoiser_passes);
            if outcome.stop_reason == StopReason::MaxIterations {
                combined.stop_reason = StopReason::MaxIterations;
            }
        }
        combined.frames *= white;
        let frame = |k| Ok::<_, ReconError>(combined.frames.index_axis(Axis(0), k).to_owned());
        combined.residual = residual(op.masks(), measured.view(), &pieces, frame)?;
        Ok(combined)
    }
}

/// Iterations of total variation after which the error hardly changes. The evidence stops there, because it does not
/// react to a cancellation.
const MAX_EVIDENCE_ITERATIONS: usize = 200;

/// Reconstructs one tile with a schedule. The frames \[S B,h,w\] are on the scale of the measurement.
///
/// Errors: those of [`solver::reconstruct`]; [`ReconError::Cancelled`] if the observer cancels.
pub fn reconstruct_tile(
    input: TileInput,
    schedule: &Schedule,
    networks: &mut dyn Networks,
    observer: &mut dyn Observer,
) -> Result<Outcome, ReconError> {
    let assessed = Model::of(schedule).is_some();
    let largest = input.masks.fold_axis(Axis(0), 0.0, |largest: &f32, mask| largest.max(*mask));
    let coverage = assessed.then(|| coverage(input.y.view(), largest.view()));
    // For longer schedules the pilot provides the evidence.
    let is_tv_only = schedule.stages.len() == 1;
    let mut evidence = None;
    let mut outcome = input.solve_pieces(|op, y, work| {
        observer.part(work);
        if !assessed {
            return solver::reconstruct(op, y, schedule, networks, observer);
        }
        if is_tv_only && evidence.is_none() {
            let bounded = match schedule.planned_iterations() {
                ..=MAX_EVIDENCE_ITERATIONS => schedule.clone(),
                _ => schedule.clone().with_iterations(MAX_EVIDENCE_ITERATIONS),
            };
            evidence = evidence::collect(op, y, &bounded, networks)?;
        }
        solver::reconstruct_assessed(op, y, schedule, networks, observer)
    })?;
    outcome.evidence = evidence;
    outcome.coverage = coverage;
    Ok(outcome)
}

/// Reconstructs one tile with an end-to-end network, snapshot by snapshot.
///
/// Errors: those of the network and of [`SensingOperator`].
pub fn run_network(
    input: TileInput,
    network: &mut dyn SnapshotNetwork,
) -> Result<Outcome, ReconError> {
    input.snapshot_by_snapshot().solve_pieces(|op, y, _| {
        Ok(Outcome {
            features: Vec::new(),
            evidence: None,
            coverage: None,
            // Networks know no missing pixels.
            frames: network.frames(filled(y.index_axis(Axis(0), 0)).view(), op.masks())?,
            iterations: 0,
            tv_iterations: 0,
            denoiser_passes: 1,
            // `solve_pieces` computes the residual of the whole tile.
            residual: 0.0,
            stop_reason: StopReason::MaxIterations,
        })
    })
}

#[cfg(test)]
#[allow(clippy::single_range_in_vec_init)] // some lists have one range
mod tests {
    use super::{TileInput, reconstruct_tile, run_network};
    use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, concatenate, s};
    use optics::{iid_masks, measure};
    use reconstruction::ReconError;
    use reconstruction::learned::SnapshotNetwork;
    use reconstruction::schedule::Schedule;

    /// The input of a tile with one snapshot.
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

    /// Areas of unknown masks were not measured, those of closed masks have no light, however the snapshots are divided.
    #[test]
    fn blocks_have_the_coverage_of_their_masks_and_pixels() {
        use reconstruction::assessment::Coverage::{Closed, Measured, Unmeasured};
        let mut masks = iid_masks(4, 32, 48, 3).unwrap();
        let y = measure(masks.view(), Array3::from_elem((4, 32, 48), 0.5).view()).unwrap();
        masks.slice_mut(s![.., ..16, ..16]).fill(f32::NAN);
        masks.slice_mut(s![.., ..16, 16..32]).fill(0.0);
        let mut y = ndarray::stack![Axis(0), y, y];
        y.slice_mut(s![.., ..16, ..16]).fill(f32::NAN);
        y.slice_mut(s![.., ..16, 16..32]).fill(0.0);
        y.slice_mut(s![.., 16.., 32..]).fill(f32::NAN);
        // The intake marks pixels whose masks leak a little.
        masks.slice_mut(s![.., 16.., ..16]).fill(0.01);
        y.slice_mut(s![.., 16.., ..16]).fill(f32::NAN);
        for pieces in [vec![0..2], vec![0..1, 1..2]] {
            let input = TileInput { masks: masks.clone(), y: y.clone(), white: 1.0, pieces };
            let schedule = Schedule::gap_tv().with_iterations(3);
            let outcome = reconstruct_tile(input, &schedule, &mut (), &mut ()).unwrap();
            let expected = [Unmeasured, Closed, Measured, Closed, Measured, Unmeasured].repeat(2);
            assert_eq!(outcome.coverage.unwrap().into_iter().collect::<Vec<_>>(), expected);
        }
    }

    #[test]
    fn frames_are_on_the_scale_of_the_measurement() {
        let (masks, truth) = scene();
        let y = measure(masks.view(), truth.view()).unwrap();
        let solve = |y: Array2<f32>, white| {
            let input = input(masks.clone(), y, white);
            reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap().frames
        };
        let plain = solve(y.clone(), 0.8);
        let error = (&plain - &truth).mapv(|d| d * d).mean().unwrap();
        assert!(error < 2e-3, "{error}");
        // Scaling by a power of two is exact.
        let bright = solve(y * 64.0, 0.8 * 64.0);
        assert_eq!(bright, plain * 64.0);
    }

    #[test]
    fn tiles_without_light_are_black() {
        let input = input(Array3::zeros((3, 16, 16)), Array2::from_elem((16, 16), 0.1), 1.0);
        let outcome = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap();
        assert!(outcome.frames.iter().all(|&v| v == 0.0));
        assert_eq!(outcome.tv_iterations, 0);
    }

    #[test]
    fn the_white_level_must_be_positive() {
        let (masks, _) = scene();
        for white in [0.0, -1.0, f32::NAN] {
            let input = input(masks.clone(), Array2::ones((32, 32)), white);
            let error = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap_err();
            assert!(error.to_string().contains("white level"), "{error}");
        }
    }

    /// A network that returns known frames after a check of its input.
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
    fn networks_work_on_the_unit_scale() {
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
    fn pieces_of_a_run_are_solved_independently() {
        let (masks, frames) = scene();
        let y = measure(masks.view(), frames.view()).unwrap().insert_axis(Axis(0));
        let y = concatenate(Axis(0), &[y.view(), (0.5 * &y).view(), (0.8 * &y).view()]).unwrap();
        let solve = |y: Array3<f32>, pieces| {
            let input = TileInput { masks: masks.clone(), y, white: 0.9, pieces };
            reconstruct_tile(input, &Schedule::gap_tv3d(), &mut (), &mut ()).unwrap()
        };
        let solved_alone = |snapshots: std::ops::Range<usize>| {
            let alone = y.slice(s![snapshots, .., ..]).to_owned();
            let whole = 0..alone.dim().0;
            solve(alone, vec![whole])
        };
        let (first, second) = (solved_alone(0..2), solved_alone(2..3));
        let two_pieces = solve(y.clone(), vec![0..2, 2..3]);
        assert_eq!(two_pieces.frames, concatenate![Axis(0), first.frames, second.frames]);
        let [one, other] = &two_pieces.features[..] else { panic!("a piece has features") };
        assert_eq!((one.first_frame, other.first_frame), (0, 8));
        assert_eq!(
            (&one.blocks, &other.blocks),
            (&first.features[0].blocks, &second.features[0].blocks)
        );
        let last_piece = solve(y.clone(), vec![1..3]).frames;
        assert!(last_piece.slice(s![..4, .., ..]).iter().all(|&value| value == 0.0));
        assert_eq!(last_piece.slice(s![4.., .., ..]), solved_alone(1..3).frames);
    }

    #[test]
    fn pieces_outside_the_run_are_refused() {
        let (masks, _) = scene();
        for pieces in [vec![0..2], vec![1..1]] {
            let y = Array3::ones((1, 32, 32));
            let input = TileInput { masks: masks.clone(), y, white: 1.0, pieces };
            let error = reconstruct_tile(input, &Schedule::gap_tv(), &mut (), &mut ()).unwrap_err();
            assert!(error.to_string().contains("pieces of these snapshots"), "{error}");
        }
    }
}
