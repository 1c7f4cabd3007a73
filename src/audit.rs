//! The audit log: one line for each change of data or rights, and for failed sign-ins.
//!
//! Each line is an event of `tracing` with the target `audit`. If a file is configured, the line is also appended to it as
//! JSON. The file is opened for each line, so that it can be rotated.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::net::IpAddr;
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_with::skip_serializing_none;
use strum::IntoStaticStr;

use engine::job::{Lab, Label, Timestamp, TokenId};

/// The origin of a change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, IntoStaticStr)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case", const_into_str)]
pub enum Actor {
    /// A request with a token.
    Token,
    /// A request with a session of a browser, which stands for a token.
    Session,
    /// A request without credentials, to a service without tokens or in a failed sign-in.
    Anyone,
    /// A command on the machine of the service.
    Command,
    /// The service, which deletes expired data.
    Service,
}

/// The result of an attempted change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, IntoStaticStr)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case", const_into_str)]
pub enum Outcome {
    Done,
    Refused,
    Failed,
    /// The client disconnected before the answer; the change may be done.
    Interrupted,
}

impl Outcome {
    /// The outcome that a status of HTTP indicates.
    #[must_use]
    pub fn from_status(status: u16) -> Self {
        match status {
            ..400 => Self::Done,
            400..500 => Self::Refused,
            _ => Self::Failed,
        }
    }
}

/// A line of the audit log.
#[skip_serializing_none]
#[derive(Debug, Clone, Serialize)]
pub struct Entry {
    pub actor: Actor,
    /// The route with its method, the command, or `sign-in`.
    pub action: String,
    /// The identifier of the changed resource.
    pub object: Option<String>,
    pub lab: Option<Lab>,
    /// The identifier of the token, which is not its secret.
    pub token: Option<TokenId>,
    /// The note of the token.
    pub note: Option<Label>,
    /// The user who ran a command.
    pub user: Option<String>,
    /// The address of the client.
    pub address: Option<IpAddr>,
    pub outcome: Outcome,
    /// The status of the answer.
    pub status: Option<u16>,
    /// The identifier of the request.
    pub request: Option<String>,
    /// Number of similar lines that were left out in the last second.
    pub left_out: Option<u64>,
}

impl Entry {
    /// An entry with the required facts.
    pub fn new(actor: Actor, action: impl Into<String>, outcome: Outcome) -> Self {
        Self {
            actor,
            action: action.into(),
            object: None,
            lab: None,
            token: None,
            note: None,
            user: None,
            address: None,
            outcome,
            status: None,
            request: None,
            left_out: None,
        }
    }
}

/// A line of the file.
#[derive(Serialize)]
struct Line<'a> {
    time: Timestamp,
    #[serde(flatten)]
    entry: &'a Entry,
}

/// The audit log with its optional file.
#[derive(Debug, Clone, Default)]
pub struct AuditLog {
    file: Option<PathBuf>,
}

impl AuditLog {
    /// A log that appends to `file`, if one is given.
    /// Errors: the file can't be written.
    pub fn open(file: Option<&Path>) -> io::Result<Self> {
        if let Some(path) = file {
            appendable(path)?;
        }
        Ok(Self { file: file.map(Path::to_owned) })
    }

    /// Writes a line. If the file can't be written, the service's log says so.
    pub fn record(&self, entry: &Entry) {
        tracing::info!(
            target: "audit",
            actor = entry.actor.into_str(),
            action = entry.action.as_str(),
            object = entry.object.as_deref(),
            lab = entry.lab.as_ref().map(Lab::as_str),
            token = entry.token.map(|token| token.to_string()),
            note = entry.note.as_ref().map(Label::as_str),
            user = entry.user.as_deref(),
            address = entry.address.map(|address| address.to_string()),
            outcome = entry.outcome.into_str(),
            status = entry.status,
            left_out = entry.left_out,
            "audit"
        );
        if let Some(path) = &self.file
            && let Err(error) = append(path, entry)
        {
            tracing::error!(%error, file = %path.display(), "the audit log can't be written");
        }
    }
}

fn append(path: &Path, entry: &Entry) -> io::Result<()> {
    let mut line = serde_json::to_vec(&Line { time: Timestamp::now(), entry })?;
    line.push(b'\n');
    let mut file = appendable(path)?;
    if !file.metadata()?.is_file() {
        return file.write_all(&line);
    }
    // Several processes append. The lock ends when the file is closed.
    file.lock()?;
    let length = file.metadata()?.len();
    if !ends_line(path, length) {
        line.insert(0, b'\n');
    }
    file.write_all(&line).inspect_err(|_| {
        // A full disk may have taken a part of the line. If the part stays, the next line begins with a line feed.
        let _ = file.set_len(length);
    })
}

/// True if the next line can be appended to a file of this length. A file that can't be read is taken to be complete.
fn ends_line(path: &Path, length: u64) -> bool {
    let mut last = [b'\n'];
    let Some(at) = length.checked_sub(1) else { return true };
    let read = File::open(path).and_then(|file| file.read_exact_at(&mut last, at));
    read.is_err() || last == [b'\n']
}

fn appendable(path: &Path) -> io::Result<File> {
    OpenOptions::new().append(true).create(true).mode(0o600).open(path)
}

#[cfg(test)]
mod tests {
    use super::{Actor, AuditLog, Entry, Outcome};

    #[test]
    fn a_rotated_file_is_created_anew_with_a_line_for_each_entry() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit.jsonl");
        let log = AuditLog::open(Some(&path)).unwrap();
        let object = Some("a\nb".to_owned());
        let entry = Entry { object, ..Entry::new(Actor::Command, "lab set", Outcome::Done) };
        log.record(&entry);
        std::fs::rename(&path, folder.path().join("audit.jsonl.1")).unwrap();
        log.record(&entry);
        log.record(&entry);
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().count(), 2, "{text}");
        let line: serde_json::Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
        assert_eq!((&line["actor"], &line["object"]), (&"command".into(), &"a\nb".into()));
        assert!(line.get("token").is_none() && line["time"].is_string(), "{line}");
        // A crash may leave a part of a line.
        std::fs::write(&path, r#"{"time":"2026-"#).unwrap();
        log.record(&entry);
        log.record(&entry);
        let text = std::fs::read_to_string(&path).unwrap();
        let parsed = text.lines().map(serde_json::from_str::<serde_json::Value>);
        assert_eq!(parsed.map(|line| line.is_ok()).collect::<Vec<_>>(), [false, true, true]);
        assert!(AuditLog::open(Some(folder.path())).is_err());
    }
}
