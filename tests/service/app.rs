//! The service under test.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc;
use std::time::Duration;

use reqwest::header::{CONTENT_LOCATION, LOCATION};
use reqwest::{Client, Method, RequestBuilder, Response, StatusCode};
use serde_json::{Value, json};
use tempfile::TempDir;

use crate::{contract, samples};

/// A running service, which is killed when this is dropped.
pub struct TestApp {
    _folder: TempDir,
    data: std::path::PathBuf,
    process: Child,
    url: String,
    client: Client,
    arguments: Vec<String>,
    token: std::sync::RwLock<Option<String>>,
}

/// An answer whose body has been read.
#[derive(Debug)]
pub struct Answer {
    pub status: StatusCode,
    pub headers: reqwest::header::HeaderMap,
    pub bytes: Vec<u8>,
}

impl Answer {
    pub async fn read(response: Response) -> Self {
        let (status, mut headers) = (response.status(), response.headers().clone());
        // References are relative, and resolved as clients do.
        for name in [LOCATION, CONTENT_LOCATION] {
            let Some(place) = headers.get(&name) else { continue };
            assert!(!place.as_bytes().starts_with(b"/"), "{place:?} ignores the prefix of a proxy");
            let place = response.url().join(place.to_str().unwrap()).unwrap();
            headers.insert(name, place.path().parse().unwrap());
        }
        Self { status, headers, bytes: response.bytes().await.unwrap().to_vec() }
    }

    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.bytes)
            .unwrap_or_else(|_| panic!("no JSON: {}", String::from_utf8_lossy(&self.bytes)))
    }

    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", |value| value.to_str().unwrap())
    }

    /// Checks that this is a complete problem with this status and code, and returns its detail.
    #[track_caller]
    pub fn problem(&self, status: u16, code: &str) -> String {
        let text = String::from_utf8_lossy(&self.bytes).into_owned();
        assert_eq!(self.status.as_u16(), status, "{text}");
        assert_eq!(self.header("content-type"), "application/problem+json", "{text}");
        assert!(!self.header("x-request-id").is_empty());
        let problem = self.json();
        assert_eq!(problem["code"], code, "{text}");
        assert_eq!(problem["status"], status);
        assert_eq!(problem["type"], format!("urn:sci-recon:problem:{code}"));
        let page = format!("{code}>; rel=\"help\"");
        assert!(self.header("link").ends_with(&page), "{:?}", self.headers);
        let request = self.header("x-request-id");
        assert_eq!(problem["instance"], format!("urn:sci-recon:request:{request}"));
        assert!(problem["title"].is_string() && problem["retryable"].is_boolean());
        problem["detail"].as_str().unwrap().to_owned()
    }

    #[track_caller]
    pub fn expect(self, status: u16) -> Self {
        let text = String::from_utf8_lossy(&self.bytes);
        assert_eq!(self.status.as_u16(), status, "{text}");
        self
    }
}

impl TestApp {
    /// Starts a service without workers, so that jobs stay in the queue.
    pub async fn start() -> Self {
        Self::with(&["--workers", "0"]).await
    }

    /// Starts a service that writes its log from this level on to this file.
    pub async fn logging(log: &Path, level: &str, arguments: &[&str]) -> Self {
        let log = std::fs::File::create(log).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let environment = [("RUST_LOG", level)];
        let spawned = spawn(folder.path(), &owned(arguments), &environment, log.into());
        Self::from_process(folder, "", arguments, spawned.expect("the server starts"))
    }

    /// Starts a service without workers that may open this many files.
    pub async fn with_few_files(files: u32, arguments: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut limited = Command::new("sh");
        let script = format!("ulimit -n {files} && exec \"$0\" \"$@\"");
        limited.arg("-c").arg(script).arg(env!("CARGO_BIN_EXE_sci-recon"));
        let arguments = [&["--workers", "0"], arguments].concat();
        let spawned = spawn_as(limited, folder.path(), &owned(&arguments), &[], Stdio::inherit());
        Self::from_process(folder, "", &arguments, spawned.expect("the server starts"))
    }

    pub async fn with(arguments: &[&str]) -> Self {
        Self::in_environment(arguments, &[]).await
    }

    /// Starts the service with these environment variables; a restart is without them.
    pub async fn in_environment(arguments: &[&str], environment: &[(&str, &str)]) -> Self {
        Self::try_in_environment(arguments, environment).await.expect("the server starts")
    }

    /// Starts the service. Returns `None` if it does not start.
    pub async fn try_in_environment(
        arguments: &[&str],
        environment: &[(&str, &str)],
    ) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let spawned = spawn(folder.path(), &owned(arguments), environment, Stdio::inherit())?;
        Some(Self::from_process(folder, "", arguments, spawned))
    }

    /// Starts the service on existing data in a subfolder.
    pub async fn on(folder: TempDir, subfolder: &str, arguments: &[&str]) -> Self {
        let data = folder.path().join(subfolder);
        let spawned = spawn(&data, &owned(arguments), &[], Stdio::inherit());
        Self::from_process(folder, subfolder, arguments, spawned.expect("the server starts"))
    }

    fn from_process(
        folder: TempDir,
        subfolder: &str,
        arguments: &[&str],
        (process, url): (Child, String),
    ) -> Self {
        let data = folder.path().join(subfolder);
        let (arguments, token) = (owned(arguments), std::sync::RwLock::default());
        // A server that stops answering fails the test.
        let client =
            sci_recon::http_client().unwrap().read_timeout(LONGEST_SILENCE).build().unwrap();
        Self { _folder: folder, data, process, url, client, arguments, token }
    }

    /// Restarts the service on the same data with other arguments.
    pub async fn again(mut self, arguments: &[&str]) -> Self {
        self.arguments = owned(arguments);
        self.restart();
        self
    }

    /// True if the server's process is running.
    pub fn is_running(&mut self) -> bool {
        self.process.try_wait().unwrap().is_none()
    }

    /// Kills the server, as a power cut would, and starts it on the same folder with other
    /// arguments.
    pub fn restart_with(&mut self, arguments: &[&str]) {
        self.arguments = arguments.iter().map(|&text| text.to_owned()).collect();
        self.restart();
    }

    /// Kills the server, as a power cut would, and starts it on the same folder.
    pub fn restart(&mut self) {
        self.kill();
        let spawned = spawn(&self.data, &self.arguments, &[], Stdio::inherit());
        (self.process, self.url) = spawned.expect("the server starts");
    }

    /// Restarts the server; false if it does not start.
    pub fn try_restart(&mut self) -> bool {
        self.kill();
        let spawned = spawn(&self.data, &self.arguments, &[], Stdio::inherit());
        let starts = spawned.is_some();
        if let Some(spawned) = spawned {
            (self.process, self.url) = spawned;
        }
        starts
    }

    /// Sends SIGKILL.
    pub fn kill(&mut self) {
        // The process may have ended already.
        let _ = self.process.kill();
        self.process.wait().unwrap();
    }

    /// Sends SIGTERM and returns the exit status.
    pub fn stop(&mut self) -> std::process::ExitStatus {
        let pid = rustix::process::Pid::from_raw(self.process.id() as i32).unwrap();
        rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
        let _limit = kill_after(self.process.id(), LONGEST_SILENCE);
        self.process.wait().unwrap()
    }

    pub fn data(&self) -> &Path {
        &self.data
    }

    pub fn pid(&self) -> u32 {
        self.process.id()
    }

    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        let request = self.client.request(method, format!("{}{path}", self.url));
        match &*self.token.read().unwrap() {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// From now on, requests carry this token.
    pub fn sign_in(&self, token: &str) {
        *self.token.write().unwrap() = Some(token.to_owned());
    }

    /// From now on, requests carry no token.
    pub fn sign_out(&self) {
        *self.token.write().unwrap() = None;
    }

    /// Output of `sci-recon token` with these arguments.
    pub fn token(&self, arguments: &[&str]) -> String {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        let output = command.args(["token", "--data"]).arg(self.data()).args(arguments).output();
        let output = output.unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// Sends a request, and checks that the contract allows the answer.
    pub async fn send(&self, request: RequestBuilder) -> Answer {
        let (client, request) = request.build_split();
        let request = request.unwrap();
        let (method, path) = (request.method().clone(), request.url().path().to_owned());
        let answer = Answer::read(client.execute(request).await.unwrap()).await;
        contract::check(&method, &path, &answer);
        answer
    }

    pub async fn get(&self, path: &str) -> Answer {
        self.send(self.request(Method::GET, path)).await
    }

    /// Sends a GET that waits at most `seconds` for the end of the work.
    pub async fn wait(&self, path: &str, seconds: &str) -> Answer {
        let request = self.request(Method::GET, path).header("prefer", format!("wait={seconds}"));
        self.send(request).await
    }

    /// Repeats a GET until the answer has this status, for at most a minute.
    pub async fn get_until(&self, path: &str, status: u16) -> Answer {
        let start = std::time::Instant::now();
        loop {
            let answer = self.get(path).await;
            if answer.status.as_u16() == status || start.elapsed().as_secs() >= 60 {
                return answer.expect(status);
            }
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    }

    pub async fn delete(&self, path: &str) -> Answer {
        self.send(self.request(Method::DELETE, path)).await
    }

    pub async fn post(&self, path: &str, body: &Value) -> Answer {
        self.send(self.request(Method::POST, path).json(body)).await
    }

    /// Downloads all files of a snapshot into a folder.
    pub async fn download(&self, job: &str, snapshot: u32) -> TempDir {
        let folder = tempfile::tempdir().unwrap();
        let listed = self.get(&format!("/v1/jobs/{job}/snapshots/{snapshot}")).await.expect(200);
        for file in listed.json()["files"].as_array().unwrap() {
            // Relative to the address of the snapshot.
            let href = format!("/v1/jobs/{job}/snapshots/{}", file["href"].as_str().unwrap());
            let path = folder.path().join(file["name"].as_str().unwrap());
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, self.get(&href).await.expect(200).bytes).unwrap();
        }
        folder
    }

    /// Uploads a file and returns its hash.
    pub async fn upload(&self, bytes: Vec<u8>) -> String {
        let answer = self.send(self.request(Method::POST, "/v1/blobs").body(bytes)).await;
        assert!(answer.status.is_success(), "{answer:?}");
        answer.json()["sha256"].as_str().unwrap().to_owned()
    }

    /// Uploads masks and creates a calibration.
    pub async fn calibrate(&self, masks: Vec<u8>) -> Answer {
        let masks = self.upload(masks).await;
        self.post("/v1/calibrations", &json!({ "masks": masks })).await
    }

    /// Uploads snapshots and creates a measurement.
    pub async fn measure(&self, calibration: &str, data: Vec<u8>) -> Answer {
        let data = self.upload(data).await;
        let body = json!({ "calibration": calibration, "data": data });
        self.post("/v1/measurements", &body).await
    }

    /// Creates a calibration and a measurement of a moving square; returns both identifiers.
    pub async fn scene(&self, scene: &samples::Scene) -> (String, String) {
        let calibration = id(&self.calibrate(scene.masks()).await.expect(201));
        let measurement = id(&self.measure(&calibration, scene.snapshots()).await.expect(201));
        (calibration, measurement)
    }
}

/// Path of a Python with the packages of tests/judges/requirements.txt. Calls [`skip`] if there is none.
#[track_caller]
pub fn judges() -> Option<String> {
    python("SCI_RECON_JUDGES", "tests/judges/requirements.txt")
}

/// Path of a Python with the packages of research/training/requirements.txt. Calls [`skip`] if there is none.
#[track_caller]
pub fn training() -> Option<String> {
    python("SCI_RECON_TRAINING", "research/training/requirements.txt")
}

#[track_caller]
fn python(variable: &str, requirements: &str) -> Option<String> {
    let python = std::env::var(variable).ok();
    if python.is_none() {
        skip(&format!("{variable} names no Python with {requirements}: run `make test`"));
    }
    python
}

/// True if libonnxruntime is available; otherwise calls [`skip`].
#[track_caller]
pub fn has_onnxruntime() -> bool {
    let library = std::env::var("ORT_DYLIB_PATH").unwrap_or_default();
    let exists = Path::new(&library).exists();
    if !exists {
        skip(&format!("ORT_DYLIB_PATH names no libonnxruntime ({library:?}): run `make runtime`"));
    }
    exists
}

/// True if these programs are installed; otherwise calls [`skip`]. `packages` are those of Debian.
#[track_caller]
pub fn has_programs(programs: &[&str], packages: &str) -> bool {
    let missing =
        programs.iter().find(|name| Command::new(name).arg("--version").output().is_err());
    if let Some(program) = missing {
        skip(&format!("{program} is not installed: run `apt-get install {packages}`"));
    }
    missing.is_none()
}

/// Reports that a test, or a part of it, is skipped because something is not installed. With `CI=true` in
/// the environment, the test fails instead.
#[track_caller]
pub fn skip(missing: &str) {
    let required = std::env::var("CI").is_ok_and(|value| value == "true");
    assert!(!required, "no test may be skipped with CI=true, but {missing}");
    eprintln!("SKIPPED: {missing}");
}

/// The identifier in an answer.
pub fn id(answer: &Answer) -> String {
    answer.json()["id"].as_str().unwrap().to_owned()
}

impl Drop for TestApp {
    fn drop(&mut self) {
        // The process may have ended already.
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Longest time in which a healthy server starts, answers or ends, on a busy machine.
const LONGEST_SILENCE: Duration = Duration::from_secs(180);

/// The program with a time limit. Without the limit, a server that should have been refused would run forever.
pub fn bounded_program() -> Command {
    let mut command = Command::new("timeout");
    command.arg(LONGEST_SILENCE.as_secs().to_string()).arg(env!("CARGO_BIN_EXE_sci-recon"));
    command
}

/// Kills the process after this time, unless the returned value is dropped before.
fn kill_after(process: u32, limit: Duration) -> mpsc::Sender<()> {
    let (alive, dropped) = mpsc::channel();
    std::thread::spawn(move || {
        let expired = dropped.recv_timeout(limit) == Err(mpsc::RecvTimeoutError::Timeout);
        if let Some(pid) = rustix::process::Pid::from_raw(process.cast_signed()).filter(|_| expired)
        {
            eprintln!("process {process} is killed after {limit:?}");
            // The process may have ended already.
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::KILL);
        }
    });
    alive
}

fn owned(arguments: &[&str]) -> Vec<String> {
    arguments.iter().map(|&text| text.to_owned()).collect()
}

/// Starts a server, and returns it with its address. Returns `None` if it ends before it prints the address.
fn spawn(
    data: &Path,
    arguments: &[String],
    environment: &[(&str, &str)],
    log: Stdio,
) -> Option<(Child, String)> {
    let program = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
    spawn_as(program, data, arguments, environment, log)
}

/// [`spawn`] with a command that starts the program.
fn spawn_as(
    mut program: Command,
    data: &Path,
    arguments: &[String],
    environment: &[(&str, &str)],
    log: Stdio,
) -> Option<(Child, String)> {
    let mut process = program
        .args(["serve", "--listen", "127.0.0.1:0", "--min-free-bytes", "1000000", "--data"])
        .arg(data)
        .args(arguments)
        .env("RUST_LOG", std::env::var("RUST_LOG").unwrap_or_else(|_| "error".into()))
        .envs(environment.iter().copied())
        .stderr(log)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut line = String::new();
    let limit = kill_after(process.id(), LONGEST_SILENCE);
    BufReader::new(process.stdout.take().unwrap()).read_line(&mut line).unwrap();
    drop(limit);
    let Ok(announced) = serde_json::from_str::<Value>(&line) else {
        process.wait().unwrap();
        return None;
    };
    Some((process, announced["url"].as_str().unwrap().to_owned()))
}

impl TestApp {
    /// The address of the service as `host:port`.
    pub fn address(&self) -> String {
        self.url.trim_start_matches("http://").to_owned()
    }

    /// Peak resident memory of the server in MiB.
    pub fn peak_memory(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.pid())).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
        line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() / 1024
    }
}
