//! The inputs of `tests/data/ways` need each option of `requests.json`. All ways in must give the same frames, findings and verdict.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Map, Value, json};
use tokio::process::Command;

use crate::app::{Answer, TestApp, has_programs, id, judges};
use crate::faults::sha256;

const FOLDER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/ways");

/// The requests without the hashes of their files.
fn requests() -> Value {
    serde_json::from_slice(&file("requests.json")).unwrap()
}

fn file(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(FOLDER).join(name)).unwrap()
}

/// The files of a measurement: an array with a window and an order of axes, or packed pixels.
#[derive(Clone, Copy)]
struct Input {
    /// The request in `requests.json`.
    request: &'static str,
    data: &'static str,
    dark: &'static str,
}

const ARRAY: Input = Input { request: "measurement", data: "bench.h5", dark: "dark.npy" };
const PACKED: Input = Input { request: "packed", data: "shots.raw", dark: "dark.raw" };

/// Properties of a resource that every way must agree on.
fn facts(resource: &Value, names: &[&str]) -> Value {
    names.iter().map(|name| ((*name).to_owned(), resource[name].clone())).collect()
}

fn codes(warnings: &Value) -> Value {
    warnings.as_array().unwrap().iter().map(|finding| finding["code"].clone()).collect()
}

/// Facts, findings, verdict and frames of a job. `reading` includes the parts of the files that were read.
async fn effect(app: &TestApp, job: &str, reading: bool) -> Value {
    let job = app.ended(job).await;
    assert_eq!(job["state"], "succeeded", "{job:#}");
    let resource = async |kind: &str, id: &Value| {
        let path = format!("/v1/{kind}/{}", id.as_str().unwrap());
        app.get(&path).await.expect(200).json()
    };
    let measurement = resource("measurements", &job["measurement"]).await;
    let calibration = resource("calibrations", &measurement["calibration"]).await;
    let mut names = vec!["full_scale", "height", "width"];
    if reading {
        names.extend(["axes", "reading", "format", "sample"]);
    }
    let npy = format!("/v1/jobs/{}/exports/npy", job["id"].as_str().unwrap());
    json!({
        "calibration": facts(&calibration, &[&names[..], &["frames", "mask_mean", "dead_pixels"]].concat()),
        "measurement": facts(&measurement, &[&names[..], &["snapshots", "saturation"]].concat()),
        "darks": measurement["dark"].as_array().unwrap().len(),
        "job": facts(&job, &["registration", "verdict", "verdict_text"]),
        "codes": [codes(&measurement["warnings"]), codes(&job["warnings"])],
        "frames": sha256(&app.get(&npy).await.expect(200).bytes),
    })
}

/// Sends the requests of an input over HTTP; returns the job, or `None` if one of them is refused.
async fn over_http(app: &TestApp, all: &Value, input: Input) -> Option<String> {
    let with = |name: &str, more: Value| {
        let mut body = all[name].as_object().unwrap().clone();
        body.extend(more.as_object().unwrap().clone());
        Value::Object(body)
    };
    let masks = app.upload(file("bench.h5")).await;
    let body = with("calibration", json!({"masks": masks}));
    let calibration = accepted(app.post("/v1/calibrations", &body).await)?;
    let data = app.upload(file(input.data)).await;
    let body = with(input.request, json!({"calibration": calibration, "data": data}));
    let measurement = accepted(app.post("/v1/measurements", &body).await)?;
    let body = with("job", json!({"measurement": measurement}));
    accepted(app.post("/v1/jobs", &body).await)
}

fn accepted(answer: Answer) -> Option<String> {
    answer.status.is_success().then(|| id(&answer))
}

/// The requests with the hashes of dark captures and the map of bad pixels.
async fn with_files(app: &TestApp, input: Input) -> Value {
    let mut all = requests();
    all["calibration"]["bad_pixels"] = app.upload(file("bad.npy")).await.into();
    all[input.request]["dark"] = json!([app.upload(file(input.dark)).await]);
    all
}

#[tokio::test]
async fn every_option_of_the_requests_has_its_effect() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let mut frames = BTreeMap::new();
    for input in [ARRAY, PACKED] {
        let all = with_files(&app, input).await;
        let job = over_http(&app, &all, input).await.unwrap();
        let whole = effect(&app, &job, true).await;
        frames.insert(input.request, whole["frames"].clone());
        for request in ["calibration", input.request] {
            let read = &whole[if request == "calibration" { request } else { "measurement" }];
            for (name, stated) in all[request].as_object().unwrap() {
                match name.as_str() {
                    "crop" | "frames" | "packing" => assert_eq!(&read["reading"][name], stated),
                    "axes" => assert_eq!(&read[name], stated),
                    "full_scale" => {
                        assert_eq!(
                            (read[name].as_f64(), &read["reading"]["scale_basis"]),
                            (stated.as_f64(), &json!("stated"))
                        );
                    }
                    _ => {}
                }
            }
        }
        assert_eq!(whole["job"]["registration"]["shift"], json!([2.0, -1.0]), "{whole:#}");
        assert!(
            ["good", "usable"].contains(&whole["job"]["verdict"].as_str().unwrap()),
            "{whole:#}"
        );
        // Each option is needed: without it, a request is refused or the result differs.
        for request in ["calibration", input.request, "job"] {
            for name in all[request].as_object().unwrap().keys().filter(|name| *name != "algorithm")
            {
                let mut others = all.clone();
                others[request].as_object_mut().unwrap().remove(name);
                let Some(job) = over_http(&app, &others, input).await else { continue };
                let other = effect(&app, &job, false).await;
                assert_ne!(other["frames"], whole["frames"], "{request} without {name}: {other:#}");
            }
        }
    }
    assert_eq!(frames["measurement"], frames["packed"], "the files hold the same numbers");
}

/// The options of the command line for the requests of an input. Options of masks start with `masks-`.
fn options(all: &Value, input: Input) -> Vec<String> {
    let path = |name: &str| format!("{FOLDER}/{name}");
    let files = [("masks", "bench.h5"), ("bad-pixels", "bad.npy"), ("dark", input.dark)];
    let files = files.map(|(option, name)| format!("--{option}={}", path(name)));
    let text = |value: &Value| match value {
        Value::String(text) => text.clone(),
        Value::Array(ends) => format!("{}-{}", ends[0], ends[1]),
        Value::Object(crop) if crop.contains_key("row") => {
            ["row", "column", "height", "width"].map(|side| crop[side].to_string()).join(",")
        }
        Value::Object(moved) => format!("{},{}", moved["shift"][0], moved["shift"][1]),
        number => number.to_string(),
    };
    let of = |request: &str, prefix: &str| -> Vec<String> {
        let stated = all[request].as_object().unwrap().iter();
        stated
            .map(|(name, value)| format!("--{prefix}{}={}", name.replace('_', "-"), text(value)))
            .collect()
    };
    [files.to_vec(), of("calibration", "masks-"), of(input.request, ""), of("job", "")].concat()
}

/// Submits the files named in a JSON object, with its keywords, and prints the job.
const PYTHON: &str = "
import json, sys
from sci_recon import Client
with Client() as client:
    print(client.reconstruct(**json.loads(sys.argv[1])).job.id)";

/// Writes the arrays of bench.h5, a dark capture and the map of bad pixels for MATLAB.
const ARRAYS: &str = "
import h5py, numpy, scipy.io, sys
folder, path = sys.argv[1:]
with h5py.File(f'{folder}/bench.h5') as bench:
    patterns, shots = bench['optics/patterns'][:], bench['camera/shots'][:].transpose(1, 0, 2)
dark, bad = numpy.load(f'{folder}/dark.npy'), numpy.load(f'{folder}/bad.npy')
scipy.io.savemat(path, dict(patterns=patterns, shots=shots, dark=dark, bad=bad))";

/// Selects and unpacks in memory what the options of the other ways state, submits it, and prints the job.
const MATLAB: &str = "
addpath('clients/matlab'); load(getenv('ARRAYS')); window = 9:72;
function pixels = unpacked(name)
  file = fopen(fullfile(getenv('FOLDER'), name)); bytes = reshape(fread(file, Inf, 'uint8'), 3, []); fclose(file);
  low = bitand(bytes(2, :), 15);
  counts = [bytes(1, :) + 256 * low; (bytes(2, :) - low) / 16 + 16 * bytes(3, :)];
  pixels = uint16(permute(reshape(counts, 64, 64, []), [2 1 3]));
end
if strcmp(getenv('INPUT'), 'packed')
  data = unpacked('shots.raw'); dark = unpacked('dark.raw');
else
  data = shots(window, window, :); dark = dark(window, window);
end
[~, job] = sci_recon(patterns(window, window, 2:9), data, 'masks_full_scale', 1000, 'full_scale', 900, 'dark', dark, ...
                     'saturation', 3500, 'bad_pixels', bad, 'registration', [2 -1], 'algorithm', 'gap-tv', 'quiet', true);
printf('%s', job.id);";

/// The keywords of `Client.reconstruct` for the requests of an input.
fn keywords(all: &Value, input: Input) -> Value {
    let path = |name: &str| json!(format!("{FOLDER}/{name}"));
    let mut keywords = Map::new();
    let masks = all["calibration"].as_object().unwrap().iter();
    keywords.extend(masks.map(|(name, value)| (format!("masks_{name}"), value.clone())));
    keywords.extend(all[input.request].as_object().unwrap().clone());
    keywords.extend(all["job"].as_object().unwrap().clone());
    let files = [("masks", "bench.h5"), ("measurement", input.data), ("bad_pixels", "bad.npy")];
    keywords.extend(files.map(|(name, value)| (name.to_owned(), path(value))));
    keywords.insert("dark".to_owned(), json!([path(input.dark)]));
    Value::Object(keywords)
}

/// Runs a client, and returns its output without the whitespace at the ends.
async fn run(app: &TestApp, program: &mut Command) -> String {
    program.env("SCI_RECON_URL", format!("http://{}", app.address()));
    let output = program.env("PYTHONPATH", "clients/python/src").output().await.unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{program:?}: {errors}");
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

/// Lets a hot folder submit a copy of the data, and returns its job.
async fn dropped(app: &TestApp, mut watch: Command, name: &str, data: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    let name = format!("{name}.{}", data.rsplit('.').next().unwrap());
    std::fs::write(folder.path().join(&name), file(data)).unwrap();
    watch.arg(folder.path()).args(["--once", "--settle-seconds=0.1"]);
    run(app, &mut watch).await;
    let report = std::fs::read_to_string(folder.path().join(format!("{name}.result/REPORT.txt")));
    let jobs = app.get("/v1/jobs").await.expect(200).json();
    let job = jobs["items"].as_array().unwrap().iter().find(|job| job["label"] == *name).unwrap();
    let verdict = job["verdict_text"].as_str().unwrap();
    assert!(report.unwrap().starts_with(&format!("{name}: {verdict}\n")));
    job["id"].as_str().unwrap().to_owned()
}

#[tokio::test]
async fn every_way_has_the_same_effect() {
    let Some(python) = judges() else { return };
    if !has_programs(&["octave-cli"], "octave") {
        return;
    }
    let app = TestApp::with(&["--workers", "1"]).await;
    let all = requests();
    let arrays = tempfile::Builder::new().suffix(".mat").tempfile().unwrap();
    run(&app, Command::new(&python).args(["-c", ARRAYS, FOLDER]).arg(arrays.path())).await;
    for input in [ARRAY, PACKED] {
        let first = over_http(&app, &with_files(&app, input).await, input).await.unwrap();
        let expected = effect(&app, &first, true).await;
        let options = options(&all, input);
        let program = || Command::new(env!("CARGO_BIN_EXE_sci-recon"));

        let mut submit = program();
        submit.arg("submit").arg(format!("{FOLDER}/{}", input.data)).args(&options);
        let submitted = run(&app, &mut submit).await;
        let mut watch = program();
        watch.arg("watch-folder").args(&options);
        let watched = dropped(&app, watch, "watched", input.data).await;
        let mut client = Command::new(&python);
        client.args(["-c", PYTHON]).arg(keywords(&all, input).to_string());
        let reconstructed = run(&app, &mut client).await;
        let mut watch = Command::new(&python);
        watch.args(["-m", "sci_recon", "watch"]).args(&options);
        let python_watched = dropped(&app, watch, "python", input.data).await;
        for (way, job) in [
            ("submit", submitted),
            ("watch-folder", watched),
            ("Python", reconstructed),
            ("Python's hot folder", python_watched),
        ] {
            assert_eq!(effect(&app, &job, true).await, expected, "{way}");
        }

        // MATLAB sends arrays, so that the parts of files that were read differ.
        let mut matlab = Command::new("octave-cli");
        matlab.args(["--no-init-file", "--eval", MATLAB]);
        matlab.env("ARRAYS", arrays.path()).env("FOLDER", FOLDER).env("INPUT", input.request);
        let job = run(&app, &mut matlab).await;
        assert_eq!(effect(&app, &job, false).await, effect(&app, &first, false).await, "MATLAB");
    }
}
