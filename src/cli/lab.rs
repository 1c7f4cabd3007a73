//! `sci-recon lab`: manages labs, their shares of the machine, their quotas and their files.

use clap::{Args, Subcommand};

use super::CliError;
use super::audited::{Change, FolderArguments, audited};
use super::output::print_line;
use super::wait::with_store;
use crate::audit::AuditLog;
use crate::cli::error::Result;
use crate::webhooks::secret_text;
use engine::job::{Lab, Sha256};
use store::{Blob, BlobRow, Entitlement, LabRow, Store, share_error};

/// Manage labs: shares, quotas and files.
///
/// Tasks of the highest priority go first; at equal priority, labs take turns. While two labs have waiting work, the
/// one with twice the share gets twice the processor time.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    folder: FolderArguments,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List all labs with their shares and waiting jobs.
    List,
    /// List the uploads of a lab, newest first.
    Uploads {
        /// The lab's name.
        lab: Lab,
    },
    /// Delete an unused upload of a lab.
    DeleteUpload {
        /// The lab's name.
        lab: Lab,
        /// The SHA-256 of the file.
        sha256: Sha256,
    },
    /// Remove a lab that has no valid token and no data.
    Remove {
        /// The lab's name.
        lab: Lab,
    },
    /// Print the secret with which the notifications of a lab are signed.
    WebhookSecret {
        /// The lab's name.
        lab: Lab,
        /// Replace the secret by a new one.
        #[arg(long)]
        new: bool,
    },
    /// Set the share and the quotas of a lab.
    Set {
        /// The lab's name.
        lab: Lab,
        /// Create the lab if it does not exist.
        #[arg(long)]
        new: bool,
        /// The share of the machine, relative to the shares of other labs, which start at 1.
        #[arg(long, value_name = "N", value_parser = share, required_unless_present_any = ["bytes", "jobs"])]
        share: Option<f64>,
        /// Bytes that the lab may store in uploads, prepared arrays and results, or `none` for no limit.
        #[arg(long, value_name = "N", value_parser = limit)]
        bytes: Option<Limit>,
        /// Jobs of the lab that may wait and run, or `none` for only the limit of the service.
        #[arg(long, value_name = "N", value_parser = limit)]
        jobs: Option<Limit>,
    },
}

/// A limit, or `None` for no limit.
#[derive(Debug, Clone, Copy)]
struct Limit(Option<u64>);

fn limit(text: &str) -> Result<Limit, String> {
    if text == "none" {
        return Ok(Limit(None));
    }
    let number = text.parse().ok().filter(|number| i64::try_from(*number).is_ok());
    number.map(|number| Limit(Some(number))).ok_or_else(|| "a limit is a number or `none`".into())
}

fn share(text: &str) -> Result<f64, String> {
    let share: f64 = text.parse().map_err(|_| format!("{text:?} is not a number"))?;
    share_error(share).map_or(Ok(share), |error| Err(error.into()))
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let log = arguments.folder.log()?;
    let act = async |store: &Store| act(store, &log, &arguments.action).await;
    print_line(with_store(&arguments.folder.data, act)?)
}

async fn act(store: &Store, log: &AuditLog, action: &Action) -> Result<String> {
    let change =
        |action, lab: &Lab, object: String| Change { action, lab: Some(lab.clone()), object };
    match action {
        Action::List => {}
        Action::Uploads { lab } => return uploads(store, lab).await,
        Action::DeleteUpload { lab, sha256 } => {
            let change = change("lab delete-upload", lab, sha256.to_string());
            audited(store, log, change, async || store.delete_upload(lab, *sha256).await).await?;
            return Ok(format!("deleted {sha256} of {lab}"));
        }
        Action::Remove { lab } => {
            let change = change("lab remove", lab, lab.to_string());
            audited(store, log, change, async || store.remove_lab(lab).await).await?;
            return Ok(format!("removed {lab}"));
        }
        Action::WebhookSecret { lab, new } => {
            if !store.knows_lab(lab).await? && *lab != Lab::local() {
                return Err(CliError::Input(format!("there is no lab {lab}")));
            }
            let read = async || store.webhook_secret(lab, *new).await;
            let secret = match new {
                true => {
                    audited(store, log, change("lab webhook-secret", lab, lab.to_string()), read)
                        .await
                }
                false => read().await.map_err(CliError::from),
            };
            return Ok(secret_text(&secret?));
        }
        Action::Set { lab, new, share, bytes, jobs } => {
            if !new && !store.knows_lab(lab).await? {
                let text = format!("there is no lab {lab}; create it with --new");
                return Err(CliError::Input(text));
            }
            let entitlement = Entitlement {
                share: *share,
                max_bytes: bytes.map(|limit| limit.0),
                max_jobs: jobs.map(|limit| limit.0),
            };
            let change = change("lab set", lab, lab.to_string());
            audited(store, log, change, async || store.entitle(lab, entitlement).await).await?;
        }
    }
    let (mut rows, costs) = (Vec::new(), store.cost_left_by_lab().await?);
    for row in store.labs().await? {
        let bytes = store.lab_bytes(&row.lab).await?;
        let cost_left = costs.get(&row.lab).copied().unwrap_or_default();
        rows.push((row, bytes, cost_left));
    }
    Ok(table(&rows))
}

async fn uploads(store: &Store, lab: &Lab) -> Result<String> {
    let mut lines = vec![format!("{:64}  {:>14}  {:24}  in use", "sha256", "bytes", "uploaded")];
    let mut after = None;
    loop {
        let page = store.uploads(lab, after, 200).await?;
        for BlobRow { blob, in_use } in &page.items {
            let Blob { sha256, size, created_at } = blob;
            let used = if *in_use { "yes" } else { "no" };
            lines.push(format!("{sha256}  {size:>14}  {:24}  {used}", created_at.to_string()));
            after = Some((*created_at, *sha256));
        }
        if !page.more {
            return Ok(lines.join("\n"));
        }
    }
}

fn table(labs: &[(LabRow, u64, f64)]) -> String {
    let head = format!(
        "{:40}  {:>8}  {:>8}  {:>8}  {:>16}  {:>16}  {:>16}",
        "lab", "share", "jobs", "of", "bytes", "of", "CPU seconds left"
    );
    let limit = |limit: Option<u64>| limit.map_or_else(|| "none".into(), |limit| limit.to_string());
    let line = |(row, bytes, cost_left): &(LabRow, u64, f64)| {
        let LabRow { lab, share, max_bytes, max_jobs, jobs } = row;
        format!(
            "{:40}  {share:>8}  {jobs:>8}  {:>8}  {bytes:>16}  {:>16}  {cost_left:>16.0}",
            lab.as_str(),
            limit(*max_jobs),
            limit(*max_bytes)
        )
    };
    std::iter::once(head).chain(labs.iter().map(line)).collect::<Vec<_>>().join("\n")
}
