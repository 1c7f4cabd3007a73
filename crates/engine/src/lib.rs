//! What happens to a job, from files to video: no SQL, no HTTP.
//!
//! A [`job`] says what is to be done: identifiers, validated requests, states and their legal steps. [`intake`]
//! turns a lab's files into checked arrays. The [`pipeline`] reconstructs them tile by tile and writes the results.

pub mod intake;
pub mod job;
pub mod pipeline;
