//! `sci-recon schedule`: what an algorithm does by itself, as a file to change.

use clap::Args;
use serde_json::json;

use super::arguments::ScheduleArguments;
use crate::cli::error::Result;

/// Print the schedule of an algorithm as JSON: the start of a file for `reconstruct --schedule`, or
/// of the field `schedule` of a job. With --schedule it checks a file of your own.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    schedule: ScheduleArguments,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let schedule = arguments.schedule.resolve()?;
    println!("{:#}", json!(schedule));
    Ok(())
}
