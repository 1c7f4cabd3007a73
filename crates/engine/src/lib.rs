//! The processing of jobs from files to video, without SQL and HTTP.
//!
//! [`job`] is the data model: identifiers, validated requests, states and their transitions. [`intake`] reads and
//! checks the files of a lab. [`pipeline`] reconstructs them tile by tile and writes the results.

pub mod intake;
pub mod job;
pub mod pipeline;
