//! Workers on other machines, over NATS JetStream.
//!
//! The store remains the authority. The *hub*, a part of the server, claims tiles from it and keeps them while they
//! are out. NATS owns the deliveries in flight. A worker owns only a cache. Other tasks stay on the server's machine.
//! A worker needs one address and one credential. It dials out, opens no port, and sees neither the database nor files.
//!
//! A tile passes through these steps:
//!
//! 1. The hub claims the tile, cuts its windows, puts missing ones into the stream of inputs, and publishes a message.
//! 2. A worker pulls the message and asks the hub whether to begin. It gets the inputs from its cache or the stream.
//! 3. The worker computes, puts the frames into the stream of outputs, and publishes an event.
//! 4. Only then does it acknowledge the message. If it dies before, the message is delivered again.
//! 5. The hub fetches the frames, checks hash, values and residual, and completes the task in the store. The store
//!    accepts one report of each attempt.
//!
//! A random sample of tiles is computed twice, by two workers.

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
pub use hub::{Hub, HubSettings, describe_metrics};
pub use message::Program;
pub use remote::{Remote, RemoteSettings};
