//! The service: how lab machines reach the reconstruction over HTTP, and the commands of the program.

pub mod cli;
pub mod config;
pub mod http;
