//! The reconstruction core: arrays in, arrays out.
//!
//! A snapshot `y = sum_k C_k x_k` of `B` frames goes through a [`sensing::SensingOperator`];
//! [`gap::reconstruct`] alternates its projection with the priors that a
//! [`schedule::Schedule`] names. A [`learned`] network does without both. All arrays are `f32` with axes (frame, row, column); frames
//! and masks live on \[0,1\].

mod change;
mod defaults;
pub mod denoise;
pub mod error;
pub mod gap;
pub mod learned;
pub mod metrics;
pub mod pilot;
pub mod preview;
pub mod scale;
pub mod schedule;
pub mod sensing;
pub mod tile;

pub use error::ReconError;
