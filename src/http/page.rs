//! Pages of lists, and query parameters that several routes share.

use std::str::FromStr;

use axum::response::Response;
use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use serde::{Deserialize, Serialize};
use serde_with::DeserializeFromStr;

use super::context::RequestContext;
use super::error::ApiError;
use engine::job::{CalibrationId, Label, Timestamp};
use store::{Filter, Page, Span};

/// Default number of items on a page.
const DEFAULT: u32 = 50;
/// Largest number of items on a page.
const MAX: u32 = 200;

/// The parameter `limit` of a list: the number of items on a page, from 1 to 200.
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

/// The query of a list that is not filtered.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, bound = "Id: FromStr")]
pub(super) struct PageQuery<Id> {
    #[serde(default)]
    pub(super) limit: Limit,
    pub(super) cursor: Option<Cursor<Id>>,
}

/// The query of a list of resources that belong to calibrations.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields, bound = "Id: FromStr")]
pub(super) struct ListQuery<Id> {
    #[serde(default)]
    pub(super) limit: Limit,
    pub(super) cursor: Option<Cursor<Id>>,
    pub(super) calibration: Option<CalibrationId>,
    pub(super) created_after: Option<Timestamp>,
    pub(super) created_before: Option<Timestamp>,
}

impl<Id> ListQuery<Id> {
    pub(super) fn filter(self) -> Filter<Id> {
        let created = Span { from: self.created_after, before: self.created_before };
        let after = self.cursor.map(|Cursor(id)| id);
        Filter { calibration: self.calibration, created, after }
    }
}

/// The place in a list after which a page begins. Clients see opaque text.
#[derive(Debug, Clone, Copy, DeserializeFromStr)]
pub(super) struct Cursor<T>(pub(super) T);

impl<T: FromStr> FromStr for Cursor<T> {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let bytes = URL_SAFE_NO_PAD.decode(text).ok();
        let place = bytes.and_then(|bytes| String::from_utf8(bytes).ok()?.parse().ok());
        place.map(Self).ok_or("cursor is invalid for this list: use the value of next_cursor")
    }
}

/// The new name of a resource; null removes the name.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[derive(schemars::JsonSchema)]
#[schemars(extend("required" = ["name"]))]
pub(super) struct Renaming {
    /// Required, because an omitted name is more likely a mistake.
    #[serde(deserialize_with = "Option::deserialize")]
    pub(super) name: Option<Label>,
}

#[derive(Debug, Serialize, schemars::JsonSchema)]
#[schemars(rename = "{T}Page")]
pub(super) struct PageBody<T> {
    items: Vec<T>,
    /// Cursor of the next page; null on the last page.
    next_cursor: Option<String>,
}

impl<T: Serialize> PageBody<T> {
    /// Converts a page of records with `show`; `place` gives the cursor after a record.
    pub(super) fn new<R>(
        page: Page<R>,
        place: impl Fn(&R) -> String,
        show: impl Fn(R) -> T,
    ) -> Self {
        let last = page.items.last().filter(|_| page.more);
        let next_cursor = last.map(|item| URL_SAFE_NO_PAD.encode(place(item)));
        Self { items: page.items.into_iter().map(show).collect(), next_cursor }
    }

    /// The answer, with the link to the next page.
    pub(super) fn answer(&self, request: &RequestContext) -> Result<Response, ApiError> {
        request.page(self, self.next_cursor.as_deref())
    }
}
