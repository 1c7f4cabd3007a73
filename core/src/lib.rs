//! Snapshot compressive imaging without a service: from files to video.
//!
//! The modules follow the way of the data: bytes become arrays in [`formats`], [`optics`] makes
//! masks and measurements where no camera does, [`intake`] takes in what a lab sends, a [`job`] says
//! what is to be done, arrays become video in [`recon`], and the [`pipeline`] does so tile by tile
//! and writes the results.

pub mod formats;
pub mod intake;
pub mod job;
pub mod optics;
pub mod pipeline;
pub mod recon;
