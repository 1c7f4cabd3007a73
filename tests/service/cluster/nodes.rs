//! Message servers and workers for the tests, as separate processes.

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

use crate::app::skip;

/// Free ports of this machine.
fn ports(count: usize) -> Vec<u16> {
    let open: Vec<TcpListener> =
        (0..count).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
    open.iter().map(|listener| listener.local_addr().unwrap().port()).collect()
}

/// Path of nats-server: `NATS_SERVER`, or the installed one. Calls [`skip`] if there is none.
pub fn server() -> Option<PathBuf> {
    let named = std::env::var_os("NATS_SERVER").map(PathBuf::from);
    let places = ["/usr/sbin/nats-server", "/usr/local/bin/nats-server", "/usr/bin/nats-server"];
    let path = named.or_else(|| places.map(PathBuf::from).into_iter().find(|path| path.exists()));
    if path.is_none() {
        skip("nats-server is not installed: run `apt-get install nats-server`, or set NATS_SERVER");
    }
    path
}

/// A process that is killed when this is dropped.
pub struct Process(Child);

impl Process {
    pub fn pid(&self) -> Pid {
        Pid::from_raw(self.0.id() as i32).unwrap()
    }

    pub fn id(&self) -> u32 {
        self.0.id()
    }

    pub fn signal(&self, signal: Signal) {
        // The process may have ended already.
        let _ = kill_process(self.pid(), signal);
    }

    /// Sends SIGKILL.
    pub fn kill(&mut self) {
        let _ = self.0.kill();
        self.0.wait().unwrap();
    }

    pub fn is_running(&mut self) -> bool {
        self.0.try_wait().unwrap().is_none()
    }

    /// Waits for the process to end; returns its exit code.
    pub fn ended(&mut self, within: Duration) -> Option<i32> {
        let start = Instant::now();
        while start.elapsed() < within {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        panic!("the process does not end within {within:?}");
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A message server with one or three nodes.
pub struct Nats {
    program: PathBuf,
    folder: TempDir,
    /// Storage folders of the nodes.
    stores: PathBuf,
    configurations: Vec<PathBuf>,
    /// True if the server requires credentials.
    secured: bool,
    pub ports: Vec<u16>,
    pub nodes: Vec<Option<Process>>,
}

impl Nats {
    /// Starts the nodes; none without nats-server.
    pub fn start(count: usize) -> Option<Self> {
        let program = server()?;
        let folder = tempfile::tempdir().unwrap();
        let all_ports = ports(2 * count);
        let (ports, routes) = all_ports.split_at(count);
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
        let configurations = (0..count).map(|n| folder.path().join(format!("n{n}.conf"))).collect();
        let stores = folder.path().to_owned();
        Some(Self::run(program, folder, stores, configurations, ports.to_vec(), false))
    }

    /// Starts the nodes with the configuration of `sci-recon cluster`; none without nats-server.
    pub fn secured(count: usize, more: &[&str]) -> Option<Self> {
        let program = server()?;
        let folder = tempfile::tempdir().unwrap();
        let (keys, stores) = (folder.path().join("keys"), folder.path().join("stores"));
        let mut line: Vec<String> = ["cluster", "init", "--keys"].map(str::to_owned).to_vec();
        line.extend([keys.to_str().unwrap().into(), "--store".into()]);
        line.extend([
            stores.to_str().unwrap().into(),
            "--store-bytes".into(),
            "20000000000".into(),
        ]);
        let mut ports = Vec::new();
        while ports.len() < count {
            let port = self::ports(1)[0];
            // Nodes connect to each other on ports that are 2000 higher.
            if port < 60_000 && TcpListener::bind(("127.0.0.1", port + 2000)).is_ok() {
                line.extend(["--node".into(), format!("127.0.0.1:{port}")]);
                ports.push(port);
            }
        }
        line.extend(more.iter().map(|&word| word.to_owned()));
        let output = Command::new(env!("CARGO_BIN_EXE_sci-recon"))
            .args(line)
            .env("NATS_SERVER", &program)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let listing = String::from_utf8(output.stdout).unwrap();
        let lines = listing.lines().filter_map(|line| line.strip_prefix("nats-server -c "));
        let configurations: Vec<PathBuf> = lines.map(PathBuf::from).collect();
        assert_eq!(configurations.len(), count, "{listing}");
        Some(Self::run(program, folder, stores, configurations, ports, true))
    }

    fn run(
        program: PathBuf,
        folder: TempDir,
        stores: PathBuf,
        configurations: Vec<PathBuf>,
        ports: Vec<u16>,
        secured: bool,
    ) -> Self {
        let nodes = configurations.iter().map(|_| None).collect();
        let mut nats = Self { program, folder, stores, configurations, secured, ports, nodes };
        for n in 0..nats.nodes.len() {
            nats.begin(n);
        }
        nats
    }

    /// The folder with the keys.
    pub fn keys(&self) -> PathBuf {
        self.folder.path().join("keys")
    }

    /// The credential of the server.
    pub fn hub(&self) -> PathBuf {
        self.keys().join("hub.creds")
    }

    /// Output of `sci-recon cluster` with these arguments.
    pub fn cluster(&self, arguments: &[&str]) -> Result<String, String> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sci-recon"));
        let ran = command.arg("cluster").args(arguments).arg("--keys").arg(self.keys()).output();
        let ran = ran.unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        if ran.status.success() { Ok(text(ran.stdout)) } else { Err(text(ran.stderr)) }
    }

    /// A credential for workers of a pool, in a file that every user may read.
    pub fn credential(&self, pool: &str) -> PathBuf {
        let path = self.folder.path().join(format!("{pool}.creds"));
        self.cluster(&["worker", "create", "--pool", pool, "--out", path.to_str().unwrap()])
            .unwrap();
        path
    }

    /// Sends SIGKILL to a node.
    pub fn end(&mut self, n: usize) {
        if let Some(mut node) = self.nodes[n].take() {
            node.kill();
        }
    }

    pub fn signal(&self, n: usize, signal: Signal) {
        if let Some(node) = &self.nodes[n] {
            node.signal(signal);
        }
    }

    /// Removes all messages of a stopped node.
    pub fn wipe(&self, n: usize) {
        let several = self.nodes.len() > 1;
        let store = match (self.secured, several) {
            (true, true) => self.stores.join(format!("n{}", n + 1)),
            (true, false) => self.stores.clone(),
            (false, _) => self.stores.join(format!("store{n}")),
        };
        std::fs::remove_dir_all(store.join("jetstream")).unwrap();
    }

    /// The node that leads the stream of tiles.
    pub async fn leader(&self) -> usize {
        let context = async_nats::jetstream::new(self.client().await);
        let Ok(stream) = context.get_stream("SCI_TASKS").await else { return 0 };
        let leader = stream.cached_info().cluster.as_ref().and_then(|all| all.leader.clone());
        let digits: String =
            leader.unwrap_or_default().chars().filter(char::is_ascii_digit).collect();
        digits.parse::<usize>().map_or(0, |n| (n - 1) % self.nodes.len())
    }

    /// Overwrites a stored chunk.
    pub async fn corrupt(&self, stream: &str) {
        use futures_util::TryStreamExt;
        let client = self.client().await;
        let context = async_nats::jetstream::new(client);
        for _ in 0..100 {
            if let Ok(found) = context.get_stream(stream).await
                && let Ok(subjects) = found.info_with_subjects(">").await
                && let Ok(all) = subjects.try_collect::<Vec<_>>().await
                && let Some((subject, _)) = all.first()
            {
                let garbage = vec![0x5a; 1000];
                if let Ok(sent) = context.publish(subject.clone(), garbage.into()).await {
                    let _ = sent.await;
                    return;
                }
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        eprintln!("{stream} has no chunk to corrupt");
    }

    /// Removes all messages of a stream.
    pub async fn purge(&self, stream: &str) {
        let context = async_nats::jetstream::new(self.client().await);
        context.get_stream(stream).await.unwrap().purge().await.unwrap();
    }

    /// Starts a node on its existing storage.
    pub fn begin(&mut self, n: usize) {
        let log = std::fs::File::create(self.folder.path().join(format!("n{n}.log"))).unwrap();
        let child = Command::new(&self.program)
            .arg("-c")
            .arg(&self.configurations[n])
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
        let mut options = match self.secured {
            true => async_nats::ConnectOptions::with_credentials_file(self.hub()).await.unwrap(),
            false => async_nats::ConnectOptions::new(),
        };
        let authority = self.keys().join("ca.pem");
        if authority.exists() {
            options = options.add_root_certificates(authority).require_tls(true);
        }
        options.connect(urls).await.unwrap()
    }

    /// The subject of a message in a stream, when there is one.
    pub async fn subject_in(&self, stream: &str) -> String {
        use futures_util::TryStreamExt;
        let context = async_nats::jetstream::new(self.client().await);
        loop {
            let handle = context.get_stream(stream).await.unwrap();
            let subjects = handle.info_with_subjects(">").await.unwrap();
            let subjects: Vec<(String, usize)> = subjects.try_collect().await.unwrap();
            if let Some((subject, _)) = subjects.into_iter().next() {
                return subject;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Number of messages in each stream.
    pub async fn messages(&self) -> Vec<(String, u64)> {
        let context = async_nats::jetstream::new(self.client().await);
        let mut counts = Vec::new();
        for name in ["SCI_TASKS", "SCI_EVENTS", "SCI_IN", "SCI_OUT"] {
            // A cluster may be electing a leader.
            let stream = context.get_stream(name).await;
            let count = stream.map_or(1, |stream| stream.cached_info().state.messages);
            counts.push((name.to_owned(), count));
        }
        counts
    }

    /// State of the streams of tiles and events and of their consumers.
    pub async fn state(&self) -> String {
        let client = self.client().await;
        let mut state = String::new();
        for (stream, consumer) in [("SCI_TASKS", "test"), ("SCI_EVENTS", "hub-test")] {
            for subject in [
                format!("$JS.API.STREAM.INFO.{stream}"),
                format!("$JS.API.CONSUMER.INFO.{stream}.{consumer}"),
            ] {
                let answer = client.request(subject.clone(), "".into()).await;
                let answer =
                    answer.map(|answer| String::from_utf8_lossy(&answer.payload).into_owned());
                state += &format!("{subject}: {answer:?}\n");
            }
        }
        state
    }

    /// Waits until all streams are empty.
    pub async fn emptied(&self) {
        let start = Instant::now();
        loop {
            let messages = self.messages().await;
            if messages.iter().all(|(_, count)| *count == 0) {
                return;
            }
            if start.elapsed() > Duration::from_secs(75) {
                panic!("streams keep {messages:?}\n{}", self.state().await);
            }
            tokio::time::sleep(Duration::from_millis(300)).await;
        }
    }
}

/// A copy of a file in a folder that other users may read; the clone may lie where they can't. The next run of the tests
/// replaces it.
fn readable_copy(file: &Path) -> PathBuf {
    let user = rustix::process::getuid().as_raw();
    let folder = std::env::temp_dir().join(format!("sci-recon-tests-{user}"));
    std::fs::create_dir_all(&folder).unwrap();
    let open = |path: &Path| {
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o755)).unwrap();
    };
    open(&folder);
    let draft = tempfile::NamedTempFile::new_in(&folder).unwrap();
    std::fs::copy(file, draft.path()).unwrap();
    open(draft.path());
    let path = folder.join(file.file_name().unwrap());
    draft.persist(&path).unwrap();
    path
}

/// A copy of the program that other users may run.
pub fn program() -> &'static Path {
    static COPY: OnceLock<PathBuf> = OnceLock::new();
    COPY.get_or_init(|| readable_copy(Path::new(env!("CARGO_BIN_EXE_sci-recon"))))
}

/// A copy of libonnxruntime that other users may read, if it is installed.
pub fn library() -> Option<&'static Path> {
    static COPY: OnceLock<Option<PathBuf>> = OnceLock::new();
    let copy = || {
        let library = PathBuf::from(std::env::var_os("ORT_DYLIB_PATH")?);
        library.is_file().then(|| readable_copy(&library))
    };
    COPY.get_or_init(copy).as_deref()
}

/// A user without rights to any file.
pub const UNPRIVILEGED_UID: u32 = 65_534;

/// The environment of every container: the ENV lines of the image.
fn image_environment() -> Vec<(String, String)> {
    let text = std::fs::read_to_string("docker/Dockerfile").unwrap();
    let (_, stage) = text.rsplit_once("\nFROM ").unwrap();
    let words =
        stage.lines().filter_map(|line| line.strip_prefix("ENV ")).flat_map(str::split_whitespace);
    let pairs = words.map(|word| word.split_once('=').unwrap());
    let variables: Vec<_> =
        pairs.map(|(name, value)| (name.to_owned(), value.to_owned())).collect();
    assert!(!variables.is_empty(), "the image has no ENV");
    variables
}

/// A worker in an empty folder, with the environment of a container. It runs as another user if the test is root.
pub struct RemoteWorker {
    pub process: Process,
    pub folder: TempDir,
    pub log: PathBuf,
    credential: Option<tempfile::NamedTempFile>,
}

impl RemoteWorker {
    pub fn start(arguments: &[&str]) -> Self {
        Self::within(&[], arguments)
    }

    /// Starts a worker with a copy of a credential.
    pub fn with_credential(credential: &Path, arguments: &[&str]) -> Self {
        let own_copy = tempfile::NamedTempFile::new().unwrap();
        std::fs::copy(credential, own_copy.path()).unwrap();
        if rustix::process::getuid().is_root() {
            std::os::unix::fs::chown(
                own_copy.path(),
                Some(UNPRIVILEGED_UID),
                Some(UNPRIVILEGED_UID),
            )
            .unwrap();
        }
        let path = own_copy.path().to_str().unwrap().to_owned();
        let mut worker = Self::within(&[], &[&["--nats-creds", path.as_str()], arguments].concat());
        worker.credential = Some(own_copy);
        worker
    }

    /// Starts a worker under another command, such as one that sets limits.
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
            .envs(image_environment())
            .env("RUST_LOG", "info")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(file);
        command.envs(library().map(|library| ("ORT_DYLIB_PATH", library)));
        if rustix::process::getuid().is_root() {
            std::os::unix::fs::chown(folder.path(), Some(UNPRIVILEGED_UID), Some(UNPRIVILEGED_UID))
                .unwrap();
            command.uid(UNPRIVILEGED_UID).gid(UNPRIVILEGED_UID);
        }
        let process = Process(command.spawn().unwrap());
        Self { process, folder, log, credential: None }
    }

    /// The computing process, a child of the supervisor.
    pub fn inner(&self) -> Option<Pid> {
        let path = format!("/proc/{}/task", self.process.pid().as_raw_nonzero());
        let threads: Vec<_> = std::fs::read_dir(path).ok()?.flatten().collect();
        let children = threads
            .iter()
            .filter_map(|thread| std::fs::read_to_string(thread.path().join("children")).ok());
        let identifiers = children.collect::<Vec<String>>().join(" ");
        Pid::from_raw(identifiers.split_whitespace().next()?.parse().ok()?)
    }

    /// Kills both processes with SIGKILL, like a failure of the machine.
    pub fn kill(&mut self) {
        let inner = self.inner();
        // Stop both first, so that neither reacts to the other's death.
        self.process.signal(Signal::STOP);
        if let Some(inner) = inner {
            let _ = kill_process(inner, Signal::KILL);
        }
        self.process.kill();
    }

    /// Sends a signal to both processes.
    pub fn signal(&self, signal: Signal) {
        self.process.signal(signal);
        if let Some(inner) = self.inner() {
            let _ = kill_process(inner, signal);
        }
    }

    /// Size of its cache in bytes.
    pub fn cached(&self) -> u64 {
        let Ok(entries) = std::fs::read_dir(self.folder.path().join("cache")) else { return 0 };
        entries.flatten().filter_map(|entry| entry.metadata().ok()).map(|facts| facts.len()).sum()
    }

    /// Peak resident memory in bytes.
    pub fn peak_memory(&self) -> u64 {
        let Some(inner) = self.inner() else { return 0 };
        let path = format!("/proc/{}/status", inner.as_raw_nonzero());
        let text = std::fs::read_to_string(path).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kib = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
        kib.unwrap_or(0) * 1024
    }

    pub fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap()
    }
}

impl Drop for RemoteWorker {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let _ = std::io::stderr().write_all(self.log().as_bytes());
        }
    }
}
