//! `sci-recon lab`: the labs that a service has, and their shares of the machine.

use std::io::Write;
use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::CliError;
use super::wait::wait;
use crate::cli::error::Result;
use crate::job::Lab;
use crate::store::{LabRow, Purpose, Store};

/// Lists labs and sets their shares of the machine. The service may be running.
///
/// Tasks are handed out by priority, then to each lab in turn. While two labs have work waiting, one with
/// twice the share gets twice the processor time.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder of the service's data.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    data: PathBuf,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Shows all labs with their share, and what they have waiting.
    List,
    /// Sets what a lab is entitled to.
    Set {
        /// The lab's name.
        lab: Lab,
        /// Its share of the machine, beside the shares of the other labs; every lab begins with 1.
        #[arg(long, value_name = "N", value_parser = share)]
        share: f64,
    },
}

fn share(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|_| format!("{text:?} is no number"))?;
    if (0.001..=1000.0).contains(&share) {
        return Ok(share);
    }
    Err("a share is a number from 0.001 to 1000".into())
}

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let store = Store::open(&arguments.data, Purpose::Use).await?;
        if let Action::Set { lab, share } = &arguments.action {
            store.set_share(lab, *share).await?;
        }
        let text = table(&store.labs().await?);
        store.close().await;
        let mut stdout = std::io::stdout();
        writeln!(stdout, "{text}").map_err(|error| CliError::Failure(error.to_string()))
    })
}

fn table(labs: &[LabRow]) -> String {
    let head = format!("{:40}  {:>8}  {:>8}  {:>16}", "lab", "share", "jobs", "CPU seconds left");
    let line = |lab: &LabRow| {
        let LabRow { lab, share, jobs, cost_left } = lab;
        format!("{:40}  {share:>8}  {jobs:>8}  {cost_left:>16.0}", lab.as_str())
    };
    std::iter::once(head).chain(labs.iter().map(line)).collect::<Vec<_>>().join("\n")
}
