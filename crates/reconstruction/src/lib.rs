//! The reconstruction core: arrays in, arrays out.
//!
//! A snapshot `y = sum_k C_k x_k` of `B` frames, or a run of snapshots (see [`sequence`]), has a sensing operator
//! ([`operator`]). [`solver::reconstruct`] alternates its projection with the [`priors`] of a [`schedule`]. The iteration
//! itself, Algorithm 1 of the paper, is in `gap.rs`. A [`learned`] network does without both. All arrays are `f32` with axes
//! (frame, row, column); frames and masks are on \[0,1\].

#![warn(missing_docs)]

mod admm;
pub mod assessment;
mod bounds;
pub mod cores;
pub mod crop;
mod defaults;
pub mod error;
pub mod evidence;
mod fields;
mod gap;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod hold_out;
mod iterate;
pub mod joints;
pub mod learned;
pub mod metrics;
pub mod motion;
pub mod operator;
pub mod order;
pub mod pilot;
pub mod preview;
pub mod priors;
pub mod progress;
pub mod projection;
pub mod quality;
#[cfg(test)]
#[path = "tests/reference.rs"]
mod reference;
pub mod registration;
#[cfg(feature = "gpu")]
mod resident;
pub mod scale;
pub mod schedule;
pub mod sequence;
pub mod signs;
pub mod solver;
#[cfg(feature = "gpu")]
pub mod speed;
pub mod stage;
mod state;
mod static_regions;
pub mod tile;
mod trial;
pub mod unmeasured;

pub use error::ReconError;
