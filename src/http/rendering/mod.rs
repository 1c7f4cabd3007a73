//! Reads regions of large pictures, reduced for display. Independent of jobs and of HTTP.

mod cache;
mod render;

pub(super) use cache::Pictures;
pub(super) use render::{Picture, Region, Spread, TILE, spread};
