//! The states of a job and the legal transitions between them.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

/// The state of a job, in the order of its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[derive(Serialize, Deserialize, schemars::JsonSchema)]
#[derive(Display, EnumString, IntoStaticStr, VariantArray)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
pub enum JobState {
    /// Accepted; no task has been claimed.
    Queued,
    /// At least one task has been claimed.
    Running,
    /// All tasks are done and the results are complete.
    Succeeded,
    /// A task has failed; the field `error` has the reason.
    Failed,
    /// Cancelled by the user, but workers still hold some tasks.
    Cancelling,
    /// Cancelled, and no worker holds a task.
    Cancelled,
}

/// A transition between two states that is not legal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a job in the state {from} can't change to {to}")]
pub struct IllegalTransition {
    pub from: JobState,
    pub to: JobState,
}

impl JobState {
    /// True if only a user's request can change the state.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// Returns `to` if the transition is legal.
    pub fn step(self, to: Self) -> Result<Self, IllegalTransition> {
        use JobState::{Cancelled, Cancelling, Failed, Queued, Running, Succeeded};
        let legal = matches!(
            (self, to),
            (Queued, Running | Cancelled | Failed)
                | (Running, Succeeded | Failed | Cancelling | Cancelled)
                | (Cancelling, Cancelled)
                // A retry repeats a job, for example after its results were damaged on disk.
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
    fn states_are_parsed_back_from_their_names() {
        for state in JobState::VARIANTS.iter().copied() {
            assert_eq!(state.into_str().parse::<JobState>().unwrap(), state);
            assert_eq!(serde_json::to_value(state).unwrap(), state.into_str());
        }
    }

    #[test]
    fn final_states_can_only_be_retried() {
        for state in [JobState::Succeeded, JobState::Failed, JobState::Cancelled] {
            for to in JobState::VARIANTS.iter().copied() {
                assert_eq!(state.step(to).is_ok(), to == JobState::Queued);
            }
        }
        assert!(JobState::Cancelling.step(JobState::Running).is_err());
        assert!(JobState::Cancelling.step(JobState::Succeeded).is_err());
    }
}
