//! Reconstructs snapshots in memory, with their tiles on several threads.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

use ndarray::{Array2, ArrayView3, Axis, s};

use super::assessment::TileAssessment;
use super::blend;
use super::error::{PipelineError, Result};
use super::networks::{ModelFile, NetworkSource, WarmNetworks};
use super::pilot;
use super::progress::ShareDone;
use super::records::{PilotRecord, TileRecord};
use super::tile::{TileInput, reconstruct_tile, run_network};
use optics::Mosaic;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::{Piece, RunShare, SequencePlan};
use reconstruction::solver::{Control, Observer, Outcome, Progress};
use reconstruction::tile::{Tile, TilePlan, Window};

#[derive(Debug, Clone, Copy)]
pub struct SequenceInput<'a> {
    /// Masks \[B,H,W\] on \[0,1\].
    pub masks: ArrayView3<'a, f32>,
    /// Snapshots \[S,H,W\].
    pub measurement: ArrayView3<'a, f32>,
    /// Index of the first snapshot in the measurement.
    pub first: usize,
    pub white: f32,
    pub solver: Solver<'a>,
    /// The cut in space. It has the size of the masks.
    pub plan: &'a TilePlan,
    /// The cut of the snapshots in time.
    pub runs: &'a SequencePlan,
    /// The sensor's colours. With a mosaic, `plan` must be one of a mosaic.
    pub mosaic: Option<Mosaic>,
}

#[derive(Debug, Clone, Copy)]
pub enum Solver<'a> {
    Schedule(&'a Schedule),
    /// Runs an end-to-end network.
    Network(&'a ModelFile),
}

impl SequenceInput<'_> {
    /// A window of snapshots, given by their indices in the measurement.
    fn window(
        &self,
        snapshots: Range<usize>,
        Window { rows, columns, step }: Window,
        pieces: Vec<Range<usize>>,
    ) -> TileInput {
        let snapshots = snapshots.start - self.first..snapshots.end - self.first;
        let step = step.cast_signed();
        let masks = s![.., rows.clone();step, columns.clone();step];
        TileInput {
            masks: self.masks.slice(masks).to_owned(),
            y: self.measurement.slice(s![snapshots, rows;step, columns;step]).to_owned(),
            white: self.white,
            pieces,
        }
    }

    /// Indices of the snapshots in the measurement.
    fn snapshots(&self) -> Range<usize> {
        self.first..self.first + self.measurement.dim().0
    }
}

/// The solved tiles of snapshots.
#[derive(Debug)]
pub struct Solved {
    /// The tiles of each run, in the plan's order.
    pub runs: Vec<Vec<Outcome>>,
    /// The pilot's decisions on an adaptive schedule and on the joints between snapshots.
    pub pilot: Option<PilotRecord>,
}

impl Solved {
    /// Frame `k` \[H,W\] of a snapshot, given by its index in the measurement.
    pub fn frame(&self, input: &SequenceInput<'_>, snapshot: usize, k: usize) -> Array2<f32> {
        let shares = input.runs.shares(snapshot, &self.cuts(), input.masks.dim().0);
        blend::frame(input.plan, &shares, &self.runs, k)
    }

    /// The records of the tiles that contribute to a snapshot, run by run.
    pub fn records(&self, input: &SequenceInput<'_>, snapshot: usize) -> Vec<TileRecord> {
        let shares = input.runs.shares(snapshot, &self.cuts(), input.masks.dim().0);
        shares.iter().flat_map(|share| &self.runs[share.run]).map(TileRecord::from).collect()
    }

    /// The assessments of the tiles of a snapshot, run by run, in the plan's order.
    pub fn assessments(
        &self,
        input: &SequenceInput<'_>,
        snapshot: usize,
        schedule: &Schedule,
    ) -> Vec<(RunShare, Vec<Option<TileAssessment>>)> {
        let shares = input.runs.shares(snapshot, &self.cuts(), input.masks.dim().0);
        let evidence = self.pilot.as_ref().and_then(|pilot| pilot.evidence.as_ref());
        let context = (schedule, evidence, input.white);
        let assess = |share: RunShare| {
            let tiles = self.runs[share.run].iter();
            let assessments = tiles.map(|tile| TileAssessment::of(tile, context)).collect();
            (share, assessments)
        };
        shares.into_iter().map(assess).collect()
    }

    fn cuts(&self) -> Vec<usize> {
        self.pilot.as_ref().map(PilotRecord::cuts).unwrap_or_default()
    }
}

/// Receives the index of a tile (run by run, in the plan's order) and the finished share of its work on \[0,1\]. It is
/// called from all threads.
pub type TileProgress<'a> = &'a (dyn Fn(usize, f64) + Sync);

/// Solves all tiles of all runs on up to `threads` threads, with one denoiser per thread. The pilot first decides an
/// adaptive schedule and the cuts between snapshots. The result does not depend on the number of threads.
/// Errors: the first failure of any tile; the others stop at their next iteration.
pub fn solve(
    input: &SequenceInput<'_>,
    network: &NetworkSource,
    threads: usize,
    progress: TileProgress<'_>,
) -> Result<Solved> {
    let mut pilot = None;
    if let Solver::Schedule(schedule) = input.solver {
        let light = input.masks.sum_axis(Axis(0));
        let first = input.measurement.index_axis(Axis(0), 0);
        let crop = pilot::choose_crop(light.view(), first, input.mosaic);
        let mut networks = WarmNetworks::new(network.clone());
        let window = input.window(input.snapshots(), crop.clone(), Vec::new());
        let task = pilot::Pilot { first: input.first, crop: &crop, schedule, runs: input.runs };
        pilot = pilot::decide(window, &task, &mut networks, &mut ())?;
    }
    let decided = match (&pilot, input.solver) {
        (Some(pilot), Solver::Schedule(schedule)) => Some(pilot.decide(schedule)),
        _ => None,
    };
    let solver = decided.as_ref().map_or(input.solver, Solver::Schedule);
    let cuts = pilot.as_ref().map(PilotRecord::cuts).unwrap_or_default();
    let pieces = input.runs.pieces(&cuts);
    let mut tiles =
        run_tiles(&SequenceInput { solver, ..*input }, &pieces, network, threads, progress)?;
    let mut runs = Vec::with_capacity(input.runs.runs().len());
    while !tiles.is_empty() {
        let rest = tiles.split_off(input.plan.len().min(tiles.len()));
        runs.push(std::mem::replace(&mut tiles, rest));
    }
    Ok(Solved { runs, pilot })
}

/// Solves all tiles, run by run.
fn run_tiles(
    input: &SequenceInput<'_>,
    pieces: &[Piece],
    network: &NetworkSource,
    threads: usize,
    progress: TileProgress<'_>,
) -> Result<Vec<Outcome>> {
    let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
    let claim = || -> Option<(usize, usize, Tile)> {
        let index = next.fetch_add(1, Ordering::Relaxed);
        let run = index / input.plan.len();
        let tile = input.plan.tile(index % input.plan.len())?;
        (run < input.runs.runs().len()).then_some((index, run, tile))
    };
    let tiles = || -> Result<Vec<(usize, Outcome)>> {
        let mut networks = WarmNetworks::new(network.clone());
        let mut done = Vec::new();
        while let Some((index, run, tile)) = claim() {
            let snapshots = input.runs.runs()[run].clone();
            let run_pieces = pieces.iter().filter(|piece| piece.run == run);
            let first = snapshots.start;
            let run_pieces = run_pieces
                .map(|Piece { snapshots, .. }| snapshots.start - first..snapshots.end - first);
            let window = input.window(snapshots, tile.window(), run_pieces.collect());
            let outcome = match input.solver {
                Solver::Schedule(schedule) => {
                    let share = ShareDone::new(schedule.clone());
                    let report = |share| progress(index, share);
                    let mut observer = TileObserver { report, stop: &stop, share };
                    reconstruct_tile(window, schedule, &mut networks, &mut observer)?
                }
                Solver::Network(_) if stop.load(Ordering::Relaxed) => {
                    return Err(PipelineError::Stopped);
                }
                Solver::Network(file) => run_network(window, networks.end_to_end(file)?)?,
            };
            progress(index, 1.0);
            done.push((index, outcome));
        }
        Ok(done)
    };
    let thread = || tiles().inspect_err(|_| stop.store(true, Ordering::Relaxed));
    let outcomes: Vec<_> = thread::scope(|scope| {
        let count = threads.clamp(1, input.plan.len() * input.runs.runs().len());
        let handles: Vec<_> = (0..count).map(|_| scope.spawn(thread)).collect();
        handles.into_iter().map(|h| h.join().unwrap_or(Err(PipelineError::Thread))).collect()
    });
    let (mut done, mut failure) = (Vec::new(), None);
    for outcome in outcomes {
        match outcome {
            Ok(tiles) => done.extend(tiles),
            // Stopped threads return this; the other error is the cause.
            Err(PipelineError::Stopped) if failure.is_some() => {}
            Err(error) => failure = Some(error),
        }
    }
    done.sort_by_key(|(index, _)| *index);
    failure.map_or_else(|| Ok(done.into_iter().map(|(_, outcome)| outcome).collect()), Err)
}

struct TileObserver<'a, F> {
    report: F,
    stop: &'a AtomicBool,
    share: ShareDone,
}

impl<F: Fn(f64)> Observer for TileObserver<'_, F> {
    fn iteration(&mut self, progress: &Progress) -> Control {
        (self.report)(self.share.after(progress));
        if self.stop.load(Ordering::Relaxed) { Control::Cancel } else { Control::Continue }
    }

    fn part(&mut self, share: Range<f64>) {
        self.share.restart(share);
    }
}

#[cfg(test)]
mod tests {
    use super::{SequenceInput, Solver, solve};
    use crate::pipeline::error::PipelineError;
    use crate::pipeline::networks::NetworkSource;
    use ndarray::{Array2, Array3, Axis};
    use optics::{iid_masks, measure};
    use reconstruction::ReconError;
    use reconstruction::priors::onnx::Device;
    use reconstruction::schedule::Schedule;
    use reconstruction::sequence::SequencePlan;
    use reconstruction::tile::TilePlan;

    /// Masks, and the frames of five snapshots.
    fn scene(side: usize) -> (Array3<f32>, Array3<f32>) {
        let masks = iid_masks(4, side, side, 2).unwrap();
        let frames = Array3::from_shape_fn((20, side, side), |(k, i, j)| {
            0.5 + 0.4 * ((i as f32 + 0.5 * k as f32) * 0.13).sin() * (j as f32 * 0.09).cos()
        });
        (masks, frames)
    }

    fn snapshots(masks: &Array3<f32>, frames: &Array3<f32>) -> Array3<f32> {
        let snapshot = |frames| measure(masks.view(), frames).unwrap();
        let all: Vec<_> = frames.axis_chunks_iter(Axis(0), 4).map(snapshot).collect();
        let views: Vec<_> = all.iter().map(|snapshot| snapshot.view()).collect();
        ndarray::stack(Axis(0), &views).unwrap()
    }

    fn input<'a>(
        masks: &'a Array3<f32>,
        y: &'a Array3<f32>,
        schedule: &'a Schedule,
        (plan, runs): (&'a TilePlan, &'a SequencePlan),
    ) -> SequenceInput<'a> {
        let (masks, measurement) = (masks.view(), y.view());
        let solver = Solver::Schedule(schedule);
        SequenceInput { masks, measurement, first: 3, white: 1.0, solver, plan, runs, mosaic: None }
    }

    fn network() -> NetworkSource {
        NetworkSource::new(None, Device::Cpu)
    }

    #[test]
    fn the_number_of_threads_changes_nothing_and_seams_are_small() {
        let (masks, truth) = scene(96);
        let y = snapshots(&masks, &truth);
        // A fixed schedule solves all cuts in the same way.
        let schedule = Schedule::gap_tv3d().with_iterations(100);
        let frames = |plan: &TilePlan, runs: &SequencePlan, threads| {
            let input = input(&masks, &y, &schedule, (plan, runs));
            let solved = solve(&input, &network(), threads, &|_, _| ()).unwrap();
            let frame = |k: usize| solved.frame(&input, 3 + k / 4, k % 4);
            (0..20).map(frame).collect::<Vec<_>>()
        };
        let (cut, runs) = (TilePlan::new(96, 96, 48, 16).unwrap(), SequencePlan::new(3..8, 3, 1));
        let runs = runs.unwrap();
        assert_eq!(runs.runs(), [3..6, 5..8]);
        let parts = frames(&cut, &runs, 1);
        assert_eq!(parts, frames(&cut, &runs, 3));
        let one = SequencePlan::new(3..8, 5, 0).unwrap();
        let whole = frames(&TilePlan::new(96, 96, 96, 0).unwrap(), &one, 2);
        let error = |a: &Array2<f32>, b: &Array2<f32>| (a - b).mapv(|d| d * d).mean().unwrap();
        let mut sums = [0.0, 0.0];
        for (k, truth) in truth.outer_iter().enumerate() {
            let truth = truth.to_owned();
            let errors = [&parts[k], &whole[k]].map(|frame| error(frame, &truth));
            let decibels = 10.0 * (errors[0] / errors[1]).log10();
            assert!(decibels < 1.5, "frame {k}: {decibels} dB between cut and whole");
            sums.iter_mut().zip(errors).for_each(|(sum, error)| *sum += error);
        }
        let decibels = 10.0 * (sums[0] / sums[1]).log10();
        assert!(decibels.abs() < 0.3, "{decibels} dB between cut and whole");
        // From frame to frame no step that the whole has not. Frames 8 to 11 are blended of two runs.
        for k in 1..20 {
            let step = |frames: &[Array2<f32>]| error(&frames[k - 1], &frames[k]);
            let decibels = 10.0 * (step(&parts) / step(&whole)).log10();
            let limit = if [8, 12].contains(&k) { 0.5 } else { 0.05 };
            assert!(decibels < limit, "from frame {} to {k}: {decibels} dB", k - 1);
        }
    }

    #[test]
    fn snapshots_that_are_separate_are_each_what_they_are_alone() {
        let (masks, truth) = scene(48);
        let y = snapshots(&masks, &truth);
        let schedule = Schedule { adaptive: false, ..Schedule::gap_tv3d() };
        let plan = TilePlan::new(48, 48, 48, 0).unwrap();
        let runs = SequencePlan::separate(3..8);
        let input = input(&masks, &y, &schedule, (&plan, &runs));
        let all = solve(&input, &network(), 2, &|_, _| ()).unwrap();
        assert!(all.pilot.is_none(), "there is no joint to be decided");
        for snapshot in 3..8 {
            let runs = SequencePlan::separate(snapshot..snapshot + 1);
            let alone = snapshot - 3..snapshot - 2;
            let measurement = y.slice(ndarray::s![alone, .., ..]);
            let alone = SequenceInput { measurement, first: snapshot, runs: &runs, ..input };
            let solved = solve(&alone, &network(), 1, &|_, _| ()).unwrap();
            for k in 0..4 {
                assert_eq!(solved.frame(&alone, snapshot, k), all.frame(&input, snapshot, k));
            }
        }
    }

    #[test]
    fn the_error_is_the_cause_of_a_failure() {
        let (masks, truth) = scene(96);
        let mut y = snapshots(&masks, &truth);
        y[[4, 90, 90]] = f32::INFINITY;
        let (schedule, plan) = (Schedule::gap_tv(), TilePlan::new(96, 96, 48, 16).unwrap());
        let runs = SequencePlan::separate(3..8);
        let input = input(&masks, &y, &schedule, (&plan, &runs));
        let error = solve(&input, &network(), 2, &|_, _| ()).unwrap_err();
        assert!(matches!(error, PipelineError::Recon(ReconError::Diverged { .. })), "{error}");
    }
}
