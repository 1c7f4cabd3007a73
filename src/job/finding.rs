//! What a check of a calibration or measurement has found, as it is stored and shown.

use serde::{Deserialize, Serialize};

use crate::optics;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Results will be worse than they could be.
    Warning,
    /// Results will be wrong.
    Error,
}

/// Something that is wrong.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    /// Its name, which never changes, for programs to rely on.
    pub code: String,
    /// How bad it is.
    pub severity: Severity,
    /// What was seen, with its numbers.
    pub detail: String,
    /// What to do.
    pub remedy: String,
    /// The patterns or frames that it is about, counted from 0.
    pub frames: Vec<usize>,
    /// The snapshot that it is about, counted from 0; none for a calibration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub snapshot: Option<u32>,
}

impl From<optics::Finding> for Finding {
    fn from(finding: optics::Finding) -> Self {
        let optics::Finding { code, severity, detail, remedy, frames } = finding;
        let severity = match severity {
            optics::Severity::Warning => Severity::Warning,
            optics::Severity::Error => Severity::Error,
        };
        Self { code: code.into(), severity, detail, remedy: remedy.into(), frames, snapshot: None }
    }
}

/// A verdict on a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// Nothing is wrong with it.
    Good,
    /// It can be used, with what the warnings say.
    Usable,
    /// Results will be wrong.
    Bad,
}

impl Grade {
    /// The grade that findings give.
    #[must_use]
    pub fn of(findings: &[Finding]) -> Self {
        match findings.iter().map(|finding| finding.severity).max() {
            None => Self::Good,
            Some(Severity::Warning) => Self::Usable,
            Some(Severity::Error) => Self::Bad,
        }
    }

    /// Its name in JSON.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Usable => "usable",
            Self::Bad => "bad",
        }
    }
}
