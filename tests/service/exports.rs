//! Results in the formats of other programs.

use std::path::PathBuf;
use std::time::Duration;

use reqwest::Method;
use serde_json::{Value, json};

use crate::app::{Answer, TestApp, has_programs, id, judges, skip};
use crate::faults::sha256;
use crate::limits::entitle;
use crate::samples::Scene;

/// A succeeded job of two snapshots, taken at 50 per second with an exposure of 16 ms.
async fn done(app: &TestApp) -> String {
    let calibration = id(&app.calibrate(Scene::SMALL.masks()).await.expect(201));
    let data = app.upload(Scene::SMALL.snapshots()).await;
    let body =
        json!({"calibration": calibration, "data": data, "camera_fps": 50, "exposure_s": 0.016});
    let measurement = id(&app.post("/v1/measurements", &body).await.expect(201));
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    job
}

#[tokio::test]
async fn other_programs_read_all_exports_bit_for_bit() {
    let Some(python) = judges() else { return };
    let app = TestApp::with(&["--workers", "1"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let job = done(&app).await;
    let mut judge = tokio::process::Command::new(python);
    judge.arg("tests/judges/read_exports.py").arg(format!("http://{}", app.address()));
    judge.args([&job, "2"]).env("SCI_RECON_TOKEN", &token);
    let output = judge.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["intervals"]["/snapshots/1"], json!(0.004));
    // The camera pauses between the snapshots.
    assert_eq!(report["intervals"][""], json!(null));
    assert_eq!(report["members"], 2 * 12 + 1);
}

#[tokio::test]
async fn libtiff_and_imagej_open_the_stack() {
    let Some(python) = judges() else { return };
    if !has_programs(&["tiffinfo"], "libtiff-tools") {
        return;
    }
    if !std::path::Path::new("/usr/share/java/ij.jar").exists() {
        return skip("ImageJ is not installed: run `apt-get install imagej`");
    }
    let app = TestApp::with(&["--workers", "1"]).await;
    let job = done(&app).await;
    let folder = tempfile::tempdir().unwrap();
    let mut files = Vec::new();
    for (export, name) in [("npy", "frames.npy"), ("tiff", "stack.tif")] {
        let file = app.get(&format!("/v1/jobs/{job}/exports/{export}")).await.expect(200);
        files.push(folder.path().join(name));
        std::fs::write(folder.path().join(name), file.bytes).unwrap();
    }
    let mut judge = tokio::process::Command::new(python);
    let output = judge.arg("tests/judges/read_tiff.py").args(files).output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[tokio::test]
async fn exports_support_caching_and_ranges_like_files() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let stuck = json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": {"stages": [
        {"prior": "tv", "iterations": 10_000, "tv_weight": 0.05, "tv_updates": 40}]}});
    let stuck = app.submit(&stuck).await;
    let paths = ["exports/tiff", "exports/npy", "exports/zip", "exports/zarr_zip"];
    let zarr = ["exports/zarr/zarr.json", "snapshots/0/exports/zarr/0/c/0/0/0"];
    for path in paths.iter().chain(&zarr) {
        app.get(&format!("/v1/jobs/{stuck}/{path}")).await.problem(404, "not_ready");
    }
    app.post(&format!("/v1/jobs/{stuck}/cancel"), &json!({})).await.expect(202);
    let job = done(&app).await;
    app.get(&format!("/v1/jobs/{job}/snapshots/2/exports/tiff")).await.problem(404, "not_found");
    for chunk in ["0/c/8/0/0", "0/c/-1/0/0", "0/c/0/1/0", "c/0/0/0", ".zarray"] {
        let path = format!("/v1/jobs/{job}/exports/zarr/{chunk}");
        app.get(&path).await.problem(404, "not_found");
    }
    for path in paths.iter().chain(&zarr[1..]).chain(&["snapshots/1/exports/tiff"]) {
        let path = format!("/v1/jobs/{job}/{path}");
        let complete = app.get(&path).await.expect(200);
        let (size, etag) = (complete.bytes.len(), complete.header("etag").to_owned());
        let head = app.send(app.request(Method::HEAD, &path)).await.expect(200);
        assert_eq!(
            (head.header("content-length"), head.header("etag")),
            (&*size.to_string(), &*etag)
        );
        let known = app.request(Method::GET, &path).header("if-none-match", &etag);
        app.send(known).await.expect(304);
        // Ranges may have any bounds.
        let mut joined = Vec::new();
        while joined.len() < size {
            let (first, last) = (joined.len(), joined.len() + size / 7 + 13);
            let part =
                app.request(Method::GET, &path).header("range", format!("bytes={first}-{last}"));
            joined.extend(app.send(part.header("if-range", &etag)).await.expect(206).bytes);
        }
        assert!(joined == complete.bytes, "{path}");
    }
    // Equal results give equal bytes.
    let archive = app.get(&format!("/v1/jobs/{job}/exports/zip")).await.bytes;
    assert_eq!(archive, app.get(&format!("/v1/jobs/{job}/exports/zip")).await.bytes);

    // A damaged file is not sent.
    let results = app.data().join("results").join(&job);
    let stack = results.join("snapshot_0001/stack.exr");
    let mut bytes = std::fs::read(&stack).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(&stack, bytes).unwrap();
    for path in ["snapshots/1/exports/tiff", "snapshots/1/exports/zarr/0/c/3/0/0"] {
        app.get(&format!("/v1/jobs/{job}/{path}")).await.problem(500, "file_damaged");
    }
    app.get(&format!("/v1/jobs/{job}/snapshots/0/exports/tiff")).await.expect(200);
    let cut =
        app.request(Method::GET, &format!("/v1/jobs/{job}/exports/zip")).send().await.unwrap();
    assert!(cut.bytes().await.is_err(), "the archive breaks off before the damaged file");
}

#[tokio::test]
async fn frames_are_stored_once_and_every_listed_file_is_served() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let job = done(&app).await;
    let results = app.data().join("results").join(&job);
    let names = |folder: &str| {
        let entries = std::fs::read_dir(results.join(folder)).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    assert_eq!(names("."), ["manifest.json", "snapshot_0000", "snapshot_0001"]);
    let mut on_disk = std::fs::metadata(results.join("manifest.json")).unwrap().len();
    for snapshot in [0, 1] {
        let folder = format!("snapshot_{snapshot:04}");
        assert_eq!(names(&folder), ["error.npy", "manifest.json", "png", "stack.exr"]);
        let base = format!("/v1/jobs/{job}/snapshots/{snapshot}");
        let listed = app.get(&base).await.expect(200).json()["files"].clone();
        let listed = listed.as_array().unwrap();
        let manifest = app.get(&format!("{base}/exports/manifest")).await.expect(200).json();
        assert_eq!(manifest["content"]["files"].as_array().unwrap().len(), listed.len() - 1);
        for file in listed {
            let (name, size) = (file["name"].as_str().unwrap(), file["size"].as_u64().unwrap());
            let stored = results.join(&folder).join(name).metadata();
            on_disk += stored.map_or(0, |stored| stored.len());
            let path = format!("/v1/jobs/{job}/snapshots/{}", file["href"].as_str().unwrap());
            let complete = app.get(&path).await.expect(200);
            assert_eq!(json!(sha256(&complete.bytes)), file["sha256"], "{name}");
            let etag = complete.header("etag").to_owned();
            assert_eq!(etag, file["sha256"].to_string(), "{name}");
            let head = app.send(app.request(Method::HEAD, &path)).await.expect(200);
            let figures = (head.header("content-length"), head.header("etag"));
            assert_eq!(figures, (&*size.to_string(), &*etag), "{name}");
            let known = app.request(Method::GET, &path).header("if-none-match", &etag);
            app.send(known).await.expect(304);
            if name == "manifest.json" {
                assert_eq!(complete.header("accept-ranges"), "none");
                continue;
            }
            let recorded = json!({"name": name, "size": size, "sha256": file["sha256"]});
            assert!(manifest["content"]["files"].as_array().unwrap().contains(&recorded), "{name}");
            let mut joined = Vec::new();
            while (joined.len() as u64) < size {
                let range =
                    format!("bytes={}-{}", joined.len(), joined.len() as u64 + size / 5 + 7);
                let part = app.request(Method::GET, &path).header("range", range);
                joined.extend(app.send(part.header("if-range", &etag)).await.expect(206).bytes);
            }
            assert!(joined == complete.bytes, "{name}");
            let beyond = app.request(Method::GET, &path).header("range", format!("bytes={size}-"));
            app.send(beyond).await.problem(416, "range_not_satisfiable");
        }
    }
    // The lab is charged for the stored files alone.
    assert_eq!(app.kept().await, on_disk);
}

/// Output of the movie judge for all movies of a job.
pub async fn judge_movies(
    app: &TestApp,
    (job, snapshots): (&str, usize),
    token: &str,
) -> Option<Value> {
    let mut judge = tokio::process::Command::new(judges()?);
    judge.arg("tests/judges/read_movies.py").arg(format!("http://{}", app.address()));
    judge.args([job, &snapshots.to_string()]).env("SCI_RECON_TOKEN", token);
    let output = judge.output().await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    eprintln!("movies: {report}");
    Some(report)
}

#[tokio::test]
async fn another_decoder_reads_the_frames_of_movies() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let job = done(&app).await;
    let Some(report) = judge_movies(&app, (&job, 2), &token).await else { return };
    // Four frames take 16 ms.
    assert_eq!(report["title"], "250 frames/s, played at 10");
}

impl TestApp {
    async fn create_movie(&self, job: &str, snapshot: Option<u32>) -> Answer {
        let body = json!({"format": "mp4", "snapshot": snapshot});
        self.post(&format!("/v1/jobs/{job}/exports"), &body).await
    }

    /// The first answer to a request for a movie that is not 202.
    async fn movie(&self, path: &str) -> Answer {
        loop {
            let answer = self.get(path).await;
            if answer.status != 202 {
                return answer;
            }
            assert_eq!(answer.header("cache-control"), "no-store");
            let seconds: u64 = answer.header("retry-after").parse().unwrap();
            assert!((1..60).contains(&seconds), "{seconds}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// Size of the lab's results in bytes.
    async fn kept(&self) -> u64 {
        self.get("/v1/me").await.expect(200).json()["use"]["result_bytes"].as_u64().unwrap()
    }

    /// Path of a movie.
    fn movie_file(&self, movie: &Answer) -> PathBuf {
        let etag = movie.header("etag").trim_matches('"');
        self.data().join("blobs").join(&etag[..2]).join(&etag[2..])
    }
}

#[tokio::test]
async fn a_movie_is_encoded_on_request_and_stored_like_a_result() {
    let mut app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) = app.scene(&Scene::SMALL).await;
    let stuck = json!({"measurement": measurement, "algorithm": "gap-tv", "schedule": {"stages": [
        {"prior": "tv", "iterations": 10_000, "tv_weight": 0.05, "tv_updates": 40}]}});
    let stuck = app.submit(&stuck).await;
    for path in ["snapshots/0/", ""] {
        let path = format!("/v1/jobs/{stuck}/{path}exports/mp4");
        app.get(&path).await.problem(404, "not_ready");
    }
    app.post(&format!("/v1/jobs/{stuck}/cancel"), &json!({})).await.expect(202);
    let job = done(&app).await;
    let path = format!("/v1/jobs/{job}/snapshots/1/exports/mp4");
    let sequence = format!("/v1/jobs/{job}/exports/mp4");

    // No movie is encoded before it is created. The light worker of the server may begin it at once.
    let before = app.kept().await;
    app.restart_with(&["--workers", "0"]);
    app.get(&path).await.problem(404, "not_found");
    let first = app.create_movie(&job, Some(1)).await.expect(202);
    let state = first.json()["state"].clone();
    assert!(state == "waiting" || state == "running", "{state}");
    assert_eq!(first.header("location"), path);
    let repeated = app.create_movie(&job, Some(1)).await;
    assert!(matches!(repeated.status.as_u16(), 200 | 202), "{repeated:?}");
    let wrong = app.create_movie(&job, Some(2)).await;
    wrong.problem(422, "invalid_request");
    assert_eq!(wrong.json()["pointer"], "/snapshot");
    let body = json!({"format": "tiff"});
    let body = app.post(&format!("/v1/jobs/{job}/exports"), &body).await;
    body.problem(422, "invalid_request");
    assert_eq!(app.get(&format!("/v1/jobs/{job}")).await.json()["state"], "succeeded");
    app.restart_with(&["--workers", "1"]);

    let movie = app.movie(&path).await.expect(200);
    let exists = app.create_movie(&job, Some(1)).await.expect(200);
    assert_eq!(exists.json(), json!({"state": "ready", "percent": 100.0}));
    let (size, etag) = (movie.bytes.len(), movie.header("etag").to_owned());
    assert_eq!(movie.header("content-type"), "video/mp4");
    assert!(movie.header("content-disposition").ends_with("_0001_movie.mp4\""), "{movie:?}");
    assert_eq!(&movie.bytes[4..8], b"ftyp");
    assert_eq!(app.kept().await, before + size as u64);
    let head = app.send(app.request(Method::HEAD, &path)).await.expect(200);
    assert_eq!(head.header("content-length"), size.to_string());
    app.send(app.request(Method::GET, &path).header("if-none-match", &etag)).await.expect(304);
    let rest =
        app.request(Method::GET, &path).header("range", "bytes=100-").header("if-range", &etag);
    assert_eq!(app.send(rest).await.expect(206).bytes, movie.bytes[100..]);
    // The archive contains only files that cannot be derived from others.
    let listed = app.get(&format!("/v1/jobs/{job}/snapshots/1")).await.expect(200).json();
    assert!(!listed.to_string().contains("movie"), "{listed}");

    // A damaged movie is encoded again with the same bytes.
    let file = app.movie_file(&movie);
    let mut bytes = movie.bytes.clone();
    bytes[size / 2] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    app.get(&path).await.problem(404, "not_found");
    app.create_movie(&job, Some(1)).await.expect(202);
    assert_eq!(app.movie(&path).await.expect(200).bytes, movie.bytes);

    // Damaged frames have no movie. The answer says so, and a retry of the job restores it.
    let stack = app.data().join("results").join(&job).join("snapshot_0000/stack.exr");
    let original = std::fs::read(&stack).unwrap();
    std::fs::write(&stack, &original[..original.len() - 1]).unwrap();
    app.create_movie(&job, None).await.expect(202);
    let detail = app.movie(&sequence).await.problem(500, "movie_failed");
    assert!(detail.contains("stack.exr is damaged: retry the job"), "{detail}");
    app.get(&sequence).await.problem(500, "movie_failed");
    app.create_movie(&job, None).await.expect(202);
    app.movie(&sequence).await.problem(500, "movie_failed");
    app.get(&format!("/v1/jobs/{job}/snapshots/0/exports/npy")).await.problem(500, "file_damaged");
    app.post(&format!("/v1/jobs/{job}/retry"), &json!({})).await.expect(202);
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    assert!(!file.exists(), "a retry deletes the movies of the old results");
    app.create_movie(&job, None).await.expect(202);
    app.create_movie(&job, Some(1)).await.expect(202);
    let both = app.movie(&sequence).await.expect(200);
    assert_eq!(app.movie(&path).await.expect(200).bytes, movie.bytes);

    // Deleting the job deletes its movies.
    app.delete(&format!("/v1/jobs/{job}")).await.expect(204);
    assert!(!app.movie_file(&movie).exists() && !app.movie_file(&both).exists());
    app.get(&path).await.problem(404, "not_found");
}

#[tokio::test]
async fn the_smallest_frames_have_only_a_gif() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let (_, measurement) =
        app.scene(&Scene { frames: 2, height: 48, width: 12, snapshots: 1 }).await;
    let job = app.submit(&json!({"measurement": measurement, "algorithm": "gap-tv"})).await;
    assert_eq!(app.ended(&job).await["state"], "succeeded");
    let path = format!("/v1/jobs/{job}/exports/mp4");
    app.get(&path).await.problem(404, "not_found");
    let detail = app.create_movie(&job, None).await.problem(404, "not_found");
    assert!(detail.contains("48x12") && detail.contains("below 16"), "{detail}");
    let gif = app.post(&format!("/v1/jobs/{job}/exports"), &json!({"format": "gif"})).await;
    assert_eq!(gif.expect(202).header("location"), format!("/v1/jobs/{job}/exports/gif"));
    let gif = app.movie(&format!("/v1/jobs/{job}/exports/gif")).await.expect(200);
    assert_eq!((gif.header("content-type"), &gif.bytes[..6]), ("image/gif", &b"GIF89a"[..]));
}

#[tokio::test]
async fn a_lab_without_space_gets_no_movie() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let job = done(&app).await;
    entitle(&app, &["a", "--bytes", "1"]);
    app.create_movie(&job, None).await.problem(403, "quota_exceeded");
    // A reader creates nothing.
    let reader = app.token(&["create", "--lab", "a", "--role", "read"]);
    app.sign_in(&reader);
    app.create_movie(&job, None).await.problem(403, "forbidden");
    app.get(&format!("/v1/jobs/{job}/exports/mp4")).await.problem(404, "not_found");
}
