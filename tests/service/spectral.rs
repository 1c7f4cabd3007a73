//! Spectral cameras with one disperser: from a cube through a sheared mask to bands in their place.

use std::path::PathBuf;
use std::process::{Command, Output};

use serde_json::{Value, json};

use crate::app::{Answer, TestApp, id};
use crate::pipeline::values;
use crate::samples::npy;

const SIDE: usize = 96;
const BANDS: usize = 8;

/// A value of a smooth spectral scene: two discs and a slope, each with its spectrum.
fn radiance(band: usize, row: usize, column: usize) -> f32 {
    let peak = |centre: f32, width: f32| (-((band as f32 - centre) / width).powi(2)).exp();
    let inside = |i: f32, j: f32, radius: f32| {
        let distance = (row as f32 - i).hypot(column as f32 - j);
        ((radius - distance) / 2.0 + 0.5).clamp(0.0, 1.0)
    };
    let slope = 0.15 + 0.2 * column as f32 / SIDE as f32;
    slope * peak(3.5, 6.0)
        + 0.5 * inside(34.0, 30.0, 18.0) * peak(1.5, 1.8)
        + 0.6 * inside(60.0, 66.0, 20.0) * peak(5.5, 2.0)
}

/// A lab with a spectral camera: the files of `simulate` for the scene.
struct Lab {
    folder: tempfile::TempDir,
    dispersion: Value,
}

impl Lab {
    fn new(axis: &str, offsets: &str, mask: &str) -> Self {
        Self::of(SIDE, radiance, axis, offsets, mask)
    }

    /// A lab with a scene of this side, given by its value at (band, row, column).
    fn of(
        side: usize,
        radiance: impl Fn(usize, usize, usize) -> f32,
        axis: &str,
        offsets: &str,
        mask: &str,
    ) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let pixel = |at: usize| radiance(at / (side * side), at / side % side, at % side);
        let cube = npy(&[BANDS, side, side], (0..BANDS * side * side).map(pixel));
        std::fs::write(folder.path().join("cube.npy"), cube).unwrap();
        let lab = Self { folder, dispersion: Value::Null };
        let output = lab.command(
            &[
                &[
                    "simulate",
                    "--frames",
                    "cube.npy",
                    "--compression-ratio",
                    "8",
                    "--pattern",
                    "iid",
                    "--out",
                    "sim",
                ][..],
                &options(axis, offsets, mask)[..],
            ]
            .concat(),
        );
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let record: Value = serde_json::from_slice(&lab.file("simulation.json")).unwrap();
        Self { dispersion: record["dispersion"].clone(), ..lab }
    }

    fn file(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.path("sim").join(name)).unwrap()
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(arguments).current_dir(self.folder.path()).output().unwrap()
    }

    async fn calibrate(&self, app: &TestApp) -> Answer {
        let masks = app.upload(self.file("masks.npy")).await;
        app.post("/v1/calibrations", &json!({"masks": masks, "dispersion": self.dispersion})).await
    }
}

fn options<'a>(axis: &'a str, offsets: &'a str, mask: &'a str) -> [&'a str; 8] {
    [
        "--dispersion-axis",
        axis,
        "--dispersion-offsets",
        offsets,
        "--dispersion-wavelengths",
        "450:30:8",
        "--dispersion-mask",
        mask,
    ]
}

/// Mean angle between the spectra of two cubes, in degrees.
fn spectral_angle(cube: &[f32], truth: &[f32]) -> f64 {
    let pixels = SIDE * SIDE;
    let product = |a: &[f32], b: &[f32], pixel: usize| {
        (0..BANDS)
            .map(|k| f64::from(a[k * pixels + pixel]) * f64::from(b[k * pixels + pixel]))
            .sum::<f64>()
    };
    let angle = |pixel: usize| {
        let norm = product(cube, cube, pixel) * product(truth, truth, pixel);
        (product(cube, truth, pixel) / norm.sqrt()).clamp(-1.0, 1.0).acos().to_degrees()
    };
    (0..pixels).map(angle).sum::<f64>() / pixels as f64
}

fn psnr(cube: &[f32], truth: &[f32]) -> f64 {
    let squares: f64 = cube.iter().zip(truth).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    -10.0 * (squares / truth.len() as f64).log10()
}

#[tokio::test]
async fn bands_come_back_in_their_place() {
    let lab = Lab::new("column", "0:2:8", "scene");
    let app = TestApp::with(&["--workers", "2"]).await;
    let calibration = lab.calibrate(&app).await.expect(201).json();
    assert_eq!((&calibration["frames"], &calibration["height"]), (&json!(8), &json!(96)));
    assert_eq!((&calibration["width"], &calibration["dispersion"]), (&json!(110), &lab.dispersion));
    let calibration = calibration["id"].as_str().unwrap();
    let created = app.measure(calibration, lab.file("measurement.npy")).await.expect(201);
    assert_eq!(created.json()["warnings"], json!([]), "a right measurement gives no warning");
    assert_eq!(created.json()["sequence"], "separate");
    let report = app.get_until(&format!("/v1/calibrations/{calibration}/report"), 200).await.json();
    assert_eq!(report["findings"], json!([]));

    let tile = json!({"size": 64, "overlap": 16});
    let body = json!({"measurement": id(&created), "algorithm": "gap-tv", "tile": tile});
    let job = app.submit(&body).await;
    let ended = app.ended(&job).await;
    assert_eq!(ended["state"], "succeeded", "{ended:#}");
    assert_eq!((&ended["shape"]["width"], &ended["dispersion"]), (&json!(96), &lab.dispersion));
    // The discs are harder than the slope, which is no fault of the input.
    let reasons = ended["assessment"]["reasons"].as_array().unwrap();
    assert!(reasons.iter().all(|reason| reason["code"] == "uneven_error"), "{ended:#}");
    assert_eq!(ended["assessment"]["order"], Value::Null, "bands have no order in time");
    let base = format!("/v1/jobs/{job}/snapshots/0");
    let frames = app.get(&format!("{base}/exports/npy")).await.expect(200).bytes;
    assert!(String::from_utf8_lossy(&frames[..128]).contains("(8, 96, 96)"));
    let (cube, truth) = (values(&frames), values(&lab.file("truth.npy")));
    let (decibels, angle) = (psnr(&cube, &truth), spectral_angle(&cube, &truth));
    println!("{decibels:.2} dB, {angle:.2} degrees, {}", ended["assessment"]);
    assert!(decibels > 32.0 && angle < 3.0, "{decibels} dB, {angle} degrees");
    let truth = app.upload(lab.file("truth.npy")).await;
    let quality = app.get(&format!("{base}/quality?truth={truth}")).await.expect(200).json();
    let unit = quality["psnr"].as_f64().unwrap() - 20.0 * quality["peak"].as_f64().unwrap().log10();
    assert!((unit - decibels).abs() < 1.0, "{quality}: {decibels}");

    // Pictures, and the residual, in which the bands return to the sensor.
    let view = |name: &str| format!("{base}/pictures/{name}").replace("/v1/", "/view/");
    let spread = app.get(&format!("{}/spread", view("frame-8"))).await.expect(200).json();
    assert_eq!((&spread["height"], &spread["width"]), (&json!(96), &json!(96)), "{spread}");
    let rest = app.get(&format!("{}/spread", view("residual"))).await.expect(200).json();
    assert!(rest["maximum"].as_f64().unwrap() < 0.1, "{rest}");
    let colours = app.get(&format!("{}/values/0/0/0", view("colours"))).await.expect(200).bytes;
    assert_eq!(colours.len(), 96 * 96 * 3 * 4);
    let errors = app.get(&format!("{base}/exports/error")).await.expect(200).bytes;
    assert!(String::from_utf8_lossy(&errors[..128]).contains("(8, 6, 6)"));

    // Wavelengths name the bands.
    let text = async |path: String| {
        let answer = app.get(&path).await.expect(200);
        String::from_utf8_lossy(&answer.bytes[..answer.bytes.len().min(1 << 15)]).into_owned()
    };
    let exr = text(format!("{base}/exports/exr")).await;
    assert!(exr.contains("S0.450nm\0") && exr.contains("S0.660nm\0"));
    assert!(text(format!("{base}/exports/exr?layers=sigma")).await.contains("sigma.Y"));
    let tiff = text(format!("{base}/exports/tiff")).await;
    assert!(tiff.contains("SizeC=\"8\" SizeT=\"1\"") && tiff.contains("Name=\"480 nm\""));
    let zarr = app.get(&format!("{base}/exports/zarr/0/zarr.json")).await.expect(200).json();
    assert_eq!((&zarr["shape"], &zarr["dimension_names"][0]), (&json!([8, 96, 96]), &json!("c")));
    let manifest = app.get(&format!("{base}/exports/manifest")).await.expect(200).json();
    assert_eq!(manifest["content"]["dispersion"], lab.dispersion);
    assert_eq!(manifest["content"]["width"], 96);
}

#[tokio::test]
async fn fractions_rows_and_masks_of_the_measurement_are_reconstructed() {
    for (axis, offsets, mask, least) in
        [("row", "0:1.5:8", "scene", 31.0), ("column", "14,12,10,8,6,4,2,0", "measurement", 31.0)]
    {
        let lab = Lab::new(axis, offsets, mask);
        let line = [
            &[
                "reconstruct",
                "--masks",
                "sim/masks.npy",
                "--measurement",
                "sim/measurement.npy",
                "--truth",
                "sim/truth.npy",
                "--algorithm",
                "gap-tv",
                "--json",
                "--out",
                "out",
            ][..],
            &options(axis, offsets, mask)[..],
        ]
        .concat();
        let output = lab.command(&line);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        println!("{axis} {offsets} {mask}: {}", report["psnr_unit_db"]);
        assert_eq!(report["findings"], json!([]), "{axis} {offsets}");
        assert_eq!((&report["height"], &report["width"]), (&json!(96), &json!(96)));
        assert!(report["psnr_unit_db"].as_f64().unwrap() > least, "{axis} {offsets}: {report}");
        let cube = values(&std::fs::read(lab.path("out/frames.npy")).unwrap());
        let truth = values(&lab.file("truth.npy"));
        assert!((psnr(&cube, &truth) - report["psnr_unit_db"].as_f64().unwrap()).abs() < 1.0);
    }
}

/// Masks that are displaced along the dispersion fit narrow spectra better, and a line has the light of one mask.
#[tokio::test]
async fn narrow_spectra_are_no_sign_of_wrong_masks() {
    let app = TestApp::start().await;
    for width in [0.2_f32, 0.9, 2.0] {
        let scene = |band: usize, row: usize, column: usize| {
            let texture = 0.5 + 0.2 * ((row as f32 / 7.0).sin() + (column as f32 / 11.0).cos());
            texture * (-((band as f32 - 4.0) / width).powi(2)).exp()
        };
        let lab = Lab::of(160, scene, "column", "0:1:8", "scene");
        let calibration = id(&lab.calibrate(&app).await.expect(201));
        let created = app.measure(&calibration, lab.file("measurement.npy")).await.expect(201);
        let warnings = &created.json()["warnings"];
        let all = warnings.as_array().unwrap();
        assert!(all.iter().all(|warning| warning["severity"] != "error"), "{width}: {warnings:#}");
    }
}

#[tokio::test]
async fn wrong_masks_of_a_dark_scene_are_errors() {
    /// The pixel of the right mask at each pixel of another one.
    type Place = fn(usize, usize) -> (usize, usize);
    const SIDE: usize = 160;
    // Three coloured discs that cover a tenth of the picture.
    let spots = |band: usize, row: usize, column: usize| {
        let disc = |i: f32, j: f32, colour: f32| {
            let inside = (row as f32 - i).hypot(column as f32 - j) < 17.0;
            let spectrum = (-((band as f32 - colour) / 2.5).powi(2)).exp();
            if inside { 0.8 * spectrum } else { 0.0 }
        };
        disc(50.0, 50.0, 1.0) + disc(84.0, 100.0, 4.0) + disc(110.0, 60.0, 6.5)
    };
    let lab = Lab::of(SIDE, spots, "column", "0:2:8", "scene");
    let app = TestApp::start().await;
    let mask = values(&lab.file("masks.npy"));
    let measured = async |place: Place| {
        let pixel = |at: usize| {
            let (row, column) = place(at / SIDE, at % SIDE);
            mask[row.min(SIDE - 1) * SIDE + column.min(SIDE - 1)]
        };
        let masks = app.upload(npy(&[1, SIDE, SIDE], (0..SIDE * SIDE).map(pixel))).await;
        let body = json!({"masks": masks, "dispersion": lab.dispersion});
        let calibration = id(&app.post("/v1/calibrations", &body).await.expect(201));
        let created = app.measure(&calibration, lab.file("measurement.npy")).await.expect(201);
        let warnings = created.json()["warnings"].as_array().unwrap().clone();
        let errors = warnings.iter().filter(|warning| warning["severity"] == "error");
        errors.map(|error| error["code"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    assert_eq!(measured(|row, column| (row, column)).await, [""; 0], "right");
    let wrong: [(&str, Place); 3] = [
        ("flipped left to right", |row, column| (row, SIDE - 1 - column)),
        ("flipped upside down", |row, column| (SIDE - 1 - row, column)),
        ("shifted by one row", |row, column| (row + 1, column)),
    ];
    for (name, place) in wrong {
        let errors = measured(place).await;
        println!("{name}: {errors:?}");
        let expected: &[&str] = match name.starts_with("shifted") {
            true => &["shifted_masks"],
            false => &["foreign_masks", "turned_masks"],
        };
        assert!(
            errors.first().is_some_and(|code| expected.contains(&code.as_str())),
            "{name}: {errors:?}"
        );
    }
}

#[tokio::test]
async fn a_picture_too_small_for_the_checks_is_doubtful() {
    let lab = Lab::of(12, radiance, "column", "0:2:8", "scene");
    let app = TestApp::start().await;
    let calibration = id(&lab.calibrate(&app).await.expect(201));
    let created = app.measure(&calibration, lab.file("measurement.npy")).await.expect(201);
    assert_eq!(created.json()["warnings"][0]["code"], "unverified_masks", "{}", created.json());
}

/// Two small discs on black show no masks, neither right nor wrong ones.
#[tokio::test]
async fn a_scene_that_does_not_show_its_masks_is_no_good_result() {
    let spots = |band: usize, row: usize, column: usize| {
        let disc = |i: f32, j: f32, colour: f32| {
            let inside = (row as f32 - i).hypot(column as f32 - j) < 5.0;
            if inside { 0.8 * (-((band as f32 - colour) / 2.5).powi(2)).exp() } else { 0.0 }
        };
        disc(50.0, 70.0, 1.0) + disc(84.0, 40.0, 4.0)
    };
    let lab = Lab::of(128, spots, "column", "0:2:8", "scene");
    let app = TestApp::with(&["--workers", "1"]).await;
    let mask = values(&lab.file("masks.npy"));
    for is_flipped in [false, true] {
        let value = |at: usize| mask[if is_flipped { mask.len() - 1 - at } else { at }];
        let masks = app.upload(npy(&[1, 128, 128], (0..mask.len()).map(value))).await;
        let body = json!({"masks": masks, "dispersion": lab.dispersion});
        let calibration = id(&app.post("/v1/calibrations", &body).await.expect(201));
        let created = app.measure(&calibration, lab.file("measurement.npy")).await.expect(201);
        assert_eq!(created.json()["warnings"][0]["code"], "unverified_masks", "{is_flipped}");
        let body = json!({"measurement": id(&created), "algorithm": "gap-tv"});
        let ended = app.ended(&app.submit(&body).await).await;
        let assessment = &ended["assessment"];
        assert_eq!(assessment["psnr_db"], Value::Null, "{is_flipped}: {assessment:#}");
        assert!(
            ["doubtful", "bad"].contains(&assessment["grade"].as_str().unwrap()),
            "{assessment:#}"
        );
    }
}

#[tokio::test]
async fn a_dispersion_that_does_not_fit_is_refused_with_the_expected_size() {
    let lab = Lab::new("column", "0:2:8", "scene");
    let app = TestApp::start().await;
    let masks = app.upload(lab.file("masks.npy")).await;
    let several = app.upload(lab.file("truth.npy")).await;
    let good = lab.dispersion.clone();
    let with = |field: &str, value: Value| {
        let mut dispersion = good.clone();
        dispersion[field] = value;
        dispersion
    };
    let refused = async |body: Value, pointer: &str| {
        let answer = app.post("/v1/calibrations", &body).await;
        let problem = answer.json();
        assert_eq!(problem["errors"][0]["pointer"], pointer, "{problem}");
        answer.problem(422, "invalid_request")
    };
    for (dispersion, pointer) in [
        (with("offsets", json!([])), "/dispersion/offsets"),
        (with("offsets", json!([0, 1, -2])), "/dispersion/offsets/2"),
        (with("wavelengths", json!([500])), "/dispersion/wavelengths"),
    ] {
        refused(json!({"masks": masks, "dispersion": dispersion}), pointer).await;
    }
    let colour = json!({"masks": masks, "dispersion": good, "mosaic": "rggb"});
    refused(colour, "/dispersion").await;
    // A mask for each band needs no dispersion.
    let answer = app.post("/v1/calibrations", &json!({"masks": several, "dispersion": good})).await;
    assert!(answer.problem(422, "invalid_content").contains("has 8 masks"));
    let short = json!({"axis": "column", "offsets": [0, 96], "mask": "measurement"});
    let answer = app.post("/v1/calibrations", &json!({"masks": masks, "dispersion": short})).await;
    assert!(answer.problem(422, "invalid_content").contains("offsets reach 96 pixels"));
    let calibration = id(&lab.calibrate(&app).await.expect(201));
    let detail =
        app.measure(&calibration, lab.file("masks.npy")).await.problem(422, "size_mismatch");
    assert!(detail.contains("expects a measurement of 96x110: 8 bands of 96x96"), "{detail}");
    assert!(detail.contains("\"mask\": \"measurement\""), "{detail}");
    let data = app.upload(lab.file("measurement.npy")).await;
    let body = json!({"calibration": calibration, "data": data, "sequence": "contiguous"});
    assert_eq!(
        app.post("/v1/measurements", &body).await.json()["errors"][0]["pointer"],
        "/sequence"
    );
    // The commands say the same.
    let line = [
        "reconstruct",
        "--masks",
        "sim/masks.npy",
        "--measurement",
        "sim/masks.npy",
        "--dispersion-offsets",
        "0:2:8",
        "--json",
    ];
    let output = lab.command(&line);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && text.contains("96x110: 8 bands of 96x96"), "{text}");
    let output = lab.command(
        &[
            "simulate",
            "--frames",
            "cube.npy",
            "--compression-ratio",
            "4",
            "--dispersion-offsets",
            "0:2:8",
            "--out",
            "other",
        ][..],
    );
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && text.contains("one offset for each band"), "{text}");
}

#[tokio::test]
async fn submit_sends_the_dispersion() {
    let lab = Lab::new("column", "0:2:8", "scene");
    let app = TestApp::with(&["--workers", "1"]).await;
    let line = [
        &[
            "submit",
            "sim/measurement.npy",
            "--masks",
            "sim/masks.npy",
            "--algorithm",
            "gap-tv",
            "--json",
        ][..],
        &options("column", "0:2:8", "scene")[..],
    ]
    .concat();
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    command.args(line).current_dir(lab.folder.path());
    command.env("SCI_RECON_URL", format!("http://{}", app.address()));
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let job: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&job["dispersion"], &job["shape"]["width"]), (&lab.dispersion, &json!(96)));
}
