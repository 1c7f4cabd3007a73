//! A progress bar, on a terminal only.

use std::io::IsTerminal;
use std::sync::Mutex;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::job::Schedule;
use crate::pipeline::{ShareDone, TileProgress};
use crate::recon::solver::Progress;
use crate::recon::tile::Tile;

const STEPS: u64 = 1000;

/// Standard error if it is a terminal, else nothing.
pub(super) fn target() -> ProgressDrawTarget {
    match std::io::stderr().is_terminal() {
        true => ProgressDrawTarget::stderr(),
        false => ProgressDrawTarget::hidden(),
    }
}

/// A bar that goes from 0 to 1.
pub(super) fn bar(title: &'static str) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(STEPS), target()).with_message(title);
    // The template is fixed: if it were wrong, the default style would do.
    let style = ProgressStyle::with_template("{msg:>24} {wide_bar} {percent:>3}% {eta:>4}");
    bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Shows `share` on \[0,1\].
pub(super) fn show(bar: &ProgressBar, share: f64) {
    bar.set_position((share.clamp(0.0, 1.0) * STEPS as f64) as u64);
}

/// The tiles of one snapshot on one bar, each weighed by what its iterations cost.
pub(super) struct SnapshotBar {
    bar: ProgressBar,
    tiles: Mutex<Vec<(ShareDone, f64)>>,
}

impl SnapshotBar {
    pub(super) fn new(schedule: &Schedule, tiles: usize) -> Self {
        let tile = (ShareDone::new(schedule.clone()), 0.0);
        Self { bar: bar("reconstructing"), tiles: Mutex::new(vec![tile; tiles]) }
    }

    fn update(&self, tile: &Tile, share: impl FnOnce(&mut ShareDone) -> f64) {
        let Ok(mut tiles) = self.tiles.lock() else { return };
        if let Some((counter, done)) = tiles.get_mut(tile.index) {
            *done = share(counter);
        }
        show(&self.bar, tiles.iter().map(|tile| tile.1).sum::<f64>() / tiles.len() as f64);
    }
}

impl TileProgress for SnapshotBar {
    fn iteration(&self, tile: &Tile, progress: &Progress) {
        self.update(tile, |counter| counter.after(progress));
    }

    fn finished(&self, tile: &Tile) {
        self.update(tile, |_| 1.0);
    }
}

impl Drop for SnapshotBar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
