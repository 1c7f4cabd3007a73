//! End-to-end networks: what is known of one, and what a job takes of it.

use serde::{Deserialize, Serialize};

use super::{Algorithm, CalibrationId, InvalidField, Label, ModelId, SceneShape, Sha256, TileSpec};
use reconstruction::schedule::Schedule;

/// A tensor that a network takes or gives.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelTensor {
    pub name: String,
    /// Its sides; null for one that may have any length.
    pub shape: Vec<Option<usize>>,
}

/// A run on zeros: what it took, for the plans of jobs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ModelTrial {
    pub height: usize,
    pub width: usize,
    /// Processor seconds of the run, without loading the network.
    pub cpu_seconds: f64,
    /// Largest resident memory of the process that ran it.
    pub peak_rss_bytes: u64,
}

/// What the check of a network has found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelFacts {
    pub inputs: Vec<ModelTensor>,
    pub outputs: Vec<ModelTensor>,
    /// True if it takes pictures of the calibration's size only, so that they can't be cut.
    pub fixed_size: bool,
    pub trial: ModelTrial,
}

/// The outcome of a check, as the checking process tells it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelVerdict {
    Fits(ModelFacts),
    /// It can't, and why.
    Refused(String),
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobModel {
    pub id: ModelId,
    pub calibration: CalibrationId,
    pub name: Option<Label>,
    /// Hash of its ONNX file.
    pub sha256: Sha256,
    /// See [`ModelFacts::fixed_size`].
    pub fixed_size: bool,
    /// See [`ModelFacts::trial`].
    pub trial: ModelTrial,
}

impl ModelTrial {
    pub fn pixels(&self) -> usize {
        self.height * self.width
    }
}

/// What a request says that concerns a network.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModelChoice<'a> {
    pub(super) algorithm: Algorithm,
    pub(super) model: Option<&'a JobModel>,
    pub(super) schedule: Option<&'a Schedule>,
    pub(super) tile: Option<TileSpec>,
}

impl ModelChoice<'_> {
    /// What is wrong with it, for a measurement of this shape taken with this calibration.
    pub(super) fn errors(
        &self,
        calibration: CalibrationId,
        shape: SceneShape,
    ) -> Vec<InvalidField> {
        let (height, width) = shape.solved();
        let mut errors = Vec::new();
        let mut wrong = |pointer: &str, detail: String| {
            errors.push(InvalidField::new(pointer, detail));
        };
        let learned = self.algorithm == Algorithm::Learned;
        match self.model {
            None if learned => wrong(
                "/model",
                "learned needs the network of a model: register one with POST /v1/models".into(),
            ),
            Some(_) if !learned => {
                let detail =
                    format!("{} takes no model; ask for learned", self.algorithm.into_str());
                wrong("/model", detail);
            }
            Some(model) if model.calibration != calibration => wrong(
                "/model",
                format!(
                    "the model was registered for calibration {}; the measurement was taken with \
                     {calibration}",
                    model.calibration
                ),
            ),
            _ => {}
        }
        if learned && self.schedule.is_some() {
            wrong("/schedule", "learned runs one network once: it has no schedule".into());
        }
        if let (Some(model), Some(tile)) = (self.model, self.tile)
            && model.fixed_size
            && tile.size < height.max(width)
        {
            let detail = format!(
                "the network takes pictures of {height}x{width} pixels only, so they can't be cut into \
                 tiles of {}: leave the tiles out",
                tile.size
            );
            wrong("/tile", detail);
        }
        errors
    }

    /// The tiles where the request names none: for a network of one size, the whole picture.
    pub(super) fn tile(&self, shape: SceneShape) -> TileSpec {
        let (height, width) = shape.solved();
        let whole = TileSpec::whole(height, width);
        let fixed = self.model.is_some_and(|model| model.fixed_size);
        self.tile.unwrap_or_else(|| if fixed { whole } else { self.algorithm.default_tile() })
    }
}
