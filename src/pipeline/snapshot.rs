//! A whole snapshot in memory, its tiles on several threads.

use std::ops::Range;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;

use ndarray::{Array2, ArrayView2, ArrayView3, Axis, s};

use super::learned::{ModelFile, run_network};
use super::networks::{NetworkError, NetworkSource, WarmNetworks};
use super::pilot::{self, PilotRecord};
use super::tile::{TileInput, TileOutcome, reconstruct_tile};
use crate::recon::schedule::Schedule;
use crate::recon::solver::{Control, Observer, Progress};
use crate::recon::tile::{Tile, TilePlan};
use crate::recon::{self, ReconError};

/// What is to be solved.
#[derive(Debug, Clone, Copy)]
pub struct SnapshotInput<'a> {
    /// Its index in the measurement, for the record.
    pub snapshot: usize,
    /// Masks \[B,H,W\] on \[0,1\].
    pub masks: ArrayView3<'a, f32>,
    /// Measurement \[H,W\].
    pub measurement: ArrayView2<'a, f32>,
    /// White level of the scene.
    pub white: f32,
    /// How.
    pub solver: Solver<'a>,
    /// The cut; it has the size of the masks.
    pub plan: &'a TilePlan,
}

/// How tiles are solved.
#[derive(Debug, Clone, Copy)]
pub enum Solver<'a> {
    /// By iterations.
    Schedule(&'a Schedule),
    /// By one run of an end-to-end network.
    Network(&'a ModelFile),
}

impl SnapshotInput<'_> {
    /// What one tile is made of.
    fn window(&self, rows: Range<usize>, columns: Range<usize>) -> TileInput {
        TileInput {
            masks: self.masks.slice(s![.., rows.clone(), columns.clone()]).to_owned(),
            measurement: self.measurement.slice(s![rows, columns]).to_owned(),
            white: self.white,
        }
    }
}

/// A snapshot whose tiles are solved.
#[derive(Debug)]
pub struct Solved {
    /// The tiles in the plan's order.
    pub tiles: Vec<TileOutcome>,
    /// What the pilot of an adaptive schedule found.
    pub pilot: Option<PilotRecord>,
}

/// Why a snapshot was not solved.
#[derive(Debug, thiserror::Error)]
pub enum SolveError {
    /// The solver refused or failed.
    #[error(transparent)]
    Recon(#[from] ReconError),
    /// There is no network.
    #[error(transparent)]
    Network(#[from] NetworkError),
    /// A thread died.
    #[error("a computing thread ended unexpectedly")]
    Thread,
}

/// Is told how far the tiles are; called from all threads.
pub trait TileProgress: Sync {
    /// A tile has done an iteration.
    fn iteration(&self, tile: &Tile, progress: &Progress);
    /// A tile is ready.
    fn finished(&self, tile: &Tile);
}

/// Listens to nothing.
impl TileProgress for () {
    fn iteration(&self, _: &Tile, _: &Progress) {}
    fn finished(&self, _: &Tile) {}
}

/// Solves all tiles of a snapshot on up to `threads` threads, one denoiser a thread; an adaptive
/// schedule is decided before. The result does not depend on the number of threads.
///
/// # Errors
/// The first failure of any tile; the others stop at their next iteration.
pub fn solve(
    input: &SnapshotInput<'_>,
    network: &NetworkSource,
    threads: usize,
    progress: &dyn TileProgress,
) -> Result<Solved, SolveError> {
    let pilot = run_pilot(input, network)?;
    let decided = match (&pilot, input.solver) {
        (Some(pilot), Solver::Schedule(schedule)) => Some(pilot.decide(schedule)),
        _ => None,
    };
    let solver = decided.as_ref().map_or(input.solver, Solver::Schedule);
    let tiles = run_tiles(&SnapshotInput { solver, ..*input }, network, threads, progress)?;
    Ok(Solved { tiles, pilot })
}

fn run_pilot(
    input: &SnapshotInput<'_>,
    network: &NetworkSource,
) -> Result<Option<PilotRecord>, SolveError> {
    let Solver::Schedule(schedule) = input.solver else { return Ok(None) };
    let (rows, columns) = recon::pilot::piece(input.measurement);
    let place = (input.snapshot, rows.start, columns.start);
    let mut networks = WarmNetworks::new(network.clone());
    Ok(pilot::decide(input.window(rows, columns), place, schedule, &mut networks, &mut ())?)
}

fn run_tiles(
    input: &SnapshotInput<'_>,
    network: &NetworkSource,
    threads: usize,
    progress: &dyn TileProgress,
) -> Result<Vec<TileOutcome>, SolveError> {
    let run = Run {
        input,
        network,
        progress,
        next: AtomicUsize::new(0),
        stop: AtomicBool::new(false),
        done: Mutex::new((0..input.plan.len()).map(|_| None).collect()),
    };
    let threads = threads.clamp(1, input.plan.len());
    let outcomes: Vec<Result<(), SolveError>> = thread::scope(|scope| {
        let handles: Vec<_> = (0..threads).map(|_| scope.spawn(|| run.thread())).collect();
        handles.into_iter().map(|h| h.join().unwrap_or(Err(SolveError::Thread))).collect()
    });
    // Threads that were stopped report a cancellation; the cause is the other error.
    let cancelled = |e: &SolveError| matches!(e, SolveError::Recon(ReconError::Cancelled));
    let mut errors: Vec<SolveError> = outcomes.into_iter().filter_map(Result::err).collect();
    errors.sort_by_key(cancelled);
    if let Some(error) = errors.into_iter().next() {
        return Err(error);
    }
    let done = run.done.into_inner().map_err(|_| SolveError::Thread)?;
    done.into_iter().collect::<Option<_>>().ok_or(SolveError::Thread)
}

struct Run<'a, 'b> {
    input: &'a SnapshotInput<'b>,
    network: &'a NetworkSource,
    progress: &'a dyn TileProgress,
    next: AtomicUsize,
    stop: AtomicBool,
    done: Mutex<Vec<Option<TileOutcome>>>,
}

impl Run<'_, '_> {
    fn thread(&self) -> Result<(), SolveError> {
        let outcome = self.tiles();
        if outcome.is_err() {
            self.stop.store(true, Ordering::Relaxed);
        }
        outcome
    }

    fn tiles(&self) -> Result<(), SolveError> {
        let mut networks = WarmNetworks::new(self.network.clone());
        loop {
            let index = self.next.fetch_add(1, Ordering::Relaxed);
            let Some(tile) = self.input.plan.tile(index) else { return Ok(()) };
            let (rows, columns) =
                (tile.row..tile.row + tile.height, tile.column..tile.column + tile.width);
            let window = self.input.window(rows, columns);
            let outcome = match self.input.solver {
                Solver::Schedule(schedule) => {
                    let (progress, stop) = (self.progress, &self.stop);
                    let mut observer = TileObserver { progress, stop, tile };
                    reconstruct_tile(window, schedule, &mut networks, &mut observer)?
                }
                Solver::Network(_) if self.stop.load(Ordering::Relaxed) => {
                    return Err(ReconError::Cancelled.into());
                }
                Solver::Network(file) => run_network(window, networks.end_to_end(file)?)?,
            };
            self.progress.finished(&tile);
            self.done.lock().map_err(|_| SolveError::Thread)?[index] = Some(outcome);
        }
    }
}

struct TileObserver<'a> {
    progress: &'a dyn TileProgress,
    stop: &'a AtomicBool,
    tile: Tile,
}

impl Observer for TileObserver<'_> {
    fn iteration(&mut self, progress: &Progress) -> Control {
        self.progress.iteration(&self.tile, progress);
        match self.stop.load(Ordering::Relaxed) {
            true => Control::Cancel,
            false => Control::Continue,
        }
    }
}

/// Frame `k` \[H,W\] of the whole picture, blended from its tiles in the plan's order.
pub fn blended_frame(plan: &TilePlan, tiles: &[TileOutcome], k: usize) -> Array2<f32> {
    let mut whole = Array2::zeros(plan.dim());
    for (tile, outcome) in plan.tiles().zip(tiles) {
        plan.blend(&tile, outcome.frames.index_axis(Axis(0), k), whole.view_mut());
    }
    whole
}

#[cfg(test)]
mod tests {
    use super::{SnapshotInput, SolveError, Solver, blended_frame, solve};
    use crate::optics::{iid_masks, measure};
    use crate::pipeline::NetworkSource;
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
            let tiles = solve(&input, &network(), threads, &()).unwrap().tiles;
            blended_frame(plan, &tiles, 1)
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
        let error = solve(&input, &network(), 2, &()).unwrap_err();
        assert!(matches!(error, SolveError::Recon(ReconError::Diverged { .. })), "{error}");
    }
}
