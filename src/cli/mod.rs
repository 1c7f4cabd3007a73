//! The commands, one file each.

mod arguments;
mod error;
mod input;
mod progress;

pub mod reconstruct;
pub mod simulate;

pub use error::CliError;
