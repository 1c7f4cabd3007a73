//! Pages of lists, and queries that several kinds of things share.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::app::App;
use engine::job::{CalibrationId, Label, Timestamp};
use store::{Filter, Page, Span};

/// How many items a page has where nobody says.
const DEFAULT: u32 = 50;
/// How many items a page has at most.
const MAX: u32 = 200;

/// The `limit` of a list, on 1 to 200.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(try_from = "u32")]
pub(super) struct Limit(u32);

impl Default for Limit {
    fn default() -> Self {
        Self(DEFAULT)
    }
}

impl TryFrom<u32> for Limit {
    type Error = String;

    fn try_from(limit: u32) -> Result<Self, String> {
        if (1..=MAX).contains(&limit) {
            return Ok(Self(limit));
        }
        Err(format!("limit is {limit}; it must be from 1 to {MAX}"))
    }
}

impl Limit {
    pub(super) fn get(self) -> u32 {
        self.0
    }
}

/// The query of a list of things that belong to calibrations.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ListQuery<Id> {
    #[serde(default)]
    pub(super) limit: Limit,
    pub(super) cursor: Option<Id>,
    pub(super) calibration: Option<CalibrationId>,
    pub(super) created_after: Option<Timestamp>,
    pub(super) created_before: Option<Timestamp>,
}

impl<Id> ListQuery<Id> {
    pub(super) fn filter(self) -> Filter<Id> {
        let created = Span { from: self.created_after, before: self.created_before };
        Filter { calibration: self.calibration, created, after: self.cursor }
    }
}

/// The query of something that comes to an end.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ShowQuery {
    #[serde(default)]
    wait: Wait,
}

impl ShowQuery {
    /// How long to wait; none for not at all.
    pub(super) fn wait(&self, app: &App) -> Option<Duration> {
        // A proxy, or the limit on the time of answers, must not come first.
        let longest = app.settings.request_time() / 2;
        (self.wait.0 > 0.0).then(|| Duration::from_secs_f64(self.wait.0).min(longest))
    }
}

/// Seconds to wait for the end of what is shown, on 0 to 20.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(try_from = "f64")]
struct Wait(f64);

impl TryFrom<f64> for Wait {
    type Error = String;

    fn try_from(seconds: f64) -> Result<Self, String> {
        if (0.0..=20.0).contains(&seconds) {
            return Ok(Self(seconds));
        }
        Err(format!("wait is {seconds}; it must be from 0 to 20 seconds"))
    }
}

/// The body of a request that gives a thing another name, or none.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Renaming {
    /// Needed: that it is left out is more likely to be a mistake.
    #[serde(deserialize_with = "Option::deserialize")]
    pub(super) name: Option<Label>,
}

#[derive(Debug, Serialize)]
pub(super) struct PageBody<T> {
    items: Vec<T>,
    /// What to send as `cursor` for the next page; null on the last one.
    next_cursor: Option<String>,
}

impl<T> PageBody<T> {
    /// The page with its items as they are shown; `id` gives the cursor after an item.
    pub(super) fn new<R>(page: Page<R>, id: impl Fn(&R) -> String, show: impl Fn(R) -> T) -> Self {
        let next_cursor = if page.more { page.items.last().map(id) } else { None };
        Self { items: page.items.into_iter().map(show).collect(), next_cursor }
    }
}
