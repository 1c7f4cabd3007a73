//! The commands, one file each.

mod arguments;
mod confine;
mod error;
#[cfg(feature = "nats")]
mod guard;
mod logging;
mod maintenance;
mod masks;
mod model;
mod progress;
mod supervisor;
mod wait;

pub mod backup;
pub mod calibrate;
pub mod check_model;
#[cfg(feature = "nats")]
pub mod cluster;
pub mod demo;
pub mod health;
pub mod job;
pub mod lab;
pub mod optics;
pub mod reconstruct;
pub mod schedule;
pub mod serve;
pub mod settings;
pub mod shell;
pub mod simulate;
pub mod token;
pub mod verify;
pub mod worker;

pub use arguments::{NetworkArguments, algorithms};
pub use error::CliError;
pub use masks::{MaskArguments, SimulatedMasks};
pub use model::{Model, cut};
pub use optics::OpticsFile;
