//! The client libraries against the real service.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use crate::app::{TestApp, has_programs, id, judges, training};
use crate::resumable::cutting;
use crate::samples::{Scene, constant};

/// Runs a client over connections that are cut, and returns its output.
async fn over_cuts(app: &TestApp, mut client: tokio::process::Command) -> Value {
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let (proxy, cuts) = cutting(app.address()).await;
    client.env("SCI_RECON_URL", format!("http://{proxy}")).env("SCI_RECON_TOKEN", &token);
    let output = client.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let cut = cuts.load(Ordering::Relaxed);
    eprintln!("{cut} connections were cut; {report}");
    assert!(cut >= 3, "{cut} connections were cut");
    // Retried requests have not created a second job.
    let jobs = app.get("/v1/jobs").await.expect(200).json();
    assert_eq!(jobs["items"].as_array().unwrap().len(), 1, "{jobs}");
    assert_eq!(jobs["items"][0]["id"], report["job"]);
    report
}

#[tokio::test]
async fn the_python_client_survives_cut_connections() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { frames: 8, height: 384, width: 384, snapshots: 2 };
    std::fs::write(folder.path().join("masks.npy"), scene.masks()).unwrap();
    std::fs::write(folder.path().join("measurement.npy"), scene.snapshots()).unwrap();
    let mut client = tokio::process::Command::new(python);
    client.env("PYTHONPATH", "clients/python/src");
    client.arg("tests/judges/python_client.py").arg(folder.path());
    let report = over_cuts(&app, client).await;
    assert_eq!(report["frames"], serde_json::json!([16, 384, 384]));
}

#[test]
fn keywords_of_python_are_the_properties_of_the_contract() {
    let Some(python) = judges() else { return };
    let contract = std::fs::read_to_string("openapi.yaml").unwrap();
    let contract: Value = serde_yaml_ng::from_str(&contract).unwrap();
    let names = |schema: &str| -> Vec<String> {
        let properties = &contract["components"]["schemas"][schema]["properties"];
        properties.as_object().unwrap().keys().cloned().collect()
    };
    let schemas = ["CalibrationRequest", "MeasurementRequest", "JobRequest"];
    let properties: Value = schemas.iter().map(|schema| (*schema, names(schema))).collect();
    let mut judge = std::process::Command::new(python);
    judge.env("PYTHONPATH", "clients/python/src").arg("tests/judges/python_options.py");
    let output = judge.arg(properties.to_string()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn options_of_matlab_are_the_properties_of_the_contract() {
    let contract = std::fs::read_to_string("openapi.yaml").unwrap();
    let contract: Value = serde_yaml_ng::from_str(&contract).unwrap();
    // Arrays of MATLAB are in memory: they are selected, ordered and cut there. Files and jobs that make masks, and the identifiers
    // that link the requests, are no options.
    let others = [
        "array",
        "axes",
        "crop",
        "frames",
        "packing",
        "captures",
        "registration_of",
        "masks",
        "data",
        "calibration",
        "measurement",
    ];
    let mut expected = BTreeSet::from(["url", "token", "quiet"].map(str::to_owned));
    for schema in ["CalibrationRequest", "MeasurementRequest", "JobRequest"] {
        let properties = &contract["components"]["schemas"][schema]["properties"];
        for name in properties.as_object().unwrap().keys() {
            let is_mask_option =
                schema == "CalibrationRequest" && ["name", "full_scale"].contains(&name.as_str());
            let prefix = if is_mask_option { "masks_" } else { "" };
            if !others.contains(&name.as_str()) {
                expected.insert(format!("{prefix}{name}"));
            }
        }
    }
    let source = std::fs::read_to_string("clients/matlab/sci_recon.m").unwrap();
    let (_, options) = source.split_once("function o = options").unwrap();
    let (options, _) = options.split_once("for k =").unwrap();
    let quoted = options.split('\'').skip(1).step_by(2);
    let is_name = |text: &&str| text.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    let names: BTreeSet<String> = quoted.filter(is_name).map(str::to_owned).collect();
    assert_eq!(names, expected);
    let (help, _) = source.split_once("if ischar(masks)").unwrap();
    for name in names {
        assert!(help.contains(&format!("'{name}'")), "the help does not explain {name}");
    }
}

/// The hot folder in Python, started several times: a job for each file, and its verdict and findings with its results.
#[tokio::test]
async fn python_watches_a_folder() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let scene = Scene { frames: 4, height: 128, width: 128, snapshots: 1 };
    let watch = async || {
        let mut watch = tokio::process::Command::new(&python);
        watch.env("PYTHONPATH", "clients/python/src");
        watch.env("SCI_RECON_URL", format!("http://{}", app.address()));
        watch.args(["-m", "sci_recon", "watch", "--algorithm=gap-tv", "--once"]);
        watch.args(["--settle-seconds=0.1", "--crop=0,0,128,128", "--masks-frames=0-3"]);
        for (option, file) in
            [("--masks", "masks.npy"), ("--bad-pixels", "map.npy"), ("--truth", "truth.npy")]
        {
            watch.arg(option).arg(path(file));
        }
        let output = watch.arg(folder.path()).output().await.unwrap();
        let text = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.code(), text.concat())
    };
    // These files belong to every snapshot, so they are no snapshots themselves.
    std::fs::write(path("masks.npy"), scene.masks()).unwrap();
    std::fs::write(path("map.npy"), constant(&[128, 128], 0.0)).unwrap();
    std::fs::write(path("truth.npy"), constant(&[4, 128, 128], 0.5)).unwrap();
    let outside = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(outside.path(), scene.snapshots()).unwrap();
    let mut savez = std::process::Command::new(&python);
    savez.args(["-c", "import sys, numpy; numpy.savez(sys.argv[2], meas=numpy.load(sys.argv[1]))"]);
    assert!(savez.arg(outside.path()).arg(path("drop.npz")).status().unwrap().success());
    std::fs::write(path("small.npy"), constant(&[1, 8, 8], 0.5)).unwrap();
    let (status, text) = watch().await;
    assert_eq!(status, Some(1), "small.npy has failed: {text}");
    let reason = std::fs::read_to_string(path("small.npy.failed.txt")).unwrap();
    assert!(reason.contains("shape_mismatch") || reason.contains("crop"), "{reason}");
    let jobs = app.get("/v1/jobs").await.expect(200).json();
    assert_eq!(jobs["items"].as_array().unwrap().len(), 1, "{jobs}");
    let job = &jobs["items"][0];
    assert!(job["truth"].is_string() && job["verdict"] != "bad", "{job:#}");
    let report = std::fs::read_to_string(path("drop.npz.result/REPORT.txt")).unwrap();
    let verdict = job["verdict_text"].as_str().unwrap();
    assert!(report.starts_with(&format!("drop.npz: {verdict}\n")), "{report}");
    assert!(report.contains(job["id"].as_str().unwrap()), "{report}");
    assert!(path("drop.npz.result/snapshot_0000/frames.npy").exists());
    assert!(path("drop.npz.result/snapshot_0000/stack.tif").exists());
    assert_eq!(watch().await.0, Some(0), "files that were processed are not processed again");
    // Masks in place of snapshots.
    std::fs::write(path("oops.npy"), scene.masks()).unwrap();
    let (status, text) = watch().await;
    assert_eq!(status, Some(3), "{text}");
    assert!(text.contains("oops.npy is in oops.npy.result: bad, no expected PSNR"), "{text}");
    let report = std::fs::read_to_string(path("oops.npy.result/REPORT.txt")).unwrap();
    let findings = report.lines().filter(|line| line.starts_with("error "));
    assert!(report.starts_with("oops.npy: bad") && findings.count() > 0, "{report}");
    assert!(report.contains("Remedy: "), "{report}");
    let count = app.get("/v1/jobs").await.expect(200).json()["items"].as_array().unwrap().len();
    assert_eq!(count, 2);
    assert!(!path("drop.npz.2.result").exists() && !path("small.npy.2.failed.txt").exists());
    // A restart before the end of a job, when the record of processed files lacks it, continues with that job.
    std::fs::write(path(".sci-recon-watch.json"), "{}").unwrap();
    let (status, text) = watch().await;
    assert_eq!(status, Some(1), "{text}");
    assert!(path("drop.npz.2.result").exists() && path("oops.npy.2.result").exists(), "{text}");
    let count = app.get("/v1/jobs").await.expect(200).json()["items"].as_array().unwrap().len();
    assert_eq!(count, 2, "{text}");
    std::fs::write(path(".sci-recon-watch.json"), "{").unwrap();
    let (_, text) = watch().await;
    assert!(text.contains("is damaged") && !text.contains("Traceback"), "{text}");
}

/// Runs a notebook of the Python client against a service, and returns the judge's report.
async fn notebook(app: &TestApp, python: String, file: &str) -> Value {
    let mut notebook = tokio::process::Command::new(python);
    // A relative path would refer to the kernel's working folder.
    let clients = concat!(env!("CARGO_MANIFEST_DIR"), "/clients/python");
    notebook.env("PYTHONPATH", format!("{clients}/src"));
    notebook.env("SCI_RECON_URL", format!("http://{}", app.address()));
    notebook.arg("tests/judges/run_notebook.py").arg(format!("{clients}/examples/{file}"));
    let output = notebook.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[tokio::test]
async fn the_notebook_runs_from_top_to_bottom() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let report = notebook(&app, python, "first_reconstruction.ipynb").await;
    let text = report["printed"].as_str().unwrap();
    let jobs = app.get("/v1/jobs").await.expect(200).json();
    assert!(text.contains(jobs["items"][0]["id"].as_str().unwrap()), "{report}");
    let psnr = text.split("PSNR ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
    assert!(psnr.parse::<f64>().unwrap() > 25.0, "{report}");
    let shown = report["kinds"].to_string();
    assert!(shown.contains("image/png") && shown.contains("text/html"), "{report}");
}

#[tokio::test]
async fn deepinv_reconstructs_with_the_operator_of_a_calibration() {
    let Some(python) = training() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let report = notebook(&app, python, "deepinv.ipynb").await;
    let text = report["printed"].as_str().unwrap();
    for name in ["sci-recon: ", "deepinv: "] {
        let psnr = text.split(name).nth(1).and_then(|rest| rest.split(' ').next()).unwrap();
        assert!(psnr.parse::<f64>().unwrap() > 22.0, "{report}");
    }
    assert!(report["kinds"].to_string().contains("image/png"), "{report}");
}

#[tokio::test]
async fn the_forward_model_of_the_python_client_is_right() {
    let Some(python) = training() else { return };
    let app = TestApp::start().await;
    let folder = tempfile::tempdir().unwrap();
    let (masks, file) = (Scene::SMALL.masks(), folder.path().join("masks.npy"));
    std::fs::write(&file, &masks).unwrap();
    let calibration = id(&app.calibrate(masks).await.expect(201));
    let mut judge = tokio::process::Command::new(python);
    judge.env("PYTHONPATH", "clients/python/src").arg("tests/judges/python_physics.py");
    judge.arg(format!("http://{}", app.address())).arg(calibration).arg(file);
    let output = judge.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["ok"], true, "{report}");
}

#[tokio::test]
async fn the_octave_client_survives_cut_connections() {
    let mut client = tokio::process::Command::new("octave-cli");
    client.args(["--quiet", "--no-init-file", "tests/judges/octave_client.m"]);
    if !has_programs(&["octave-cli"], "octave") {
        return;
    }
    over_cuts(&TestApp::with(&["--workers", "1"]).await, client).await;
}

/// Forwards connections to the service with `Prefer: respond-async` added, so that checks outlast
/// their requests. Returns the number of such requests.
async fn respond_async(service: String) -> (SocketAddr, Arc<AtomicU64>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (address, asked) = (listener.local_addr().unwrap(), Arc::new(AtomicU64::new(0)));
    let counter = asked.clone();
    tokio::spawn(async move {
        loop {
            let (mut client, _) = listener.accept().await.unwrap();
            let (service, asked) = (service.clone(), counter.clone());
            tokio::spawn(async move {
                let mut server = TcpStream::connect(&service).await.unwrap();
                let (mut from_client, mut to_client) = client.split();
                let (mut from_server, mut to_server) = server.split();
                let requests = async {
                    let mut buffer = vec![0; 64 << 10];
                    while let Ok(count @ 1..) = from_client.read(&mut buffer).await {
                        let head = buffer[..count].to_ascii_lowercase();
                        let key = b"\r\nidempotency-key:";
                        let place = head.windows(key.len()).position(|part| part == key);
                        let (before, after) = buffer[..count].split_at(place.unwrap_or(0));
                        let hurry: &[u8] =
                            if place.is_some() { b"\r\nPrefer: respond-async" } else { b"" };
                        asked.fetch_add(u64::from(place.is_some()), Ordering::Relaxed);
                        if to_server.write_all(&[before, hurry, after].concat()).await.is_err() {
                            return;
                        }
                    }
                };
                tokio::select! {
                    () = requests => {}
                    _ = tokio::io::copy(&mut from_server, &mut to_client) => {}
                }
            });
        }
    });
    (address, asked)
}

#[tokio::test]
async fn clients_wait_for_checks_that_outlast_their_requests() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (proxy, asked) = respond_async(app.address()).await;
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene { frames: 8, height: 96, width: 96, snapshots: 2 };
    std::fs::write(folder.path().join("masks.npy"), scene.masks()).unwrap();
    std::fs::write(folder.path().join("measurement.npy"), scene.snapshots()).unwrap();
    let bright = constant(&[8, 96, 96], 3.0);
    std::fs::write(folder.path().join("bright.npy"), bright).unwrap();
    let url = format!("http://{proxy}");
    let submit = async |masks: &str| {
        let mut command = tokio::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["submit", "measurement.npy", "--algorithm", "gap-tv", "--masks", masks]);
        command.current_dir(folder.path()).env("SCI_RECON_URL", &url).output().await.unwrap()
    };
    let output = submit("masks.npy").await;
    let (report, errors) = (output.stdout, String::from_utf8_lossy(&output.stderr).into_owned());
    assert!(output.status.success(), "{errors}");
    let job = String::from_utf8(report).unwrap().trim().to_owned();
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert!(asked.load(Ordering::Relaxed) >= 3, "calibration, measurement and job");
    let output = submit("bright.npy").await;
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{errors}");
    assert!(
        errors.contains("invalid_content") && errors.contains("above the full scale 1"),
        "{errors}"
    );
    // The Python client inspects all jobs of the service.
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    if let Some(python) = judges() {
        let mut client = tokio::process::Command::new(python);
        client.env("PYTHONPATH", "clients/python/src").env("SCI_RECON_URL", &url);
        client.arg("tests/judges/python_client.py").arg(folder.path());
        let output = client.output().await.unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    if has_programs(&["octave-cli"], "octave") {
        let mut client = tokio::process::Command::new("octave-cli");
        client.args(["--quiet", "--no-init-file", "tests/judges/octave_client.m"]);
        let output = client.env("SCI_RECON_URL", &url).output().await.unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
}
