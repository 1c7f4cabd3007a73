//! Compares each row of the tables in `docs/DATA.md` with files from the programs of labs.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use engine::intake::Source;
use formats::mat::SceneArray;
use formats::{Limits, read_stack};
use ndarray::Array3;
use serde::Deserialize;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id, judges};

/// A table row: its first cell, and its command if there is one.
type Row = (String, Option<String>);

/// Rows of the first table below this heading.
fn rows(heading: &str) -> Vec<Row> {
    let text = std::fs::read_to_string("docs/DATA.md").unwrap();
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
            .arranged(axes, written.measurement.then_some((48, 64)));
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
        let options = [("axes", json!(self.axes)), ("array", json!(self.name))];
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
    let (accepted, refused) = (rows("## Supported input formats"), rows("## Convert other files"));
    let rows_of_files: BTreeSet<&str> =
        accepted.iter().chain(&refused).map(|(row, _)| &**row).collect();
    let written: BTreeSet<&str> = files.iter().map(|file| &*file.row).collect();
    assert_eq!(
        rows_of_files, written,
        "rows of docs/DATA.md (left) differ from tests/judges/written_files.py (right)"
    );
    for file in &files {
        let (path, asked) = (judge.folder.path().join(&file.file), file.asked());
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
        assert!(detail.contains(command), "{}: no {command} in {detail}", file.row);
        let code = command.strip_prefix("python -c \"").unwrap().strip_suffix('"').unwrap();
        let folder = path.parent().unwrap();
        run(Command::new(&judge.python).args(["-c", code]).current_dir(folder));
        let mut file_names = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let out = file_names.find(|path| path.file_stem().is_some_and(|stem| stem == "out"));
        judge.accept(file, &out.unwrap(), &asked).await;
    }
}
