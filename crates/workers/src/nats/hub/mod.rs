//! The part of the server that hands tiles out to other machines and takes their frames in.

mod accept;
mod compare;
mod core;
mod dispatch;
mod error;
mod events;
mod figures;
mod presence;
mod replays;
mod requests;
mod run;
mod sweep;

pub use figures::describe as describe_metrics;
pub use run::{Hub, HubSettings};
