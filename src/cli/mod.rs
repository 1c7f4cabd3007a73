//! The commands, one file each.

mod logging;
mod supervisor;

pub mod serve;
