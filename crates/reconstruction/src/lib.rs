//! The reconstruction core: arrays in, arrays out.
//!
//! A snapshot `y = sum_k C_k x_k` of `B` frames, or a run of them (see [`sequence`]), goes through a
//! [`sensing::SensingOperator`]; [`solver::reconstruct`] alternates its projection with the priors that a
//! [`schedule::Schedule`] names. A [`learned`] network does without both. All arrays are `f32` with axes
//! (frame, row, column); frames and masks live on \[0,1\].

#![warn(missing_docs)]

pub mod assessment;
mod defaults;
pub mod error;
mod held_out;
pub mod joints;
pub mod learned;
pub mod metrics;
pub mod motion;
pub mod pilot;
pub mod preview;
pub mod prior;
mod rest;
pub mod scale;
pub mod schedule;
pub mod sensing;
pub mod sequence;
pub mod signs;
pub mod solver;
pub mod tile;

pub use error::ReconError;
