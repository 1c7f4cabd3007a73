//! `sci-recon lab`: the labs that a service has, their shares of the machine, and their limits.

use std::io::Write;
use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::CliError;
use super::wait::wait;
use crate::cli::error::Result;
use crate::job::Lab;
use crate::store::{Entitlement, LabRow, Purpose, Store};

/// Lists labs, and sets their shares of the machine and their limits. The service may be running.
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
        #[arg(long, value_name = "N", value_parser = share, required_unless_present_any = ["bytes", "jobs"])]
        share: Option<f64>,
        /// Bytes that it may keep here, in uploads, what is prepared of them, and results, or none for no limit.
        #[arg(long, value_name = "N", value_parser = limit)]
        bytes: Option<Limit>,
        /// Jobs that it may have waiting and running, or none for no limit of its own.
        #[arg(long, value_name = "N", value_parser = limit)]
        jobs: Option<Limit>,
    },
}

/// A limit, or word that there is to be none.
#[derive(Debug, Clone, Copy)]
struct Limit(Option<u64>);

fn limit(text: &str) -> Result<Limit, String> {
    if text == "none" {
        return Ok(Limit(None));
    }
    let number = text.parse().ok().filter(|number| i64::try_from(*number).is_ok());
    number.map(|number| Limit(Some(number))).ok_or_else(|| "a limit is a number, or none".into())
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
        if let Action::Set { lab, share, bytes, jobs } = &arguments.action {
            let to = Entitlement {
                share: *share,
                max_bytes: bytes.map(|limit| limit.0),
                max_jobs: jobs.map(|limit| limit.0),
            };
            store.entitle(lab, to).await?;
        }
        let mut rows = Vec::new();
        for row in store.labs().await? {
            let bytes = store.lab_bytes(&row.lab).await?;
            rows.push((row, bytes));
        }
        let text = table(&rows);
        store.close().await;
        let mut stdout = std::io::stdout();
        writeln!(stdout, "{text}").map_err(|error| CliError::Failure(error.to_string()))
    })
}

fn table(labs: &[(LabRow, u64)]) -> String {
    let head = format!(
        "{:40}  {:>8}  {:>8}  {:>8}  {:>16}  {:>16}  {:>16}",
        "lab", "share", "jobs", "of", "bytes", "of", "CPU seconds left"
    );
    let limit = |limit: Option<u64>| limit.map_or_else(|| "none".into(), |limit| limit.to_string());
    let line = |(row, bytes): &(LabRow, u64)| {
        let LabRow { lab, share, max_bytes, max_jobs, jobs, cost_left } = row;
        format!(
            "{:40}  {share:>8}  {jobs:>8}  {:>8}  {bytes:>16}  {:>16}  {cost_left:>16.0}",
            lab.as_str(),
            limit(*max_jobs),
            limit(*max_bytes)
        )
    };
    std::iter::once(head).chain(labs.iter().map(line)).collect::<Vec<_>>().join("\n")
}
