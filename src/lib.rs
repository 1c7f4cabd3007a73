//! Snapshot compressive imaging, from coded measurement to video, as an HTTP service.
//!
//! The modules follow the way of the data: bytes become arrays in [`formats`], [`optics`] makes
//! masks and measurements where no camera does, [`intake`] takes in what a lab sends, arrays become
//! video in [`recon`], and the [`pipeline`] does so tile by tile and writes the results. A [`job`] says
//! what is to be done, the [`store`] keeps what lasts, a [`worker`] takes its tasks to the pipeline, the
//! [`cluster`] brings them to workers on other machines, [`http`] is how lab machines reach all of it, and [`cli`] has the commands.

pub mod cli;
#[cfg(feature = "nats")]
pub mod cluster;
pub mod config;
pub mod formats;
pub mod http;
pub mod intake;
pub mod job;
pub mod optics;
pub mod pipeline;
pub mod recon;
pub mod store;
pub mod worker;
