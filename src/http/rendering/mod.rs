//! Windows of large pictures, reduced for display. Knows neither jobs nor requests.

mod cache;
mod render;

pub(super) use cache::Pictures;
pub(super) use render::{Picture, Region, TILE, spread};
