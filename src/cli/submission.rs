//! The options of `submit` and `watch-folder`, and the requests that follow from them.

use std::path::{Path, PathBuf};

use clap::{ArgGroup, Args};
use serde_json::{Map, Value, json};

use super::CliError;
use super::arguments::{
    AlgorithmArguments, DispersionArguments, MaskFileArguments, SnapshotFileArguments, Snapshots,
    named, registration,
};
use super::client::{Client, Result};
use super::fields::Role;
use engine::job::{
    CalibrationId, CalibrationRequest, Dispersion, JobId, Label, Mosaic, RegistrationRequest,
    Sequence, Sha256, fields,
};

/// Options of the calibration, the measurement and the job.
#[derive(Debug, Args)]
#[command(group = ArgGroup::new("camera").args(["masks", "calibration", "registration_of"]).required(true).multiple(true))]
pub(super) struct SubmissionArguments {
    /// The calibration that the snapshots were taken with.
    #[arg(long, value_name = "ID", help_heading = CALIBRATION,
          conflicts_with_all = ["masks_array", "masks_axes", "masks_crop", "masks_frames", "masks_packing", "bad_pixels"])]
    calibration: Option<CalibrationId>,
    /// Masks [frame, row, column] instead of a calibration. The same file creates one calibration only.
    #[arg(long, value_name = "FILE", conflicts_with = "calibration", help_heading = CALIBRATION)]
    masks: Option<PathBuf>,
    /// A job that has moved its masks: they become a calibration. The same job creates one calibration only.
    #[arg(long, value_name = "JOB", help_heading = CALIBRATION,
          conflicts_with_all = ["calibration", "masks", "masks_array", "masks_axes", "masks_crop", "masks_frames",
                                "masks_packing", "masks_full_scale", "mosaic", "bad_pixels"])]
    registration_of: Option<JobId>,
    #[command(flatten, next_help_heading = CALIBRATION)]
    mask_file: MaskFileArguments,
    /// The stored number in the masks that means 1, fully open [default: that of their type].
    #[arg(long, value_name = "NUMBER", conflicts_with = "calibration", help_heading = CALIBRATION)]
    masks_full_scale: Option<f32>,
    /// Name of the calibration [default: none].
    #[arg(long, value_name = "TEXT", conflicts_with = "calibration", help_heading = CALIBRATION)]
    masks_name: Option<Label>,
    /// The colours of the sensor's pixels, row by row of a 2x2 cell [default: a grey sensor].
    #[arg(long, value_name = "NAME", conflicts_with = "calibration", value_parser = named::<Mosaic>(),
          help_heading = CALIBRATION)]
    mosaic: Option<Mosaic>,
    #[command(flatten, next_help_heading = CALIBRATION)]
    dispersion: DispersionArguments,
    #[command(flatten, next_help_heading = MEASUREMENT)]
    snapshot_file: SnapshotFileArguments,
    /// The stored number in the snapshots that means 1 [default: that of their type].
    #[arg(long, value_name = "NUMBER", help_heading = MEASUREMENT)]
    full_scale: Option<f64>,
    /// Snapshots per second.
    #[arg(long, value_name = "NUMBER", help_heading = MEASUREMENT)]
    camera_fps: Option<f64>,
    /// Exposure time of a snapshot in seconds.
    #[arg(long, value_name = "SECONDS", help_heading = MEASUREMENT)]
    exposure_s: Option<f64>,
    /// `contiguous` if the snapshots follow one another without a gap, else `separate` [default: the camera's
    /// times decide].
    #[arg(long, value_name = "KIND", value_parser = named::<Sequence>(), help_heading = MEASUREMENT)]
    sequence: Option<Sequence>,
    /// Name of the measurement [default: none].
    #[arg(long, value_name = "TEXT", help_heading = MEASUREMENT)]
    name: Option<String>,
    #[command(flatten, next_help_heading = JOB)]
    algorithm: AlgorithmArguments,
    /// The network of `learned`.
    #[arg(long, value_name = "ID", help_heading = JOB)]
    model: Option<String>,
    /// The snapshots: all, an index from 0, or FIRST-LAST including both ends.
    #[arg(long, value_name = "WHICH", default_value = "all", help_heading = JOB)]
    snapshots: Snapshots,
    /// Largest side of a tile in pixels [default: as the algorithm needs].
    #[arg(long, value_name = "PIXELS", requires = "overlap", help_heading = JOB)]
    tile: Option<u32>,
    /// Least overlap of neighbouring tiles in pixels.
    #[arg(long, value_name = "PIXELS", requires = "tile", help_heading = JOB)]
    overlap: Option<u32>,
    /// Masks that have moved since the calibration: off, auto to estimate and correct the motion, or
    /// ROWS,COLUMNS or ROWS,COLUMNS,DEGREES,SCALE to state a shift in pixels, a clockwise rotation and a factor [default: auto].
    #[arg(long, value_name = "WHICH", value_parser = registration, allow_hyphen_values = true, help_heading = JOB)]
    registration: Option<RegistrationRequest>,
    /// True frames [frame, row, column] of this snapshot, or of all. PSNR and SSIM are relative to them.
    #[arg(long, value_name = "FILE", help_heading = JOB)]
    truth: Option<PathBuf>,
    #[command(flatten, next_help_heading = JOB)]
    plain: PlainArguments,
}

/// Options of a job that do not change its frames.
#[derive(Debug, Args)]
pub(super) struct PlainArguments {
    /// From -100 to 100; jobs of higher priority are served first.
    #[arg(long, value_name = "N", default_value_t = 0, allow_negative_numbers = true)]
    priority: i32,
    /// Label of the job [default: none; of watch-folder: the name of the file].
    #[arg(long, value_name = "TEXT")]
    label: Option<String>,
    /// Address that is notified when the job ends; the administrator allows its host [default: none].
    #[arg(long, value_name = "URL")]
    webhook: Option<String>,
}

impl PlainArguments {
    /// Adds the options to a request for a job.
    pub(super) fn add_to(&self, job: &mut Map<String, Value>) {
        add(job, "priority", json!(self.priority));
        add(job, "label", json!(self.label));
        add(job, "webhook", json!(self.webhook));
    }
}

/// Options of [`SubmissionArguments`] that a manifest states. [`PlainArguments`] has the others.
pub(super) const SETTINGS: [&str; 35] = [
    "calibration",
    "masks",
    "registration_of",
    "masks_array",
    "masks_axes",
    "masks_crop",
    "masks_frames",
    "masks_packing",
    "masks_full_scale",
    "masks_name",
    "bad_pixels",
    "mosaic",
    "dispersion_offsets",
    "dispersion_axis",
    "dispersion_wavelengths",
    "dispersion_mask",
    "array",
    "axes",
    "crop",
    "packing",
    "dark",
    "saturation",
    "full_scale",
    "camera_fps",
    "exposure_s",
    "sequence",
    "name",
    "algorithm",
    "model",
    "schedule",
    "snapshots",
    "tile",
    "overlap",
    "registration",
    "truth",
];

const CALIBRATION: &str = "Calibration";
const MEASUREMENT: &str = "Measurement";
const JOB: &str = "Job";

/// The requests for a file, without the parts that differ from file to file.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Recipe {
    measurement: Map<String, Value>,
    job: Map<String, Value>,
}

impl SubmissionArguments {
    /// Files that belong to each snapshot: the masks, the map of bad pixels, the dark captures and the true frames.
    pub(super) fn own_files(&self) -> impl Iterator<Item = &PathBuf> {
        self.masks
            .iter()
            .chain(&self.mask_file.bad_pixels)
            .chain(&self.snapshot_file.dark)
            .chain(&self.truth)
    }

    /// True if snapshots are packed pixels, whose files may have no header.
    pub(super) fn is_packed(&self) -> bool {
        self.snapshot_file.packing.is_some()
    }

    /// Options that do not change the frames.
    pub(super) fn plain(&self) -> &PlainArguments {
        &self.plain
    }

    /// Uploads masks, dark captures and true frames, creates the calibration if necessary, and returns the requests.
    pub(super) async fn recipe(&self, client: &Client) -> Result<Recipe> {
        let schedule = self.algorithm.schedule()?;
        let dispersion = self.dispersion.resolve()?;
        let calibration = match (&self.calibration, &self.masks, &self.registration_of) {
            (Some(_), ..) | (_, None, Some(_)) if dispersion.is_some() => {
                let text =
                    "--dispersion-offsets belongs to --masks: a calibration has its own dispersion";
                return Err(CliError::Input(text.into()).into());
            }
            (Some(id), ..) => id.to_string(),
            (None, Some(masks), _) => {
                let bad_pixels = match &self.mask_file.bad_pixels {
                    Some(map) => Some(client.upload_with_bar(map).await?),
                    None => None,
                };
                let sent = client.upload_with_bar(masks).await?;
                let body = self.calibration_request(sent, bad_pixels, dispersion);
                let created = create_calibration(client, &Value::Object(body)).await;
                created.map_err(|error| error.about(Role::Masks, masks))?
            }
            (None, None, Some(job)) => {
                let mut body = Map::from_iter([("registration_of".to_owned(), json!(job))]);
                add(&mut body, "name", json!(self.masks_name));
                create_calibration(client, &Value::Object(body)).await?
            }
            (None, None, None) => {
                let text = "give --masks FILE, --calibration ID or --registration-of JOB";
                return Err(CliError::Input(text.into()).into());
            }
        };
        let dark = self.send_dark(client).await?;
        let truth = match &self.truth {
            Some(frames) => Some(client.upload_with_bar(frames).await?),
            None => None,
        };
        let measurement = self.measurement_request(&calibration, &dark);
        Ok(Recipe { measurement, job: self.job_request(schedule, truth) })
    }

    /// Uploads the dark captures that the service does not have, or has deleted as unused.
    pub(super) async fn send_dark(&self, client: &Client) -> Result<Vec<Sha256>> {
        let mut sent = Vec::with_capacity(self.snapshot_file.dark.len());
        for dark in &self.snapshot_file.dark {
            sent.push(client.upload_with_bar(dark).await?);
        }
        Ok(sent)
    }

    fn calibration_request(
        &self,
        masks: Sha256,
        bad_pixels: Option<Sha256>,
        dispersion: Option<Dispersion>,
    ) -> Map<String, Value> {
        let request = CalibrationRequest {
            name: self.masks_name.clone(),
            full_scale: self.masks_full_scale,
            mosaic: self.mosaic,
            dispersion,
            bad_pixels,
            ..self.mask_file.request(masks)
        };
        fields(&request, &[])
    }

    /// A request for a measurement, without its data.
    fn measurement_request(&self, calibration: &str, dark: &[Sha256]) -> Map<String, Value> {
        let mut body = Map::from_iter([("calibration".to_owned(), json!(calibration))]);
        add(&mut body, "array", json!(self.snapshot_file.array));
        add(&mut body, "axes", json!(self.snapshot_file.axes));
        add(&mut body, "crop", json!(self.snapshot_file.crop));
        add(&mut body, "packing", json!(self.snapshot_file.packing));
        add(&mut body, "dark", if dark.is_empty() { Value::Null } else { json!(dark) });
        add(&mut body, "saturation", json!(self.snapshot_file.saturation));
        add(&mut body, "full_scale", json!(self.full_scale));
        add(&mut body, "camera_fps", json!(self.camera_fps));
        add(&mut body, "exposure_s", json!(self.exposure_s));
        add(&mut body, "sequence", json!(self.sequence.map(|kind| kind.to_string())));
        add(&mut body, "name", json!(self.name));
        body
    }

    /// A request for a job, without its measurement.
    fn job_request(&self, schedule: Option<Value>, truth: Option<Sha256>) -> Map<String, Value> {
        let tile = self.tile.zip(self.overlap);
        let tile = tile.map(|(size, overlap)| json!({"size": size, "overlap": overlap}));
        let mut body = Map::from_iter([("algorithm".to_owned(), json!(self.algorithm.algorithm))]);
        add(&mut body, "model", json!(self.model));
        add(&mut body, "schedule", json!(schedule));
        add(&mut body, "snapshots", self.snapshots.request());
        add(&mut body, "sequence", json!(self.sequence.map(|kind| kind.to_string())));
        add(&mut body, "tile", json!(tile));
        add(&mut body, "registration", json!(self.registration));
        add(&mut body, "truth", json!(truth));
        self.plain.add_to(&mut body);
        body
    }
}

/// Creates a calibration, once for all clients that send the same request.
pub(super) async fn create_calibration(client: &Client, body: &Value) -> Result<String> {
    let key = format!("calibration-{}", Sha256::of(body.to_string().as_bytes()));
    client.create_checked("/v1/calibrations", body, &key).await
}

fn add(request: &mut Map<String, Value>, name: &str, value: Value) {
    if !value.is_null() {
        request.insert(name.to_owned(), value);
    }
}

impl Recipe {
    /// Creates a measurement and a job from a file that was uploaded. `label` is the default label. The same key returns the same job.
    pub(super) async fn submit(
        &self,
        client: &Client,
        file: &Path,
        data: Sha256,
        label: Option<&str>,
        key: &str,
    ) -> Result<Value> {
        let mut measurement = self.measurement.clone();
        measurement.insert("data".to_owned(), json!(data));
        let body = Value::Object(measurement);
        let created = client.create_checked("/v1/measurements", &body, key).await;
        let measurement = created.map_err(|error| error.about(Role::Measurement, file))?;
        let mut job = self.job.clone();
        job.insert("measurement".to_owned(), json!(measurement));
        if !job.contains_key("label") {
            add(&mut job, "label", json!(label));
        }
        client.create("/v1/jobs", &Value::Object(job), key).await
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fs;

    use clap::{Args, Command, FromArgMatches};
    use serde_json::{Map, Value};

    use super::SubmissionArguments;
    use engine::job::Sha256;

    fn command() -> Command {
        SubmissionArguments::augment_args(Command::new("test"))
    }

    /// Names of the properties of a request in the API contract, except those in `without`.
    fn properties(schema: &str, without: &[&str]) -> BTreeSet<String> {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml");
        let contract: Value = serde_yaml_ng::from_str(&fs::read_to_string(path).unwrap()).unwrap();
        let properties = contract["components"]["schemas"][schema]["properties"].as_object();
        let mut names: BTreeSet<String> = properties.unwrap().keys().cloned().collect();
        for name in without {
            assert!(names.remove(*name), "{schema} has no {name}");
        }
        names
    }

    fn names(request: &Map<String, Value>) -> BTreeSet<String> {
        request.keys().cloned().collect()
    }

    /// With all options set, each request has every property of the API contract that the commands do not derive.
    #[test]
    fn options_cover_every_property_of_the_requests() {
        let folder = tempfile::tempdir().unwrap();
        let schedule = folder.path().join("schedule.json");
        fs::write(&schedule, "{}").unwrap();
        let values = [
            ("masks", "m.npy"),
            ("masks-array", "mask"),
            ("masks-axes", "frame-row-column"),
            ("masks-crop", "0,8,64,64"),
            ("masks-frames", "4-11"),
            ("masks-packing", "mono12p"),
            ("masks-full-scale", "255"),
            ("masks-name", "May"),
            ("mosaic", "rggb"),
            ("dispersion-offsets", "0:2:8"),
            ("dispersion-axis", "row"),
            ("dispersion-wavelengths", "450:10:8"),
            ("dispersion-mask", "measurement"),
            ("bad-pixels", "b.npy"),
            ("array", "meas"),
            ("axes", "row-column-frame"),
            ("crop", "0,8,64,64"),
            ("packing", "mono12packed"),
            ("dark", "d.npy"),
            ("saturation", "4095"),
            ("full-scale", "4095"),
            ("camera-fps", "45"),
            ("exposure-s", "0.02"),
            ("sequence", "separate"),
            ("name", "drop"),
            ("algorithm", "gap-tv"),
            ("model", "x"),
            ("schedule", schedule.to_str().unwrap()),
            ("snapshots", "0-3"),
            ("tile", "128"),
            ("overlap", "16"),
            ("registration", "-0.5,2,0.1,1.001"),
            ("priority", "-3"),
            ("truth", "t.npy"),
            ("label", "milk"),
            ("webhook", "https://lab.example/hook"),
        ];
        let mut known: BTreeSet<&str> = values.iter().map(|(name, _)| *name).collect();
        // They replace the options of masks.
        known.extend(["calibration", "registration-of"]);
        let command = command();
        let options: BTreeSet<&str> =
            command.get_arguments().filter_map(|arg| arg.get_long()).collect();
        assert_eq!(options, known, "an option is missing in this test");
        let mut stated: BTreeSet<String> =
            super::SETTINGS.iter().map(|name| name.replace('_', "-")).collect();
        stated.extend(["priority", "label", "webhook"].map(str::to_owned));
        assert!(stated.iter().eq(&known), "a manifest states the settings: {stated:?}");
        let line = values.iter().map(|(name, value)| format!("--{name}={value}"));
        let line = ["test".to_owned()].into_iter().chain(line);
        let matches = command.try_get_matches_from(line).unwrap();
        let arguments = SubmissionArguments::from_arg_matches(&matches).unwrap();

        let sha256 = Sha256::of(b"file");
        let dispersion = arguments.dispersion.resolve().unwrap();
        let calibration = arguments.calibration_request(sha256, Some(sha256), dispersion);
        // Captures of many files are for `calibrate`, the dashboard and the client libraries; `registration_of` replaces files.
        let expected = properties("CalibrationRequest", &["captures", "registration_of"]);
        assert_eq!(names(&calibration), expected);
        let measurement = arguments.measurement_request("id", &[sha256]);
        assert_eq!(names(&measurement), properties("MeasurementRequest", &["data"]));
        let job = arguments.job_request(arguments.algorithm.schedule().unwrap(), Some(sha256));
        // The measurement names the calibration.
        assert_eq!(names(&job), properties("JobRequest", &["measurement", "calibration"]));
        assert_eq!(job["tile"], serde_json::json!({"size": 128, "overlap": 16}));
        assert_eq!(
            job["registration"],
            serde_json::json!({"shift": [-0.5, 2.0], "rotation": 0.1, "scale": 1.001})
        );
    }

    #[test]
    fn options_of_masks_exclude_a_calibration() {
        let parse = |line: &[&str]| command().try_get_matches_from([&["test"], line].concat());
        assert!(parse(&[]).is_err() && parse(&["--masks-axes", "frame-row-column"]).is_err());
        assert!(parse(&["--masks", "m.npy", "--mosaic", "rggb"]).is_ok());
        let id = "00000000-0000-7000-8000-000000000000";
        assert!(parse(&["--calibration", id, "--dark", "a", "--dark", "b"]).is_ok());
        for option in ["--masks=m.npy", "--masks-full-scale=1", "--mosaic=rggb"] {
            assert!(parse(&["--calibration", id, option]).is_err(), "{option}");
        }
        assert!(parse(&["--masks", "m.npy", "--tile", "64"]).is_err(), "without an overlap");
    }
}
