//! The HTTP interface. `openapi.yaml` is its contract, [`router()`] its table of contents.
//!
//! Handlers are thin: take the request apart, make one or two calls, answer. Errors are
//! problem+json (RFC 9457); [`error`] has the only table of status codes.

mod access;
mod admission;
mod algorithms;
mod app;
mod asset;
mod audit;
mod blobs;
mod calibrations;
mod client;
mod client_places;
mod conditional;
mod context;
mod contract;
mod dashboard;
mod download;
pub mod error;
mod events;
mod exports;
mod extract;
mod intake;
mod jobs;
mod labs;
mod layers;
mod listen;
mod me;
mod measurements;
mod metrics;
mod models;
mod negotiation;
mod observation;
mod origins;
mod page;
mod pictures;
mod problems;
mod quality;
mod rate;
mod reference;
mod rendering;
mod reports;
mod results;
mod revocation;
mod router;
mod samples;
mod session;
mod shares;
mod sign_ins;
mod strict;
mod submissions;
mod system;
mod throttle;
mod tiles;
mod truth;
mod turnover;
pub mod tus;
mod upload;
mod write_deadline;

pub use app::{App, Machine};
pub use listen::listen;
pub use metrics::Metrics;
pub use router::{Route, router, routes};
