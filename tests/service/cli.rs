//! Commands that need no server.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

use crate::samples::{Scene, npy};

fn sci_recon(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sci-recon")).args(arguments).output().unwrap()
}

fn json(output: &Output) -> Value {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("one JSON object on standard output")
}

/// Runs a command that must reject its input; returns the message.
fn rejection(arguments: &[&str]) -> String {
    refusal(&sci_recon(arguments))
}

fn refusal(output: &Output) -> String {
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{message}");
    assert!(output.stdout.is_empty());
    message
}

struct Files {
    folder: tempfile::TempDir,
}

impl Files {
    /// Six frames of a scene, as .npy.
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let scene = Scene::SMALL;
        let at = |k: usize| (0..48 * 64).map(move |at| scene.pixel(0, k, at / 64, at % 64));
        std::fs::write(folder.path().join("clip.npy"), npy(&[6, 48, 64], (0..6).flat_map(at)))
            .unwrap();
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    fn simulate(&self, pattern: &str, out: &str, more: &[&str]) -> Output {
        let (frames, out) = (self.text("clip.npy"), self.text(out));
        let line = ["simulate", "--frames", &frames, "--pattern", pattern, "--out", &out];
        sci_recon(&[&line[..], more].concat())
    }

    fn reconstruct(&self, simulation: &str, more: &[&str]) -> Output {
        let file = |name: &str| self.text(&format!("{simulation}/{name}.npy"));
        let (masks, measurement, truth) = (file("masks"), file("measurement"), file("truth"));
        let line = ["reconstruct", "--masks", &masks, "--measurement", &measurement];
        let line = [&line[..], &["--truth", &truth, "--algorithm", "gap-tv", "--json"], more];
        sci_recon(&line.concat())
    }
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap()
}

#[test]
fn a_simulated_snapshot_is_reconstructed() {
    let files = Files::new();
    for pattern in ["iid", "random-squares"] {
        let simulated = files.simulate(pattern, pattern, &["--compression-ratio", "4"]);
        assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
        let out = files.text("result");
        let output = files.reconstruct(pattern, &["--out", &out]);
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        // Of four independent binary masks, one pixel in 16 is closed in all by chance, which is no fault.
        assert_eq!(output.status.code(), Some(0), "{report:#}");
        let fields: Vec<&str> = report.as_object().unwrap().keys().map(String::as_str).collect();
        let mut expected = vec![
            "algorithm",
            "snapshots",
            "runs",
            "frames",
            "height",
            "width",
            "psnr_db",
            "psnr_db_by_snapshot",
            "psnr_unit_db",
            "ssim",
            "seconds",
            "iterations",
            "denoiser_passes",
            "tv_iterations",
            "cpu_seconds",
            "peak_rss_bytes",
            "provider",
            "stop_reason",
            "white_level",
            "pilot",
            "verdict",
            "assessment",
            "findings",
        ];
        expected.sort_unstable();
        assert_eq!(fields, expected);
        assert_eq!(
            (&report["frames"], &report["height"], &report["width"]),
            (&4.into(), &48.into(), &64.into())
        );
        assert_eq!(report["provider"], Value::Null);
        assert!(report["psnr_db"].as_f64().unwrap() > 18.0, "{pattern}: {report}");
        assert!(report["peak_rss_bytes"].as_u64().unwrap() > 1 << 20);
        // A second result replaces the first one.
        for name in [
            "frames/frame_0004.exr",
            "png/frame_0001.png",
            "stack.exr",
            "frames.npy",
            "manifest.json",
        ] {
            assert!(files.path("result").join(name).is_file(), "{name}");
        }
    }
    let record: Value =
        serde_json::from_slice(&bytes(&files.path("random-squares/simulation.json"))).unwrap();
    assert_eq!(record["apertures"]["rank"], 4);
    assert_eq!(record["unused_frames"], 2);
}

#[test]
fn every_kind_of_mask_is_simulated_from_an_optics_file() {
    let files = Files::new();
    let optics = files.text("optics.toml");
    let mut text = String::from_utf8(sci_recon(&["optics"]).stdout).unwrap();
    text = text.replace("magnification = 1.0", "magnification = 2.0");
    text = text.replace("vignetting = 0.0", "vignetting = 0.5");
    std::fs::write(&optics, text).unwrap();
    let checked = json(&sci_recon(&["optics", "--check", &optics]));
    assert_eq!(checked["derived"]["sensor_pixels_per_mask_pixel"], 2.0);
    std::fs::write(
        files.path("patterns.npy"),
        npy(&[3, 1, 2], [1.0, 0.0, 0.0, 1.0, 1.0, 1.0].into_iter()),
    )
    .unwrap();
    let images = files.text("patterns.npy");
    for (pattern, rank, more) in [
        ("rotating-circle", 3, &[][..]),
        ("single-apertures", 3, &["--normalise", "throughput"]),
        ("images", 2, &["--images", &images, "--blur", "0.6", "--leak", "0.1"]),
    ] {
        let base = ["--compression-ratio", "3", "--optics", &optics];
        let simulated = files.simulate(pattern, pattern, &[&base[..], more].concat());
        assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
        let record: Value =
            serde_json::from_slice(&bytes(&files.path(pattern).join("simulation.json"))).unwrap();
        assert_eq!(record["apertures"]["rank"], rank, "{record:#}");
        assert_eq!(record["optics"]["light"]["vignetting"], 0.5);
        let mean = record["mask_mean"].as_f64().unwrap();
        let share = record["light_throughput"].as_f64().unwrap();
        let scale = record["mask_scale"].as_f64().unwrap();
        assert!((mean * scale - share).abs() < 1e-6, "{record:#}");
    }
    // The corners lose half of the light. The truth contains the visible part only.
    let truth = std::fs::read(files.path("images/truth.npy")).unwrap();
    let first = crate::pipeline::values(&truth)[63];
    let expected = Scene::SMALL.pixel(0, 0, 0, 63) / 2.0;
    assert!((first - expected).abs() < 1e-3, "{first}");
}

#[test]
fn schedules_are_printed_in_the_format_that_is_read() {
    let files = Files::new();
    let own = sci_recon(&["schedule", "--algorithm", "pnp-nonlocal"]).stdout;
    std::fs::write(files.path("own.json"), &own).unwrap();
    let (file, line) = (files.text("own.json"), ["schedule", "--schedule"]);
    let read = |more: &[&str]| sci_recon(&[&line[..], &[&file], more].concat()).stdout;
    assert_eq!(read(&["--algorithm", "pnp-nonlocal"]), own);
    let cut: Value = serde_json::from_slice(&read(&["--iterations", "5"])).unwrap();
    assert_eq!(
        (&cut["stages"][0]["prior"], &cut["stages"][0]["iterations"]),
        (&"tv".into(), &5.into())
    );
    let message = rejection(&["schedule", "--schedule", &file, "--algorithm", "gap-tv"]);
    assert!(message.contains("gap-tv does not support the prior nonlocal"), "{message}");
}

#[test]
fn impossible_optics_are_rejected_at_once() {
    let files = Files::new();
    let optics = files.text("optics.toml");
    let refuse = |text: &str, pattern: &str, ratio: &str, more: &[&str]| {
        std::fs::write(&optics, text).unwrap();
        let base = ["--compression-ratio", ratio, "--optics", &optics];
        let output = files.simulate(pattern, "bad", &[&base[..], more].concat());
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{message}");
        message
    };
    let message = refuse("[mask]\ndistance_um = 0", "random-squares", "4", &[]);
    assert!(message.contains("distance_um is 0"), "{message}");
    let message = refuse("[sub_apertures]\nopen_share = 1.1", "random-squares", "4", &[]);
    assert!(message.contains("the open share of the sub-apertures"), "{message}");
    let message = refuse("[sub_apertures]\nrank = 5", "random-squares", "4", &[]);
    assert!(message.contains("rank 5 can't be reached"), "{message}");
    let two = "[sub_apertures]\nrows = 1\ncolumns = 2";
    let message = refuse(two, "single-apertures", "4", &[]);
    assert!(message.contains("4 frames need 4 sub-apertures"), "{message}");
    let folder = files.path("pictures");
    std::fs::create_dir_all(&folder).unwrap();
    for (name, size) in [("1.png", 4), ("2.png", 5)] {
        image::GrayImage::new(size, 4).save(folder.join(name)).unwrap();
    }
    let images = ["--images", folder.to_str().unwrap()];
    let message = refuse("", "images", "2", &images);
    assert!(message.contains("4x5") && message.contains("4x4"), "{message}");
}

#[test]
fn a_seed_reproduces_a_simulation_bit_for_bit() {
    let files = Files::new();
    let more = ["--compression-ratio", "3", "--noise-sigma", "5", "--seed"];
    for (out, seed) in [("a", "7"), ("b", "7"), ("c", "8")] {
        files.simulate("random-squares", out, &[&more[..], &[seed]].concat());
    }
    for name in ["masks.npy", "measurement.npy", "truth.npy", "simulation.json"] {
        let file = |out: &str| bytes(&files.path(out).join(name));
        assert_eq!(file("a"), file("b"), "{name}");
        assert_eq!(file("a") == file("c"), name == "truth.npy", "{name}");
    }
}

#[test]
fn fixed_iterations_are_independent_of_the_number_of_threads() {
    let files = Files::new();
    files.simulate("iid", "s", &["--compression-ratio", "6"]);
    let cut = ["--iterations", "33", "--tile", "32", "--overlap", "8"];
    let mut frames = Vec::new();
    for threads in ["1", "3"] {
        let out = files.text(threads);
        let more = [&cut[..], &["--threads", threads, "--out", &out]].concat();
        let report = json(&files.reconstruct("s", &more));
        assert_eq!(report["tv_iterations"], 33);
        assert_eq!(report["stop_reason"], "max-iterations");
        frames.push(bytes(&files.path(threads).join("frames.npy")));
    }
    assert_eq!(frames[0], frames[1]);
}

#[test]
fn mismatched_inputs_are_rejected_with_the_reason() {
    let files = Files::new();
    files.simulate("iid", "four", &["--compression-ratio", "4"]);
    let [masks, measurement, clip] =
        ["four/masks.npy", "four/measurement.npy", "clip.npy"].map(|name| files.text(name));
    std::fs::write(files.path("small.npy"), npy(&[20, 30], (0..600).map(|_| 0.5))).unwrap();
    let small = files.text("small.npy");
    let base = ["reconstruct", "--algorithm", "gap-tv", "--json", "--masks"];
    let run = |masks: &str, more: &[&str]| rejection(&[&base[..], &[masks], more].concat());
    let sizes = run(&masks, &["--measurement", &small]);
    assert!(sizes.contains("20x30") && sizes.contains("48x64"), "{sizes}");
    let truth = run(&masks, &["--measurement", &measurement, "--truth", &clip]);
    assert!(truth.contains("6x48x64") && truth.contains("4x48x64"), "{truth}");
    let snapshot = run(&masks, &["--measurement", &measurement, "--snapshot", "1"]);
    assert!(snapshot.contains("no snapshot 1"), "{snapshot}");
    let missing = run("/nowhere/masks.npy", &["--measurement", &measurement]);
    assert!(missing.contains("/nowhere/masks.npy"), "{missing}");
    let tile = run(&masks, &["--measurement", &measurement, "--tile", "4"]);
    assert!(tile.contains("tile size is 4"), "{tile}");
    std::fs::create_dir_all(files.path("mine/frames")).unwrap();
    let foreign = run(&masks, &["--measurement", &measurement, "--out", &files.text("mine")]);
    assert!(foreign.contains("frames"), "{foreign}");
    // The output is tried before the model is read, and so before the work.
    let out = ["--measurement", &measurement, "--model", "/nowhere/m.onnx", "--out", &small];
    let late = [&base[..1], &["--algorithm", "learned", "--masks", &masks], &out].concat();
    let late = String::from_utf8(sci_recon(&late).stderr).unwrap();
    assert!(late.contains("cannot write") && late.contains("small.npy"), "{late}");
    let few = rejection(&[
        "simulate",
        "--frames",
        &clip,
        "--compression-ratio",
        "7",
        "--pattern",
        "iid",
        "--out",
        &small,
    ]);
    assert!(few.contains("6 frames") && few.contains("need 7"), "{few}");
    rejection(&["reconstruct", "--json"]);
}

#[test]
fn the_demo_writes_frames_and_a_report() {
    let files = Files::new();
    let output = sci_recon(&["demo", "--json", "--out", &files.text("demo")]);
    let report = json(&output);
    let (tv, pnp) = (&report["gap_tv"], &report["pnp_tv_fastdvdnet"]);
    let gain = pnp["psnr_db"].as_f64().unwrap() - tv["psnr_db"].as_f64().unwrap();
    assert!(gain >= 1.0, "{report:#}");
    assert!(pnp["ssim"].as_f64() > tv["ssim"].as_f64(), "{report:#}");
    let frames = files.path("demo/frames/pnp-tv-fastdvdnet/snapshot_0000/frames");
    assert_eq!(std::fs::read_dir(frames).unwrap().count(), 8);
    let page = std::fs::read_to_string(files.path("demo/report.html")).unwrap();
    let shown: Vec<&str> =
        page.split("src=\"").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    assert_eq!(shown.iter().filter(|file| file.ends_with(".mp4")).count(), 2, "{shown:?}");
    for file in &shown {
        assert!(files.path(&format!("demo/{file}")).is_file(), "{file}");
    }
}

#[test]
fn settings_come_from_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("sci.toml");
    let config = file.to_str().unwrap();
    std::fs::write(&file, "data = \"/nowhere\"\n[serve]\nmax-upload-bytes = \"10GB\"\n").unwrap();
    let shown = sci_recon(&["--config", config, "config", "show", "serve", "--", "--workers", "4"]);
    let text = String::from_utf8(shown.stdout).unwrap();
    let line = |key: &str| text.lines().find(|line| line.starts_with(key)).unwrap().to_owned();
    assert!(line("data ").contains("/nowhere") && line("data ").contains("sci.toml"), "{text}");
    assert!(line("max-upload-bytes").contains("10GB"), "{text}");
    assert!(line("workers").contains('4') && line("workers").contains("command line"), "{text}");
    assert!(line("max-jobs").contains("1000") && line("max-jobs").contains("default"), "{text}");
    // A client command reads the same file.
    let rejection = rejection(&["--config", config, "token", "list"]);
    assert!(rejection.contains("/nowhere"), "{rejection}");
    std::fs::write(&file, "[serve]\nmax-uploads-bytes = 1\n").unwrap();
    let rejection = self::rejection(&["serve", "--config", config, "--data", "/nowhere"]);
    assert!(rejection.contains("max-uploads-bytes"), "{rejection}");
    let rejection = sci_recon(&["serve", "--data", "/nowhere", "--max-upload-bytes", "10 apples"]);
    assert!(String::from_utf8_lossy(&rejection.stderr).contains("10GB"), "{rejection:?}");
}

/// Closes the pipe early, like `| head -1`.
#[test]
fn a_reader_that_closes_the_pipe_is_no_failure() {
    for line in [&["completions", "bash"][..], &["config", "show"], &["schedule"], &["optics"]] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let output = command.args(line).stdout(writer).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && stderr.is_empty(), "{line:?}: {stderr}");
    }
}

#[test]
fn the_help_groups_the_commands() {
    let output = sci_recon(&["--help"]);
    let text = String::from_utf8(output.stdout).unwrap();
    let position = |word: &str| text.find(word).unwrap_or_else(|| panic!("no {word} in {text}"));
    let words = ["Lab machine:", "  submit ", "Server:", "  serve ", "Administration:"];
    let words =
        [&words[..], &["  token ", "Offline:", "  reconstruct ", "--url", "--config"]].concat();
    assert!(words.is_sorted_by_key(|word| position(word)), "{text}");
    let text = rejection(&["--url", "http://127.0.0.1:1", "serve", "--data", "/nowhere"]);
    assert!(text.contains("serve takes no --url"), "{text}");
}

#[test]
fn completions_and_man_pages_are_printed() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().to_str().unwrap();
    assert!(sci_recon(&["man", "--out", out]).status.success());
    for page in ["sci-recon.1", "sci-recon-serve.1", "sci-recon-token-create.1"] {
        let text = std::fs::read_to_string(folder.path().join(page)).unwrap();
        assert!(text.contains(".SH NAME"), "{page}");
    }
    for shell in ["bash", "zsh", "fish"] {
        let output = sci_recon(&["completions", shell]);
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success() && text.contains("max-upload-bytes"), "{shell}");
    }
}
