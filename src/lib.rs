//! Snapshot compressive imaging, from coded measurement to video, as an HTTP service.
//!
//! The modules follow the way of the data: bytes become arrays in [`formats`], arrays
//! become video in [`recon`].

pub mod cli;
pub mod config;
pub mod formats;
pub mod http;
pub mod job;
pub mod models;
pub mod recon;
pub mod store;
