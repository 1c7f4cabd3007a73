//! Forecast of the queue: the order in which jobs are served, and their waiting times.
//!
//! A task of a higher priority goes first. At equal priority, labs take turns by their shares, and the jobs of a lab
//! follow each other. When a lab has been served `w` CPU-seconds, another lab has been served `w` times the ratio of
//! their shares, or all that it wanted.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::columns::from_row;
use engine::job::{JobId, Lab};

/// A forecast is good for so long for each job in it, about twenty times as long as it takes to make: it
/// costs a twentieth of a core, however many ask.
const KEPT_PER_JOB: Duration = Duration::from_micros(50);
const KEPT_AT_MOST: Duration = Duration::from_secs(1);
/// Number of unfinished jobs above which callers get an outdated forecast while a new one is made. A forecast of 500
/// jobs takes about a millisecond.
const LONG: usize = 500;
/// A forecast that was due so long ago helps nobody: callers wait for a new one.
const OUTDATED: Duration = Duration::from_secs(30);

/// The last forecast of a store, and the making of the next one.
#[derive(Debug, Default)]
pub struct Forecasts {
    last: Mutex<Option<Arc<Forecast>>>,
    /// Held while a forecast is made.
    pub(super) making: Arc<tokio::sync::Mutex<()>>,
}

impl Forecasts {
    pub(super) fn last(&self) -> Option<Arc<Forecast>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(super) fn keep(&self, made: Forecast) -> Arc<Forecast> {
        let made = Arc::new(made);
        *self.last.lock().unwrap_or_else(PoisonError::into_inner) = Some(made.clone());
        made
    }
}

/// The load ahead of every unfinished job.
#[derive(Debug)]
pub struct Forecast {
    /// Workers that take tiles and pilots.
    tiles: Crew,
    /// Workers that take other tasks: reading and writing are slower than computing.
    others: Crew,
    jobs: HashMap<JobId, Ahead>,
    /// The load ahead of a new job.
    new_job: Ahead,
    pub(super) left_by_lab: HashMap<Lab, f64>,
    until: Instant,
}

/// Workers that share tasks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Crew {
    pub(super) workers: u32,
    /// Planned CPU-seconds that all of them do in a second.
    pub(super) speed: f64,
}

from_row!(Crew, row => { workers, speed });

impl Crew {
    /// Seconds that a worker takes for a planned CPU-second: the harmonic mean.
    fn rate(self) -> f64 {
        f64::from(self.workers) / self.speed
    }

    /// Seconds for these tasks at a rate: if the work is shared evenly, and how much later the longest task may end.
    fn seconds(self, left: Left, rate: f64) -> Left {
        let workers = f64::from(self.workers);
        let longest = (1.0 - 1.0 / workers) * rate * left.longest;
        Left { sum: rate * left.sum / workers, longest }
    }
}

/// Planned CPU-seconds that are left of some tasks of a job.
#[derive(Debug, Clone, Copy)]
pub struct Left {
    /// Sum over all of them.
    pub(crate) sum: f64,
    /// The largest of them.
    pub(crate) longest: f64,
}

/// The load that is served before a job.
#[derive(Debug, Clone, Copy)]
struct Ahead {
    /// Seconds that all workers need for it.
    seconds: f64,
    /// The job's place among those that wait, from 1.
    position: usize,
}

/// A job that has not ended.
#[derive(Debug)]
pub(super) struct Unfinished {
    pub(super) id: JobId,
    pub(super) lab: usize,
    pub(super) priority: i64,
    pub(super) waits: bool,
    /// Planned CPU-seconds that are left of its tiles and pilot.
    pub(super) tiles: f64,
    /// Planned CPU-seconds that are left of its other tasks.
    pub(super) others: f64,
}

impl Forecast {
    /// Seconds until a job ends, from the work left of its tiles and of its other tasks; `None` without workers for
    /// both. `own_rate` is what a planned CPU-second of its tiles has taken so far: its tiles converge about as
    /// early as each other.
    pub(crate) fn eta_seconds(
        &self,
        job: JobId,
        (tiles, others): (Left, Left),
        own_rate: Option<f64>,
    ) -> Option<f64> {
        if self.tiles.workers == 0 || self.others.workers == 0 {
            return None;
        }
        let ahead = self.ahead(job).seconds;
        let tiles = self.tiles.seconds(tiles, own_rate.unwrap_or(self.tiles.rate()));
        let others = self.others.seconds(others, self.others.rate());
        Some(ahead + tiles.sum + others.sum + tiles.longest.max(others.longest))
    }

    /// Seconds that a worker takes for planned CPU-seconds of a task that is no tile; `None` without a worker.
    pub(crate) fn other_seconds(&self, cost: f64) -> Option<f64> {
        (self.others.workers > 0).then(|| self.others.rate() * cost)
    }

    /// The place of a job that waits among all that do, from 1.
    pub(crate) fn position(&self, job: JobId) -> usize {
        self.ahead(job).position
    }

    /// For the workers of tiles and those of other tasks. `labs` has the name and the share of each lab.
    pub(super) fn new(
        unfinished: &[Unfinished],
        labs: Vec<(Lab, f64)>,
        tiles: Crew,
        others: Crew,
    ) -> Self {
        let shares: Vec<f64> = labs.iter().map(|(_, share)| *share).collect();
        let mut left = vec![0.0; labs.len()];
        for job in unfinished {
            left[job.lab] += job.tiles + job.others;
        }
        // Without workers the order alone matters.
        let speed = |crew: Crew| if crew.workers == 0 { 1.0 } else { crew.speed };
        let seconds: Vec<f64> = unfinished
            .iter()
            .map(|job| job.tiles / speed(tiles) + job.others / speed(others))
            .collect();
        let new_job = Ahead {
            seconds: seconds.iter().sum(),
            position: 1 + unfinished.iter().filter(|job| job.waits).count(),
        };
        Self {
            tiles,
            others,
            jobs: ahead(unfinished, &seconds, &shares),
            new_job,
            left_by_lab: labs.into_iter().map(|(lab, _)| lab).zip(left).collect(),
            until: Instant::now() + (KEPT_PER_JOB * count(unfinished.len())).min(KEPT_AT_MOST),
        }
    }

    /// False once it should be renewed.
    pub(super) fn is_good(&self) -> bool {
        Instant::now() < self.until
    }

    /// True if it takes so long to make that callers should not wait for a new one.
    pub(super) fn is_long(&self) -> bool {
        self.jobs.len() > LONG
    }

    pub(super) fn is_outdated(&self) -> bool {
        Instant::now() > self.until + OUTDATED
    }

    fn ahead(&self, job: JobId) -> Ahead {
        self.jobs.get(&job).copied().unwrap_or(self.new_job)
    }
}

fn count(things: usize) -> u32 {
    u32::try_from(things).unwrap_or(u32::MAX)
}

/// The load ahead of each of these jobs, which are in the order of their submission. `seconds` are left of each job, and
/// `shares` are those of the labs.
fn ahead(jobs: &[Unfinished], seconds: &[f64], shares: &[f64]) -> HashMap<JobId, Ahead> {
    let mut by_priority: BTreeMap<i64, Vec<(&Unfinished, f64)>> = BTreeMap::new();
    for (job, left) in jobs.iter().zip(seconds) {
        by_priority.entry(job.priority).or_default().push((job, *left));
    }
    let (mut above, mut found) = (0.0, Vec::with_capacity(jobs.len()));
    for jobs in by_priority.into_values().rev() {
        let mut wanted = vec![0.0; shares.len()];
        for (job, left) in &jobs {
            wanted[job.lab] += left;
        }
        let mut earlier = vec![0.0; shares.len()];
        for (job, left) in jobs {
            let served = earlier[job.lab] + left;
            let others: f64 = (0..shares.len())
                .filter(|lab| *lab != job.lab)
                .map(|lab| wanted[lab].min(served * shares[lab] / shares[job.lab]))
                .sum();
            let before = above + earlier[job.lab] + others;
            found.push((job, before, before + left));
            earlier[job.lab] = served;
        }
        above += wanted.iter().sum::<f64>();
    }
    // The job that ends first is served first; of two equal jobs, the older one.
    found.sort_by(|(a, _, end_a), (b, _, end_b)| {
        b.priority.cmp(&a.priority).then(end_a.total_cmp(end_b))
    });
    let mut position = 1;
    let mut placed = HashMap::with_capacity(found.len());
    for (job, seconds, _) in found {
        placed.insert(job.id, Ahead { seconds, position });
        position += usize::from(job.waits);
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::{Ahead, Crew, Forecast, JobId, Left, Unfinished, ahead};

    fn unfinished(lab: usize, priority: i64, (tiles, others): (f64, f64)) -> Unfinished {
        Unfinished { id: JobId::new(), lab, priority, waits: true, tiles, others }
    }

    /// Planned seconds ahead of each job and its place, from its lab, its priority and the seconds left of it.
    fn served(jobs: &[(usize, i64, f64)], shares: &[f64]) -> Vec<(f64, usize)> {
        let seconds: Vec<_> = jobs.iter().map(|(.., left)| *left).collect();
        let jobs: Vec<_> = jobs
            .iter()
            .map(|&(lab, priority, left)| unfinished(lab, priority, (left, 0.0)))
            .collect();
        let found = ahead(&jobs, &seconds, shares);
        let figures = |Ahead { seconds, position }| (seconds, position);
        jobs.iter().map(|job| figures(found[&job.id])).collect()
    }

    #[test]
    fn jobs_of_one_lab_wait_for_older_and_for_urgent_jobs() {
        let jobs = [(0, 0, 10.0), (0, 0, 20.0), (0, 5, 3.0)];
        assert_eq!(served(&jobs, &[1.0]), [(3.0, 2), (13.0, 3), (0.0, 1)]);
    }

    /// Workers do a planned second of other tasks ten times slower than one of tiles.
    #[test]
    fn a_later_job_does_not_end_earlier() {
        let jobs = [unfinished(0, 0, (10.0, 10.0)), unfinished(0, 0, (10.0, 0.0))];
        let crew = |speed| Crew { workers: 1, speed };
        let labs = vec![("optics".parse().unwrap(), 1.0)];
        let forecast = Forecast::new(&jobs, labs, crew(10.0), crew(1.0));
        let left = |sum| Left { sum, longest: 0.0 };
        let end = |job: &Unfinished| {
            forecast.eta_seconds(job.id, (left(job.tiles), left(job.others)), None).unwrap()
        };
        assert_eq!((end(&jobs[0]), end(&jobs[1])), (11.0, 12.0));
        assert_eq!(jobs.each_ref().map(|job| forecast.position(job.id)), [1, 2]);
    }

    #[test]
    fn labs_are_served_side_by_side_by_their_shares() {
        let jobs = [(0, 0, 60.0), (0, 0, 60.0), (1, 0, 30.0)];
        // While the second lab gets its 30, the first one gets 30 too; it has had all by then that it wants.
        assert_eq!(served(&jobs, &[1.0, 1.0]), [(30.0, 2), (90.0, 3), (30.0, 1)]);
        assert_eq!(served(&jobs, &[1.0, 2.0])[2], (15.0, 1));
    }
}
