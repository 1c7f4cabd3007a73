//! The order in which waiting jobs are served, and what that means in seconds.
//!
//! A task of a higher priority goes first. At the same priority labs take turns by their shares, and a
//! lab's jobs go one after the other: when the lab of a job has been served `w` CPU-seconds, another
//! lab has been served `w` times the ratio of their shares, or all that it wanted.

use std::collections::{BTreeMap, HashMap};
use std::time::{Duration, Instant};

use engine::job::JobId;

/// A forecast is good for so long for each job in it, about twenty times as long as it takes to make: it
/// costs a twentieth of a core, however many ask.
const KEPT_PER_JOB: Duration = Duration::from_micros(50);
const KEPT_AT_MOST: Duration = Duration::from_secs(1);

/// What is ahead of every unfinished job.
#[derive(Debug)]
pub struct Forecast {
    workers: u32,
    /// Seconds that a planned CPU-second of a tile takes.
    rate: f64,
    /// The same of all other tasks: reading and writing are not as fast as computing is.
    others_rate: f64,
    jobs: HashMap<JobId, Ahead>,
    /// What is ahead of a job that was not there yet.
    of_a_new_one: Ahead,
    until: Instant,
}

/// Planned CPU-seconds that are left of some tasks of a job.
#[derive(Debug, Clone, Copy)]
pub struct Left {
    /// Of all of them.
    pub(crate) sum: f64,
    /// Of the one that has most left.
    pub(crate) longest: f64,
}

/// What is served before a job.
#[derive(Debug, Clone, Copy)]
struct Ahead {
    /// Planned CPU-seconds.
    cost: f64,
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
    /// Planned CPU-seconds that are left of it.
    pub(super) left: f64,
}

impl Forecast {
    /// Seconds until a job ends, of whose tiles and other tasks so much is left; none if no worker lives.
    /// `own_rate` is what a planned CPU-second of its tiles has taken so far: its tiles converge
    /// about as early as each other.
    pub(crate) fn eta_seconds(
        &self,
        job: JobId,
        (tiles, others): (Left, Left),
        own_rate: Option<f64>,
    ) -> Option<f64> {
        let workers = f64::from(self.workers);
        let own = own_rate.unwrap_or(self.rate);
        let ahead = self.ahead(job).cost;
        let left = self.rate * ahead + self.others_rate * others.sum + own * tiles.sum;
        let longest = (self.others_rate * others.longest).max(own * tiles.longest);
        let seconds = left / workers + (1.0 - 1.0 / workers) * longest;
        (self.workers > 0).then_some(seconds)
    }

    /// The place of a job that waits among all that do, from 1.
    pub(crate) fn position(&self, job: JobId) -> usize {
        self.ahead(job).position
    }

    /// For as many workers, which take these seconds for a planned CPU-second of tiles and of other tasks.
    pub(super) fn new(
        unfinished: &[Unfinished],
        shares: &[f64],
        workers: usize,
        (rate, others_rate): (f64, f64),
    ) -> Self {
        let of_a_new_one = Ahead {
            cost: unfinished.iter().map(|job| job.left).sum(),
            position: 1 + unfinished.iter().filter(|job| job.waits).count(),
        };
        Self {
            workers: count(workers),
            rate,
            others_rate,
            jobs: ahead(unfinished, shares),
            of_a_new_one,
            until: Instant::now() + (KEPT_PER_JOB * count(unfinished.len())).min(KEPT_AT_MOST),
        }
    }

    /// False once it should be made anew.
    pub(super) fn is_good(&self) -> bool {
        Instant::now() < self.until
    }

    fn ahead(&self, job: JobId) -> Ahead {
        self.jobs.get(&job).copied().unwrap_or(self.of_a_new_one)
    }
}

fn count(things: usize) -> u32 {
    u32::try_from(things).unwrap_or(u32::MAX)
}

/// What is ahead of each of these jobs, which stand in the order in which they came, with the shares of
/// the labs.
fn ahead(jobs: &[Unfinished], shares: &[f64]) -> HashMap<JobId, Ahead> {
    let mut by_priority: BTreeMap<i64, Vec<&Unfinished>> = BTreeMap::new();
    for job in jobs {
        by_priority.entry(job.priority).or_default().push(job);
    }
    let (mut above, mut found) = (0.0, Vec::with_capacity(jobs.len()));
    for jobs in by_priority.into_values().rev() {
        let mut wanted = vec![0.0; shares.len()];
        for job in &jobs {
            wanted[job.lab] += job.left;
        }
        let mut earlier = vec![0.0; shares.len()];
        for job in jobs {
            let served = earlier[job.lab] + job.left;
            let others: f64 = (0..shares.len())
                .filter(|lab| *lab != job.lab)
                .map(|lab| wanted[lab].min(served * shares[lab] / shares[job.lab]))
                .sum();
            found.push((job, above + earlier[job.lab] + others));
            earlier[job.lab] = served;
        }
        above += wanted.iter().sum::<f64>();
    }
    // Who ends first is served first; a job that came earlier stands before an equal one.
    found.sort_by(|(a, before_a), (b, before_b)| {
        b.priority.cmp(&a.priority).then((before_a + a.left).total_cmp(&(before_b + b.left)))
    });
    let mut position = 1;
    let mut placed = HashMap::with_capacity(found.len());
    for (job, cost) in found {
        placed.insert(job.id, Ahead { cost, position });
        position += usize::from(job.waits);
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::{Ahead, JobId, Unfinished, ahead};

    /// Planned seconds ahead of jobs, and their places, from lab, priority and what is left of each.
    fn served(jobs: &[(usize, i64, f64)], shares: &[f64]) -> Vec<(f64, usize)> {
        let jobs: Vec<_> = jobs
            .iter()
            .map(|&(lab, priority, left)| Unfinished {
                id: JobId::new(),
                lab,
                priority,
                waits: true,
                left,
            })
            .collect();
        let found = ahead(&jobs, shares);
        let figures = |Ahead { cost, position }| (cost, position);
        jobs.iter().map(|job| figures(found[&job.id])).collect()
    }

    #[test]
    fn jobs_of_one_lab_wait_for_those_before_them_and_for_urgent_ones() {
        let jobs = [(0, 0, 10.0), (0, 0, 20.0), (0, 5, 3.0)];
        assert_eq!(served(&jobs, &[1.0]), [(3.0, 2), (13.0, 3), (0.0, 1)]);
    }

    #[test]
    fn labs_are_served_side_by_side_by_their_shares() {
        let jobs = [(0, 0, 60.0), (0, 0, 60.0), (1, 0, 30.0)];
        // While the second lab gets its 30, the first one gets 30 too; it has had all by then that it wants.
        assert_eq!(served(&jobs, &[1.0, 1.0]), [(30.0, 2), (90.0, 3), (30.0, 1)]);
        assert_eq!(served(&jobs, &[1.0, 2.0])[2], (15.0, 1));
    }
}
