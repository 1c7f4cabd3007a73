//! Workers on other machines, over NATS JetStream.
//!
//! The store stays the truth. In its eyes the *hub*, a part of the server, claims tiles and holds them
//! for as long as they are out; NATS owns the deliveries in flight; a worker owns nothing but a cache.
//! Tiles alone leave the machine. A worker needs one address and one credential: it dials out, opens no
//! port, and sees neither database nor files.
//!
//! The life of a tile: the hub claims it, cuts its windows, puts what is absent into the stream of
//! inputs and publishes a message. A worker pulls the message, tells that it begins, gets the inputs
//! from its cache or the stream, computes, puts the frames into the stream of outputs, publishes an
//! event, and only then acknowledges the message: if it dies before, the message is delivered again.
//! The hub fetches the frames, checks their hash and completes the task in the store, which accepts
//! one report of each attempt.

mod arrays;
mod authority;
mod blobs;
mod cache;
mod check;
pub mod configuration;
mod connection;
mod hub;
mod message;
mod names;
mod remote;
mod setup;

pub use authority::{Authority, HUB as HUB_CREDENTIAL, Issued};
pub use check::Check;
pub use configuration::{Node, ServerVersion};
pub use connection::{Access, ClusterError, Credential};
pub use hub::{Hub, describe_metrics};
pub use message::Program;
pub use remote::{Remote, RemoteSettings};
