//! What `submit` and `watch-folder` ask for: masks, scales and how to reconstruct.

use std::path::{Path, PathBuf};

use clap::Args;
use serde_json::{Map, Value, json};

use super::CliError;
use super::arguments::{Snapshots, axes, mosaic, named_all, sequence};
use super::client::{Client, Result};
use engine::job::{Algorithm, CalibrationId, Mosaic, Sequence, Sha256};
use formats::Axes;

/// How jobs are made of measurements.
#[derive(Debug, Args)]
pub(super) struct SubmissionArguments {
    /// The calibration that the snapshots were taken with.
    #[arg(long, value_name = "ID", required_unless_present = "masks", conflicts_with = "masks")]
    calibration: Option<CalibrationId>,
    /// Masks [frame, row, column] instead of a calibration; the same file makes one calibration only.
    #[arg(long, value_name = "FILE")]
    masks: Option<PathBuf>,
    /// What the masks are called in an npz, .mat or HDF5 file [default: mask].
    #[arg(long, value_name = "NAME", requires = "masks")]
    masks_array: Option<String>,
    /// What the snapshots are called in an npz, .mat or HDF5 file [default: meas].
    #[arg(long, value_name = "NAME")]
    array: Option<String>,
    /// The order of the axes of the masks [default: the only one that fits].
    #[arg(long, value_name = "ORDER", requires = "masks", value_parser = axes())]
    masks_axes: Option<Axes>,
    /// The order of the axes of the snapshots [default: the only one that fits].
    #[arg(long, value_name = "ORDER", value_parser = axes())]
    axes: Option<Axes>,
    /// The number in the masks that means 1 [default: that of their type].
    #[arg(long, value_name = "NUMBER", requires = "masks")]
    masks_full_scale: Option<f64>,
    /// The colours of the sensor's pixels, row by row of a cell of 2x2 [default: a grey sensor].
    #[arg(long, value_name = "NAME", requires = "masks", value_parser = mosaic())]
    mosaic: Option<Mosaic>,
    /// The number in the snapshots that means 1 [default: that of their type].
    #[arg(long, value_name = "NUMBER")]
    full_scale: Option<f64>,
    /// Snapshots that the camera takes in a second.
    #[arg(long, value_name = "NUMBER")]
    camera_fps: Option<f64>,
    /// Seconds that one snapshot is exposed.
    #[arg(long, value_name = "SECONDS")]
    exposure_s: Option<f64>,
    /// The algorithm.
    #[arg(long, value_name = "NAME", default_value = Algorithm::PnpTvFastdvdnet.into_str(),
          value_parser = named_all())]
    algorithm: Algorithm,
    /// The network of `learned`.
    #[arg(long, value_name = "ID")]
    model: Option<String>,
    /// A schedule as JSON (docs/schedule.schema.json) instead of the algorithm's own.
    #[arg(long, value_name = "FILE")]
    schedule: Option<PathBuf>,
    /// Which snapshots: all, an index from 0, or FIRST-LAST with both ends in.
    #[arg(long, value_name = "WHICH", default_value = "all")]
    snapshots: Snapshots,
    /// Whether snapshots are reconstructed together [default: as the measurement's times say].
    #[arg(long, value_name = "KIND", value_parser = sequence())]
    sequence: Option<Sequence>,
    /// From -100 to 100; higher ones go first.
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    priority: i32,
}

/// What is asked for of each file: the requests without what differs from file to file.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Recipe {
    measurement: Map<String, Value>,
    job: Map<String, Value>,
}

impl SubmissionArguments {
    /// Where the masks lie, if they are a file.
    pub(super) fn masks(&self) -> Option<&Path> {
        self.masks.as_deref()
    }

    /// Makes the calibration, if need be, and says what to ask for.
    pub(super) async fn recipe(&self, client: &Client) -> Result<Recipe> {
        let schedule = self.schedule()?;
        let calibration = match (&self.calibration, &self.masks) {
            (Some(id), _) => id.to_string(),
            (None, Some(masks)) => self.calibrate(client, masks).await?,
            (None, None) => {
                let text = "give --masks FILE or --calibration ID";
                return Err(CliError::Input(text.into()).into());
            }
        };
        let mut measurement = Map::from_iter([("calibration".to_owned(), json!(calibration))]);
        add(&mut measurement, "array", json!(self.array));
        add(&mut measurement, "axes", json!(self.axes));
        add(&mut measurement, "full_scale", json!(self.full_scale));
        add(&mut measurement, "camera_fps", json!(self.camera_fps));
        add(&mut measurement, "exposure_s", json!(self.exposure_s));
        let mut job = Map::from_iter([("algorithm".to_owned(), json!(self.algorithm.into_str()))]);
        add(&mut job, "model", json!(self.model));
        add(&mut job, "schedule", schedule);
        add(&mut job, "snapshots", self.snapshots.request());
        add(&mut job, "sequence", json!(self.sequence.map(|kind| kind.to_string())));
        job.insert("priority".to_owned(), json!(self.priority));
        Ok(Recipe { measurement, job })
    }

    fn schedule(&self) -> Result<Value, CliError> {
        let Some(path) = &self.schedule else { return Ok(Value::Null) };
        let refused = |error: &dyn std::fmt::Display| {
            CliError::Input(format!("schedule {}: {error}", path.display()))
        };
        let text = std::fs::read_to_string(path).map_err(|error| refused(&error))?;
        serde_json::from_str(&text).map_err(|error| refused(&error))
    }

    async fn calibrate(&self, client: &Client, masks: &Path) -> Result<String> {
        let sha256 = client.sent(masks).await?;
        let mut body = Map::from_iter([("masks".to_owned(), json!(sha256))]);
        add(&mut body, "array", json!(self.masks_array));
        add(&mut body, "axes", json!(self.masks_axes));
        add(&mut body, "full_scale", json!(self.masks_full_scale));
        add(&mut body, "mosaic", json!(self.mosaic));
        let body = Value::Object(body);
        // The same masks are the same calibration, whoever asks.
        let key = format!("calibration-{}", Sha256::of(body.to_string().as_bytes()));
        client.made("/v1/calibrations", &body, &key).await
    }
}

fn add(to: &mut Map<String, Value>, name: &str, value: Value) {
    if !value.is_null() {
        to.insert(name.to_owned(), value);
    }
}

impl Recipe {
    /// Makes a measurement and a job of a file that was sent. With the same key it is the same job.
    pub(super) async fn submit(
        &self,
        client: &Client,
        data: Sha256,
        label: Option<&str>,
        key: &str,
    ) -> Result<Value> {
        let mut measurement = self.measurement.clone();
        measurement.insert("data".to_owned(), json!(data));
        let body = Value::Object(measurement);
        let measurement = client.made("/v1/measurements", &body, key).await?;
        let mut job = self.job.clone();
        job.insert("measurement".to_owned(), json!(measurement));
        add(&mut job, "label", json!(label));
        client.create("/v1/jobs", &Value::Object(job), key).await
    }
}
