//! The commands, one file each.

// Only `output` prints: it handles a reader that closes the pipe.
#![deny(clippy::print_stdout)]

mod arguments;
mod audited;
mod client;
mod command_line;
mod confine;
mod error;
mod exec;
mod guard;
mod logging;
mod maintenance;
mod manifest;
mod masks;
mod model;
mod output;
mod progress;
mod settings;
mod shell;
mod stop;
mod submission;
mod supervisor;
mod verdict;
mod wait;

pub mod backup;
pub mod calibrate;
pub mod cancel;
pub mod check_model;
pub mod cluster;
pub mod demo;
pub mod devices;
pub mod fetch;
mod fields;
pub mod health;
pub mod job;
pub mod lab;
pub mod ls;
pub mod optics;
pub mod reconstruct;
pub mod run_model;
pub mod schedule;
pub mod serve;
pub mod simulate;
pub mod submit;
pub mod token;
pub mod verify;
pub mod watch;
pub mod watch_folder;
pub mod worker;

pub use arguments::{NetworkArguments, algorithms};
pub use command_line::run;
pub use error::CliError;
pub use masks::{MaskArguments, SimulatedMasks};
pub use model::{Model, cut};
pub use optics::OpticsFile;
