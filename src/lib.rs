//! The service, which lab machines use over HTTP, and the commands of the program.

pub mod audit;
pub mod cli;
pub mod config;
pub mod http;
mod webhooks;
