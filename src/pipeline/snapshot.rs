//! A whole snapshot in memory, its tiles on several threads.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

use ndarray::{ArrayView2, ArrayView3, Axis, s};

use super::error::{PipelineError, Result};
use super::networks::{ModelFile, NetworkSource, WarmNetworks};
use super::pilot;
use super::progress::ShareDone;
use super::records::PilotRecord;
use super::tile::{TileInput, reconstruct_tile, run_network};
use crate::recon;
use crate::recon::schedule::Schedule;
use crate::recon::solver::{Control, Observer, Outcome, Progress};
use crate::recon::tile::TilePlan;

#[derive(Debug, Clone, Copy)]
pub struct SnapshotInput<'a> {
    pub snapshot: usize,
    /// Masks \[B,H,W\] on \[0,1\].
    pub masks: ArrayView3<'a, f32>,
    /// Measurement \[H,W\].
    pub measurement: ArrayView2<'a, f32>,
    pub white: f32,
    pub solver: Solver<'a>,
    /// The cut; it has the size of the masks.
    pub plan: &'a TilePlan,
}

#[derive(Debug, Clone, Copy)]
pub enum Solver<'a> {
    Schedule(&'a Schedule),
    /// By one run of an end-to-end network.
    Network(&'a ModelFile),
}

impl SnapshotInput<'_> {
    fn window(&self, rows: Range<usize>, columns: Range<usize>) -> TileInput {
        let y = self.measurement.slice(s![rows.clone(), columns.clone()]);
        TileInput {
            masks: self.masks.slice(s![.., rows, columns]).to_owned(),
            y: y.to_owned().insert_axis(Axis(0)),
            plane: 0,
            white: self.white,
        }
    }
}

/// A snapshot whose tiles are solved.
#[derive(Debug)]
pub struct Solved {
    pub tiles: Vec<Outcome>,
    /// What the pilot of an adaptive schedule found.
    pub pilot: Option<PilotRecord>,
}

/// Hears of a tile, by its index in the plan, which share of its work is done, on \[0,1\]; called from
/// all threads.
pub type TileProgress<'a> = &'a (dyn Fn(usize, f64) + Sync);

/// Solves all tiles of a snapshot on up to `threads` threads, one denoiser a thread; an adaptive
/// schedule is decided before. The result does not depend on the number of threads.
/// Errors: the first failure of any tile; the others stop at their next iteration.
pub fn solve(
    input: &SnapshotInput<'_>,
    network: &NetworkSource,
    threads: usize,
    progress: TileProgress<'_>,
) -> Result<Solved> {
    let mut pilot = None;
    if let Solver::Schedule(schedule) = input.solver {
        let (rows, columns) = recon::pilot::piece(input.measurement);
        let place = (input.snapshot, rows.start, columns.start);
        let mut networks = WarmNetworks::new(network.clone());
        let piece = input.window(rows, columns);
        pilot = pilot::decide(piece, place, schedule, &mut networks, &mut ())?;
    }
    let decided = match (&pilot, input.solver) {
        (Some(pilot), Solver::Schedule(schedule)) => Some(pilot.decide(schedule)),
        _ => None,
    };
    let solver = decided.as_ref().map_or(input.solver, Solver::Schedule);
    let tiles = run_tiles(&SnapshotInput { solver, ..*input }, network, threads, progress)?;
    Ok(Solved { tiles, pilot })
}

fn run_tiles(
    input: &SnapshotInput<'_>,
    network: &NetworkSource,
    threads: usize,
    progress: TileProgress<'_>,
) -> Result<Vec<Outcome>> {
    let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
    let tiles = || -> Result<Vec<(usize, Outcome)>> {
        let mut networks = WarmNetworks::new(network.clone());
        let mut done = Vec::new();
        while let Some(tile) = input.plan.tile(next.fetch_add(1, Ordering::Relaxed)) {
            let window = input.window(tile.rows(), tile.columns());
            let outcome = match input.solver {
                Solver::Schedule(schedule) => {
                    let share = ShareDone::new(schedule.clone());
                    let tell = |share| progress(tile.index, share);
                    let mut observer = TileObserver { tell, stop: &stop, share };
                    reconstruct_tile(window, schedule, &mut networks, &mut observer)?
                }
                Solver::Network(_) if stop.load(Ordering::Relaxed) => {
                    return Err(PipelineError::Stopped);
                }
                Solver::Network(file) => run_network(window, networks.end_to_end(file)?)?,
            };
            progress(tile.index, 1.0);
            done.push((tile.index, outcome));
        }
        Ok(done)
    };
    let thread = || tiles().inspect_err(|_| stop.store(true, Ordering::Relaxed));
    let outcomes: Vec<_> = thread::scope(|scope| {
        let count = threads.clamp(1, input.plan.len());
        let handles: Vec<_> = (0..count).map(|_| scope.spawn(thread)).collect();
        handles.into_iter().map(|h| h.join().unwrap_or(Err(PipelineError::Thread))).collect()
    });
    let (mut done, mut failure) = (Vec::new(), None);
    for outcome in outcomes {
        match outcome {
            Ok(tiles) => done.extend(tiles),
            // Threads that were stopped say so; the cause is the other error.
            Err(PipelineError::Stopped) if failure.is_some() => {}
            Err(error) => failure = Some(error),
        }
    }
    done.sort_by_key(|(index, _)| *index);
    failure.map_or_else(|| Ok(done.into_iter().map(|(_, outcome)| outcome).collect()), Err)
}

struct TileObserver<'a, F> {
    tell: F,
    stop: &'a AtomicBool,
    share: ShareDone,
}

impl<F: Fn(f64)> Observer for TileObserver<'_, F> {
    fn iteration(&mut self, progress: &Progress) -> Control {
        (self.tell)(self.share.after(progress));
        if self.stop.load(Ordering::Relaxed) { Control::Cancel } else { Control::Continue }
    }
}

#[cfg(test)]
mod tests {
    use super::{SnapshotInput, Solver, solve};
    use crate::optics::{iid_masks, measure};
    use crate::pipeline::blend;
    use crate::pipeline::error::PipelineError;
    use crate::pipeline::networks::NetworkSource;
    use crate::recon::ReconError;
    use crate::recon::prior::onnx::Device;
    use crate::recon::schedule::Schedule;
    use crate::recon::tile::TilePlan;
    use ndarray::Array3;

    fn scene(side: usize) -> (Array3<f32>, Array3<f32>) {
        let masks = iid_masks(4, side, side, 2).unwrap();
        let frames = Array3::from_shape_fn((4, side, side), |(k, i, j)| {
            0.5 + 0.4 * ((i + 3 * k) as f32 * 0.13).sin() * (j as f32 * 0.09).cos()
        });
        (masks, frames)
    }

    fn network() -> NetworkSource {
        NetworkSource::new(None, Device::Cpu)
    }

    #[test]
    fn the_number_of_threads_changes_nothing_and_seams_are_small() {
        let (masks, truth) = scene(96);
        let y = measure(masks.view(), truth.view()).unwrap();
        let schedule = Schedule::gap_tv();
        let frames = |plan: &TilePlan, threads| {
            let (masks, measurement) = (masks.view(), y.view());
            let solver = Solver::Schedule(&schedule);
            let input = SnapshotInput { snapshot: 0, masks, measurement, white: 1.0, solver, plan };
            let tiles = solve(&input, &network(), threads, &|_, _| ()).unwrap().tiles;
            blend::frame(plan, &tiles, 1)
        };
        let cut = TilePlan::new(96, 96, 48, 16).unwrap();
        let one = frames(&cut, 1);
        assert_eq!(one, frames(&cut, 3));
        let whole = frames(&TilePlan::new(96, 96, 96, 0).unwrap(), 1);
        let error = |frame: &ndarray::Array2<f32>| {
            (frame - &truth.index_axis(ndarray::Axis(0), 1)).mapv(|d| d * d).mean().unwrap()
        };
        let decibels = 10.0 * (error(&one) / error(&whole)).log10();
        assert!(decibels.abs() < 0.3, "{decibels} dB between tiled and whole");
    }

    #[test]
    fn the_cause_of_a_failure_is_told_not_its_consequence() {
        let (masks, truth) = scene(96);
        let mut y = measure(masks.view(), truth.view()).unwrap();
        y[[90, 90]] = f32::NAN;
        let (schedule, plan) = (Schedule::gap_tv(), TilePlan::new(96, 96, 48, 16).unwrap());
        let (masks, measurement) = (masks.view(), y.view());
        let solver = Solver::Schedule(&schedule);
        let input =
            SnapshotInput { snapshot: 0, masks, measurement, white: 1.0, solver, plan: &plan };
        let error = solve(&input, &network(), 2, &|_, _| ()).unwrap_err();
        assert!(matches!(error, PipelineError::Recon(ReconError::Diverged { .. })), "{error}");
    }
}
