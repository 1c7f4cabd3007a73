//! Compares each row of the tables of formats and conversions with files from the programs of labs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use engine::intake::Source;
use formats::mat::SceneArray;
use formats::{Limits, Selection, read_stack};
use ndarray::Array3;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id, judges};
use crate::samples::{Scene, npy, npy_header};

/// A table row: its first cell, and its command if there is one.
type Row = (String, Option<String>);

/// Rows of the first table below this heading of a document.
fn rows(document: &str, heading: &str) -> Vec<Row> {
    let text = std::fs::read_to_string(document).unwrap();
    let (_, below) = text.split_once(heading).unwrap();
    let lines = below.lines().skip_while(|line| !line.starts_with("| ---")).skip(1);
    let row = |line: &str| {
        let first = line.trim_start_matches("| ").split(" | ").next().unwrap().to_owned();
        let command = line.split('`').find(|part| part.starts_with("python -c"));
        (first, command.map(str::to_owned))
    };
    lines.take_while(|line| line.starts_with('|')).map(row).collect()
}

/// The description of a file by `tests/judges/written_files.py`.
#[derive(Deserialize)]
struct Written {
    row: String,
    file: PathBuf,
    axes: Option<String>,
    /// Axis order that is read if none is stated; none for images.
    read_axes: Option<String>,
    name: Option<String>,
    packing: Option<String>,
    full_scale: Option<f32>,
    #[serde(default)]
    measurement: bool,
    /// The number of frames, if it is not that of the calibration.
    frames: Option<usize>,
    /// The reason for which the file is rejected.
    reason: Option<String>,
    /// Further fields of a request that is accepted.
    again: Option<Value>,
}

struct Judge {
    python: String,
    folder: tempfile::TempDir,
    app: TestApp,
    calibration: String,
}

impl Judge {
    /// Writes all files; none without Python.
    async fn new() -> Option<(Self, Vec<Written>)> {
        let python = judges()?;
        let folder = tempfile::tempdir().unwrap();
        run(Command::new(&python).arg("tests/judges/written_files.py").arg(folder.path()));
        let index = std::fs::read(folder.path().join("index.json")).unwrap();
        let app = TestApp::start().await;
        let masks = std::fs::read(folder.path().join("masks.npy")).unwrap();
        let calibration = id(&app.calibrate(masks).await.expect(201));
        let judge = Self { python, folder, app, calibration };
        Some((judge, serde_json::from_slice(&index).unwrap()))
    }

    /// Uploads a file and creates its resource with these fields.
    async fn send(&self, written: &Written, file: &Path, asked: &Value) -> Answer {
        let sha256 = self.app.upload(std::fs::read(file).unwrap()).await;
        let mut body = match written.measurement {
            true => json!({ "calibration": self.calibration, "data": sha256 }),
            false => json!({ "masks": sha256 }),
        };
        body.as_object_mut().unwrap().extend(asked.as_object().unwrap().clone());
        let kind = if written.measurement { "measurements" } else { "calibrations" };
        self.app.post(&format!("/v1/{kind}"), &body).await
    }

    /// Uploads a file that must be accepted, and compares its values with those written.
    async fn accept(&self, written: &Written, file: &Path, asked: &Value) {
        let created = self.send(written, file, asked).await.expect(201).json();
        let name = if written.measurement { "snapshots.npy" } else { "masks.npy" };
        let expected = read_stack(&self.folder.path().join(name), &Limits::default()).unwrap().1;
        let frames = written.frames.unwrap_or(expected.dim().0);
        let count = if written.measurement { "snapshots" } else { "frames" };
        let shape = (&created[count], &created["height"], &created["width"]);
        assert_eq!(json!(shape), json!([frames, 48, 64]), "{} {created}", written.row);
        if file.ends_with(&written.file) {
            let read_axes = written.axes.as_ref().or(written.read_axes.as_ref());
            assert_eq!(created["axes"], json!(read_axes), "{} {created}", written.row);
        }
        let array = if written.measurement { SceneArray::Measurements } else { SceneArray::Masks };
        let stated = |key: &str| asked[key].as_str().map(str::to_owned);
        let axes = stated("axes").map(|axes| axes.parse().unwrap());
        let scale = asked["full_scale"].as_f64().map(|scale| scale as f32);
        let source = Source::upload(file, array, scale, Limits::default())
            .named(stated("array"))
            .arranged(axes, written.measurement.then_some((48, 64)))
            .part(Selection::default(), stated("packing").map(|packing| packing.parse().unwrap()));
        let mut opened = source.open().unwrap();
        let mut values = Vec::new();
        while let Some(frame) = opened.next_frame().unwrap() {
            values.extend(frame);
        }
        let values = Array3::from_shape_vec((frames, 48, 64), values).unwrap();
        let expected = expected.slice_move(ndarray::s![..frames, .., ..]);
        let worst = (&values - &expected).iter().fold(0f32, |worst, value| worst.max(value.abs()));
        assert!(worst < 1e-6, "{} {}: {worst}", written.row, written.file.display());
    }
}

impl Written {
    fn asked(&self) -> Value {
        let mut asked = json!({});
        let options = [("axes", &self.axes), ("array", &self.name), ("packing", &self.packing)];
        let options = options.map(|(key, value)| (key, json!(value)));
        for (key, value) in options.into_iter().chain([("full_scale", json!(self.full_scale))]) {
            if !value.is_null() {
                asked[key] = value;
            }
        }
        asked
    }
}

fn run(command: &mut Command) {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[tokio::test]
async fn every_row_of_the_tables_holds() {
    let Some((judge, files)) = Judge::new().await else { return };
    let accepted = rows("docs/DATA.md", "## Supported input formats");
    let refused = rows("tests/judges/conversions.md", "# Conversions of refused files");
    let rows_of_files: BTreeSet<&str> =
        accepted.iter().chain(&refused).map(|(row, _)| &**row).collect();
    let written: BTreeSet<&str> = files.iter().map(|file| &*file.row).collect();
    assert_eq!(
        rows_of_files, written,
        "rows of the tables (left) differ from tests/judges/written_files.py (right)"
    );
    for file in &files {
        let (path, mut asked) = (judge.folder.path().join(&file.file), file.asked());
        if accepted.iter().any(|(row, _)| *row == file.row) {
            judge.accept(file, &path, &asked).await;
            continue;
        }
        let answer = judge.send(file, &path, &asked).await;
        let detail = answer.problem(422, "invalid_content");
        if let Some(reason) = &file.reason {
            assert_eq!(answer.json()["reason"], **reason, "{detail}");
        }
        if let Some(again) = &file.again {
            let mut asked = asked.clone();
            let again = again.as_object().unwrap().clone();
            let name = |(key, value)| (if key == "name" { "array".to_owned() } else { key }, value);
            asked.as_object_mut().unwrap().extend(again.into_iter().map(name));
            judge.accept(file, &path, &asked).await;
        }
        let (_, command) = refused.iter().find(|(row, _)| *row == file.row).unwrap();
        let Some(command) = command else { continue };
        // The line has the name of the array that was asked for.
        let name = file.name.as_deref().unwrap_or("mask");
        let command = &command.replace("'mask'", &format!("'{name}'"));
        assert!(detail.contains(command), "{}: no {command} in {detail}", file.row);
        let code = command.strip_prefix("python -c \"").unwrap().strip_suffix('"').unwrap();
        let folder = path.parent().unwrap();
        run(Command::new(&judge.python).args(["-c", code]).current_dir(folder));
        let mut file_names = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let out = file_names.find(|path| path.file_stem().is_some_and(|stem| stem == "out"));
        // The converted file has one array without a name.
        asked.as_object_mut().unwrap().remove("array");
        judge.accept(file, &out.unwrap(), &asked).await;
    }
}

/// Walks the small files in `cases` of the shared data, if they are available.
#[tokio::test]
async fn files_that_once_failed_are_read_or_refused_in_words() {
    let shared = std::env::var_os("SCI_RECON_SHARED").unwrap_or("../shared".into());
    let folder = Path::new(&shared).join("cases");
    if !folder.exists() {
        println!("skipped: {} is not there (SCI_RECON_SHARED names its parent)", folder.display());
        return;
    }
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let mut judge = tokio::process::Command::new(python);
    judge.env("PYTHONPATH", "clients/python/src");
    judge.env("SCI_RECON_URL", format!("http://{}", app.address()));
    let output = judge.arg("tests/judges/shared_cases.py").arg(folder).output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// An npy file of integers of `bytes` bytes.
fn integers(code: &str, bytes: usize, shape: &[usize], value: impl Fn(usize) -> u8) -> Vec<u8> {
    let count = shape.iter().product();
    let number = |at| std::iter::once(value(at)).chain(std::iter::repeat_n(0, bytes - 1));
    [npy_header(code, shape), (0..count).flat_map(number).collect()].concat()
}

/// Pseudorandom bits.
fn bit(at: usize) -> u8 {
    let mixed = (at as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    ((mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40 & 1) as u8
}

#[tokio::test]
async fn integer_masks_of_zeros_and_ones_are_closed_and_open() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let calibrate = async |file: Vec<u8>, fields: Value| {
        let mut body = json!({ "masks": app.upload(file).await });
        body.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        app.post("/v1/calibrations", &body).await.expect(201).json()
    };
    let shape = [8, 96, 96];
    for (code, bytes) in
        [("|u1", 1), ("<u2", 2), ("<u4", 4), ("<u8", 8), ("|i1", 1), ("<i2", 2), ("<i8", 8)]
    {
        let made = calibrate(integers(code, bytes, &shape, bit), json!({})).await;
        assert_eq!(made["reading"]["scale_basis"], "values", "{code} {made:#}");
        assert_eq!(made["full_scale"], 1.0, "{code}");
        assert!((made["mask_mean"].as_f64().unwrap() - 0.5).abs() < 0.02, "{made:#}");
        // One pixel in 256 is dark in all masks, and one is open in all, by chance.
        let report = format!("/v1/calibrations/{}/report", made["id"].as_str().unwrap());
        let report = app.get_until(&report, 200).await.json();
        let codes: Vec<&str> = report["findings"]
            .as_array()
            .unwrap()
            .iter()
            .map(|finding| finding["code"].as_str().unwrap())
            .collect();
        assert!(made["dead_pixels"].as_u64().unwrap() > 9, "{made:#}");
        assert!(!codes.contains(&"dead_pixels") && !codes.contains(&"stuck_pixels"), "{codes:?}");
    }
    let stated = calibrate(integers("|u1", 1, &shape, bit), json!({"full_scale": 255})).await;
    assert_eq!(
        (&stated["reading"]["scale_basis"], &stated["full_scale"]),
        (&json!("stated"), &json!(255.0))
    );
    let levels = calibrate(integers("|u1", 1, &shape, |at| 3 * bit(at)), json!({})).await;
    assert_eq!(
        (&levels["reading"]["scale_basis"], &levels["full_scale"]),
        (&json!("type"), &json!(255.0))
    );
}

#[tokio::test]
async fn masks_of_minus_one_and_one_are_refused() {
    let app = TestApp::start().await;
    let sign = |at| if bit(at) == 1 { 1.0 } else { -1.0 };
    let floats = npy(&[4, 64, 64], (0..4 * 64 * 64).map(sign));
    let integers = integers("|i1", 1, &[4, 64, 64], |at| if bit(at) == 1 { 1 } else { 255 });
    for file in [floats, integers] {
        let answer = app.calibrate(file).await;
        let detail = answer.problem(422, "invalid_content");
        assert_eq!(answer.json()["reason"], "bipolar_masks", "{detail}");
        assert!(detail.contains("(1+C)/2") && detail.contains("two exposures"), "{detail}");
    }
}

#[tokio::test]
async fn windows_and_ranges_select_the_part_that_masks_and_snapshots_share() {
    let app = TestApp::start().await;
    let (frames, height, width) = (6, 40, 48);
    let value =
        |k: usize, i: usize, j: usize| f32::from(bit((k * height + i) * width + j)) * 0.5 + 0.25;
    let masks = npy(
        &[frames, height, width],
        (0..frames * height * width)
            .map(|at| value(at / (height * width), at / width % height, at % width)),
    );
    let (row, column, rows, columns) = (4, 8, 32, 36);
    let sum = |i: usize, j: usize| (1..5).map(|k| value(k, i, j)).sum::<f32>() * 0.5;
    let large = npy(&[height, width], (0..height * width).map(|at| sum(at / width, at % width)));
    let small = npy(
        &[rows, columns],
        (0..rows * columns).map(|at| sum(row + at / columns, column + at % columns)),
    );
    let [masks, large, small] =
        [app.upload(masks).await, app.upload(large).await, app.upload(small).await];
    let whole = app.post("/v1/calibrations", &json!({ "masks": masks })).await.expect(201);
    let refused =
        app.post("/v1/measurements", &json!({"calibration": id(&whole), "data": small})).await;
    assert!(refused.problem(422, "size_mismatch").contains("`crop`"));

    let crop = json!({"row": row, "column": column, "height": rows, "width": columns});
    let asked = json!({"masks": masks, "crop": crop, "frames": [1, 4]});
    let part = app.post("/v1/calibrations", &asked).await.expect(201).json();
    assert_eq!(json!([part["frames"], part["height"], part["width"]]), json!([4, rows, columns]));
    assert_eq!((&part["reading"]["crop"], &part["reading"]["frames"]), (&crop, &json!([1, 4])));
    let places = (1..5).flat_map(|k| (0..rows * columns).map(move |at| (k, at)));
    let total: f32 =
        places.map(|(k, at)| value(k, row + at / columns, column + at % columns)).sum();
    let mean = f64::from(total) / (4 * rows * columns) as f64;
    assert!((part["mask_mean"].as_f64().unwrap() - mean).abs() < 1e-5, "{part:#} {mean}");
    let measure = async |fields: Value| {
        let mut body = json!({"calibration": part["id"]});
        body.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        app.post("/v1/measurements", &body).await
    };
    let plain = measure(json!({ "data": small })).await.expect(201).json();
    let cropped = measure(json!({"data": large, "crop": crop, "dark": [large]})).await;
    // A dark like the snapshot leaves nothing.
    assert_eq!(cropped.json()["reason"], "snapshot_zero");
    let cropped = measure(json!({"data": large, "crop": crop})).await.expect(201).json();
    assert_eq!((&cropped["height"], &cropped["width"]), (&json!(rows), &json!(columns)));
    assert_eq!(cropped["reading"]["crop"], crop);
    let picture = |of: &Value| {
        format!("/view/measurements/{}/pictures/snapshot-0", of["id"].as_str().unwrap())
    };
    let (first, second) = (app.get(&picture(&plain)).await, app.get(&picture(&cropped)).await);
    assert_eq!(first.bytes, second.bytes);

    for (fields, pointer) in [
        (json!({"crop": {"row": 9, "column": 0, "height": 32, "width": 8}}), "/crop"),
        (json!({"frames": [2, 6]}), "/frames"),
        (json!({"packing": "mono12p"}), "/packing"),
    ] {
        let mut body = json!({ "masks": masks });
        body.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
        let answer = app.post("/v1/calibrations", &body).await;
        answer.problem(422, "invalid_content");
        let problem = answer.json();
        assert_eq!(
            (&problem["reason"], &problem["pointer"]),
            (&json!("invalid_part"), &json!(pointer))
        );
    }
    let odd = json!({"masks": masks, "mosaic": "rggb", "crop": {"row": 1, "column": 0, "height": 32, "width": 8}});
    assert_eq!(app.post("/v1/calibrations", &odd).await.json()["pointer"], "/crop");
    let many = app.upload(npy(&[70, 32, 32], (0..70 * 1024).map(|at| f32::from(bit(at))))).await;
    let mut body = json!({"masks": many, "axes": "frame-row-column"});
    let refused = app.post("/v1/calibrations", &body).await;
    assert!(refused.problem(422, "size_mismatch").contains("`frames`"));
    body["frames"] = json!([60, 67]);
    assert_eq!(app.post("/v1/calibrations", &body).await.expect(201).json()["frames"], 8);
}

/// Darks in files of one array are read whatever its name; several arrays are listed with the options that select one.
#[tokio::test]
async fn the_only_array_of_a_file_needs_no_name() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let script = "import h5py, numpy, scipy.io, sys
dark, masks = numpy.full((2, 48, 64), 0.01, 'f4'), numpy.load('masks.npy')
scipy.io.savemat('dark.mat', {'black_level': dark.transpose(1, 2, 0)}, do_compression=True)
h5py.File('dark.h5', 'w')['entry/black_level'] = dark
numpy.savez('dark.npz', black_level=dark)
scipy.io.savemat('several.mat', {'a': dark[0], 'b': dark[1]})
scipy.io.savemat('masks.mat', {'codes': masks.transpose(1, 2, 0), 'other': masks[0]})
";
    std::fs::write(folder.path().join("masks.npy"), Scene::SMALL.masks()).unwrap();
    let mut write = tokio::process::Command::new(python);
    let written = write.args(["-c", script]).current_dir(&folder).status().await.unwrap();
    assert!(written.success());
    let read = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await);
    let data = app.upload(Scene::SMALL.snapshots()).await;
    for file in ["dark.mat", "dark.h5", "dark.npz"] {
        let dark = app.upload(read(file)).await;
        let body = json!({"calibration": calibration, "data": data, "dark": [dark]});
        app.post("/v1/measurements", &body).await.expect(201);
    }
    let dark = app.upload(read("several.mat")).await;
    let body = json!({"calibration": calibration, "data": data, "dark": [dark]});
    let answer = app.post("/v1/measurements", &body).await;
    let detail = answer.problem(422, "invalid_content");
    assert!(detail.contains("'a', 'b'") && detail.contains("save the array alone"), "{detail}");

    let run = |masks: &str, more: &[&str]| {
        let mut reconstruct = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        reconstruct.args(["reconstruct", "--masks", masks, "--measurement", "y.npy"]);
        reconstruct.args(["--algorithm", "gap-tv", "--iterations", "3", "--json"]).args(more);
        reconstruct.current_dir(&folder).output().unwrap()
    };
    std::fs::write(folder.path().join("y.npy"), Scene::SMALL.snapshots()).unwrap();
    let output = run("masks.mat", &[]);
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(
        text.contains("'codes' (48x64x4), 'other' (48x64)") && text.contains("--masks-array"),
        "{text}"
    );
    let output = run("masks.mat", &["--masks-array", "codes", "--dark", "dark.mat"]);
    assert!([Some(0), Some(3)].contains(&output.status.code()), "{output:?}");
}
