//! Message servers and workers for the tests, as processes of their own.

use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;

/// Free ports of this machine.
fn ports(count: usize) -> Vec<u16> {
    let open: Vec<TcpListener> =
        (0..count).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
    open.iter().map(|listener| listener.local_addr().unwrap().port()).collect()
}

/// nats-server: `NATS_SERVER`, or the one that is installed; none if there is none.
pub fn server() -> Option<PathBuf> {
    let named = std::env::var_os("NATS_SERVER").map(PathBuf::from);
    let places = ["/usr/sbin/nats-server", "/usr/local/bin/nats-server", "/usr/bin/nats-server"];
    let found = named.or_else(|| places.map(PathBuf::from).into_iter().find(|path| path.exists()));
    if found.is_none() {
        eprintln!("SKIPPED: there is no nats-server (Debian: apt-get install nats-server)");
    }
    found
}

/// A process that is killed when this is dropped.
pub struct Process(Child);

impl Process {
    pub fn pid(&self) -> Pid {
        Pid::from_raw(self.0.id() as i32).unwrap()
    }

    pub fn signal(&self, signal: Signal) {
        // It may have ended.
        let _ = kill_process(self.pid(), signal);
    }

    /// SIGKILL.
    pub fn kill(&mut self) {
        let _ = self.0.kill();
        self.0.wait().unwrap();
    }

    pub fn lives(&mut self) -> bool {
        self.0.try_wait().unwrap().is_none()
    }

    /// Waits for its end; the exit code.
    pub fn ended(&mut self, within: Duration) -> Option<i32> {
        let start = Instant::now();
        while start.elapsed() < within {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        panic!("it does not end within {within:?}");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A message server of one node or three.
pub struct Nats {
    program: PathBuf,
    folder: TempDir,
    pub ports: Vec<u16>,
    pub nodes: Vec<Option<Process>>,
}

impl Nats {
    /// None if there is no nats-server.
    pub fn start(count: usize) -> Option<Self> {
        let program = server()?;
        let folder = tempfile::tempdir().unwrap();
        let all = ports(2 * count);
        let (ports, routes) = all.split_at(count);
        for n in 0..count {
            let store = folder.path().join(format!("store{n}"));
            let mut text = format!(
                "server_name: n{n}\nlisten: \"127.0.0.1:{}\"\n\
                 jetstream {{ store_dir: {store:?}, max_file_store: 20GB }}\n",
                ports[n]
            );
            if count > 1 {
                let others: Vec<String> =
                    routes.iter().map(|port| format!("\"nats://127.0.0.1:{port}\"")).collect();
                text += &format!(
                    "cluster {{ name: test, listen: \"127.0.0.1:{}\", routes: [{}] }}\n",
                    routes[n],
                    others.join(", ")
                );
            }
            std::fs::write(folder.path().join(format!("n{n}.conf")), text).unwrap();
        }
        let nodes = (0..count).map(|_| None).collect();
        let mut nats = Self { program, folder, ports: ports.to_vec(), nodes };
        for n in 0..count {
            nats.begin(n);
        }
        Some(nats)
    }

    /// Starts a node, on the disk that it had.
    pub fn begin(&mut self, n: usize) {
        let log = std::fs::File::create(self.folder.path().join(format!("n{n}.log"))).unwrap();
        let child = Command::new(&self.program)
            .arg("-c")
            .arg(self.folder.path().join(format!("n{n}.conf")))
            .env("GOMEMLIMIT", "400MiB")
            .stderr(log)
            .stdin(Stdio::null())
            .spawn()
            .unwrap();
        self.nodes[n] = Some(Process(child));
        let start = Instant::now();
        while TcpStream::connect(("127.0.0.1", self.ports[n])).is_err() {
            assert!(start.elapsed() < Duration::from_secs(20), "nats-server does not start");
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// The addresses of all nodes.
    pub fn url(&self) -> String {
        let urls = self.ports.iter().map(|port| format!("nats://127.0.0.1:{port}"));
        urls.collect::<Vec<_>>().join(",")
    }

    pub async fn client(&self) -> async_nats::Client {
        let urls: Vec<async_nats::ServerAddr> =
            self.url().split(',').map(|url| url.parse().unwrap()).collect();
        async_nats::connect(urls).await.unwrap()
    }

    /// Messages in each stream.
    pub async fn messages(&self) -> Vec<(String, u64)> {
        let context = async_nats::jetstream::new(self.client().await);
        let mut found = Vec::new();
        for name in ["SCI_TASKS", "SCI_EVENTS", "SCI_IN", "SCI_OUT"] {
            let stream = context.get_stream(name).await.unwrap();
            found.push((name.to_owned(), stream.cached_info().state.messages));
        }
        found
    }

    /// Waits until all streams are empty.
    pub async fn emptied(&self) {
        let start = Instant::now();
        loop {
            let messages = self.messages().await;
            if messages.iter().all(|(_, count)| *count == 0) {
                return;
            }
            assert!(start.elapsed() < Duration::from_secs(75), "streams keep {messages:?}");
            tokio::time::sleep(Duration::from_millis(300)).await;
        }
    }
}

/// The program, where others than root may run it.
fn program() -> &'static Path {
    static COPY: OnceLock<(TempDir, PathBuf)> = OnceLock::new();
    let (_, path) = COPY.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let open = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(folder.path(), open).unwrap();
        let path = folder.path().join("sci-recon");
        std::fs::copy(env!("CARGO_BIN_EXE_sci-recon"), &path).unwrap();
        (folder, path)
    });
    path
}

/// Somebody without rights to anything.
const NOBODY: u32 = 65_534;

/// A worker in an empty folder, with a cleared environment, as another user where the test is root.
pub struct RemoteWorker {
    pub process: Process,
    pub folder: TempDir,
    pub log: PathBuf,
}

impl RemoteWorker {
    pub fn start(arguments: &[&str]) -> Self {
        Self::within(&[], arguments)
    }

    /// Under the command in front of it, such as one that sets limits.
    pub fn within(before: &[&str], arguments: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("log");
        let file = std::fs::File::create(&log).unwrap();
        let line: Vec<&str> =
            before.iter().copied().chain([program().to_str().unwrap(), "worker"]).collect();
        let mut command = Command::new(line[0]);
        command
            .args(&line[1..])
            .args(["--cache", "cache", "--log-format", "json"])
            .args(arguments)
            .current_dir(folder.path())
            .env_clear()
            .env("RUST_LOG", "info")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(file);
        if let Ok(library) = std::env::var("ORT_DYLIB_PATH") {
            command.env("ORT_DYLIB_PATH", library);
        }
        if rustix::process::getuid().is_root() {
            std::os::unix::fs::chown(folder.path(), Some(NOBODY), Some(NOBODY)).unwrap();
            command.uid(NOBODY).gid(NOBODY);
        }
        let process = Process(command.spawn().unwrap());
        Self { process, folder, log }
    }

    pub fn said(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap()
    }
}

impl Drop for RemoteWorker {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let _ = std::io::stderr().write_all(self.said().as_bytes());
        }
    }
}
