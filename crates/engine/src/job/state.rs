//! The states of a job and the steps between them that are legal.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

/// Where a job stands, in the order of its life.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    Hash,
    Serialize,
    Deserialize,
    Display,
    EnumString,
    IntoStaticStr,
    VariantArray,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
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
    pub from: JobState,
    pub to: JobState,
}

impl JobState {
    /// True if nothing happens to the job any more unless a user asks for it.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// The state `to`, if the step there is legal.
    pub fn step(self, to: Self) -> Result<Self, IllegalTransition> {
        use JobState::{Cancelled, Cancelling, Failed, Queued, Running, Succeeded};
        let legal = matches!(
            (self, to),
            (Queued, Running | Cancelled | Failed)
                | (Running, Succeeded | Failed | Cancelling | Cancelled)
                | (Cancelling, Cancelled)
                // A job whose results were damaged on the disk is done again.
                | (Failed | Cancelled | Succeeded, Queued)
        );
        if legal { Ok(to) } else { Err(IllegalTransition { from: self, to }) }
    }
}

#[cfg(test)]
mod tests {
    use strum::VariantArray;

    use super::JobState;

    #[test]
    fn names_are_one_to_one() {
        for state in JobState::VARIANTS.iter().copied() {
            assert_eq!(state.into_str().parse::<JobState>().unwrap(), state);
            assert_eq!(serde_json::to_value(state).unwrap(), state.into_str());
        }
    }

    #[test]
    fn ends_can_be_retried_and_lead_nowhere_else() {
        for end in [JobState::Succeeded, JobState::Failed, JobState::Cancelled] {
            for to in JobState::VARIANTS.iter().copied() {
                assert_eq!(end.step(to).is_ok(), to == JobState::Queued);
            }
        }
        assert!(JobState::Cancelling.step(JobState::Running).is_err());
        assert!(JobState::Cancelling.step(JobState::Succeeded).is_err());
    }
}
