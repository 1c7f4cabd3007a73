//! How the solver went, in as many points as a plot can show.

use serde_json::{Value, json};

use crate::recon::solver::Progress;

/// The most points that are kept, beside the last.
const POINTS: usize = 128;

/// What an iteration told.
#[derive(Debug, Clone, Copy)]
struct Point {
    iteration: usize,
    residual: f32,
    change: f32,
    sigma: Option<f32>,
}

/// A record of iterations that is thinned out as it grows: of many, every second, fourth, eighth ...
/// is kept, and always the last.
#[derive(Debug, Default)]
pub struct History {
    points: Vec<Point>,
    last: Option<Point>,
    /// Iterations seen, of which each 2^`thinned`-th is kept.
    seen: usize,
    thinned: u32,
}

impl History {
    /// Takes note of an iteration.
    pub fn note(&mut self, progress: &Progress) {
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
            self.thinned += 1;
        }
        if self.seen.is_multiple_of(1 << self.thinned) {
            self.points.push(point);
        }
        self.seen += 1;
        self.last = Some(point);
    }

    /// \[\[iteration, residual, change, sigma or null\], ...\] as JSON.
    pub fn to_json(&self) -> String {
        let kept = self.points.last().map(|point| point.iteration);
        let last = self.last.filter(|last| Some(last.iteration) != kept);
        let show = |point: &Point| {
            let sigma = point.sigma.map_or(Value::Null, rounded);
            json!([point.iteration, rounded(point.residual), rounded(point.change), sigma])
        };
        Value::from_iter(self.points.iter().chain(&last).map(show)).to_string()
    }
}

/// Four digits are more than a plot shows.
fn rounded(value: f32) -> Value {
    let text = format!("{value:.3e}");
    // What is not finite has no place in JSON.
    text.parse::<f64>().ok().filter(|value| value.is_finite()).into()
}

#[cfg(test)]
mod tests {
    use super::{History, POINTS};
    use crate::recon::solver::Progress;
    use serde_json::Value;

    fn after(iterations: usize) -> Vec<Value> {
        let mut history = History::default();
        for done in 1..=iterations {
            let (residual, change) = (1.0 / done as f32, f32::INFINITY);
            let sigma = (done % 2 == 0).then_some(0.1);
            history.note(&Progress {
                stage: 0,
                done,
                planned: 9,
                residual,
                change,
                sigma,
                deep: false,
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
}
