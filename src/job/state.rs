//! The states of a job and the steps between them that are legal.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Where a job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Accepted; no task of it was claimed yet.
    Queued,
    /// At least one task was claimed.
    Running,
    /// All tasks are done and the results are there.
    Succeeded,
    /// A task could not be done; `error` says why.
    Failed,
    /// Cancel was asked for and some tasks are still in a worker's hands.
    Cancelling,
    /// Cancelled, and no worker is at it any more.
    Cancelled,
}

/// A step between two states that does not exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a job that is {from} can't become {to}")]
pub struct IllegalTransition {
    /// The state that the job is in.
    pub from: JobState,
    /// The state that was asked for.
    pub to: JobState,
}

impl JobState {
    /// All states, in the order of a job's life.
    pub const ALL: [Self; 6] = [
        Self::Queued,
        Self::Running,
        Self::Succeeded,
        Self::Failed,
        Self::Cancelling,
        Self::Cancelled,
    ];

    /// The state's name in JSON and in the database.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelling => "cancelling",
            Self::Cancelled => "cancelled",
        }
    }

    /// True if nothing happens to the job any more unless a user asks for it.
    #[must_use]
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// The state `to`, if the step there is legal.
    ///
    /// # Errors
    /// [`IllegalTransition`] names both states.
    pub fn step(self, to: Self) -> Result<Self, IllegalTransition> {
        use JobState::{Cancelled, Cancelling, Failed, Queued, Running, Succeeded};
        let legal = matches!(
            (self, to),
            (Queued, Running | Cancelled | Failed)
                | (Running, Succeeded | Failed | Cancelling | Cancelled)
                | (Cancelling, Cancelled)
                | (Failed | Cancelled, Queued)
        );
        if legal { Ok(to) } else { Err(IllegalTransition { from: self, to }) }
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for JobState {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|state| state.name() == text).ok_or_else(|| {
            format!("{text:?} is not a job state; the states are {:?}", Self::ALL.map(Self::name))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::JobState;

    #[test]
    fn names_are_one_to_one() {
        for state in JobState::ALL {
            assert_eq!(state.name().parse::<JobState>().unwrap(), state);
            assert_eq!(serde_json::to_value(state).unwrap(), state.name());
        }
    }

    #[test]
    fn success_is_for_ever_and_the_other_ends_can_be_retried() {
        for to in JobState::ALL {
            assert!(JobState::Succeeded.step(to).is_err());
        }
        assert_eq!(JobState::Failed.step(JobState::Queued), Ok(JobState::Queued));
        assert_eq!(JobState::Cancelled.step(JobState::Queued), Ok(JobState::Queued));
        assert!(JobState::Cancelling.step(JobState::Running).is_err());
        assert!(JobState::Cancelling.step(JobState::Succeeded).is_err());
    }
}
