//! Snapshot compressive imaging, from coded measurement to video, as an HTTP service.
//!
//! The core makes video of arrays: [`formats`], [`optics`], [`recon`], [`job`], [`intake`] and
//! [`pipeline`] are its modules. Around it stands the service: the [`store`] keeps what lasts, a
//! [`worker`] takes its tasks to the pipeline, the [`cluster`] brings them to workers on other
//! machines, [`http`] is how lab machines reach all of it, and [`cli`] has the commands.

pub use sci_recon_core::{formats, intake, job, optics, pipeline, recon};

pub mod cli;
#[cfg(feature = "nats")]
pub mod cluster;
pub mod config;
pub mod http;
pub mod store;
pub mod worker;
