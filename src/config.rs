//! All settings of the service. The comments are the help of the command line.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytesize::ByteSize;
use clap::builder::RangedU64ValueParser;
use clap::{Args, ValueEnum};
use hyper::http::{HeaderValue, Uri};
use ipnet::IpNet;
use strum::IntoStaticStr;

use engine::job::{Pool, Webhook, WorkerId};
use engine::pipeline::networks::{NetworkError, NetworkSource, find_library};
use reconstruction::priors::onnx::Device;
use store::Claimant;

/// The version of the program, with its commit if `make` built it.
pub const VERSION: &str = match option_env!("SCI_RECON_VERSION") {
    Some(version) => version,
    None => env!("CARGO_PKG_VERSION"),
};

/// Exit code of a worker that lost its GPU: EX_TEMPFAIL of sysexits.h.
pub(crate) const DEVICE_LOST: u8 = 75;

/// Largest number of CPU workers beside those on a GPU. More would wait for the disk.
const MAX_HOST_WORKERS: usize = 4;

/// Run the HTTP service, its dashboard and its workers.
#[derive(Debug, Clone, Args)]
pub struct ServeArguments {
    /// Folder for the database, uploads and results; created if it is missing.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    pub data: PathBuf,

    /// Address to listen on; port 0 selects a free port.
    #[arg(
        long,
        env = "SCI_RECON_LISTEN",
        value_name = "ADDRESS",
        default_value = "127.0.0.1:8080"
    )]
    pub listen: SocketAddr,

    /// Listen on an address that other machines can reach although there are no tokens: everyone who reaches it may do
    /// everything.
    #[arg(long, env = "SCI_RECON_ALLOW_REMOTE")]
    pub allow_remote: bool,

    /// Host names of the service, separated by commas, in addition to its addresses, `localhost` and the name of the
    /// machine. While there are no tokens, requests of browsers with another name are refused.
    #[arg(long = "host", env = "SCI_RECON_HOSTS", value_name = "NAME", value_delimiter = ',')]
    pub hosts: Vec<String>,

    /// Origins of pages on other hosts or ports that may use the API with a token, such as `https://lab.example`, separated
    /// by commas. Without tokens they may use it freely.
    #[arg(long = "cors-origin", env = "SCI_RECON_CORS_ORIGINS", value_name = "ORIGIN", value_delimiter = ',',
          value_parser = origin)]
    pub cors_origins: Vec<HeaderValue>,

    /// Addresses or networks of proxies, such as `127.0.0.1,10.1.0.0/16`, which may state the address of a client in
    /// `X-Forwarded-For` or `Forwarded`. They must set that header, not pass on the one of the client.
    #[arg(long, env = "SCI_RECON_TRUSTED_PROXIES", value_name = "NETWORK", value_delimiter = ',', value_parser = network)]
    pub trusted_proxies: Vec<IpNet>,

    /// Hosts that may be notified when jobs end, separated by commas, with the port unless it is the default one of http or
    /// https. Jobs with a webhook on another host are refused [default: none].
    #[arg(
        long = "webhook-host",
        env = "SCI_RECON_WEBHOOK_HOSTS",
        value_name = "HOST",
        value_delimiter = ',',
        value_parser = Webhook::allowed_host
    )]
    pub webhook_hosts: Vec<String>,

    /// Worker processes to run in addition to the light worker, which performs checks and other short tasks. With a GPU, the
    /// number of those that use it; workers on the CPU, one for each other core but at most four, take all tasks except
    /// tiles. 0 runs none, for workers that are started by hand. With --nats, 0 runs one that leaves the tiles to other
    /// machines [default: one per core, one on a GPU].
    #[arg(long, env = "SCI_RECON_WORKERS", value_name = "N")]
    pub workers: Option<usize>,

    /// Workers on other machines.
    #[command(flatten)]
    pub cluster: ClusterArguments,

    /// Settings of the workers.
    #[command(flatten)]
    pub engine: EngineArguments,

    /// Memory that a worker may need; jobs that need more are refused. A task fails if it takes more than 1.25
    /// times this plus 256 MiB.
    #[arg(long, env = "SCI_RECON_WORKER_MEMORY_BYTES", value_name = "BYTES", value_parser = some_bytes, default_value_t = 4 << 30)]
    pub worker_memory_bytes: u64,

    /// Largest size of an upload.
    #[arg(long, env = "SCI_RECON_MAX_UPLOAD_BYTES", value_name = "BYTES", value_parser = some_bytes, default_value_t = 8 << 30)]
    pub max_upload_bytes: u64,

    /// Uploads that are received at the same time; further ones must try again later. A lab has at most half of
    /// these places. A lab without an upload always gets one.
    #[arg(long, env = "SCI_RECON_MAX_UPLOADS", value_name = "N", default_value_t = 64,
          value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    pub max_uploads: usize,

    /// Bytes of the disk to keep free of uploads.
    #[arg(long, env = "SCI_RECON_MIN_FREE_BYTES", value_name = "BYTES", value_parser = bytes, default_value_t = 1 << 30)]
    pub min_free_bytes: u64,

    /// Seconds without a byte after which an upload is interrupted.
    #[arg(
        long,
        env = "SCI_RECON_UPLOAD_IDLE_SECONDS",
        value_name = "SECONDS",
        default_value_t = 60,
        value_parser = clap::value_parser!(u64).range(1..)
    )]
    pub upload_idle_seconds: u64,

    /// Lowest rate of an upload in bytes per second, averaged over --upload-idle-seconds.
    #[arg(
        long,
        env = "SCI_RECON_UPLOAD_BYTES_PER_SECOND",
        value_name = "BYTES",
        default_value_t = 1000
    )]
    pub upload_bytes_per_second: u64,

    /// Seconds after which a client is disconnected that receives an answer more slowly than
    /// --download-bytes-per-second. It can request the rest with a range.
    #[arg(
        long,
        env = "SCI_RECON_DOWNLOAD_STALL_SECONDS",
        value_name = "SECONDS",
        default_value_t = 60,
        value_parser = clap::value_parser!(u64).range(1..)
    )]
    pub download_stall_seconds: u64,

    /// Lowest rate at which a client may receive an answer, in bytes per second, averaged over
    /// --download-stall-seconds; 0: no limit.
    #[arg(
        long,
        env = "SCI_RECON_DOWNLOAD_BYTES_PER_SECOND",
        value_name = "BYTES",
        default_value_t = 1000
    )]
    pub download_bytes_per_second: u64,

    /// Seconds that an answer may take (other than uploads, checks of uploads, and downloads).
    #[arg(long, env = "SCI_RECON_REQUEST_SECONDS", value_name = "SECONDS", default_value_t = 30,
          value_parser = clap::value_parser!(u64).range(1..))]
    pub request_seconds: u64,

    /// Seconds that the check of a file for a calibration, a measurement or a model may take.
    #[arg(long, env = "SCI_RECON_CHECK_SECONDS", value_name = "SECONDS", default_value_t = 300.0, value_parser = seconds)]
    pub check_seconds: f64,

    /// Requests that a token may send in a minute, in any rhythm; 0: no limit.
    #[arg(long, env = "SCI_RECON_REQUESTS_PER_MINUTE", value_name = "N", default_value_t = 6000)]
    pub requests_per_minute: u32,

    /// Jobs that may wait and run; further ones must try again later, except those of a lab with less than an
    /// equal share.
    #[arg(long, env = "SCI_RECON_MAX_JOBS", value_name = "N", default_value_t = 1000,
          value_parser = clap::value_parser!(u64).range(1..))]
    pub max_jobs: u64,

    /// Jobs of one lab that may wait and run, if there are several labs; `lab set --jobs` sets a limit for one lab
    /// [default: the value of --max-jobs].
    #[arg(long, env = "SCI_RECON_LAB_JOBS", value_name = "N")]
    pub lab_jobs: Option<u64>,

    /// Bytes that one lab may keep, if there are several labs; `lab set --bytes` sets a limit for one lab
    /// [default: half of the disk].
    #[arg(long, env = "SCI_RECON_LAB_BYTES", value_name = "BYTES", value_parser = bytes)]
    pub lab_bytes: Option<u64>,

    /// Hours for which unused and incomplete uploads are kept.
    #[arg(long, env = "SCI_RECON_UPLOAD_HOURS", value_name = "HOURS", default_value_t = 72)]
    pub upload_hours: u64,

    /// Days for which ended jobs are kept, with their results [default: until they are deleted].
    #[arg(long, env = "SCI_RECON_JOB_DAYS", value_name = "DAYS")]
    pub job_days: Option<u32>,

    /// Days for which files without a record, such as those of a crash, are kept in quarantine/.
    #[arg(long, env = "SCI_RECON_QUARANTINE_DAYS", value_name = "DAYS", default_value_t = 7)]
    pub quarantine_days: u32,

    /// Days for which deleted files are kept in before-updates/kept/ after an update of the database, for a rollback to
    /// the earlier version; 0 keeps none. A disk that is nearly full ends this early.
    #[arg(long, env = "SCI_RECON_ROLLBACK_DAYS", value_name = "DAYS", default_value_t = 7)]
    pub rollback_days: u32,

    /// Bytes per second at which stored files are compared with their hashes in the background, at most once a
    /// day; 0: never.
    #[arg(long, env = "SCI_RECON_SCRUB_BYTES", value_name = "BYTES", value_parser = bytes,
          default_value_t = 10 << 20)]
    pub scrub_bytes: u64,

    /// Start although database and folder do not belong together: trust the database, and move unknown files to
    /// quarantine/. For a single start, once the reason is understood.
    #[arg(long)]
    pub accept_database: bool,

    /// Free bytes of the disk below which unused uploads and the oldest ended jobs are deleted early, except
    /// those of the last hour; 0: never.
    #[arg(long, env = "SCI_RECON_LOW_WATER_BYTES", value_name = "BYTES", value_parser = bytes, default_value_t = 0)]
    pub low_water_bytes: u64,

    /// Format of log lines.
    #[arg(long, env = "SCI_RECON_LOG_FORMAT", value_enum, default_value_t)]
    pub log_format: LogFormat,

    /// The file of the audit log.
    #[command(flatten)]
    pub audit: AuditArguments,
}

/// The file of the audit log.
#[derive(Debug, Clone, Default, Args)]
pub struct AuditArguments {
    /// File to which a line of JSON is appended for each change and each failed sign-in. It is opened for each line, so that
    /// it can be rotated [default: none; commands use the file of the running service].
    #[arg(long, env = "SCI_RECON_AUDIT_LOG", value_name = "FILE")]
    pub audit_log: Option<PathBuf>,
}

/// Address of a NATS server, and a credential for it.
#[derive(Debug, Clone, Default, Args)]
pub struct NatsArguments {
    /// Addresses of a NATS server with JetStream, such as nats://host:4222 or tls://host:4222, separated by
    /// commas [default: the address in the credential].
    #[arg(long, env = "SCI_RECON_NATS", value_name = "URL")]
    pub nats: Option<String>,

    /// File with a credential for the NATS server.
    #[arg(long, env = "SCI_RECON_NATS_CREDS", value_name = "FILE")]
    pub nats_creds: Option<PathBuf>,
}

impl NatsArguments {
    /// True if a NATS server is configured.
    #[must_use]
    pub fn is_wanted(&self) -> bool {
        self.nats.is_some() || self.nats_creds.is_some()
    }
}

/// Settings for workers on other machines.
#[derive(Debug, Clone, Args)]
pub struct ClusterArguments {
    /// The NATS server.
    #[command(flatten)]
    pub nats: NatsArguments,

    /// Seconds of silence after which the tile of a worker on another machine is given to another worker.
    #[arg(long, env = "SCI_RECON_ACK_WAIT", value_name = "SECONDS", default_value_t = 30,
          value_parser = clap::value_parser!(u64).range(2..=3600))]
    pub ack_wait: u64,

    /// Share of the tiles that a second worker on another machine computes for comparison; 0 for none, 1 for all.
    #[arg(long, env = "SCI_RECON_VERIFY_FRACTION", value_name = "SHARE", default_value_t = 0.002,
          value_parser = fraction)]
    pub verify_fraction: f64,
}

/// Settings of a worker for a server elsewhere.
#[derive(Debug, Clone, Default, Args)]
pub struct RemoteArguments {
    /// The NATS server.
    #[command(flatten)]
    pub nats: NatsArguments,

    /// Folder that caches inputs for later tiles; it may be deleted when the worker has ended [default: in the folder for
    /// temporary files].
    #[arg(long, env = "SCI_RECON_CACHE", value_name = "DIR")]
    pub cache: Option<PathBuf>,

    /// Largest size of the cache.
    #[arg(long, env = "SCI_RECON_CACHE_BYTES", value_name = "N", value_parser = bytes, default_value_t = 4 << 30)]
    pub cache_bytes: u64,

    /// Seconds without a tile after which the worker ends [default: never].
    #[arg(long, env = "SCI_RECON_EXIT_WHEN_IDLE", value_name = "SECONDS")]
    pub exit_when_idle: Option<u64>,

    /// The pool of the worker [default: the pool in the credential].
    #[arg(long, env = "SCI_RECON_POOL", value_name = "NAME")]
    pub pool: Option<Pool>,

    /// File in which the worker records its current tile.
    #[arg(long, value_name = "FILE", hide = true)]
    pub hand: Option<PathBuf>,

    /// Reason why the previous process of this file died.
    #[arg(long, value_name = "TEXT", hide = true)]
    pub died: Option<String>,
}

impl RemoteArguments {
    /// The folder of the cache.
    #[must_use]
    pub fn cache_folder(&self) -> PathBuf {
        self.cache.clone().unwrap_or_else(|| std::env::temp_dir().join("sci-recon-cache"))
    }
}

/// Run an additional worker, here or on another machine.
///
/// It performs tasks of a data folder on this machine or, with --nats or --nats-creds, tiles of a server on another
/// machine, until it is stopped.
#[derive(Debug, Clone, Args)]
pub struct WorkerArguments {
    /// Folder with the database, uploads and results; ignored for a server on another machine.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR", required_unless_present_any = ["nats", "nats_creds"])]
    pub data: Option<PathBuf>,

    /// Settings for a server elsewhere.
    #[command(flatten)]
    pub remote: RemoteArguments,

    /// Kinds of tasks that the worker performs.
    #[arg(long, value_enum, default_value_t, hide = true)]
    pub takes: Takes,

    /// Memory limit; a task that needs more fails [default: no limit].
    #[arg(long, env = "SCI_RECON_WORKER_LIMIT_BYTES", value_name = "BYTES")]
    pub memory_bytes: Option<u64>,

    /// Device and limits of the computation.
    #[command(flatten)]
    pub engine: EngineArguments,

    /// Format of log lines.
    #[arg(long, env = "SCI_RECON_LOG_FORMAT", value_enum, default_value_t)]
    pub log_format: LogFormat,

    /// Identifier of the worker [default: a new one].
    #[arg(long, value_name = "ID", hide = true)]
    pub id: Option<WorkerId>,

    /// End when standard input closes, which the server holds open.
    #[arg(long, hide = true)]
    pub supervised: bool,
}

/// Kinds of tasks that a worker of this machine performs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum, IntoStaticStr)]
#[strum(serialize_all = "kebab-case", const_into_str)]
pub enum Takes {
    #[default]
    All,
    /// All except tiles, which are left to other machines.
    WithoutTiles,
    /// Tiles and pilots, on a GPU.
    Gpu,
    /// All except tiles and pilots, on the CPU beside workers on a GPU.
    Host,
    /// Short tasks, which must not wait for tiles, and at the same time checks of users' networks, one after the other.
    Light,
}

impl Takes {
    /// The claimants of a worker. Each takes one task at a time.
    pub fn claimants(self) -> &'static [Claimant<'static>] {
        match self {
            Self::All => &[Claimant::Local],
            Self::WithoutTiles => &[Claimant::WithoutTiles],
            Self::Gpu => &[Claimant::Gpu],
            Self::Host => &[Claimant::Host],
            Self::Light => &[Claimant::Light, Claimant::Networks],
        }
    }
}

/// Device and limits of the computation.
#[derive(Debug, Clone, Args)]
pub struct EngineArguments {
    /// Path of libonnxruntime [default: next to the program, or in ../lib/sci-recon, ../lib or ../../runtime].
    #[arg(long, value_name = "FILE", env = "ORT_DYLIB_PATH")]
    pub onnxruntime: Option<PathBuf>,

    /// Device that runs networks, and the solver in a build with the feature gpu: cpu, gpu (the first GPU of any vendor), or
    /// cuda:N (NVIDIA, from 0; networks only).
    #[arg(long, env = "SCI_RECON_DEVICE", value_name = "DEVICE", default_value = "cpu",
          value_parser = device)]
    pub device: String,

    /// Folder with networks that replace the built-in ones: fastdvdnet-gray/stage1.onnx and stage2.onnx, or
    /// ffdnet-gray/model.onnx. Workers on other machines need the same. Manifests have their hashes.
    #[arg(long, env = "SCI_RECON_MODELS", value_name = "FOLDER")]
    pub models: Option<PathBuf>,

    /// Nice value of workers (0 to 19), so that the API responds under full load. A process with a higher nice value keeps
    /// it.
    #[arg(long, env = "SCI_RECON_NICE", value_name = "N", default_value_t = 10,
          value_parser = clap::value_parser!(i32).range(0..=19))]
    pub nice: i32,

    /// Run workers and networks of users without confinement. Otherwise workers of this machine read only the data
    /// folder and the system's libraries, networks only those libraries, and neither makes connections.
    #[arg(long, env = "SCI_RECON_UNCONFINED")]
    pub unconfined: bool,

    /// Seconds without progress, beyond four times the planned time of a task, after which its worker is terminated and
    /// another worker tries the task.
    #[arg(long, env = "SCI_RECON_STALL_SECONDS", value_name = "SECONDS", default_value_t = 300)]
    pub stall_seconds: u64,
}

/// A device in its shortest form.
pub(crate) fn device(text: &str) -> Result<String, String> {
    Device::parse(text).map(|device| device.to_string()).map_err(|error| error.to_string())
}

/// State of the device of a server's workers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DeviceState {
    /// No worker has tried it.
    Untried,
    /// A worker has run a network on it.
    Ready,
    /// A worker can't use it, for this reason.
    Refused(String),
}

/// A time in seconds, above 0 and up to a day.
fn seconds(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| *seconds > 0.0 && *seconds <= 86_400.0);
    seconds.ok_or_else(|| format!("{text:?} is not a number of seconds above 0 and up to 86400"))
}

/// A share from 0 to 1.
fn fraction(text: &str) -> Result<f64, String> {
    let share = text.parse().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| format!("{text:?} is not a share from 0 to 1"))
}

/// A network, such as 10.1.0.0/16, or a single address.
fn network(text: &str) -> Result<IpNet, String> {
    let address = || text.parse::<IpAddr>().map(IpNet::from);
    text.parse::<IpNet>()
        .or_else(|_| address())
        .map_err(|_| format!("{text:?} is neither an address nor a network such as 10.1.0.0/16"))
}

/// The origin of a page: scheme, host and port.
fn origin(text: &str) -> Result<HeaderValue, String> {
    let wrong = || {
        format!("{text:?} is no origin: write scheme and host, such as https://lab.example:8443")
    };
    let uri: Uri = text.parse().map_err(|_| wrong())?;
    let written = match (uri.scheme_str(), uri.authority()) {
        (Some(scheme @ ("http" | "https")), Some(place)) => format!("{scheme}://{place}"),
        _ => return Err(wrong()),
    };
    if written != text {
        return Err(wrong());
    }
    HeaderValue::try_from(written).map_err(|_| wrong())
}

/// Reads a number of bytes: `1000000`, `10GB` (powers of 1000) or `8GiB` (of 1024).
pub fn bytes(text: &str) -> Result<u64, String> {
    let size: Result<ByteSize, String> = text.parse();
    size.map(|size| size.as_u64())
        .map_err(|_| format!("{text:?} is not a size such as 1000000, 10GB or 8GiB"))
}

/// A number of bytes above 0.
fn some_bytes(text: &str) -> Result<u64, String> {
    match bytes(text)? {
        0 => Err("0 would refuse everything; state a size such as 10GB or 8GiB".into()),
        size => Ok(size),
    }
}

/// Format of log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

impl ServeArguments {
    /// True if other machines can reach the service and need no token; `open` means that there are no tokens.
    #[must_use]
    pub fn is_exposed(&self, open: bool) -> bool {
        open && !self.listen.ip().is_loopback() && !self.allow_remote
    }

    /// Number of workers on the device.
    #[must_use]
    pub fn worker_count(&self) -> usize {
        let default = || match self.engine.device.as_str() {
            "cpu" => cores(),
            // Workers that share a GPU share its memory, too.
            _ => 1,
        };
        // Tasks that do not leave this machine need a worker.
        let minimum = usize::from(self.without_tiles());
        self.workers.unwrap_or_else(default).max(minimum)
    }

    /// Number of workers on the CPU beside those on a GPU, for all tasks except tiles and pilots.
    #[must_use]
    pub fn host_worker_count(&self) -> usize {
        if self.engine.device == "cpu" || self.workers == Some(0) {
            return 0;
        }
        cores().saturating_sub(self.worker_count()).clamp(1, MAX_HOST_WORKERS)
    }

    /// True if the workers of this machine leave the tiles to others.
    #[must_use]
    pub fn without_tiles(&self) -> bool {
        self.cluster.nats.is_wanted() && self.workers == Some(0)
    }

    #[must_use]
    pub fn upload_idle(&self) -> Duration {
        Duration::from_secs(self.upload_idle_seconds)
    }

    #[must_use]
    pub fn download_stall(&self) -> Duration {
        Duration::from_secs(self.download_stall_seconds)
    }

    /// Time for which unused and incomplete uploads are kept.
    #[must_use]
    pub fn upload_age(&self) -> Duration {
        Duration::from_secs(self.upload_hours.saturating_mul(3600))
    }

    #[must_use]
    pub fn check_time(&self) -> Duration {
        Duration::from_secs_f64(self.check_seconds)
    }

    #[must_use]
    pub fn request_time(&self) -> Duration {
        Duration::from_secs(self.request_seconds)
    }
}

impl EngineArguments {
    /// Errors: libonnxruntime is missing.
    pub fn check_library(&self) -> Result<(), NetworkError> {
        find_library(self.onnxruntime.as_deref()).map(drop)
    }

    /// The networks on the device.
    ///
    /// # Errors
    /// The device can't be read, or `--models` has no networks.
    pub fn source(&self) -> Result<NetworkSource, NetworkError> {
        // An empty variable counts as not set.
        let library = self.onnxruntime.clone().filter(|path| !path.as_os_str().is_empty());
        let device = Device::parse(&self.device)?;
        NetworkSource::new(library, device).with_models(self.models.as_deref())
    }

    /// Name of the execution provider for the device. Workers refuse a device that can't be read,
    /// with the reason.
    #[must_use]
    pub fn provider(&self) -> &'static str {
        Device::parse(&self.device).map_or("unknown", Device::provider)
    }
}

impl WorkerArguments {
    /// Data folder that the worker opens. `None` for a worker of a server on another machine: it ignores `data`, which
    /// containers and configuration files set for all commands.
    #[must_use]
    pub fn data_folder(&self) -> Option<&Path> {
        if self.remote.nats.is_wanted() {
            return None;
        }
        self.data.as_deref()
    }

    /// Memory limit of the process in bytes. A process with a GPU has none, because the driver maps far more memory than
    /// it uses; processes of users' networks have it in any case.
    #[must_use]
    pub fn memory_limit(&self) -> Option<u64> {
        self.memory_bytes.filter(|_| self.engine.device == "cpu")
    }

    /// The command line with these arguments, for a worker process of this machine.
    #[must_use]
    pub fn command_line(&self) -> Vec<std::ffi::OsString> {
        let mut line: Vec<std::ffi::OsString> = vec!["worker".into()];
        let mut option = |name: &str, value: std::ffi::OsString| line.extend([name.into(), value]);
        option("--data", self.data.clone().unwrap_or_default().into());
        option("--device", self.engine.device.clone().into());
        option("--nice", self.engine.nice.to_string().into());
        option("--stall-seconds", self.engine.stall_seconds.to_string().into());
        let format = if self.log_format == LogFormat::Json { "json" } else { "text" };
        option("--log-format", format.into());
        if let Some(library) = &self.engine.onnxruntime {
            option("--onnxruntime", library.clone().into());
        }
        if let Some(models) = &self.engine.models {
            option("--models", models.clone().into());
        }
        option("--takes", self.takes.into_str().into());
        if let Some(id) = self.id {
            option("--id", id.to_string().into());
        }
        if let Some(bytes) = self.memory_bytes {
            option("--memory-bytes", bytes.to_string().into());
        }
        if self.engine.unconfined {
            line.push("--unconfined".into());
        }
        if self.supervised {
            line.push("--supervised".into());
        }
        line
    }
}

#[cfg(test)]
mod tests {
    use super::{ServeArguments, WorkerArguments, bytes};
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Serve {
        #[command(flatten)]
        arguments: ServeArguments,
    }

    #[derive(Debug, Parser)]
    #[command(no_binary_name = true)]
    struct Worker {
        #[command(flatten)]
        arguments: WorkerArguments,
    }

    #[test]
    fn a_public_address_needs_permission_or_tokens() {
        let serve = |listen: &[&str]| {
            let line = [&["serve", "--data", "d"], listen].concat();
            Serve::try_parse_from(line).unwrap().arguments.is_exposed(true)
        };
        assert!(!serve(&[]));
        assert!(!serve(&["--listen", "[::1]:0"]));
        assert!(serve(&["--listen", "0.0.0.0:80"]));
        assert!(!serve(&["--listen", "0.0.0.0:80", "--allow-remote"]));
    }

    #[test]
    fn one_worker_uses_a_gpu_unless_others_are_wanted() {
        let counts = |more: &[&str]| {
            let line = [&["serve", "--data", "d"], more].concat();
            let arguments = Serve::try_parse_from(line).unwrap().arguments;
            (arguments.worker_count(), arguments.host_worker_count())
        };
        let cores = std::thread::available_parallelism().unwrap().get();
        let beside = |workers| cores.saturating_sub(workers).clamp(1, 4);
        assert_eq!(counts(&["--device", "gpu"]), (1, beside(1)));
        assert_eq!(counts(&["--device", "cuda:0", "--workers", "3"]), (3, beside(3)));
        assert_eq!(counts(&["--device", "gpu", "--workers", "0"]), (0, 0));
        assert_eq!(counts(&[]), (cores, 0));
    }

    #[test]
    fn limits_that_would_refuse_everything_are_refused() {
        for option in [
            "max-uploads",
            "max-jobs",
            "worker-memory-bytes",
            "max-upload-bytes",
            "request-seconds",
            "upload-idle-seconds",
        ] {
            let serve = |value: &str| {
                let option = format!("--{option}={value}");
                Serve::try_parse_from(["serve", "--data", "d", &option])
            };
            assert!(serve("0").unwrap_err().to_string().contains(option));
            assert!(serve("1").is_ok(), "{option}");
        }
    }

    #[test]
    fn sizes_are_numbers_with_or_without_a_unit() {
        for (text, size) in [("1000000", 1_000_000), ("10GB", 10_000_000_000), ("8GiB", 8 << 30)] {
            assert_eq!(bytes(text), Ok(size), "{text}");
        }
        for bad in ["", "GB", "-1", "10 XB", "lots"] {
            assert!(bytes(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_worker_of_a_server_elsewhere_has_no_data_folder() {
        let folder = |more: &[&str]| {
            let line = [&["--data", "d"], more].concat();
            let arguments = Worker::try_parse_from(line).unwrap().arguments;
            arguments.data_folder().map(std::path::Path::to_owned)
        };
        assert_eq!(folder(&[]), Some("d".into()));
        assert_eq!(folder(&["--nats", "nats://host:4222"]), None);
        assert_eq!(folder(&["--nats-creds", "gpu.creds"]), None);
    }

    #[test]
    fn a_worker_process_receives_all_arguments() {
        let line = ["--data", "some dir", "--device", "cuda:0", "--nice", "5"];
        let more = [
            "--stall-seconds",
            "7",
            "--onnxruntime",
            "lib.so",
            "--supervised",
            "--unconfined",
            "--memory-bytes",
            "1000",
            "--takes",
            "light",
            "--log-format",
            "json",
        ];
        let arguments = Worker::try_parse_from(line.iter().chain(&more)).unwrap().arguments;
        let received = Worker::try_parse_from(&arguments.command_line()[1..]).unwrap().arguments;
        assert_eq!(format!("{arguments:?}"), format!("{received:?}"));
    }
}
