//! The client commands of the real program, over connections that are cut.

use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::Command;

use crate::app::TestApp;
use crate::faults::sha256;
use crate::resumable::cutting;
use crate::samples::{Scene, constant};

/// A lab machine with its working folder.
struct Lab {
    folder: tempfile::TempDir,
    url: String,
    token: String,
}

impl Lab {
    fn new(url: String, token: &str) -> Self {
        Self { folder: tempfile::tempdir().unwrap(), url, token: token.to_owned() }
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.folder.path().join(name), bytes).unwrap();
    }

    fn path(&self, name: &str) -> std::path::PathBuf {
        self.folder.path().join(name)
    }

    async fn run(&self, arguments: &[&str]) -> std::process::Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(arguments).current_dir(self.folder.path());
        command.env("SCI_RECON_URL", &self.url).env("SCI_RECON_TOKEN", &self.token);
        command.output().await.unwrap()
    }

    /// Output of a command that must succeed.
    async fn text(&self, arguments: &[&str]) -> String {
        let output = self.run(arguments).await;
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    async fn json(&self, arguments: &[&str]) -> Value {
        serde_json::from_str(&self.text(arguments).await).unwrap()
    }

    /// Error message of a command that must end with this code.
    async fn refused(&self, code: i32, arguments: &[&str]) -> String {
        let output = self.run(arguments).await;
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{text}");
        text
    }
}

#[tokio::test]
async fn a_lab_machine_submits_watches_and_downloads_over_cut_connections() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let (proxy, cuts) = cutting(app.address()).await;
    let lab = Lab::new(format!("http://{proxy}"), &token);
    let scene = Scene { frames: 8, height: 256, width: 256, snapshots: 2 };
    lab.write("masks.npy", &scene.masks());
    lab.write("shots.npy", &scene.snapshots());
    let submit = ["submit", "shots.npy", "--masks", "masks.npy", "--algorithm", "gap-tv"];
    let job = lab.text(&[&submit[..], &["--label", "first", "--key", "k"]].concat()).await;
    // A repeated submission returns the same job and calibration.
    let repeated =
        lab.json(&[&submit[..], &["--label", "first", "--key", "k", "--json"]].concat()).await;
    assert_eq!((&repeated["id"], &repeated["label"]), (&json!(job), &json!("first")));
    let calibrations = app.get("/v1/calibrations").await.expect(200).json();
    assert_eq!(calibrations["items"].as_array().unwrap().len(), 1);

    let watched = lab.text(&["watch", &job]).await;
    let line = watched.lines().next().unwrap_or_default();
    assert!(line.starts_with(&format!("{job}: ")) && line.ends_with("; finished"), "{watched}");
    let everything = [
        "frames.npy,stack.exr,stack-sigma.exr,stack.tif,movie.mp4,movie.gif,frames,png,manifest.json",
        "sequence.npy,sequence.mp4,sequence.gif",
    ];
    let line =
        ["fetch", &job, "--out", "out", "--json", "--file", everything[0], "--file", everything[1]];
    let fetched = lab.json(&line).await;
    // Each snapshot has array, stacks, movies, manifest, and EXR and PNG of each frame. The sequence
    // has manifest, array and movies.
    assert_eq!(fetched["files"].as_array().unwrap().len(), 2 * (7 + 2 * 8) + 4, "{fetched:#}");
    for file in [
        "snapshot_0001/frames.npy",
        "snapshot_0000/png/frame_0003.png",
        "snapshot_0001/movie.mp4",
        "snapshot_0001/stack-sigma.exr",
        "sequence.npy",
        "sequence.mp4",
        "snapshot_0000/movie.gif",
        "sequence.gif",
    ] {
        let (subfolder, name) = file.split_once('/').unwrap_or(("", file));
        let path = match (subfolder, name) {
            ("", "sequence.npy") => "exports/npy".to_owned(),
            ("", "sequence.gif") => "exports/gif".to_owned(),
            ("", _) => "exports/mp4".to_owned(),
            _ => {
                let format = match name {
                    "frames.npy" => "npy",
                    "png/frame_0003.png" => "frames/3.png",
                    "movie.mp4" => "mp4",
                    "movie.gif" => "gif",
                    _ => "exr?layers=sigma",
                };
                format!("snapshots/{}/exports/{format}", &subfolder[12..])
            }
        };
        let served = app.get(&format!("/v1/jobs/{job}/{path}")).await.expect(200).bytes;
        assert!(std::fs::read(lab.path("out").join(file)).unwrap() == served, "{file}");
    }
    assert!(parts(&lab.path("out")).is_empty(), "{:?}", parts(&lab.path("out")));
    let cut = cuts.load(Ordering::Relaxed);
    assert!(cut >= 5, "{cut} connections were cut");

    // A repeated download transfers nothing, and a foreign file is kept.
    lab.text(&["fetch", &job, "--out", "out"]).await;
    lab.write("out/snapshot_0000/frames.npy", b"mine");
    let refused = lab.refused(2, &["fetch", &job, "--out", "out"]).await;
    assert!(refused.contains("it is not overwritten"), "{refused}");
    assert_eq!(std::fs::read(lab.path("out/snapshot_0000/frames.npy")).unwrap(), b"mine");

    let listed = lab.json(&["ls", "--json", "--state", "succeeded"]).await;
    assert_eq!(listed[0]["id"], job);
    let listed = lab.text(&["ls"]).await;
    let jobs: Vec<&str> = listed.lines().filter(|line| !line.starts_with(' ')).collect();
    assert!(jobs.len() == 1 && jobs[0].contains(&job) && jobs[0].contains("first"), "{listed}");
    assert_eq!(lab.text(&["ls", "--state", "failed"]).await, "");
}

/// Forms of frames have the same size for all frames of a shape.
#[tokio::test]
async fn files_of_the_same_size_are_not_taken_for_one_another() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new(format!("http://{}", app.address()), "");
    let scene = Scene { frames: 4, height: 128, width: 128, snapshots: 2 };
    lab.write("masks.npy", &scene.masks());
    lab.write("shots.npy", &scene.snapshots());
    lab.write("cut.npy", &scene.with_a_cut(1));
    let submit = async |file: &str| {
        let line = ["submit", file, "--masks", "masks.npy", "--algorithm", "gap-tv"];
        let job = String::from_utf8(lab.run(&line).await.stdout).unwrap().trim().to_owned();
        assert_eq!(app.ended(&job).await["state"], "succeeded");
        job
    };
    let (first, second) = (submit("shots.npy").await, submit("cut.npy").await);
    for (name, file, export) in [
        ("stack.tif", "snapshot_0001/stack.tif", "snapshots/1/exports/tiff"),
        (
            "stack-sigma.exr",
            "snapshot_0001/stack-sigma.exr",
            "snapshots/1/exports/exr?layers=sigma",
        ),
        ("sequence.npy", "sequence.npy", "exports/npy"),
        ("sequence.tif", "sequence.tif", "exports/tiff"),
        ("results.zip", "results.zip", "exports/zip"),
        ("frames.npy", "snapshot_0001/frames.npy", "snapshots/1/exports/npy"),
    ] {
        let fetch =
            async |job: &str| lab.run(&["fetch", job, "--out", "out", "--file", name]).await;
        let served =
            async |job: &str| app.get(&format!("/v1/jobs/{job}/{export}")).await.expect(200).bytes;
        let refused = async |job: &str| {
            let output = fetch(job).await;
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(2), "{name}: {text}");
            assert!(text.contains("it is not overwritten"), "{name}: {text}");
        };
        let content = served(&first).await;
        fetch(&first).await;
        let path = lab.path("out").join(file);
        assert!(std::fs::read(&path).unwrap() == content, "{name}");
        refused(&second).await;
        assert!(std::fs::read(&path).unwrap() == content, "{name}");
        // An identical file is accepted, and a damaged one is refused.
        let output = fetch(&first).await;
        assert_ne!(output.status.code(), Some(2), "{name}");
        let mut damaged = content.to_vec();
        damaged[1000..1100].fill(0x55);
        std::fs::write(&path, &damaged).unwrap();
        refused(&first).await;
        std::fs::remove_file(&path).unwrap();

        // The beginning of an interrupted download counts only if its record confirms it.
        let head = app.send(app.request(Method::HEAD, &format!("/v1/jobs/{first}/{export}"))).await;
        let etag: String = head.header("etag").trim_matches('"').chars().take(16).collect();
        let base = path.file_name().unwrap().to_str().unwrap();
        let part = path.with_file_name(format!(".{base}.{etag}.part"));
        let record = path.with_file_name(format!(".{base}.{etag}.part.sha256"));
        let sound = format!("1000 {}\n", sha256(&content[..1000]));
        let [zeros, longer] = [vec![0; 1000], [&content[..], b"xx"].concat()];
        for (beginning, text) in [
            (&content[..1000], Some(sound.clone())),
            (&zeros[..], Some(sound.clone())),
            (&zeros[..], None),
            (&content[..500], Some(sound)),
            (&longer[..], Some(format!("{} {}\n", longer.len(), sha256(&longer)))),
            (&longer[..], Some("12".to_owned())),
        ] {
            std::fs::write(&part, beginning).unwrap();
            if let Some(text) = text {
                std::fs::write(&record, text).unwrap();
            }
            let output = fetch(&first).await;
            let text = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(std::fs::read(&path).unwrap() == content, "{name}: {text}");
            assert!(!part.exists() && !record.exists(), "{name}");
            std::fs::remove_file(&path).unwrap();
        }
    }
}

/// Partial files.
fn parts(folder: &Path) -> Vec<std::path::PathBuf> {
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            paths.extend(parts(&path));
        } else if path.extension().is_some_and(|ending| ending == "part") {
            paths.push(path);
        }
    }
    paths
}

#[tokio::test]
async fn rejections_name_the_reason_and_the_place() {
    let app = TestApp::start().await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let lab = Lab::new(format!("http://{}", app.address()), &token);
    lab.write("masks.npy", &Scene::SMALL.masks());
    lab.write("shots.npy", &Scene::SMALL.snapshots());
    lab.write("small.npy", &constant(&[1, 8, 8], 0.5));
    lab.write("empty.npy", b"");
    let masks = ["--masks", "masks.npy", "--algorithm", "gap-tv"];
    for (line, words) in [
        (vec!["submit", "shots.npy"], "--calibration"),
        (vec!["submit", "nothing.npy"], "nothing.npy"),
        (vec!["submit", "empty.npy"], "is empty"),
        (vec!["submit", "small.npy"], "size_mismatch"),
        (vec!["submit", "shots.npy", "--snapshots", "7"], "/snapshots"),
        (vec!["submit", "shots.npy", "--url", "ftp://here"], "http://"),
        (vec!["submit", "shots.npy", "--token", "wrong"], "unauthorized"),
    ] {
        let arguments =
            if words == "--calibration" { line.clone() } else { [&line[..], &masks].concat() };
        let output = lab.run(&arguments).await;
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && text.contains(words), "{line:?}: {text}");
    }
    let submit = ["submit", "shots.npy", "--masks", "masks.npy", "--algorithm", "gap-tv"];
    let job = lab.text(&submit).await;
    let refused = lab.refused(1, &["fetch", &job]).await;
    assert!(refused.contains("has no results"), "{refused}");
    assert_eq!(lab.text(&["cancel", &job]).await, format!("{job} cancelled"));
    let refused = lab.refused(1, &["watch", &job]).await;
    assert!(refused.contains("is cancelled"), "{refused}");
    let nothing = "00000000-0000-7000-8000-000000000000";
    let refused = lab.refused(2, &["watch", nothing]).await;
    assert!(refused.contains("not_found"), "{refused}");

    // A configuration file contains the address of the service.
    lab.write("lab.toml", format!("url = {:?}\ntoken = {token:?}\n", lab.url).as_bytes());
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    command.args(["--config", "lab.toml", "ls"]).current_dir(lab.folder.path());
    let output = command.env_remove("SCI_RECON_URL").output().await.unwrap();
    assert!(String::from_utf8_lossy(&output.stdout).contains(&job), "{output:?}");
}

/// Starts a server with a self-signed certificate that answers every request with 404. Returns its address, and the
/// certificate as PEM.
fn tls_server() -> (String, String) {
    let names = vec!["localhost".to_owned(), "127.0.0.1".to_owned()];
    let certified = rcgen::generate_simple_self_signed(names).unwrap();
    let key =
        rustls::pki_types::PrivateKeyDer::try_from(certified.signing_key.serialize_der()).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![certified.cert.der().clone()], key)
        .unwrap();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("https://{}", listener.local_addr().unwrap());
    let config = Arc::new(config);
    std::thread::spawn(move || {
        for mut socket in listener.incoming().flatten() {
            let mut session = rustls::ServerConnection::new(config.clone()).unwrap();
            let mut stream = rustls::Stream::new(&mut session, &mut socket);
            // A client that does not trust the certificate ends the connection.
            if matches!(stream.read(&mut [0; 4096]), Ok(1..)) {
                let answer =
                    "HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";
                stream.write_all(answer.as_bytes()).unwrap();
            }
        }
    });
    (url, certified.cert.pem())
}

/// Starts a server that answers every request with a redirection. Returns its address.
fn redirecting_server(place: &'static str) -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for mut socket in listener.incoming().flatten() {
            let _ = socket.read(&mut [0; 4096]);
            let answer = format!(
                "HTTP/1.1 308 Permanent Redirect\r\nLocation: {place}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
            );
            socket.write_all(answer.as_bytes()).unwrap();
        }
    });
    url
}

#[tokio::test]
async fn permanent_failures_end_a_command_at_once_and_others_are_retried() {
    let (url, certificate) = tls_server();
    let lab = Lab::new(url.clone(), "token");
    lab.write("authority.pem", certificate.as_bytes());
    let app = TestApp::start().await;
    let start = Instant::now();
    for (url, words) in [
        (url.as_str(), "SSL_CERT_FILE"),
        (&format!("https://{}", app.address()), "http:// instead of https://"),
        // The host name is too long for the resolver, so that none is needed.
        (&format!("http://{}.lab", "b".repeat(70)), "correct the host name"),
    ] {
        let refused = lab.refused(2, &["ls", "--url", url]).await;
        assert!(refused.contains(words) && refused.contains(url), "{refused}");
    }
    assert!(start.elapsed() < Duration::from_secs(20), "{:?}", start.elapsed());
    // The client accepts the service with the certificate of its authority.
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    command.args(["ls", "--url", &url]).env("SSL_CERT_FILE", lab.path("authority.pem"));
    let output = command.output().await.unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("404"), "{output:?}");
    // A variable that names no certificate is refused by its name, even if the folder of certificates is good.
    lab.write("text.pem", b"no certificate");
    let folder = lab.path("authorities");
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(folder.join("8d33f237.0"), certificate.as_bytes()).unwrap();
    for (name, why) in [("lost.pem", "can't be read"), ("text.pem", "no certificate in PEM form")] {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["ls", "--url", &url]).env("SSL_CERT_DIR", &folder);
        let output = command.env("SSL_CERT_FILE", lab.path(name)).output().await.unwrap();
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{text}");
        let named = text.contains("SSL_CERT_FILE names") && text.contains(name);
        assert!(named && text.contains(why), "{text}");
    }
    // A redirection to another place would lose the token.
    let moved = redirecting_server("https://lab.example/sci/v1/jobs");
    let refused = lab.refused(2, &["ls", "--url", &moved]).await;
    assert!(refused.contains("redirects to https://lab.example/sci"), "{refused}");
    assert!(refused.contains("--url"), "{refused}");
    // A service that is down may come back.
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    command.args(["ls", "--url", &format!("http://127.0.0.1:{port}")]);
    let mut child =
        command.stderr(std::process::Stdio::piped()).kill_on_drop(true).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let line = tokio::time::timeout(Duration::from_secs(10), lines.next_line()).await;
    let line = line.expect("the first failure is announced").unwrap().unwrap();
    assert!(line.contains("refused") && line.contains("trying again"), "{line}");
    assert!(child.try_wait().unwrap().is_none(), "the command tries again");
}

/// A scene that is large enough for the checks.
const SCENE: Scene = Scene { frames: 4, height: 128, width: 128, snapshots: 1 };

/// Submits masks as snapshots, as a mistake of a user.
#[tokio::test]
async fn findings_are_printed_by_every_command_with_their_remedies() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new(format!("http://{}", app.address()), "");
    lab.write("masks.npy", &SCENE.masks());
    lab.write("oops.npy", &SCENE.masks());
    let masks = ["--masks", "masks.npy", "--algorithm", "gap-tv"];
    let submitted = lab.run(&[&["submit", "oops.npy"][..], &masks].concat()).await;
    let stderr = String::from_utf8(submitted.stderr).unwrap();
    assert_eq!(submitted.status.code(), Some(3), "{stderr}");
    let errors = stderr.lines().filter(|line| line.starts_with("error ")).count();
    assert!(errors > 0 && stderr.matches("Remedy: ").count() >= errors, "{stderr}");
    assert!(stderr.contains("the checks found"), "{stderr}");
    assert!(!stderr.contains("`axes`") && !stderr.contains("`full_scale`"), "{stderr}");
    let job = String::from_utf8(submitted.stdout).unwrap().trim().to_owned();

    let watched = lab.run(&["watch", &job]).await;
    let text = String::from_utf8(watched.stdout).unwrap();
    assert_eq!(watched.status.code(), Some(3), "{text}");
    assert!(text.starts_with(&format!("{job}: bad")), "the verdict leads: {text}");
    assert!(text.lines().skip(1).any(|line| line.starts_with("    error ")), "{text}");
    let fetched = lab.run(&["fetch", &job, "--out", "out", "--file", "frames.npy"]).await;
    assert_eq!(fetched.status.code(), Some(3));
    assert!(String::from_utf8(fetched.stderr).unwrap().contains("    error "));
    assert!(lab.path("out/snapshot_0000/frames.npy").exists());
    let listed = lab.text(&["ls"]).await;
    assert!(listed.contains("  bad") && listed.contains("\n    error "), "{listed}");
    assert!(listed.contains("  finished") && !listed.contains("succeeded"), "{listed}");

    std::fs::create_dir(lab.path("bench")).unwrap();
    lab.write("bench/oops.npy", &SCENE.masks());
    let watch = ["watch-folder", "bench", "--once", "--settle-seconds", "0.1"];
    let exec = "echo \"$JOB_STATE $JOB_FILE $JOB_RESULTS\" >> ended";
    let options = ["--file", "manifest.json", "--exec", exec];
    let watched = lab.run(&[&watch[..], &masks, &options].concat()).await;
    let text = String::from_utf8(watched.stdout).unwrap();
    assert_eq!(watched.status.code(), Some(3), "{text}");
    assert!(
        text.contains("    error ") && text.contains("oops.npy is in oops.npy.result"),
        "{text}"
    );
    let ended = std::fs::read_to_string(lab.path("ended")).unwrap();
    assert!(
        ended.starts_with("succeeded /") && ended.ends_with("bench/oops.npy.result\n"),
        "{ended}"
    );
    let report = std::fs::read_to_string(lab.path("bench/oops.npy.result/REPORT.txt")).unwrap();
    assert!(report.starts_with("oops.npy: bad") && report.contains("\nerror "), "{report}");
    assert!(report.contains("Remedy: "), "{report}");

    // The offline command has the same findings.
    let watched = lab.run(&["watch", &job, "--json"]).await;
    let online: Value = serde_json::from_slice(&watched.stdout).unwrap();
    let line = ["reconstruct", "--masks", "masks.npy", "--measurement", "oops.npy"];
    let more = ["--snapshots", "all", "--algorithm", "gap-tv", "--json"];
    let offline = lab.run(&[&line[..], &more].concat()).await;
    assert_eq!(offline.status.code(), Some(3), "{}", String::from_utf8_lossy(&offline.stderr));
    let offline: Value = serde_json::from_slice(&offline.stdout).unwrap();
    assert!(!online["findings"].as_array().unwrap().is_empty(), "{online}");
    assert_eq!(offline["findings"], online["findings"]);
}

#[tokio::test]
async fn a_dark_is_subtracted_by_submit_and_without_a_server() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new("http://127.0.0.1:1".to_owned(), "");
    lab.write("masks.npy", &SCENE.masks());
    let pixels = SCENE.height * SCENE.width;
    let bytes = SCENE.snapshots();
    let values = bytes[bytes.len() - 4 * pixels..].chunks_exact(4);
    let values = values.map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap()) + 0.4);
    lab.write("shots.npy", &crate::samples::npy(&[SCENE.height, SCENE.width], values));
    for name in ["dark_1.npy", "dark_2.npy"] {
        let level = if name == "dark_1.npy" { 0.3 } else { 0.5 };
        lab.write(name, &constant(&[SCENE.height, SCENE.width], level));
    }
    let url = format!("http://{}", app.address());
    let submit = ["--url", &url, "submit", "shots.npy", "--masks", "masks.npy"];
    let submit = [&submit[..], &["--algorithm", "gap-tv", "--name", "drop"]].concat();
    let dark = ["--dark", "dark_1.npy", "--dark", "dark_2.npy", "--saturation", "3"];
    let reconstruct = ["reconstruct", "--masks", "masks.npy", "--measurement", "shots.npy"];
    let reconstruct = [&reconstruct[..], &["--algorithm", "gap-tv", "--json"]].concat();
    for (more, is_dark) in [(&[][..], false), (&dark[..], true)] {
        let output = lab.run(&[&submit[..], more].concat()).await;
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(stderr.contains("no_dark"), !is_dark, "{stderr}");
        let job = String::from_utf8(output.stdout).unwrap().trim().to_owned();
        let job = app.get(&format!("/v1/jobs/{job}")).await.expect(200).json();
        let path = format!("/v1/measurements/{}", job["measurement"].as_str().unwrap());
        let measurement = app.get(&path).await.expect(200).json();
        assert_eq!(measurement["name"], "drop");
        assert_eq!(measurement["dark"].as_array().unwrap().len(), if is_dark { 2 } else { 0 });
        let output = lab.run(&[&reconstruct[..], more].concat()).await;
        let stdout = String::from_utf8_lossy(&output.stdout);
        assert_eq!(stdout.contains("no_dark"), !is_dark, "{stdout}");
    }
}

/// Repeats a job from its manifest, where its inputs are, and on another service from the files.
#[tokio::test]
async fn a_manifest_repeats_a_job_and_names_what_is_missing() {
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new(format!("http://{}", app.address()), "");
    let scene = Scene::SMALL;
    lab.write("masks.npy", &scene.masks());
    lab.write("shots.npy", &scene.snapshots());
    lab.write("dark.npy", &constant(&[scene.height, scene.width], 0.01));
    // The checks may find errors in the small scene, which gives status 3.
    let done = async |lab: &Lab, line: &[&str]| {
        let output = lab.run(line).await;
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!([Some(0), Some(3)].contains(&output.status.code()), "{line:?}: {errors}");
        (String::from_utf8(output.stdout).unwrap().trim().to_owned(), errors)
    };
    let inputs = ["shots.npy", "--masks", "masks.npy", "--dark", "dark.npy"];
    let settings = ["--algorithm", "gap-tv", "--snapshots", "1", "--label", "first"];
    let submit = [&["submit"], &inputs[..], &settings].concat();
    let (first, _) = done(&lab, &submit).await;
    done(&lab, &["watch", &first]).await;
    done(&lab, &["fetch", &first, "--out", "out"]).await;

    let manifest = lab.path("out/manifest.json");
    let manifest = manifest.to_str().unwrap();
    let (again, _) = done(&lab, &["submit", "--manifest", manifest]).await;
    assert_ne!(again, first);
    let (watched, _) = done(&lab, &["watch", &again, "--manifest", manifest]).await;
    assert!(watched.contains("equal to the manifest"), "{watched}");
    let fetch = ["fetch", &again, "--out", "again", "--manifest", manifest];
    let (_, fetched) = done(&lab, &fetch).await;
    assert!(fetched.contains("equal to the manifest"), "{fetched}");
    let content = |folder: &str| {
        let text = std::fs::read(lab.path(folder).join("manifest.json")).unwrap();
        serde_json::from_slice::<Value>(&text).unwrap()["content"].take()
    };
    assert_eq!(content("out"), content("again"));

    let other =
        [&submit[..], &["--registration", "off", "--tile", "32", "--overlap", "8"]].concat();
    let (other, _) = done(&lab, &other).await;
    let different = lab.refused(1, &["watch", &other, "--manifest", manifest]).await;
    assert!(different.contains("different from the manifest"), "{different}");
    assert!(different.contains("request.tile.size is 32"), "{different}");

    // A manifest that names another measurement, and a webhook, repeats the inputs that it has hashes of.
    let inputs = ["dark.npy", "--masks", "masks.npy", "--algorithm", "gap-tv"];
    let (another, _) = done(&lab, &[&["submit"], &inputs[..]].concat()).await;
    let another = app.get(&format!("/v1/jobs/{another}")).await.expect(200).json();
    let mut forged: Value = serde_json::from_slice(&std::fs::read(manifest).unwrap()).unwrap();
    forged["run"]["measurement"] = another["measurement"].clone();
    forged["content"]["request"]["webhook"] = json!("https://lab.example/hook");
    lab.write("forged.json", forged.to_string().as_bytes());
    let (again, _) = done(&lab, &["submit", "--manifest", "forged.json"]).await;
    let job = app.get(&format!("/v1/jobs/{again}")).await.expect(200).json();
    assert_ne!(job["measurement"], another["measurement"]);
    assert_eq!(job["webhook"], Value::Null);
    forged["run"]["measurement"] = json!("../jobs");
    lab.write("forged.json", forged.to_string().as_bytes());
    let refused = lab.refused(2, &["submit", "--manifest", "forged.json"]).await;
    assert!(refused.contains("a damaged manifest"), "{refused}");

    // Another service has none of the inputs.
    let app = TestApp::with(&["--workers", "1"]).await;
    let far = Lab::new(format!("http://{}", app.address()), "");
    let repeat = ["submit", "--manifest", manifest];
    let missing = far.refused(2, &repeat).await;
    for role in ["masks with", "measurement with", "dark of the measurement with"] {
        assert!(missing.contains(role), "{role}: {missing}");
    }
    let [masks, shots, dark] =
        ["masks.npy", "shots.npy", "dark.npy"].map(|name| lab.path(name).display().to_string());
    let missing = far.refused(2, &[&repeat[..], &[&shots, &masks]].concat()).await;
    assert!(missing.contains("dark of") && !missing.contains("masks with"), "{missing}");
    let foreign = far.refused(2, &[&repeat[..], &[manifest]].concat()).await;
    assert!(foreign.contains("is no input of the manifest"), "{foreign}");
    far.refused(2, &[&repeat[..], &["--masks", &masks]].concat()).await;
    let line = [&repeat[..], &[&dark, &shots, &masks, "--priority", "-3", "--json"]].concat();
    let (repeated, _) = done(&far, &line).await;
    let repeated: Value = serde_json::from_str(&repeated).unwrap();
    assert_eq!((&repeated["label"], &repeated["priority"]), (&json!("first"), &json!(-3)));
    let watch = ["watch", repeated["id"].as_str().unwrap(), "--manifest", manifest];
    let (watched, _) = done(&far, &watch).await;
    assert!(watched.contains("equal to the manifest"), "{watched}");
}

/// Reads arrays with unusual names from files of other programs.
#[tokio::test]
async fn arrays_can_have_any_name() {
    let app = TestApp::start().await;
    let lab = Lab::new(format!("http://{}", app.address()), "");
    for file in ["names.h5", "names.mat"] {
        let bytes = std::fs::read(format!("tests/data/formats/{file}")).unwrap();
        lab.write(file, &bytes);
    }
    let masks =
        ["--masks", "names.h5", "--masks-array", "calibrated/masks", "--algorithm", "gap-tv"];
    let scale = ["--full-scale", "65535", "--masks-full-scale", "1"];
    for file in ["names.h5", "names.mat"] {
        let line = [&["submit", file, "--array", "shots"][..], &masks, &scale].concat();
        lab.text(&line).await;
        let line = [&["submit", file, "--array", "nothing"][..], &masks, &scale].concat();
        let refused = lab.refused(2, &line).await;
        assert!(refused.contains("/array") && refused.contains("'shots' ("), "{refused}");
    }
    lab.write("plain.npy", &Scene::SMALL.snapshots());
    let line = [&["submit", "plain.npy", "--array", "shots"][..], &masks, &scale].concat();
    let refused = lab.refused(2, &line).await;
    assert!(refused.contains("omit `--array`"), "{refused}");
}

/// Adds 50 files, two of them equal, while the watcher is killed repeatedly.
#[tokio::test]
async fn a_watched_folder_submits_each_file_once_despite_kills() {
    let app = TestApp::with(&["--workers", "2"]).await;
    let token = app.token(&["create", "--lab", "a"]);
    app.sign_in(&token);
    let lab = Lab::new(format!("http://{}", app.address()), &token);
    let scene = Scene { frames: 2, height: 24, width: 32, snapshots: 1 };
    lab.write("masks.npy", &scene.masks());
    let schedule = json!({"stages": [{"prior": "tv", "iterations": 2, "tv_weight": 0.1}]});
    lab.write("schedule.json", schedule.to_string().as_bytes());
    let bench = lab.path("bench");
    std::fs::create_dir(&bench).unwrap();
    let start = |once: bool| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        command.args(["watch-folder", "bench", "--masks", "masks.npy", "--algorithm", "gap-tv"]);
        command.args(["--schedule", "schedule.json", "--settle-seconds", "0.1"]);
        command.args(["--file", "frames.npy"]).args(once.then_some("--once"));
        command.current_dir(lab.folder.path()).stdout(std::process::Stdio::null());
        command.env("SCI_RECON_URL", &lab.url).env("SCI_RECON_TOKEN", &lab.token);
        command.kill_on_drop(true).spawn().unwrap()
    };
    let plain = scene.snapshots();
    let shot = |number: usize| {
        // Files 0 and 1 are equal.
        let mut bytes = plain.clone();
        let last = bytes.len() - 4;
        bytes[last..].copy_from_slice(&(number.max(1) as f32 * 1e-3).to_le_bytes());
        bytes
    };
    for kill in 0..10 {
        let mut watcher = start(false);
        for number in kill * 5..kill * 5 + 5 {
            // Camera software writes a file in pieces under its final name.
            let (path, bytes) = (bench.join(format!("shot_{number:02}.npy")), shot(number));
            std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
            std::fs::write(&path, &bytes).unwrap();
        }
        tokio::time::sleep(std::time::Duration::from_millis(150 + 40 * kill as u64)).await;
        watcher.kill().await.unwrap();
    }
    // Files that are not regular or contain no snapshots are not submitted.
    std::os::unix::fs::symlink(lab.path("masks.npy"), bench.join("link.npy")).unwrap();
    std::fs::create_dir(bench.join("folder.npy")).unwrap();
    std::fs::write(bench.join("notes.txt"), "mine").unwrap();
    // One result name is taken, and one file is invalid.
    std::fs::write(bench.join("taken.npy"), shot(99)).unwrap();
    std::fs::write(bench.join("taken.npy.result"), "mine").unwrap();
    std::fs::write(bench.join("bad.npy"), "no array").unwrap();
    assert_eq!(start(true).wait().await.unwrap().code(), Some(1), "bad.npy has failed");

    let mut jobs = Vec::new();
    let mut cursor = String::new();
    loop {
        let page = app.get(&format!("/v1/jobs?limit=200{cursor}")).await.expect(200).json();
        jobs.extend(page["items"].as_array().unwrap().clone());
        match page["next_cursor"].as_str() {
            Some(next) => cursor = format!("&cursor={next}"),
            None => break,
        }
    }
    let mut labels: Vec<_> = jobs.iter().map(|job| job["label"].as_str().unwrap()).collect();
    labels.sort_unstable();
    let mut expected: Vec<_> = (0..50).map(|number| format!("shot_{number:02}.npy")).collect();
    expected.push("taken.npy".into());
    assert_eq!(labels, expected);
    for label in &expected[..50] {
        let report = bench.join(format!("{label}.result/REPORT.txt"));
        assert!(std::fs::read_to_string(report).unwrap().starts_with(label.as_str()));
        let result = bench.join(format!("{label}.result/snapshot_0000/frames.npy"));
        let job = jobs.iter().find(|job| job["label"] == label.as_str()).unwrap();
        let path = format!("/v1/jobs/{}/snapshots/0/exports/npy", job["id"].as_str().unwrap());
        assert!(std::fs::read(&result).unwrap() == app.get(&path).await.expect(200).bytes);
    }
    assert!(parts(&bench).is_empty());
    assert_eq!(std::fs::read(bench.join("taken.npy.result")).unwrap(), b"mine");
    assert!(bench.join("taken.npy.2.result/snapshot_0000/frames.npy").exists());
    let reason = std::fs::read_to_string(bench.join("bad.npy.failed.txt")).unwrap();
    assert!(reason.contains("invalid_content") && reason.contains("bad.npy"), "{reason}");
    assert!(!bench.join("link.npy.result").exists() && !bench.join("link.npy.failed.txt").exists());
    std::fs::remove_file(bench.join("link.npy")).unwrap();
    // A restart has nothing to do; a changed file is a new one.
    assert!(start(true).wait().await.unwrap().success());
    std::fs::write(bench.join("bad.npy"), shot(7)).unwrap();
    // One pixel in four is closed in both masks: an error of the calibration.
    assert_eq!(start(true).wait().await.unwrap().code(), Some(3));
    assert!(bench.join("bad.npy.2.result/snapshot_0000/frames.npy").exists());
    let all = app.get("/v1/jobs?limit=200").await.expect(200).json();
    assert_eq!(all["items"].as_array().unwrap().len(), 52);
}

#[cfg(unix)]
#[tokio::test]
async fn a_watched_folder_reports_files_that_it_skips() {
    use std::os::unix::ffi::OsStringExt;
    let app = TestApp::with(&["--workers", "1"]).await;
    let lab = Lab::new(format!("http://{}", app.address()), "");
    lab.write("masks.npy", &SCENE.masks());
    std::fs::create_dir(lab.path("bench")).unwrap();
    lab.write("bench/empty.npy", b"");
    std::os::unix::fs::symlink(lab.path("masks.npy"), lab.path("bench/link.npy")).unwrap();
    let unreadable = std::ffi::OsString::from_vec(b"bench/\xff.npy".to_vec());
    std::fs::write(lab.folder.path().join(unreadable), SCENE.snapshots()).unwrap();
    lab.write("bench/notes.txt", b"");
    lab.write("bench/a\u{1b}[2Jb.npy", &SCENE.snapshots());
    let long = format!("{}.npy", "x".repeat(230));
    lab.write(&format!("bench/{long}"), &SCENE.snapshots());
    let watch = ["watch-folder", "bench", "--once", "--settle-seconds", "0.1"];
    let watched = lab.run(&[&watch[..], &["--masks", "masks.npy"]].concat()).await;
    let text = String::from_utf8(watched.stdout).unwrap();
    assert_eq!(watched.status.code(), Some(1), "{text}");
    for expected in [
        "empty.npy is skipped: the file is empty",
        "link.npy is skipped: it is a symbolic link",
        "is not UTF-8",
        "a\u{fffd}[2Jb.npy is skipped: the name has control characters",
        "x.npy is skipped: the name has more than 230 bytes",
    ] {
        assert_eq!(text.matches(expected).count(), 1, "{text}");
    }
    assert!(!text.contains("notes.txt"), "{text}");
    let errors = String::from_utf8(watched.stderr).unwrap();
    assert!(errors.contains("5 files were skipped"), "{errors}");

    // Archives are submitted. Bytes without a header are, too, if their packing is stated.
    std::fs::create_dir(lab.path("kinds")).unwrap();
    let kinds = ["npz", "zip", "tar", "raw"];
    kinds.iter().for_each(|ending| lab.write(&format!("kinds/drop.{ending}"), b"no snapshot"));
    let watch = ["watch-folder", "kinds", "--once", "--settle-seconds", "0.1"];
    let refused =
        || kinds.map(|ending| lab.path(&format!("kinds/drop.{ending}.failed.txt")).exists());
    let masks = ["--masks", "masks.npy"];
    assert_eq!(lab.run(&[&watch[..], &masks].concat()).await.status.code(), Some(1));
    assert_eq!(refused(), [true, true, true, false]);
    let packed = [&watch[..], &masks, &["--packing", "mono12p"]].concat();
    assert_eq!(lab.run(&packed).await.status.code(), Some(1));
    assert_eq!(refused(), [true; 4]);
}

#[tokio::test]
async fn mistakes_on_the_command_line_are_named() {
    let lab = Lab::new("http://127.0.0.1:1".to_owned(), "");
    lab.write("table.toml", b"serve = 1");
    lab.write("value.toml", b"[serve]\nlog-format = \"xml\"");
    lab.write("flag.toml", b"[serve]\nunconfined = 2");
    let made = std::process::Command::new("mkfifo").arg(lab.path("pipe.npy")).status().unwrap();
    assert!(made.success());
    let cases: [(&[&str], &str); 6] = [
        (&["--config", "table.toml", "config", "show", "serve"], "a line [serve]"),
        (&["--config", "value.toml", "config", "show", "serve"], "value.toml"),
        (&["--config", "flag.toml", "config", "show", "serve"], "true or false"),
        (&["serve", "--data", "d", "--max-uploads", "0"], "--max-uploads"),
        (&["simulate", "--dispersion-offsets", "0:1:1000000"], "from 1 to 64"),
        // Opening a pipe would wait for its writer.
        (
            &["reconstruct", "--masks", "pipe.npy", "--measurement", "pipe.npy", "--out", "o"],
            "not a regular file",
        ),
    ];
    for (line, expected) in cases {
        let text = lab.refused(2, line).await;
        assert!(text.contains(expected), "{line:?}: {text}");
    }
}
