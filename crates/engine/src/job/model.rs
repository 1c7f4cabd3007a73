//! End-to-end networks: the result of their check, and their use in a job.

use serde::{Deserialize, Serialize};

use super::{Algorithm, CalibrationId, InvalidField, Label, ModelId, SceneShape, Sha256, TileSpec};
use reconstruction::schedule::Schedule;

/// An input or output tensor of a network.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ModelTensor {
    pub name: String,
    /// Length of each axis; null for a variable one.
    pub shape: Vec<Option<usize>>,
}

/// Cost of a trial run on zeros, for planning jobs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ModelTrial {
    pub height: usize,
    pub width: usize,
    /// CPU seconds of the run, without loading the network.
    pub cpu_seconds: f64,
    /// Peak resident memory of the process, in bytes.
    pub peak_rss_bytes: u64,
}

/// The result of the check of a network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ModelFacts {
    pub inputs: Vec<ModelTensor>,
    pub outputs: Vec<ModelTensor>,
    /// True if the network accepts only the size of the calibration, so that pictures can't be tiled.
    pub fixed_size: bool,
    pub trial: ModelTrial,
}

/// A network as jobs and manifests record it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ModelRecord {
    pub name: String,
    /// SHA-256 of the concatenated ONNX files.
    pub sha256: String,
}

/// The outcome of the check of a network, as the checking process reports it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ModelVerdict {
    /// The network can be used.
    Fits(ModelFacts),
    /// The network can't be used, for this reason.
    Refused(String),
}

/// Longest reason why a network can't be used, in characters.
const MAX_REASON: usize = 2000;

/// Shortens the reason why a network can't be used. A network may contain names of any length.
#[must_use]
pub fn shortened_reason(reason: &str) -> String {
    reason.chars().take(MAX_REASON).collect()
}

/// The network of a job with the algorithm [`Algorithm::Learned`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct JobModel {
    pub id: ModelId,
    pub calibration: CalibrationId,
    pub name: Option<Label>,
    /// Hash of the ONNX file.
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

/// The fields of a request that concern a network.
#[derive(Debug, Clone, Copy)]
pub(super) struct ModelChoice<'a> {
    pub(super) algorithm: Algorithm,
    pub(super) model: Option<&'a JobModel>,
    pub(super) schedule: Option<&'a Schedule>,
    pub(super) tile: Option<TileSpec>,
}

impl ModelChoice<'_> {
    /// Checks the fields against the calibration and the shape of the measurement. Returns all errors.
    pub(super) fn errors(
        &self,
        calibration: CalibrationId,
        shape: SceneShape,
    ) -> Vec<InvalidField> {
        let (height, width) = shape.solved();
        let mut errors = Vec::new();
        let mut refuse = |pointer: &str, detail: String| {
            errors.push(InvalidField::new(pointer, detail));
        };
        let learned = self.algorithm == Algorithm::Learned;
        match self.model {
            None if learned => refuse(
                "/model",
                "the algorithm learned needs a model: register one with POST /v1/models".into(),
            ),
            Some(_) if !learned => {
                let detail = format!(
                    "{} takes no model: use the algorithm learned, or omit the model",
                    self.algorithm.into_str()
                );
                refuse("/model", detail);
            }
            Some(model) if model.calibration != calibration => refuse(
                "/model",
                format!(
                    "the model was registered for calibration {}, but the measurement belongs to \
                     calibration {calibration}",
                    model.calibration
                ),
            ),
            _ => {}
        }
        if learned && self.schedule.is_some() {
            refuse(
                "/schedule",
                "the algorithm learned runs a network once and has no schedule: omit it".into(),
            );
        }
        if let (Some(model), Some(tile)) = (self.model, self.tile)
            && model.fixed_size
            && tile.size < height.max(width)
        {
            let detail = format!(
                "the network accepts only {height}x{width} pixels, so the picture can't be cut into tiles of \
                 {}: omit `tile`",
                tile.size
            );
            refuse("/tile", detail);
        }
        errors
    }

    /// The tiles of the request or, if it states none, the default: the whole picture for a network of fixed size.
    pub(super) fn tile(&self, shape: SceneShape) -> TileSpec {
        let (height, width) = shape.solved();
        let whole = TileSpec::whole(height, width);
        let fixed = self.model.is_some_and(|model| model.fixed_size);
        self.tile.unwrap_or_else(|| if fixed { whole } else { self.algorithm.default_tile() })
    }
}
