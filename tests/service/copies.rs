//! Copies of a data folder, and damaged files: no wrong data are served, and results can be
//! computed again.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rand::RngExt;
use serde_json::{Value, json};

use crate::app::TestApp;
use crate::crashes::Shim;
use crate::faults::{results, sha256};
use crate::samples::Scene;

fn quick(measurement: &str) -> Value {
    json!({
        "measurement": measurement,
        "algorithm": "gap-tv",
        "tile": {"size": 48, "overlap": 8},
        "schedule": {"stages": [{"prior": "tv", "iterations": 20, "tv_weight": 0.05}]},
    })
}

/// Flips a bit in the middle of a file. The modification time changes only if `is_visible`.
fn flip_a_bit(path: &Path, is_visible: bool) {
    use std::os::unix::fs::FileExt;
    let file = std::fs::File::options().read(true).write(true).open(path).unwrap();
    let meta = file.metadata().unwrap();
    let (mut byte, middle) = ([0], meta.len() / 2);
    file.read_exact_at(&mut byte, middle).unwrap();
    file.write_all_at(&[byte[0] ^ 0x10], middle).unwrap();
    if !is_visible {
        file.set_modified(meta.modified().unwrap()).unwrap();
    }
}

fn command(name: &str, data: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    command.arg(name).arg("--data").arg(data);
    command
}

/// Report of a command on a folder, and whether it succeeded.
fn figures(output: &Output) -> (bool, Value) {
    let message = String::from_utf8_lossy(&output.stderr);
    let figures = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{message}"));
    (output.status.success(), figures)
}

fn verify(data: &Path) -> (bool, Value) {
    figures(&command("verify", data).output().unwrap())
}

/// Error message of `verify` on a folder that it rejects.
fn refused(data: &Path) -> String {
    let mut serve = command("serve", data);
    serve.args(["--listen", "127.0.0.1:0", "--workers", "0", "--accept-database"]);
    let mut child = serve.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let start = Instant::now();
    while child.try_wait().unwrap().is_none() {
        if start.elapsed().as_secs() > 30 {
            child.kill().unwrap();
            panic!("{} is served", data.display());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let output = child.wait_with_output().unwrap();
    assert!(!output.status.success());
    String::from_utf8(output.stderr).unwrap()
}

async fn done(app: &TestApp) -> (String, String) {
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let job = app.submit(&quick(&measurement)).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    (measurement, job)
}

fn frames_of(app: &TestApp, job: &str) -> PathBuf {
    app.data().join("results").join(job).join("snapshot_0000/stack.exr")
}

#[tokio::test]
async fn a_damaged_result_is_not_served_and_is_computed_again() {
    let app = TestApp::with(&["--workers", "1", "--scrub-bytes", "0"]).await;
    let (_, job) = done(&app).await;
    let before = results(&app, &job).await;
    let path = format!("/v1/jobs/{job}/snapshots/0/exports/npy");
    let etag = app.get(&path).await.expect(200).header("etag").to_owned();
    let address = format!("/v1/jobs/{job}/retry");
    let retry = async || app.post(&address, &json!({})).await;
    let detail = retry().await.problem(409, "illegal_state");
    assert!(detail.contains("succeeded"), "{detail}");

    flip_a_bit(&frames_of(&app, &job), true);
    let detail = app.get(&path).await.problem(500, "file_damaged");
    assert!(detail.contains("stack.exr") && detail.contains("retry"), "{detail}");
    let range = app.request(reqwest::Method::GET, &path).header("range", "bytes=0-9");
    app.send(range).await.problem(500, "file_damaged");
    for derived in ["exr", "frames/1.exr", "tiff"] {
        let path = format!("/v1/jobs/{job}/snapshots/0/exports/{derived}");
        app.get(&path).await.problem(500, "file_damaged");
    }
    app.get(&format!("/view/jobs/{job}/snapshots/0/pictures/frame-1"))
        .await
        .problem(500, "file_damaged");
    let mut fetch = std::process::Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    fetch.args(["fetch", &job, "--url", &format!("http://{}", app.address()), "--out"]);
    let output = fetch.arg(app.data().join("fetched")).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && text.contains(&detail), "{text}");
    // Intact files are served, and a client with the right bytes gets 304.
    app.get(&format!("/v1/jobs/{job}/snapshots/0/exports/frames/1.png")).await.expect(200);
    app.get(&format!("/v1/jobs/{job}/snapshots/1/exports/npy")).await.expect(200);
    let known = app.request(reqwest::Method::GET, &path).header("if-none-match", &etag);
    app.send(known).await.expect(304);
    let (good, found) = verify(app.data());
    assert!(!good);
    assert_eq!(found["damaged"].as_array().unwrap().len(), 1, "{found}");

    retry().await.expect(202);
    app.get(&path).await.problem(404, "not_ready");
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert_eq!(results(&app, &job).await, before, "the new frames are the same");
    let again = app.get(&path).await.expect(200);
    assert_eq!(
        (again.header("etag"), format!("\"{}\"", sha256(&again.bytes))),
        (&*etag, etag.clone())
    );
    // A missing file is reported in the same way.
    std::fs::remove_file(frames_of(&app, &job)).unwrap();
    app.get(&path).await.problem(500, "file_damaged");
    retry().await.expect(202);
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert_eq!(results(&app, &job).await, before);
    let (good, found) = verify(app.data());
    assert!(good, "{found}");
    // The lab's usage counts the existing files once, although they were computed several times.
    let mut database = app.database().await;
    let mut sums = async || -> (i64, i64) {
        let sums = "SELECT (SELECT coalesce(sum(result_bytes), 0) FROM jobs),
                           (SELECT coalesce(sum(size), 0) FROM result_files WHERE NOT derived)";
        sqlx::query_as(sums).fetch_one(&mut database).await.unwrap()
    };
    let (charged, stored) = sums().await;
    assert!(charged == stored && stored > 0, "{charged} {stored}");
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    assert_eq!(sums().await, (0, 0));
}

#[tokio::test]
async fn a_damaged_upload_is_not_used() {
    let app = TestApp::start().await;
    let masks = app.upload(Scene::SMALL.masks()).await;
    flip_a_bit(&app.data().join("blobs").join(&masks[..2]).join(&masks[2..]), true);
    let answer = app.post("/v1/calibrations", &json!({ "masks": masks })).await;
    assert!(answer.problem(410, "upload_damaged").contains(&masks));
    assert_eq!(answer.json()["pointer"], "/masks");
    // Uploading the file again repairs it.
    app.calibrate(Scene::SMALL.masks()).await.expect(201);
}

#[tokio::test]
async fn the_periodic_check_finds_silent_damage() {
    let app = TestApp::with(&["--workers", "1", "--scrub-bytes", "0"]).await;
    let (_, job) = done(&app).await;
    let path = format!("/v1/jobs/{job}/snapshots/0/exports/npy");
    let app = app.again(&["--workers", "0", "--scrub-bytes", "1000000000"]).await;
    app.get(&path).await.expect(200);
    // The first check may be over, so its time is set back by a day.
    let mut database = app.database().await;
    flip_a_bit(&frames_of(&app, &job), false);
    let start = Instant::now();
    loop {
        let overdue = "UPDATE scrub SET started_at = started_at - 86400001, place = NULL";
        sqlx::query(overdue).execute(&mut database).await.unwrap();
        tokio::time::sleep(Duration::from_secs(1)).await;
        let figures = app.get("/metrics").await.expect(200).bytes;
        if String::from_utf8(figures).unwrap().contains("\nsci_recon_damaged_files 1\n") {
            break;
        }
        assert!(start.elapsed().as_secs() < 60, "the flipped bit is not found");
    }
    app.get(&path).await.problem(500, "file_damaged");
    app.get(&format!("/v1/jobs/{job}/snapshots/1/exports/npy")).await.expect(200);
}

#[tokio::test]
async fn backup_and_verify_name_missing_files() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, job) = done(&app).await;
    let masks = app.upload(b"a file that goes".to_vec()).await;
    let folder = tempfile::tempdir().unwrap();
    let back_up = |name: &str| {
        let out = folder.path().join(name);
        figures(&command("backup", app.data()).arg("--out").arg(&out).output().unwrap())
    };
    // The name of the copy may lack a folder.
    let mut bare = command("backup", &std::path::absolute(app.data()).unwrap());
    let bare = bare.args(["--out", "bare"]).current_dir(folder.path()).output().unwrap();
    assert!(figures(&bare).0, "{bare:?}");
    assert!(verify(&folder.path().join("bare")).0);
    let (good, found) = back_up("whole");
    assert!(good && found["missing"] == json!([]), "{found}");
    assert!(verify(&folder.path().join("whole")).0);
    let inside =
        command("backup", app.data()).arg("--out").arg(app.data().join("blobs/copy")).output();
    let inside = inside.unwrap();
    let text = String::from_utf8_lossy(&inside.stderr);
    assert!(inside.status.code() == Some(2) && text.contains("inside the data folder"), "{text}");
    let blob = format!("blobs/{}/{}", &masks[..2], &masks[2..]);
    std::fs::remove_file(app.data().join(&blob)).unwrap();
    std::fs::remove_file(frames_of(&app, &job)).unwrap();
    let frames = format!("results/{job}/snapshot_0000/stack.exr");
    let reports = [back_up("less"), verify(app.data()), verify(&folder.path().join("less"))];
    for (is_good, report) in reports {
        assert!(!is_good);
        assert_eq!(report["missing"], json!([blob, frames]), "{report}");
        assert_eq!(report["damaged"], json!([]), "{report}");
    }
    // A copy is verified in the same way.
    let copied = folder.path().join("whole").join(&blob);
    flip_a_bit(&copied, false);
    let (good, found) = verify(&folder.path().join("whole"));
    assert!(!good && found["damaged"] == json!([blob]), "{found}");
}

fn disturbed(shim: &Shim, data: &Path, out: &Path, kind: &str, at: u64) -> Command {
    let token = shim.file("token");
    std::fs::write(&token, [0]).unwrap();
    let mut backup = command("backup", data);
    backup.arg("--out").arg(out).env("LD_PRELOAD", shim.library()).env("FAULT_TOKEN", token);
    backup.env("FAULT_PROGRAM", "backup").env("FAULT_KIND", kind).env("FAULT_AT", at.to_string());
    backup
}

#[tokio::test]
async fn an_interrupted_copy_cannot_be_served() {
    let shim = Shim::build();
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, job) = done(&app).await;
    let expected = results(&app, &job).await;
    let folder = tempfile::tempdir().unwrap();
    let (out, unfinished) = (folder.path().join("copy"), folder.path().join("copy.unfinished"));
    let (mut killed, mut at) = (0, 1);
    loop {
        let output = disturbed(&shim, app.data(), &out, "kill", at).output().unwrap();
        // A kill after the renaming leaves a complete copy, which is verified below.
        if output.status.success() || out.exists() {
            break;
        }
        killed += 1;
        assert!(killed < 200, "{}", String::from_utf8_lossy(&output.stderr));
        if unfinished.join("blobs").exists() && killed % 5 == 0 {
            let message = refused(&unfinished);
            assert!(message.contains("copy.unfinished"), "{message}");
        }
        at += 1 + at / 12;
    }
    println!("{}", json!({"target": "killed_copies", "ok": killed >= 10, "killed": killed}));
    assert!(killed >= 10, "{killed}");
    assert!(verify(&out).0 && !unfinished.exists());
    let restored = TestApp::on(folder, "copy", &["--workers", "1"]).await;
    assert_eq!(results(&restored, &job).await, expected);
}

#[tokio::test]
async fn a_copy_killed_during_cleanup_blocks_no_later_copy() {
    let shim = Shim::build();
    let app = TestApp::with(&["--workers", "0"]).await;
    for number in 0..10u32 {
        app.upload(number.to_string().into_bytes()).await;
    }
    let folder = tempfile::tempdir().unwrap();
    let (out, unfinished) = (folder.path().join("copy"), folder.path().join("copy.unfinished"));
    let kill = |at| disturbed(&shim, app.data(), &out, "kill", at).output().unwrap();
    // The first copy is killed late and leaves many entries. The next one is killed earlier, while it removes them.
    let far = (40..400).step_by(10).find(|at| {
        kill(*at);
        entries(&unfinished) > 12
    });
    let (far, mut removing) = (far.expect("a copy is killed while it copies files"), 0);
    for at in 1..30 {
        if entries(&unfinished) < 12 {
            kill(far);
        }
        let before = entries(&unfinished);
        kill(at);
        let remaining = entries(&unfinished);
        removing += u32::from(remaining > 0 && remaining < before);
        let is_marked = unfinished.join("sci-recon.json").exists();
        assert!(
            is_marked || remaining == 0,
            "killed at operation {at}: {remaining} of {before} entries remain"
        );
    }
    assert!(removing >= 5, "{removing} were killed while they removed files");
    let output = command("backup", app.data()).arg("--out").arg(&out).output().unwrap();
    assert!(figures(&output).0 && verify(&out).0 && !unfinished.exists());
}

/// Number of files and folders below a folder.
fn entries(folder: &Path) -> usize {
    let children = std::fs::read_dir(folder).into_iter().flatten().flatten();
    children.map(|entry| 1 + entries(&entry.path())).sum()
}

struct Suspended(Child);

impl Drop for Suspended {
    fn drop(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

#[tokio::test]
async fn a_suspended_copy_does_not_block_uploads() {
    let shim = Shim::build();
    let app = TestApp::with(&["--workers", "0"]).await;
    for number in 0..30u32 {
        app.upload(number.to_string().into_bytes()).await;
    }
    let folder = tempfile::tempdir().unwrap();
    let (mut stopped, mut slowest) = (0, Duration::ZERO);
    for at in [2, 5, 9, 20, 40, 60, 80] {
        let out = folder.path().join(format!("copy-{at}"));
        let mut backup = disturbed(&shim, app.data(), &out, "stop", at);
        let backup = Suspended(backup.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
        let stat = format!("/proc/{}/stat", backup.0.id());
        let start = Instant::now();
        while start.elapsed().as_secs() < 20 {
            let stat = std::fs::read_to_string(&stat).unwrap_or_default();
            if stat.contains(") T ") || stat.contains(") Z ") {
                stopped += u32::from(stat.contains(") T "));
                break;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        let start = Instant::now();
        app.upload(rand::rng().random::<[u8; 16]>().to_vec()).await;
        slowest = slowest.max(start.elapsed());
    }
    assert!(stopped >= 4, "{stopped}");
    assert!(slowest.as_secs() < 5, "an upload waited for {slowest:?}");
}
