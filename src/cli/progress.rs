//! Progress bars, which appear only on a terminal.

use std::borrow::Cow;
use std::io::IsTerminal;
use std::sync::Mutex;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

const STEPS: u64 = 1000;

/// Standard error if it is a terminal, else a hidden target.
pub(super) fn target() -> ProgressDrawTarget {
    match std::io::stderr().is_terminal() {
        true => ProgressDrawTarget::stderr(),
        false => ProgressDrawTarget::hidden(),
    }
}

/// A bar that goes from 0 to 1.
pub(super) fn bar(title: impl Into<Cow<'static, str>>) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(Some(STEPS), target()).with_message(title);
    // The template is fixed: if it were wrong, the default style would do.
    let style = ProgressStyle::with_template("{msg:>24} {wide_bar} {percent:>3}% {eta:>4}");
    bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// A bar of bytes. Its length is set later.
pub(super) fn bytes(title: impl Into<Cow<'static, str>>) -> ProgressBar {
    let bar = ProgressBar::with_draw_target(None, target()).with_message(title);
    let style = "{msg:>24} {wide_bar} {decimal_bytes}/{decimal_total_bytes} {eta:>4}";
    let style = ProgressStyle::with_template(style);
    bar.with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// Shows `share` on \[0,1\].
pub(super) fn show(bar: &ProgressBar, share: f64) {
    bar.set_position((share.clamp(0.0, 1.0) * STEPS as f64) as u64);
}

pub(super) struct SnapshotBar {
    bar: ProgressBar,
    shares: Mutex<Vec<f64>>,
}

impl SnapshotBar {
    pub(super) fn new(tiles: usize) -> Self {
        Self { bar: bar("reconstructing"), shares: Mutex::new(vec![0.0; tiles]) }
    }

    /// Updates the finished share of a tile, on \[0,1\].
    pub(super) fn update(&self, tile: usize, share: f64) {
        let Ok(mut shares) = self.shares.lock() else { return };
        if let Some(done) = shares.get_mut(tile) {
            *done = share;
        }
        show(&self.bar, shares.iter().sum::<f64>() / shares.len() as f64);
    }
}

impl Drop for SnapshotBar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
