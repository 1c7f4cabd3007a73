//! Manifests of jobs: repeats a job, and compares the frames of another one.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::CliError;
use super::client::Client;
use super::error::{Result, open_input};
use super::submission::{PlainArguments, create_calibration};
use engine::job::{CalibrationId, MeasurementId, ModelId, ResultFile, Sha256};
use engine::pipeline::manifest::JOB_SCHEMA;

/// File with the frames of a snapshot.
const FRAMES: &str = "frames.npy";
/// Parts of the content that are not computed from the others.
const SETTINGS: [&str; 4] = ["program_version", "inputs", "request", "models"];
/// Differences and snapshots that are listed. Further ones are counted.
const LISTED: usize = 8;

/// A manifest to compare with.
#[derive(Debug, Args)]
pub(super) struct ManifestArguments {
    /// Compare the frames with the manifest of another job, and end with 1 if they differ.
    #[arg(long, value_name = "FILE")]
    manifest: Option<PathBuf>,
}

impl ManifestArguments {
    pub(super) fn read(&self) -> Result<Option<Manifest>> {
        self.manifest.as_deref().map(Manifest::read).transpose()
    }
}

/// The manifest of a job.
#[derive(Debug, Deserialize)]
pub(super) struct Manifest {
    content: Map<String, Value>,
    run: Run,
}

/// Identifiers of a job's inputs in the service that ran it.
#[derive(Debug, Deserialize)]
struct Run {
    label: Option<String>,
    truth_sha256: Option<Sha256>,
    calibration: CalibrationId,
    measurement: MeasurementId,
    model: Option<ModelId>,
}

/// The requests that repeat the inputs of a job.
#[derive(Debug, Deserialize)]
struct Inputs {
    masks_sha256: Sha256,
    calibration: Map<String, Value>,
    measurement: Map<String, Value>,
}

#[derive(Debug, Deserialize)]
struct Snapshot {
    snapshot: u32,
    files: Vec<ResultFile>,
}

impl Manifest {
    /// Errors: a file that can't be read, or is not the manifest of a job.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let refused = |text: String| CliError::Input(format!("{}: {text}", path.display()));
        let text = fs::read(path).map_err(|error| CliError::unreadable(path, &error))?;
        let value: Value =
            serde_json::from_slice(&text).map_err(|error| refused(format!("no JSON: {error}")))?;
        let whole = "give the manifest.json of a job, which `sci-recon fetch` writes into the folder of the results";
        match value["schema"].as_str() {
            Some(JOB_SCHEMA) => {}
            Some("sci-recon/snapshot/1") => {
                let text = format!("this is the manifest of a snapshot: {whole}");
                return Err(refused(text));
            }
            _ => return Err(refused(format!("this is no manifest: {whole}"))),
        }
        if value["content"]["request"].is_null() {
            let text =
                "an earlier version has written this manifest, which lacks the request of the job";
            return Err(refused(text.into()));
        }
        Self::parse(value).map_err(|error| refused(format!("a damaged manifest: {error}")))
    }

    /// Errors: a value of another form. All parts are parsed once.
    fn parse(value: Value) -> serde_json::Result<Self> {
        let manifest: Self = serde_json::from_value(value)?;
        let inputs: Inputs = manifest.part("inputs")?;
        let masks = inputs.calibration.get("masks").filter(|masks| !masks.is_null());
        if masks.is_some_and(|masks| *masks != json!(inputs.masks_sha256)) {
            return Err(serde::de::Error::custom("`masks` and `masks_sha256` differ"));
        }
        manifest.part::<Map<String, Value>>("request")?;
        manifest.part::<Vec<Snapshot>>("snapshots")?;
        Ok(manifest)
    }

    fn part<T: for<'de> Deserialize<'de>>(&self, name: &str) -> serde_json::Result<T> {
        T::deserialize(self.content.get(name).unwrap_or(&Value::Null))
    }

    fn read_part<T: for<'de> Deserialize<'de>>(&self, name: &str) -> Result<T> {
        self.part(name).map_err(|error| CliError::Failure(error.to_string()))
    }

    /// Hashes of the frames of all snapshots.
    fn frames(&self) -> Result<BTreeMap<u32, Sha256>> {
        let snapshots: Vec<Snapshot> = self.read_part("snapshots")?;
        let frames = |Snapshot { snapshot, files }| {
            let array = files.into_iter().find(|file| file.name == FRAMES)?;
            Some((snapshot, array.sha256))
        };
        Ok(snapshots.into_iter().filter_map(frames).collect())
    }

    /// The network of algorithm `learned`.
    fn network(&self) -> Option<Sha256> {
        self.run.model.as_ref()?;
        self.content.get("models")?.get(0)?.get("sha256")?.as_str()?.parse().ok()
    }

    /// Submits the job again, with the calibration, measurement and model of the manifest if the service has them. Otherwise
    /// they are created from uploads and from `files`.
    ///
    /// Errors: missing inputs, each with its hash; a file that is not an input; refusals of the service.
    pub(super) async fn submit(
        &self,
        client: &Client,
        files: &[PathBuf],
        plain: &PlainArguments,
        key: &str,
    ) -> Result<Value> {
        let Inputs { masks_sha256, calibration, mut measurement } = self.read_part("inputs")?;
        let mut job: Map<String, Value> = self.read_part("request")?;
        // A manifest may come from a stranger, and its webhook with it.
        job.remove("webhook");
        let Run { label, truth_sha256: truth, calibration: id, .. } = &self.run;
        let mut stated = calibration.clone();
        stated.insert("masks".to_owned(), json!(masks_sha256));
        let masks = Input::find(client, "calibrations", id.to_string(), &stated).await?;
        let masks = masks.made_of(uploads("masks", &calibration));
        let mut stated = measurement.clone();
        stated.insert("calibration".to_owned(), json!(id));
        let data = match &masks.existing {
            Some(_) => {
                let id = self.run.measurement.to_string();
                Input::find(client, "measurements", id, &stated).await?
            }
            None => Input::default(),
        };
        let data = data.made_of(uploads("measurement", &measurement));
        let network = match (&masks.existing, self.run.model, self.network()) {
            (Some(calibration), Some(id), Some(file)) => {
                let stated = json!({"calibration": calibration, "file": file});
                let stated = stated.as_object().cloned().unwrap_or_default();
                Input::find(client, "models", id.to_string(), &stated).await?
            }
            _ => Input::default(),
        };
        let network = network.made_of(self.network().map(|sha256| ("network".to_owned(), sha256)));
        let inputs = [&masks, &data, &network];
        let all = inputs.iter().flat_map(|input| &input.uploads);
        let all: Vec<_> =
            all.cloned().chain(truth.map(|it| ("true frames".to_owned(), it))).collect();
        let given = given(files, &all)?;

        let needed = inputs.iter().filter(|input| input.existing.is_none());
        let needed = needed.flat_map(|input| &input.uploads);
        let mut missing = Vec::new();
        for (role, sha256) in needed {
            match given.get(sha256) {
                Some(file) => drop(client.upload_with_bar(file).await?),
                None if client.has(*sha256).await? => {}
                None => missing.push(format!("{role} with the SHA-256 {sha256}")),
            }
        }
        if masks.existing.is_none() && masks.uploads.is_empty() {
            missing.push(format!(
                "calibration {}, which only the service that moved its masks has",
                self.run.calibration
            ));
        }
        if !missing.is_empty() {
            let text = format!(
                "the service lacks inputs of the manifest: {}. Add their files to the command",
                missing.join("; ")
            );
            return Err(CliError::Input(text));
        }

        let calibration = match masks.existing {
            Some(id) => id,
            None => create_calibration(client, &Value::Object(calibration)).await?,
        };
        let measurement = match data.existing {
            Some(id) => id,
            None => {
                measurement.insert("calibration".to_owned(), json!(calibration));
                client.create_checked("/v1/measurements", &Value::Object(measurement), key).await?
            }
        };
        if let Some(file) = self.network() {
            let model = match network.existing {
                Some(id) => id,
                None => {
                    let body = json!({"calibration": calibration, "file": file});
                    client.create_checked("/v1/models", &body, key).await?
                }
            };
            job.insert("model".to_owned(), json!(model));
        }
        if let Some(truth) = truth {
            if let Some(file) = given.get(truth) {
                client.upload_with_bar(file).await?;
            }
            if client.has(*truth).await? {
                job.insert("truth".to_owned(), json!(truth));
            }
        }
        job.insert("measurement".to_owned(), json!(measurement));
        plain.add_to(&mut job);
        if let Some(label) = label {
            job.entry("label").or_insert_with(|| json!(label));
        }
        Ok(client.create("/v1/jobs", &Value::Object(job), key).await?)
    }

    /// Compares the frames of a job that has succeeded with those of the manifest.
    pub(super) async fn compare(&self, client: &Client, job: &str) -> Result<Comparison> {
        let manifest = client.get(&format!("/v1/jobs/{job}/exports/manifest")).await?;
        let other = Self::parse(manifest).map_err(|error| {
            CliError::Failure(format!("the manifest of job {job} can't be read: {error}"))
        })?;
        self.difference(&other)
    }

    fn difference(&self, other: &Self) -> Result<Comparison> {
        let (expected, frames) = (self.frames()?, other.frames()?);
        let snapshots =
            expected.keys().chain(frames.keys().filter(|key| !expected.contains_key(key)));
        let snapshots = snapshots.copied().filter(|key| expected.get(key) != frames.get(key));
        let mut settings = Vec::new();
        for name in SETTINGS {
            let value = |manifest: &Self| manifest.content.get(name).cloned().unwrap_or_default();
            differences(name, &value(self), &value(other), &mut settings);
        }
        Ok(Comparison { compared: expected.len(), snapshots: snapshots.collect(), settings })
    }
}

/// A calibration, measurement or model of a job.
#[derive(Default)]
struct Input {
    /// The identifier, if the service has it.
    existing: Option<String>,
    /// The uploads that make it, with their roles.
    uploads: Vec<(String, Sha256)>,
}

impl Input {
    /// Looks for an input by its identifier. It must be ready, and agree with the request that is `stated` to have made it.
    async fn find(
        client: &Client,
        kind: &str,
        id: String,
        stated: &Map<String, Value>,
    ) -> Result<Self> {
        let found = client.find(&format!("/v1/{kind}/{id}")).await?;
        // A model has no state.
        let is_ready = |found: &Value| found["state"].as_str().is_none_or(|state| state == "ready");
        let existing = found.filter(|found| is_ready(found) && agrees(stated, found)).map(|_| id);
        Ok(Self { existing, uploads: Vec::new() })
    }

    fn made_of(self, uploads: impl IntoIterator<Item = (String, Sha256)>) -> Self {
        Self { uploads: uploads.into_iter().collect(), ..self }
    }
}

/// Fields of a resource that are empty unless the request states them.
const STATED: [&str; 11] = [
    "bad_pixels",
    "camera_fps",
    "crop",
    "dark",
    "data",
    "dispersion",
    "exposure_s",
    "frames",
    "mosaic",
    "packing",
    "saturation",
];

/// True if a resource agrees with the request that is `stated` to have made it: it has all values of the request, and no
/// others. Names are free.
fn agrees(stated: &Map<String, Value>, found: &Value) -> bool {
    let differs = |was: &Value, is: &Value| {
        #[allow(clippy::cast_possible_truncation)] // a scale has 32 bits
        match (was.as_f64(), is.as_f64()) {
            (Some(was), Some(is)) => was as f32 != is as f32,
            _ => was != is,
        }
    };
    let is_empty = |value: &Value| value.is_null() || value.as_array().is_some_and(Vec::is_empty);
    let has_scale = stated.get("full_scale").is_some_and(|scale| !scale.is_null());
    // The service states the scale of masks that it has made.
    if stated.contains_key("data") && found["reading"]["scale_basis"] == "stated" && !has_scale {
        return false;
    }
    let mut names = stated.keys().map(String::as_str).chain(STATED).filter(|name| *name != "name");
    names.all(|name| {
        let was = stated.get(name).filter(|was| !is_empty(was));
        // The `frames` of a calibration are their number, those of its `reading` the range.
        let own = || found.get(name).filter(|_| name != "frames");
        let is = found["reading"].get(name).or_else(own);
        match (was, is) {
            (Some(was), Some(is)) => !differs(was, is),
            (None, Some(is)) => !STATED.contains(&name) || is_empty(is),
            (_, None) => true,
        }
    })
}

/// The comparison of a job's frames with a manifest.
#[derive(Debug, PartialEq, Serialize)]
pub(super) struct Comparison {
    /// Number of snapshots of the manifest.
    compared: usize,
    /// Snapshots with other frames, or without frames on one side.
    snapshots: Vec<u32>,
    /// Settings that differ, as text.
    settings: Vec<String>,
}

impl Comparison {
    /// A line for people.
    pub(super) fn indented(&self) -> String {
        match self.difference() {
            Some(difference) => format!("    {difference}"),
            None => format!(
                "    equal to the manifest: same SHA-256 of the frames of {}",
                self.counted()
            ),
        }
    }

    /// The error of a job with other frames.
    pub(super) fn failure(&self, job: &str) -> Option<String> {
        self.difference().map(|difference| format!("job {job} is {difference}"))
    }

    fn counted(&self) -> String {
        let plural = if self.compared == 1 { "" } else { "s" };
        format!("{} snapshot{plural}", self.compared)
    }

    fn difference(&self) -> Option<String> {
        if self.snapshots.is_empty() && self.compared > 0 {
            return None;
        }
        let snapshots: Vec<String> = self.snapshots.iter().map(ToString::to_string).collect();
        let plural = if snapshots.len() == 1 { "" } else { "s" };
        let snapshots = listed(&snapshots, ", ");
        let cause = if self.settings.is_empty() {
            "inputs and settings are the same: another processor or GPU rounds differently"
                .to_owned()
        } else {
            listed(&self.settings, "; ")
        };
        Some(format!(
            "different from the manifest: other frames of snapshot{plural} {snapshots}. Cause: {cause}"
        ))
    }
}

/// The first of some texts, and the number of the others.
fn listed(texts: &[String], separator: &str) -> String {
    let more = texts.len().saturating_sub(LISTED);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    texts.iter().take(LISTED).cloned().collect::<Vec<_>>().join(separator) + &more
}

/// Appends each value of `was` that is another one in `is`, with its path.
fn differences(path: &str, was: &Value, is: &Value, found: &mut Vec<String>) {
    match (was, is) {
        (Value::Object(before), Value::Object(after)) => {
            let names =
                before.keys().chain(after.keys().filter(|name| !before.contains_key(*name)));
            for name in names {
                let value =
                    |object: &Map<String, Value>| object.get(name).cloned().unwrap_or_default();
                differences(&format!("{path}.{name}"), &value(before), &value(after), found);
            }
        }
        _ if was == is => {}
        _ => found.push(format!("{path} is {is}, and was {was}")),
    }
}

/// The files by their hashes.
///
/// Errors: a file that can't be read or is not an input.
fn given<'a>(
    files: &'a [PathBuf],
    inputs: &[(String, Sha256)],
) -> Result<HashMap<Sha256, &'a Path>> {
    let mut given = HashMap::new();
    for file in files {
        let hashed = Sha256::of_reader(&mut open_input(file)?);
        let (sha256, _) = hashed.map_err(|error| CliError::file("read", file, &error))?;
        if inputs.iter().all(|(_, input)| *input != sha256) {
            let inputs: Vec<String> =
                inputs.iter().map(|(role, sha256)| format!("{role} {sha256}")).collect();
            let text = format!(
                "{} has the SHA-256 {sha256} and is no input of the manifest, which has {}",
                file.display(),
                inputs.join(", ")
            );
            return Err(CliError::Input(text));
        }
        given.insert(sha256, file.as_path());
    }
    Ok(given)
}

/// The uploads of a request with their roles. Every text of the form of a hash names one.
fn uploads(role: &str, request: &Map<String, Value>) -> Vec<(String, Sha256)> {
    let mut uploads = Vec::new();
    for (name, value) in request {
        let name = name.replace('_', " ");
        let role = match name.as_str() {
            "masks" | "data" => role.to_owned(),
            "captures" => format!("captures of the {role}"),
            _ => format!("{name} of the {role}"),
        };
        texts(value, &mut |text| {
            uploads.extend(text.parse().ok().map(|sha256| (role.clone(), sha256)));
        });
    }
    uploads
}

/// Passes every text in a JSON value to `visit`.
fn texts(value: &Value, visit: &mut impl FnMut(&str)) {
    match value {
        Value::String(text) => visit(text),
        Value::Array(values) => values.iter().for_each(|value| texts(value, visit)),
        Value::Object(fields) => fields.values().for_each(|value| texts(value, visit)),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::{Comparison, Manifest};
    use engine::job::Sha256;

    fn manifest(frames: &[&str], size: u32) -> Value {
        let entry = |(snapshot, text): (usize, &&str)| {
            let sha256 = Sha256::of(text.as_bytes());
            json!({"snapshot": snapshot, "files": [{"name": "frames.npy", "size": 4, "sha256": sha256}]})
        };
        let snapshots: Vec<Value> = frames.iter().enumerate().map(entry).collect();
        json!({
            "schema": super::JOB_SCHEMA,
            "content": {
                "program_version": "1",
                "inputs": {"masks_sha256": Sha256::of(b"masks"), "calibration": {}, "measurement": {}},
                "request": {"tile": {"size": size}},
                "snapshots": snapshots,
            },
            "run": {
                "calibration": "0190a9b8-0000-7000-8000-000000000001",
                "measurement": "0190a9b8-0000-7000-8000-000000000002",
            },
        })
    }

    fn compared(was: Value, is: Value) -> Comparison {
        Manifest::parse(was).unwrap().difference(&Manifest::parse(is).unwrap()).unwrap()
    }

    #[test]
    fn a_comparison_names_the_snapshots_and_the_settings_that_differ() {
        let equal = compared(manifest(&["a", "b"], 64), manifest(&["a", "b"], 64));
        assert_eq!(equal.failure("x"), None);
        assert!(
            equal.indented().contains("equal to the manifest: same SHA-256 of the frames of 2")
        );
        let other = compared(manifest(&["a", "b"], 64), manifest(&["a", "c"], 32)).failure("x");
        let other = other.unwrap();
        assert!(other.contains("other frames of snapshot 1. Cause"), "{other}");
        assert!(other.ends_with("Cause: request.tile.size is 32, and was 64"), "{other}");
        let missing = compared(manifest(&["a"], 64), manifest(&["a", "b"], 64)).failure("x");
        assert!(missing.unwrap().contains("another processor or GPU"), "the same settings");
        assert!(compared(manifest(&[], 64), manifest(&[], 64)).failure("x").is_some());
    }

    #[test]
    fn a_resource_agrees_with_its_request_and_with_no_other() {
        let found = json!({
            "name": "bench", "data": "a", "full_scale": 0.1, "camera_fps": null, "dark": [], "saturation": 4095,
            "frames": 8, "reading": {"scale_basis": "stated", "crop": null, "frames": [2, 9]},
        });
        let agrees = |stated: Value| super::agrees(stated.as_object().unwrap(), &found);
        let request = json!({"data": "a", "full_scale": 0.1, "saturation": 4095, "frames": [2, 9]});
        assert!(agrees(request.clone()));
        let with = |name: &str, value: Value| {
            let mut request = request.clone();
            request[name] = value;
            request
        };
        for same in [("name", json!("other")), ("dark", json!([])), ("camera_fps", Value::Null)] {
            assert!(agrees(with(same.0, same.1.clone())), "{same:?}");
        }
        for other in [
            ("saturation", Value::Null),
            ("saturation", json!(1023)),
            ("frames", Value::Null),
            ("data", Value::Null),
            ("full_scale", Value::Null),
            ("full_scale", json!(0.2)),
            ("dark", json!(["b"])),
            ("camera_fps", json!(30)),
        ] {
            assert!(!agrees(with(other.0, other.1.clone())), "{other:?}");
        }
    }

    /// Corrected calibrations, and those of captures, were not read from one file of masks.
    #[test]
    fn calibrations_without_a_reading_agree() {
        let found = json!({"frames": 8, "reading": null, "bad_pixels": null});
        assert!(super::agrees(json!({"registration_of": "a"}).as_object().unwrap(), &found));
    }

    #[test]
    fn other_files_are_refused_with_what_to_give() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("manifest.json");
        let refused = |text: String| {
            std::fs::write(&file, text).unwrap();
            Manifest::read(&file).unwrap_err().to_string()
        };
        assert!(refused("{".into()).contains("no JSON"));
        assert!(refused("{}".into()).contains("this is no manifest"));
        let snapshot = json!({"schema": "sci-recon/snapshot/1"}).to_string();
        assert!(refused(snapshot).contains("the manifest of a snapshot"));
        let mut old = manifest(&["a"], 64);
        old["content"]["request"].take();
        assert!(refused(old.to_string()).contains("an earlier version"));
        let mut damaged = manifest(&["a"], 64);
        damaged["run"]["measurement"].take();
        assert!(refused(damaged.to_string()).contains("damaged"));
    }
}
