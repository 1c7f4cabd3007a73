//! The ledger of a watched folder: the state of each file, one JSON object per line. The last line about a file is valid.
//! A line is on the disk before the step that it announces, so no step is repeated under another key.

use std::collections::HashMap;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::cli::CliError;
use crate::cli::error::Result;
use crate::cli::submission::Recipe;
use store::LockedFile;

/// A file, identified by its name, size and time when it was first recorded.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub(super) struct Shot {
    pub(super) name: String,
    pub(super) size: u64,
    /// Time of its last change, in seconds and nanoseconds.
    pub(super) time: (i64, i64),
}

/// Progress of a file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub(super) enum FileState {
    /// Not submitted yet, or perhaps submitted under its key.
    Taken,
    Submitted {
        job: String,
    },
    /// The results are downloaded.
    Done {
        job: String,
    },
    Failed {
        reason: String,
    },
}

impl FileState {
    pub(super) fn is_final(&self) -> bool {
        matches!(self, Self::Done { .. } | Self::Failed { .. })
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Entry {
    #[serde(flatten)]
    pub(super) shot: Shot,
    /// Idempotency key of its measurement and its job.
    pub(super) key: String,
    /// The requests, as decided when the file was recorded.
    pub(super) recipe: Recipe,
    /// Name of the results or of the failure's reason. No file had the name when the entry was made.
    pub(super) results: String,
    #[serde(flatten)]
    pub(super) stage: FileState,
}

pub(super) struct Ledger {
    path: PathBuf,
    file: LockedFile,
    entries: HashMap<Shot, Entry>,
}

impl Ledger {
    /// Opens or creates the ledger of a folder.
    /// Errors: another process uses it; a line is damaged.
    pub(super) fn open(path: PathBuf) -> Result<Self> {
        let failed = |error: std::io::Error| CliError::file("open", &path, &error);
        let mut options = OpenOptions::new();
        let file = options.create(true).read(true).append(true).open(&path).map_err(failed)?;
        let file = LockedFile::take(file).map_err(|error| {
            let text = "another watch-folder watches this folder";
            CliError::Input(format!("{}: {text} ({error})", path.display()))
        })?;
        let bytes = fs::read(&path).map_err(failed)?;
        // The step after an incomplete last line was not started.
        let complete = bytes.iter().rposition(|byte| *byte == b'\n').map_or(0, |end| end + 1);
        let mut entries = HashMap::new();
        for (number, line) in bytes[..complete].split_inclusive(|byte| *byte == b'\n').enumerate() {
            let entry: Entry = serde_json::from_slice(line).map_err(|error| {
                CliError::Input(format!(
                    "{}, line {}: {error}. The file is damaged, or another program has changed it: remove this line, or \
                     move the file away and submit all files of the folder again",
                    path.display(),
                    number + 1
                ))
            })?;
            entries.insert(entry.shot.clone(), entry);
        }
        file.set_len(complete as u64).map_err(failed)?;
        Ok(Self { path, file, entries })
    }

    pub(super) fn has(&self, shot: &Shot) -> bool {
        self.entries.contains_key(shot)
    }

    /// True if results of a file have this name.
    pub(super) fn has_results(&self, name: &str) -> bool {
        self.entries.values().any(|entry| entry.results == name)
    }

    /// Entries that have not ended, the oldest file first.
    pub(super) fn open_entries(&self) -> Vec<Entry> {
        let mut open: Vec<Entry> =
            self.entries.values().filter(|entry| !entry.stage.is_final()).cloned().collect();
        open.sort_by(|a, b| (a.shot.time, &a.shot.name).cmp(&(b.shot.time, &b.shot.name)));
        open
    }

    /// Records the progress of a file. It is on the disk when this returns.
    pub(super) fn record(&mut self, entry: Entry) -> Result<()> {
        let failed = |error: std::io::Error| CliError::file("write", &self.path, &error);
        let line = serde_json::to_string(&entry).map_err(|error| failed(error.into()))?;
        self.file.write_all(format!("{line}\n").as_bytes()).map_err(failed)?;
        self.file.sync_data().map_err(failed)?;
        self.entries.insert(entry.shot.clone(), entry);
        Ok(())
    }
}

/// Path of the ledger of a folder.
pub(super) fn path_in(folder: &Path) -> PathBuf {
    folder.join(".sci-recon.ledger")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::{Entry, FileState, Ledger, Shot};

    fn entry(name: &str, stage: FileState) -> Entry {
        let shot = Shot { name: name.into(), size: 3, time: (1, 2) };
        let recipe = serde_json::json!({"measurement": {"calibration": "c"}, "job": {}});
        let recipe = serde_json::from_value(recipe).unwrap();
        Entry { shot, key: "k".into(), recipe, results: format!("{name}.result"), stage }
    }

    #[test]
    fn the_last_complete_line_about_a_file_is_valid() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ledger");
        let mut ledger = Ledger::open(path.clone()).unwrap();
        assert!(Ledger::open(path.clone()).is_err(), "one process at a time");
        ledger.record(entry("a", FileState::Taken)).unwrap();
        ledger.record(entry("b", FileState::Taken)).unwrap();
        ledger.record(entry("a", FileState::Done { job: "j".into() })).unwrap();
        drop(ledger);
        let text = fs::read_to_string(&path).unwrap();
        fs::write(&path, format!("{text}{{\"name\": \"c\", \"si")).unwrap();
        let mut ledger = Ledger::open(path.clone()).unwrap();
        assert_eq!(ledger.open_entries(), [entry("b", FileState::Taken)]);
        assert!(ledger.has(&entry("a", FileState::Taken).shot) && ledger.has_results("b.result"));
        ledger.record(entry("b", FileState::Failed { reason: "r".into() })).unwrap();
        drop(ledger);
        assert!(Ledger::open(path.clone()).unwrap().open_entries().is_empty());
        for damaged in [&b"nonsense\n"[..], b"{\"name\": \"\xff\"}\n"] {
            fs::write(&path, damaged).unwrap();
            let error = Ledger::open(path.clone()).err().unwrap().to_string();
            assert!(error.contains("line 1") && error.contains("remove this line"), "{error}");
            assert_eq!(fs::read(&path).unwrap(), damaged);
        }
        fs::write(&path, b"torn \xff").unwrap();
        assert!(Ledger::open(path).unwrap().open_entries().is_empty());
    }
}
