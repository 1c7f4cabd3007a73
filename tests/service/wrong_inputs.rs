//! Inputs that are wrong in ways that the files don't show: the finding names the cause.

use std::process::Command;

use serde_json::{Value, json};

use crate::app::{TestApp, has_programs, id, judges};
use crate::pipeline::values;
use crate::samples::{Scene, constant, npy};

const SIDE: usize = 144;
const PIXELS: usize = SIDE * SIDE;
const FRAMES: usize = 8;

/// Masks, and a snapshot of a pattern that moves by 1.5 pixels a frame.
fn scene() -> (Vec<f32>, Vec<f32>) {
    let masks = values(&Scene { frames: FRAMES, height: SIDE, width: SIDE, snapshots: 1 }.masks());
    let y = snapshot(&masks);
    (masks, y)
}

/// Masks with values between 0 and 1: an irregular pattern of 3x3 pixels, seen through four to six of nine openings.
fn grey_masks() -> Vec<f32> {
    let hash = |values: [usize; 2]| {
        let mut state = 0x9E37_79B9_7F4A_7C15_u64;
        for value in values {
            state = (state ^ value as u64).wrapping_mul(0xD6E8_FEB8_6659_FD93);
            state ^= state >> 32;
        }
        state
    };
    let pixel = |k: usize, row: usize, column: usize| {
        let is_open = |opening: &usize| hash([100 + k, *opening]) % 9 < 5;
        let open: Vec<usize> = (0..9).filter(is_open).collect();
        let pattern = |opening: &usize| {
            let place = [(row + 5 * (opening / 3)) / 3, (column + 7 * (opening % 3)) / 3];
            f32::from(u8::from(hash(place) & 1 == 1))
        };
        open.iter().map(pattern).sum::<f32>() / open.len() as f32
    };
    let place = |at: usize| pixel(at / PIXELS, at % PIXELS / SIDE, at % SIDE);
    (0..FRAMES * PIXELS).map(place).collect()
}

/// A snapshot of a pattern that moves by 1.5 pixels a frame behind masks.
fn snapshot(masks: &[f32]) -> Vec<f32> {
    snapshot_at(masks, 1.5)
}

/// A snapshot of a pattern that moves by `speed` pixels a frame behind masks.
fn snapshot_at(masks: &[f32], speed: f32) -> Vec<f32> {
    let pixel = |k: usize, at: usize| {
        let (row, column) = ((at / SIDE) as f32, (at % SIDE) as f32 + speed * k as f32);
        0.45 + 0.2 * (column * 0.2).sin() * (row * 0.15).cos()
            + 0.1 * (column * 0.31 + row * 0.27).sin()
    };
    let frames = masks.len() / PIXELS;
    let y = |at: usize| (0..frames).map(|k| masks[k * PIXELS + at] * pixel(k, at)).sum();
    (0..PIXELS).map(y).collect()
}

/// Masks that are enlarged by a factor about the middle of the picture.
fn enlarged(masks: &[f32], factor: f32) -> Vec<f32> {
    let middle = (SIDE - 1) as f32 / 2.0;
    let source = |at: usize| ((at as f32 - middle) / factor + middle).clamp(0.0, (SIDE - 1) as f32);
    let pixel = |at: usize| {
        let (row, column) = (source(at % PIXELS / SIDE), source(at % SIDE));
        let (i, j) = ((row as usize).min(SIDE - 2), (column as usize).min(SIDE - 2));
        let (down, right) = (row - i as f32, column - j as f32);
        let value = |i: usize, j: usize| masks[at / PIXELS * PIXELS + i * SIDE + j];
        (1.0 - down) * ((1.0 - right) * value(i, j) + right * value(i, j + 1))
            + down * ((1.0 - right) * value(i + 1, j) + right * value(i + 1, j + 1))
    };
    (0..masks.len()).map(pixel).collect()
}

/// The assessment and the codes of the findings.
fn reconstruct(masks: &[f32], y: &[f32]) -> (Value, Vec<String>) {
    reconstruct_after(masks, y, None)
}

/// The assessment and the codes of the findings, after an even dark was subtracted.
fn reconstruct_after(masks: &[f32], y: &[f32], dark: Option<f32>) -> (Value, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let shape = [masks.len() / PIXELS, SIDE, SIDE];
    std::fs::write(path("masks.npy"), npy(&shape, masks.iter().copied())).unwrap();
    std::fs::write(path("y.npy"), npy(&[SIDE, SIDE], y.iter().copied())).unwrap();
    let mut program = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    program.args(["reconstruct", "--masks", "masks.npy", "--measurement", "y.npy", "--json"]);
    program.args(["--algorithm", "gap-tv", "--iterations", "60", "--registration", "off"]);
    if let Some(level) = dark {
        std::fs::write(path("dark.npy"), constant(&[SIDE, SIDE], level)).unwrap();
        program.args(["--dark", "dark.npy"]);
    }
    let output = program.current_dir(folder.path()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!([Some(0), Some(3)].contains(&output.status.code()), "{text}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let codes = report["findings"].as_array().unwrap().iter();
    let codes = codes.map(|one| one["code"].as_str().unwrap().to_owned());
    (report["assessment"].clone(), codes.collect())
}

#[test]
fn the_right_input_has_a_figure_and_no_finding_on_the_masks() {
    let (masks, y) = scene();
    let (assessment, codes) = reconstruct(&masks, &y);
    assert_eq!(codes, Vec::<String>::new());
    assert!(assessment["psnr_db"].is_number(), "{assessment}");
    assert_eq!(assessment["order"], "consistent");
}

/// Areas of a picture by row and column: a square, one half, a frame, stripes.
const AREAS: [fn(usize, usize) -> bool; 4] = [
    |row, column| (40..104).contains(&row) && (40..104).contains(&column),
    |_, column| column < SIDE / 2,
    |row, column| row.min(column) < 28 || row.max(column) >= SIDE - 28,
    |_, column| column / 12 % 2 == 0,
];

#[tokio::test]
async fn large_areas_that_are_not_measured_cause_no_finding_and_hide_none() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (masks, y) = scene();
    for (which, is_hidden) in AREAS.into_iter().enumerate() {
        let hidden = |at: usize| is_hidden(at % PIXELS / SIDE, at % SIDE);
        let with = |values: &[f32], unknown: f32| -> Vec<f32> {
            let value = |(at, value): (usize, &f32)| if hidden(at) { unknown } else { *value };
            values.iter().enumerate().map(value).collect()
        };
        let unknown = with(&masks, f32::NAN);
        // The sensor has values that mean nothing in the area.
        let noise = |at: usize| if at * 7919 % 13 < 6 { 3.0 } else { 0.1 };
        let broken: Vec<f32> =
            y.iter().enumerate().map(|(at, y)| if hidden(at) { noise(at) } else { *y }).collect();
        let marked = ["bad_pixels"];
        // An uneven error is the effect of such an area.
        let found = |masks: &[f32], y: &[f32]| {
            let mut codes = reconstruct(masks, y).1;
            codes.retain(|code| code != "uneven_error");
            codes
        };
        assert_eq!(found(&unknown, &broken), marked, "area {which}");
        assert_eq!(found(&masks, &with(&y, f32::NAN)), marked, "area {which}");
        let dark = with(&masks, 0.0);
        // Stripes are too narrow for an area without an open mask.
        let closed = if which < 3 { &["dead_pixels"][..] } else { &[] };
        assert_eq!(found(&dark, &snapshot(&dark)), closed, "area {which}");
        let inverted: Vec<f32> = unknown.iter().map(|mask| 1.0 - mask).collect();
        let codes = reconstruct(&inverted, &broken).1;
        assert_eq!(codes[0], "inverted_masks", "area {which}: {codes:?}");
        let lifted: Vec<f32> = broken.iter().map(|y| y + 0.5).collect();
        let codes = reconstruct(&unknown, &lifted).1;
        assert!(codes.contains(&"no_dark".to_owned()), "area {which}: {codes:?}");

        let map = (0..PIXELS).map(|at| f32::from(u8::from(hidden(at))));
        let map = app.upload(npy(&[SIDE, SIDE], map)).await;
        let file = app.upload(npy(&[FRAMES, SIDE, SIDE], masks.iter().copied())).await;
        let body = json!({"masks": file, "bad_pixels": map});
        let calibration = id(&app.post("/v1/calibrations", &body).await.expect(201));
        let report = format!("/v1/calibrations/{calibration}/report");
        let report = app.get_until(&report, 200).await.json();
        assert_eq!(report["findings"], json!([]), "area {which}");
        let made = app.measure(&calibration, npy(&[SIDE, SIDE], broken.into_iter())).await;
        let warnings = made.expect(201).json()["warnings"].take();
        let codes: Vec<_> = warnings.as_array().unwrap().iter().map(|one| &one["code"]).collect();
        assert_eq!(codes, marked, "area {which}: {warnings:#}");
    }
}

#[test]
fn inverted_masks_are_named_first() {
    let (masks, y) = scene();
    let inverted: Vec<f32> = masks.iter().map(|mask| 1.0 - mask).collect();
    let (assessment, codes) = reconstruct(&inverted, &y);
    assert_eq!(codes[0], "inverted_masks", "{codes:?}");
    assert_eq!(assessment["psnr_db"], Value::Null, "{assessment}");
}

#[test]
fn masks_of_another_orientation_are_named() {
    let (masks, y) = scene();
    let turned = |place: &dyn Fn(usize, usize) -> (usize, usize)| -> Vec<f32> {
        let pixel = |at: usize| {
            let (row, column) = place(at % PIXELS / SIDE, at % SIDE);
            masks[at / PIXELS * PIXELS + row * SIDE + column]
        };
        (0..masks.len()).map(pixel).collect()
    };
    let last = SIDE - 1;
    let orientations: [Vec<f32>; 3] = [
        turned(&|row, column| (column, row)),
        turned(&|row, column| (last - row, column)),
        turned(&|row, column| (last - column, row)),
    ];
    for masks in orientations {
        let (assessment, codes) = reconstruct(&masks, &y);
        assert_eq!(codes[0], "turned_masks", "{codes:?}");
        assert_eq!((&assessment["grade"], &assessment["psnr_db"]), (&"bad".into(), &Value::Null));
    }
}

#[test]
fn exchanged_masks_are_found_by_the_motion() {
    let (mut masks, y) = scene();
    let (head, tail) = masks.split_at_mut(5 * PIXELS);
    head[PIXELS..2 * PIXELS].swap_with_slice(&mut tail[..PIXELS]);
    let (assessment, codes) = reconstruct(&masks, &y);
    assert_eq!(codes, ["exchanged_masks"]);
    assert_eq!((&assessment["order"], &assessment["psnr_db"]), (&"doubtful".into(), &Value::Null));
}

#[test]
fn an_order_that_can_t_be_verified_comes_with_its_reason() {
    let grey = grey_masks();
    let masks = scene().0;
    for (masks, speed, reason) in [
        (&masks, 0.0, "the scene moves too little"),
        (&grey, 1.5, "the masks resemble one another"),
    ] {
        let (assessment, _) = reconstruct(masks, &snapshot_at(masks, speed));
        assert_eq!(assessment["order"], "not_verifiable");
        let found = assessment["order_reason"].as_str().unwrap();
        assert!(found.starts_with(reason), "{found}");
    }
}

#[test]
fn a_mosaic_of_complementary_colours_is_found() {
    let (masks, mut y) = scene();
    for (at, value) in y.iter_mut().enumerate() {
        let (row, column) = (at / SIDE, at % SIDE);
        let hue = 0.4 * (row as f32 / 20.0).sin() * (column as f32 / 17.0).cos();
        *value *= match (row % 2, column % 2) {
            (0, 0) => 1.0 + hue,
            (1, 1) => 1.0 - hue,
            _ => 1.0,
        };
    }
    let (_, codes) = reconstruct(&masks, &y);
    assert!(codes.contains(&"mosaic".to_owned()), "{codes:?}");
}

#[test]
fn a_drift_by_a_fraction_of_a_pixel_is_no_missing_dark() {
    let (masks, y) = scene();
    let next = |at: usize| if at % SIDE + 1 < SIDE { masks[at + 1] } else { masks[at] };
    let drifted: Vec<f32> = (0..masks.len()).map(|at| 0.65 * masks[at] + 0.35 * next(at)).collect();
    let (assessment, codes) = reconstruct(&drifted, &y);
    assert_eq!(codes[0], "drifted_masks", "{codes:?}");
    assert_eq!((&assessment["grade"], &assessment["psnr_db"]), (&"doubtful".into(), &Value::Null));
    let lifted: Vec<f32> = y.iter().map(|y| y + 0.2).collect();
    let (assessment, codes) = reconstruct(&masks, &lifted);
    assert_eq!(codes[0], "no_dark", "{codes:?}");
    assert_eq!(assessment["psnr_db"], Value::Null);
    assert!(["doubtful", "bad"].contains(&assessment["grade"].as_str().unwrap()), "{assessment}");
    let lifted: Vec<f32> = y.iter().map(|y| y + 0.3).collect();
    let (assessment, codes) = reconstruct_after(&masks, &lifted, Some(0.1));
    assert_eq!(codes[0], "wrong_dark", "{codes:?}");
    assert_eq!(assessment["psnr_db"], Value::Null);
    assert!(["doubtful", "bad"].contains(&assessment["grade"].as_str().unwrap()), "{assessment}");
}

#[test]
fn stray_light_and_parts_with_one_value_are_doubtful() {
    let (masks, y) = scene();
    let mean = y.iter().sum::<f32>() / PIXELS as f32;
    let spot = |at: usize| {
        let distance = (at as f32 / SIDE as f32 - 70.0).hypot((at % SIDE) as f32 - 60.0);
        1.5 * mean * (-0.5 * (distance / 16.0).powi(2)).exp()
    };
    let stray = y.iter().enumerate().map(|(at, y)| y + spot(at)).collect();
    let is_stuck = |at: usize| (40..80).contains(&(at / SIDE)) && (40..80).contains(&(at % SIDE));
    let stuck = |(at, y): (usize, &f32)| if is_stuck(at) { 0.07 * mean } else { *y };
    for y in [stray, y.iter().enumerate().map(stuck).collect::<Vec<f32>>()] {
        let (assessment, codes) = reconstruct(&masks, &y);
        assert_eq!(codes[0], "unmodulated_area", "{codes:?}");
        assert_eq!(assessment["psnr_db"], Value::Null);
        assert!(["doubtful", "bad"].contains(&assessment["grade"].as_str().unwrap()));
    }
}

#[test]
fn masks_that_moved_in_one_half_are_named() {
    let (masks, y) = scene();
    let source = |at: usize| if at % PIXELS < PIXELS / 2 { at } else { at - 1 };
    let moved: Vec<f32> = (0..masks.len()).map(|at| masks[source(at)]).collect();
    let (assessment, codes) = reconstruct(&moved, &y);
    assert_eq!(codes[0], "partly_moved_masks", "{codes:?}");
    assert_eq!(assessment["psnr_db"], Value::Null);
}

/// Square masks in the order of axes that `h5write` of MATLAB leaves, which the sizes can't show.
#[tokio::test]
async fn the_axes_of_square_masks_are_named() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let (masks, y) = scene();
    std::fs::write(path("in.npy"), npy(&[FRAMES, SIDE, SIDE], masks.into_iter())).unwrap();
    let line = "import sys, h5py, numpy
h5py.File(sys.argv[2], 'w')['masks'] = numpy.load(sys.argv[1]).transpose(0, 2, 1)";
    let mut write = Command::new(python);
    write.args(["-c", line]).arg(path("in.npy")).arg(path("masks.h5"));
    assert!(write.status().unwrap().success());
    let masks = app.upload(std::fs::read(path("masks.h5")).unwrap()).await;
    let data = npy(&[SIDE, SIDE], y.into_iter());
    let made = app.post("/v1/calibrations", &json!({ "masks": masks })).await.expect(201);
    let taken = app.measure(&id(&made), data.clone()).await.expect(201).json();
    let found = &taken["warnings"][0];
    assert_eq!(found["code"], "turned_masks", "{taken:#}");
    assert!(found["detail"].as_str().unwrap().contains("state `frame-column-row` as `axes`"));
    let asked = json!({"masks": masks, "axes": "frame-column-row"});
    let made = app.post("/v1/calibrations", &asked).await.expect(201);
    let taken = app.measure(&id(&made), data).await.expect(201).json();
    assert_eq!(taken["warnings"], json!([]), "{taken:#}");
}

/// Prints word and text of a job's verdict as `clients/python` shows them.
const PYTHON_VERDICT: &str = "
import sys, sci_recon
job = sci_recon.Client().job(sys.argv[1])
print(job.record['verdict'], job.verdict, sep='|')";

/// Prints the word of a job's verdict as the dashboard's list shows it. Node takes modules from a file with this ending.
const DASHBOARD_VERDICT: &str = "
import(process.argv[1]).then(({ verdictOf }) => console.log(verdictOf(JSON.parse(process.argv[2]))[1]))";

/// Prints word and text of a job's verdict as `clients/matlab` shows them.
const MATLAB_VERDICT: &str = "
addpath('clients/matlab'); [~, job] = sci_recon(getenv('JOB'));
printf('%s|%s', job.verdict, job.verdict_text);";

/// The output of a program that must end with this code.
async fn printed(app: &TestApp, mut program: tokio::process::Command, code: i32) -> String {
    program.env("SCI_RECON_URL", format!("http://{}", app.address()));
    let output = program.env("PYTHONPATH", "clients/python/src").output().await.unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{program:?}: {errors}");
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

#[tokio::test]
async fn every_way_shows_the_same_verdict() {
    use tokio::process::Command;
    let Some(python) = judges() else { return };
    if !has_programs(&["node", "octave-cli"], "nodejs octave") {
        return;
    }
    let app = TestApp::with(&["--workers", "1"]).await;
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    std::fs::copy("src/http/dashboard/format.js", path("format.mjs")).unwrap();
    let (masks, y) = scene();
    std::fs::write(path("y.npy"), npy(&[SIDE, SIDE], y.iter().copied())).unwrap();
    let next = |at: usize| if at % SIDE + 1 < SIDE { masks[at + 1] } else { masks[at] };
    let drifted: Vec<f32> = (0..masks.len()).map(|at| 0.5 * (masks[at] + next(at))).collect();
    let inverted: Vec<f32> = masks.iter().map(|mask| 1.0 - mask).collect();
    for (masks, algorithm, expected) in [
        (&masks, "gap-tv", &["good", "usable"][..]),
        (&drifted, "gap-tv", &["doubtful"]),
        (&inverted, "gap-tv", &["bad"]),
        (&drifted, "admm-tv", &["doubtful"]),
    ] {
        std::fs::write(path("masks.npy"), npy(&[FRAMES, SIDE, SIDE], masks.iter().copied()))
            .unwrap();
        let mut submit = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        submit.arg("submit").arg(path("y.npy")).arg("--masks").arg(path("masks.npy"));
        submit.args(["--algorithm", algorithm, "--registration", "off"]);
        let code = if expected == ["bad"] { 3 } else { 0 };
        let job = printed(&app, submit, code).await;
        let ended = app.ended(&job).await;
        let word = ended["verdict"].as_str().unwrap();
        let text = ended["verdict_text"].as_str().unwrap();
        assert!(expected.contains(&word) && text.starts_with(word), "{algorithm}: {ended:#}");

        let place = format!("/v1/jobs/{job}/snapshots/0/exports/manifest");
        let content = &app.get(&place).await.expect(200).json()["content"];
        let whole = app.get(&format!("/v1/jobs/{job}/exports/manifest")).await.expect(200).json();
        let snapshot = &whole["content"]["snapshots"][0];
        assert_eq!((&content["verdict"], &snapshot["verdict"]), (&word.into(), &word.into()));
        if algorithm == "gap-tv" {
            assert_eq!(content["assessment"]["grade"], word);
        }
        let mut watch = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        watch.args(["watch", &job]);
        let line = printed(&app, watch, code).await;
        assert!(line.starts_with(&format!("{job}: {text}; finished")), "{line}");
        let mut client = Command::new(&python);
        client.args(["-c", PYTHON_VERDICT, &job]);
        assert_eq!(printed(&app, client, 0).await, format!("{word}|{text}"));
        let mut dashboard = Command::new("node");
        dashboard.args(["-e", DASHBOARD_VERDICT]).arg(path("format.mjs")).arg(ended.to_string());
        assert_eq!(printed(&app, dashboard, 0).await, word);
        let mut matlab = Command::new("octave-cli");
        matlab.args(["--no-init-file", "--eval", MATLAB_VERDICT]).env("JOB", &job);
        let line = printed(&app, matlab, 0).await;
        assert!(line.ends_with(&format!("{text}\n{word}|{text}")), "{line}");
    }
    // Without findings and without a quality model there is no verdict.
    let calibration =
        app.calibrate(npy(&[FRAMES, SIDE, SIDE], masks.into_iter())).await.expect(201);
    let measured =
        app.measure(&id(&calibration), npy(&[SIDE, SIDE], y.into_iter())).await.expect(201);
    let request = json!({"measurement": id(&measured), "algorithm": "admm-tv"});
    let ended = app.ended(&app.submit(&request).await).await;
    let found = (&ended["verdict"], &ended["verdict_text"]);
    assert_eq!(found, (&Value::Null, &"not assessed".into()), "{ended:#}");
}

#[test]
fn masks_far_below_their_full_scale_are_named_before_their_effects() {
    let (masks, y) = scene();
    for scale in [4095.0 / 65_535.0, 1.0 / 255.0, 15.0 / 255.0] {
        let masks: Vec<f32> = masks.iter().map(|mask| mask * scale).collect();
        let (assessment, codes) = reconstruct(&masks, &y);
        assert_eq!(codes[0], "mask_scale", "{codes:?}");
        assert!(!codes.contains(&"level".to_owned()), "{codes:?}");
        assert_eq!(assessment["psnr_db"], Value::Null);
    }
}

#[test]
fn a_crop_that_begins_at_another_place_is_named() {
    let (masks, y) = scene();
    for (rows, columns) in [(8, 20), (SIDE - 13, 3), (0, 31)] {
        let moved = |at: usize| {
            let (row, column) = (at % PIXELS / SIDE + rows, at % SIDE + columns);
            masks[at / PIXELS * PIXELS + row % SIDE * SIDE + column % SIDE]
        };
        let moved: Vec<f32> = (0..masks.len()).map(moved).collect();
        let (assessment, codes) = reconstruct(&moved, &y);
        assert_eq!(codes[0], "shifted_masks", "{rows} {columns}: {codes:?}");
        assert_eq!((&assessment["grade"], &assessment["psnr_db"]), (&"bad".into(), &Value::Null));
    }
}

#[test]
fn resampled_masks_are_named_first() {
    for masks in [scene().0, grey_masks()] {
        let y = snapshot(&masks);
        for factor in [1.01, 0.985, 1.05, 1.28, 0.8] {
            let (assessment, codes) = reconstruct(&enlarged(&masks, factor), &y);
            assert_eq!(codes[0], "resampled_masks", "{factor}: {codes:?}");
            let is_bad = (&assessment["grade"], &assessment["psnr_db"]);
            assert_eq!(is_bad, (&"bad".into(), &Value::Null));
        }
    }
}

#[test]
fn altered_values_of_masks_are_named_before_the_dark() {
    let masks = grey_masks();
    let y = snapshot(&masks);
    let (_, codes) = reconstruct(&masks, &y);
    assert_eq!(codes, Vec::<String>::new());
    let encoded = |value: f32| match value {
        ..=0.003_130_8 => 12.92 * value,
        _ => 1.055 * value.powf(1.0 / 2.4) - 0.055,
    };
    let picture = |value: &f32| (255.0 * encoded(*value)).round() / 255.0;
    let pictures: Vec<f32> = masks.iter().map(picture).collect();
    let binary: Vec<f32> = masks.iter().map(|mask| f32::from(u8::from(*mask > 0.5))).collect();
    for masks in [pictures, binary] {
        let (assessment, codes) = reconstruct(&masks, &y);
        assert_eq!(codes[0], "mask_values", "{codes:?}");
        assert_eq!(assessment["psnr_db"], Value::Null);
    }
    // A dark that is missing is no altered mask.
    let lifted: Vec<f32> = y.iter().map(|y| y + 0.8).collect();
    assert_eq!(reconstruct(&masks, &lifted).1[0], "no_dark");
}

#[tokio::test]
async fn a_missing_mask_is_named_before_the_dark() {
    let (masks, y) = scene();
    for missing in [0, FRAMES / 2, FRAMES - 1] {
        let mut fewer = masks.clone();
        fewer.drain(missing * PIXELS..(missing + 1) * PIXELS);
        let (assessment, codes) = reconstruct(&fewer, &y);
        assert_eq!(codes[0], "missing_mask", "{missing}: {codes:?}");
        assert_eq!(assessment["psnr_db"], Value::Null);
    }
    // One of few masks takes a large share of the light with it.
    let few = &masks[..6 * PIXELS];
    let (_, codes) = reconstruct(&few[PIXELS..], &snapshot(few));
    assert_eq!(codes[0], "missing_mask", "{codes:?}");
    // The service has the same warning.
    let app = TestApp::with(&["--workers", "1"]).await;
    let (mut masks, y) = scene();
    masks.truncate((FRAMES - 1) * PIXELS);
    let calibration =
        app.calibrate(npy(&[FRAMES - 1, SIDE, SIDE], masks.into_iter())).await.expect(201);
    let data = app.upload(npy(&[SIDE, SIDE], y.into_iter())).await;
    let body = json!({"calibration": id(&calibration), "data": data});
    let measurement = app.post("/v1/measurements", &body).await.expect(201).json();
    assert_eq!(measurement["warnings"][0]["code"], "missing_mask", "{measurement:#}");
}

#[tokio::test]
async fn masks_of_another_size_get_the_likely_cause() {
    let app = TestApp::start().await;
    let scene = Scene { frames: 4, height: 48, width: 64, snapshots: 1 };
    let calibration = id(&app.calibrate(scene.masks()).await.expect(201));
    for (shape, cause) in [([64, 48], "90 degrees"), ([96, 128], "binned"), ([48, 96], "`packing`")]
    {
        let data = app.upload(constant(&shape, 1.0)).await;
        let body = json!({"calibration": calibration, "data": data});
        let refused = app.post("/v1/measurements", &body).await.problem(422, "size_mismatch");
        assert!(refused.contains(cause), "{refused}");
    }
}

#[test]
fn a_small_bright_object_in_a_dark_scene_has_a_plausible_level() {
    let (masks, _) = scene();
    let pixel = |k: usize, at: usize| {
        let (row, column) = ((at / SIDE) as f32 - 60.0, (at % SIDE) as f32 - 70.0 - k as f32);
        if row.hypot(column) < 5.0 { 0.95 } else { 0.05 }
    };
    let y = |at: usize| (0..FRAMES).map(|k| masks[k * PIXELS + at] * pixel(k, at)).sum();
    let y: Vec<f32> = (0..PIXELS).map(y).collect();
    let (_, codes) = reconstruct(&masks, &y);
    assert!(!codes.contains(&"level".to_owned()), "{codes:?}");
    let tenth: Vec<f32> = y.iter().map(|y| 0.1 * y).collect();
    assert!(reconstruct(&masks, &tenth).1.contains(&"level".to_owned()));
}
