//! Progress and cancellation of a computation.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::error::{PipelineError, Result};
use crate::job::{TaskProgress, TaskStage};
use reconstruction::priors::Family;
use reconstruction::schedule::Schedule;
use reconstruction::solver::{Control, Observer, Progress};

/// State that a computing thread shares with the thread that watches it.
#[derive(Debug)]
pub struct Monitor {
    /// The progress, and the time of the last sign of life.
    progress: Mutex<(TaskProgress, Instant)>,
    /// The solver's history, and whether it has grown since it was last reported.
    history: Mutex<(History, bool)>,
    stop: AtomicBool,
}

impl Default for Monitor {
    fn default() -> Self {
        let progress = Mutex::new((TaskProgress::START, Instant::now()));
        Self { progress, history: Mutex::default(), stop: AtomicBool::new(false) }
    }
}

impl Monitor {
    fn lock(&self) -> MutexGuard<'_, (TaskProgress, Instant)> {
        // Every change is a single assignment, so the value is valid even if a thread panicked.
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn progress(&self) -> TaskProgress {
        self.lock().0
    }

    /// Time since the last sign of life of the computing thread.
    pub fn silence(&self) -> Duration {
        self.lock().1.elapsed()
    }

    /// Records the progress, which is also a sign of life.
    pub fn set_progress(&self, progress: TaskProgress) {
        *self.lock() = (progress, Instant::now());
    }

    /// Records the progress of a stage without iterations.
    pub fn reach(&self, stage: TaskStage, fraction: f64) {
        self.set_progress(TaskProgress { stage, fraction, ..self.progress() });
    }

    /// Returns the solver's history as JSON if it has grown since the last call.
    pub fn news(&self) -> Option<String> {
        let mut history = self.history.lock().unwrap_or_else(PoisonError::into_inner);
        std::mem::take(&mut history.1).then(|| history.0.to_json())
    }

    /// Asks the computing thread to stop at the next opportunity.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// True once [`Monitor::stop`] was called.
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Gives a sign of life. Returns [`PipelineError::Stopped`] once [`Monitor::stop`] was called.
    pub fn check(&self) -> Result<()> {
        self.lock().1 = Instant::now();
        if self.stopped() { Err(PipelineError::Stopped) } else { Ok(()) }
    }

    /// An observer of one run of a schedule that reports to this monitor.
    pub fn observe(&self, schedule: Schedule) -> impl Observer {
        MonitorObserver { monitor: self, share: ShareDone::new(schedule), passes: 0 }
    }
}

struct MonitorObserver<'a> {
    monitor: &'a Monitor,
    share: ShareDone,
    passes: u32,
}

impl Observer for MonitorObserver<'_> {
    fn iteration(&mut self, progress: &Progress) -> Control {
        self.passes += u32::from(progress.family == Family::Learned);
        {
            let history = &self.monitor.history;
            let mut history = history.lock().unwrap_or_else(PoisonError::into_inner);
            history.0.record(progress);
            history.1 = true;
        }
        self.monitor.set_progress(TaskProgress {
            stage: stage(progress.family),
            iterations: u32::try_from(progress.done).unwrap_or(u32::MAX),
            passes: self.passes,
            fraction: self.share.after(progress),
        });
        if self.monitor.stopped() { Control::Cancel } else { Control::Continue }
    }

    fn part(&mut self, share: Range<f64>) {
        self.share.restart(share);
        // A plot shows only the last run of the solver.
        *self.monitor.history.lock().unwrap_or_else(PoisonError::into_inner) = Default::default();
    }
}

/// The stage of a task that iterations with a prior of this family belong to.
fn stage(family: Family) -> TaskStage {
    match family {
        Family::TotalVariation => TaskStage::Tv,
        Family::Learned => TaskStage::Deep,
        Family::Nonlocal => TaskStage::Nonlocal,
    }
}

/// Converts the solver's progress into the finished share of the work, by the planned cost.
#[derive(Debug, Clone)]
pub(super) struct ShareDone {
    schedule: Schedule,
    stage: usize,
    iterations: usize,
    /// The part of the work, on \[0,1\], that the solver's run covers.
    part: Range<f64>,
}

impl ShareDone {
    pub(super) fn new(schedule: Schedule) -> Self {
        Self { schedule, stage: 0, iterations: 0, part: 0.0..1.0 }
    }

    /// Starts another run of the schedule, which is this part of the work.
    pub(super) fn restart(&mut self, part: Range<f64>) {
        (self.stage, self.iterations, self.part) = (0, 0, part);
    }

    /// The share on \[0,1\] after the iteration in `progress`. Must be called for every iteration. The share jumps
    /// when a stage ends early.
    pub(super) fn after(&mut self, progress: &Progress) -> f64 {
        if progress.stage != self.stage {
            (self.stage, self.iterations) = (progress.stage, 0);
        }
        self.iterations += 1;
        let Range { start, end } = self.part;
        start + (end - start) * self.schedule.share_done(self.stage, self.iterations)
    }
}

/// Largest number of kept points, not counting the last one.
const POINTS: usize = 128;

/// The values of one iteration.
#[derive(Debug, Clone, Copy)]
struct Point {
    iteration: usize,
    residual: f32,
    change: f32,
    sigma: Option<f32>,
}

/// A record of iterations that is log2_step out as it grows: it keeps every second, fourth or eighth point and so on, and
/// always the last.
#[derive(Debug, Default)]
struct History {
    points: Vec<Point>,
    last: Option<Point>,
    /// Number of recorded iterations.
    count: usize,
    /// Base-2 logarithm of the distance between kept points.
    log2_step: u32,
}

impl History {
    /// Records an iteration.
    fn record(&mut self, progress: &Progress) {
        let point = Point {
            iteration: progress.done,
            residual: progress.residual,
            change: progress.change,
            sigma: progress.sigma,
        };
        if self.points.len() == POINTS {
            let mut index = 0;
            self.points.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.log2_step += 1;
        }
        if self.count.is_multiple_of(1 << self.log2_step) {
            self.points.push(point);
        }
        self.count += 1;
        self.last = Some(point);
    }

    /// \[\[iteration, residual, change, sigma or null\], ...\] as JSON.
    fn to_json(&self) -> String {
        let last_kept = self.points.last().map(|point| point.iteration);
        let last = self.last.filter(|last| Some(last.iteration) != last_kept);
        let show = |point: &Point| {
            let sigma = point.sigma.map_or(Value::Null, rounded);
            json!([point.iteration, rounded(point.residual), rounded(point.change), sigma])
        };
        Value::from_iter(self.points.iter().chain(&last).map(show)).to_string()
    }
}

/// True if a text could come from [`Monitor::news`] after at most `iterations` iterations.
pub fn is_history(text: &str, iterations: usize) -> bool {
    type Row = (usize, Option<f64>, Option<f64>, Option<f64>);
    let rows = serde_json::from_str::<Vec<Row>>(text);
    rows.is_ok_and(|rows| {
        rows.len() <= POINTS + 1 && rows.iter().all(|(iteration, ..)| *iteration <= iterations)
    })
}

/// Rounds to four digits, which are more than a plot shows.
fn rounded(value: f32) -> Value {
    let text = format!("{value:.3e}");
    // JSON has no infinity and no NaN.
    text.parse::<f64>().ok().filter(|value| value.is_finite()).into()
}

#[cfg(test)]
mod tests {
    use super::{History, POINTS, ShareDone, is_history};
    use reconstruction::priors::Family;
    use reconstruction::schedule::Schedule;
    use reconstruction::solver::Progress;
    use serde_json::Value;

    fn after(iterations: usize) -> Vec<Value> {
        let mut history = History::default();
        for done in 1..=iterations {
            let (residual, change) = (1.0 / done as f32, f32::INFINITY);
            let sigma = (done % 2 == 0).then_some(0.1);
            history.record(&Progress {
                stage: 0,
                done,
                planned: 9,
                residual,
                change,
                sigma,
                family: Family::TotalVariation,
            });
        }
        serde_json::from_str(&history.to_json()).unwrap()
    }

    #[test]
    fn few_iterations_are_all_kept() {
        assert_eq!(after(0), Vec::<Value>::new());
        let points = after(3);
        assert_eq!(points[0], serde_json::json!([1, 1.0, null, null]));
        assert_eq!(points[1], serde_json::json!([2, 0.5, null, 0.1]));
        assert_eq!(points[2], serde_json::json!([3, 0.3333, null, null]));
    }

    #[test]
    fn only_what_a_history_writes_is_one() {
        for iterations in [0, 3, POINTS, 9999] {
            let text = Value::from(after(iterations)).to_string();
            assert!(is_history(&text, iterations), "{text}");
            assert!(iterations == 0 || !is_history(&text, iterations - 1));
        }
        let long = Value::from_iter(vec![serde_json::json!([1, 0.1, 0.1, 0.1]); POINTS + 2]);
        let more =
            ["", "{}", "[1]", "[[1,2]]", "[[-1,0,0,0]]", "[[1,0,0,\"x\"]]", "[[1,1e999,0,0]]"];
        for text in more.map(str::to_owned).into_iter().chain([long.to_string()]) {
            assert!(!is_history(&text, 10_000), "{text}");
        }
    }

    #[test]
    fn many_are_thinned_out_evenly_with_the_first_and_the_last() {
        for iterations in [POINTS, POINTS + 1, 1000, 9999, 10_000] {
            let points = after(iterations);
            assert!((POINTS / 2..=POINTS + 1).contains(&points.len()), "{}", points.len());
            let at: Vec<u64> = points.iter().map(|point| point[0].as_u64().unwrap()).collect();
            assert_eq!((at[0], at[at.len() - 1]), (1, iterations as u64));
            let steps: Vec<u64> = at.windows(2).map(|pair| pair[1] - pair[0]).collect();
            let (even, rest) = steps.split_at(steps.len() - 1);
            assert!(even.iter().all(|step| *step == steps[0]) && rest[0] <= steps[0], "{steps:?}");
        }
    }

    #[test]
    fn an_early_end_of_a_stage_jumps_to_its_end() {
        let schedule = Schedule::pnp_ffdnet();
        let passes = schedule.stages[1].iterations;
        let mut share = ShareDone::new(schedule);
        let at = |stage, done| Progress {
            stage,
            done,
            planned: 64,
            residual: 0.1,
            change: 0.1,
            sigma: None,
            family: if stage > 0 { Family::Learned } else { Family::TotalVariation },
        };
        let first = share.after(&at(0, 1));
        // The stage of total variation ended after three iterations.
        let mut last = first;
        for pass in 1..=passes {
            let now = share.after(&at(1, 3 + pass));
            assert!(now > last);
            last = now;
        }
        assert!(first < 0.01);
        assert!((last - 1.0).abs() < 1e-9, "{last}");
    }
}
