//! Inputs that are wrong in ways that the files don't show: the finding names the cause.

use std::process::Command;

use serde_json::Value;

use crate::pipeline::values;
use crate::samples::{Scene, npy};

const SIDE: usize = 144;
const PIXELS: usize = SIDE * SIDE;
const FRAMES: usize = 8;

/// Masks, and a snapshot of a pattern that moves by 1.5 pixels a frame.
fn scene() -> (Vec<f32>, Vec<f32>) {
    let masks = values(&Scene { frames: FRAMES, height: SIDE, width: SIDE, snapshots: 1 }.masks());
    let pixel = |k: usize, at: usize| {
        let (row, column) = ((at / SIDE) as f32, (at % SIDE) as f32 + 1.5 * k as f32);
        0.45 + 0.2 * (column * 0.2).sin() * (row * 0.15).cos()
            + 0.1 * (column * 0.31 + row * 0.27).sin()
    };
    let y = |at: usize| (0..FRAMES).map(|k| masks[k * PIXELS + at] * pixel(k, at)).sum();
    let y = (0..PIXELS).map(y).collect();
    (masks, y)
}

/// The assessment and the codes of the findings.
fn reconstruct(masks: &[f32], y: &[f32]) -> (Value, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let masks = npy(&[FRAMES, SIDE, SIDE], masks.iter().copied());
    std::fs::write(path("masks.npy"), masks).unwrap();
    std::fs::write(path("y.npy"), npy(&[SIDE, SIDE], y.iter().copied())).unwrap();
    let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
        .args(["reconstruct", "--masks", "masks.npy", "--measurement", "y.npy", "--json"])
        .args(["--algorithm", "gap-tv", "--iterations", "60", "--registration", "off"])
        .current_dir(folder.path())
        .output()
        .unwrap();
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
    let (_, codes) = reconstruct(&drifted, &y);
    assert_eq!(codes[0], "drifted_masks", "{codes:?}");
    let lifted: Vec<f32> = y.iter().map(|y| y + 0.2).collect();
    let (_, codes) = reconstruct(&masks, &lifted);
    assert_eq!(codes[0], "no_dark", "{codes:?}");
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
