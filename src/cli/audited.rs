//! Records the changes that commands make on the machine of the service.

use std::path::PathBuf;

use clap::Args;

use super::CliError;
use super::serve::Announcement;
use crate::audit::{Actor, AuditLog, Entry, Outcome};
use crate::cli::error::Result;
use crate::config::AuditArguments;
use engine::job::Lab;
use formats::DiskTrouble;
use store::{Store, StoreError};

/// A change that a command makes.
#[derive(Debug)]
pub(super) struct Change {
    /// The command.
    pub action: &'static str,
    pub lab: Option<Lab>,
    /// The identifier of the changed resource.
    pub object: String,
}

/// The data folder that a command changes, and the log of its changes.
#[derive(Debug, Args)]
pub(super) struct FolderArguments {
    /// Folder of the service's data; the service may be running.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    pub data: PathBuf,
    #[command(flatten)]
    audit: AuditArguments,
}

impl FolderArguments {
    /// The audit log with the given file, or else with that of the service that runs on the data folder.
    ///
    /// Errors: the file can't be written.
    pub(super) fn log(&self) -> Result<AuditLog> {
        let announced = || Announcement::read(&self.data).ok()?.audit_log;
        let Some(file) = self.audit.audit_log.clone().or_else(announced) else {
            return Ok(AuditLog::default());
        };
        AuditLog::open(Some(&file)).map_err(|error| {
            let path = file.display();
            CliError::Input(format!(
                "the audit log {path} can't be written: {error}; nothing was changed. Run the command as the user of \
                the service, or name another file with --audit-log"
            ))
        })
    }
}

/// Makes a change, and records it with its outcome. On a full disk the reserve is given up first.
pub(super) async fn audited<T>(
    store: &Store,
    log: &AuditLog,
    change: Change,
    act: impl AsyncFn() -> Result<T, StoreError>,
) -> Result<T> {
    let Change { action, lab, object } = change;
    let mut result = act().await;
    if let Err(error) = &result
        && error.disk_trouble() == Some(DiskTrouble::Full)
        && store.give_up_reserve().await?
    {
        result = act().await;
    }
    let result = result.map_err(CliError::from);
    let outcome = match &result {
        Ok(_) => Outcome::Done,
        Err(CliError::Input(_)) => Outcome::Refused,
        Err(_) => Outcome::Failed,
    };
    let entry = Entry::new(Actor::Command, action, outcome);
    log.record(&Entry { lab, object: Some(object), user: Some(user()), ..entry });
    result
}

/// The user of this process, and the user behind `sudo`.
fn user() -> String {
    let uid = rustix::process::getuid().as_raw();
    match std::env::var("SUDO_USER") {
        Ok(name) => format!("uid {uid}, sudo by {name}"),
        Err(_) => format!("uid {uid}"),
    }
}
