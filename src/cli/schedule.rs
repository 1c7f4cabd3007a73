//! `sci-recon schedule`: prints the default schedule of an algorithm, for editing.

use clap::Args;
use serde_json::json;

use super::arguments::ScheduleArguments;
use super::output::print_line;
use crate::cli::error::Result;

/// Print the schedule of an algorithm as JSON.
///
/// Edit it and pass it as --schedule, or as the field `schedule` of a job. With --schedule, the command checks that
/// file.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    schedule: ScheduleArguments,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let schedule = arguments.schedule.resolve()?;
    print_line(format!("{:#}", json!(schedule)))
}
