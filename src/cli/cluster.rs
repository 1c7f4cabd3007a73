//! `sci-recon cluster`: configures the message server for workers on other machines, and manages credentials.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::CliError;
use super::output::print_line;
use super::wait::wait;
use crate::config::{NatsArguments, VERSION};
use engine::job::{Pool, Timestamp};
use engine::pipeline::networks::NetworkSource;
use reconstruction::priors::onnx::Device;
use workers::nats::{Authority, Check, ClusterError, Node, Program, ServerVersion, configuration};

/// Set up workers on other machines: keys, credentials, connection.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Init(Init),
    Worker(Worker),
    Check(CheckArguments),
}

/// Create keys, certificates, and a configuration of nats-server for each node.
#[derive(Debug, Args)]
struct Init {
    #[command(flatten)]
    folder: Folder,

    /// A node of the NATS server, as workers reach it; may be repeated. With 3 nodes, the server survives the loss of
    /// one.
    #[arg(long = "node", value_name = "HOST[:PORT]", default_value = "127.0.0.1:4222")]
    nodes: Vec<Node>,

    /// Folder for messages on the machine of a node [default: `store` in the folder of the keys].
    #[arg(long, value_name = "DIR")]
    store: Option<PathBuf>,

    /// Limit of the folder's size in bytes.
    #[arg(long, value_name = "N", default_value_t = 20 << 30)]
    store_bytes: u64,

    /// Version of the nodes' nats-server, such as 2.12 [default: the version on this machine, or a current one].
    #[arg(long, value_name = "VERSION")]
    nats_version: Option<ServerVersion>,

    /// Do not encrypt connections: for a single machine or an isolated network.
    #[arg(long)]
    no_tls: bool,
}

/// Manage the credentials of workers.
#[derive(Debug, Args)]
struct Worker {
    #[command(subcommand)]
    command: WorkerCommand,
}

#[derive(Debug, Subcommand)]
enum WorkerCommand {
    /// Create a credential for the workers of a pool: one file with everything they need.
    Create {
        #[command(flatten)]
        folder: Folder,
        /// The pool. Its workers see the tiles of every lab.
        #[arg(long)]
        pool: Pool,
        /// Name of the credential [default: the pool's].
        #[arg(long)]
        name: Option<String>,
        /// Days until it expires.
        #[arg(long, default_value_t = 365, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
        /// The file to write [default: NAME.creds].
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// List all credentials.
    List {
        #[command(flatten)]
        folder: Folder,
    },
    /// Revoke the credentials of a pool: workers that use them are disconnected at once.
    Revoke {
        #[command(flatten)]
        folder: Folder,
        /// The pool.
        #[arg(long)]
        pool: Pool,
        /// Revoke only the credential with this name [default: all of the pool].
        #[arg(long)]
        name: Option<String>,
    },
}

/// Check whether a server, or a worker with its credential, can work, and list missing requirements.
#[derive(Debug, Args)]
struct CheckArguments {
    #[command(flatten)]
    nats: NatsArguments,
}

#[derive(Debug, Args)]
struct Folder {
    /// Folder with the keys of the cluster. Keep it secret: it allows to create credentials.
    #[arg(
        long = "keys",
        env = "SCI_RECON_CLUSTER_KEYS",
        value_name = "DIR",
        default_value = "cluster"
    )]
    path: PathBuf,
}

pub fn run(arguments: &Arguments) -> Result<(), CliError> {
    match &arguments.command {
        Command::Init(init) => make(init),
        Command::Worker(worker) => credentials(&worker.command),
        Command::Check(check) => examine(check),
    }
}

fn make(init: &Init) -> Result<(), CliError> {
    let Init { folder, nodes, store, store_bytes, nats_version, no_tls } = init;
    let tls = !no_tls;
    let store = store.clone().unwrap_or_else(|| folder.path.join("store"));
    let url = configuration::url(nodes, tls);
    let authority = Authority::create(&folder.path, &url)?;
    if tls {
        configuration::make_certificates(&folder.path, nodes)?;
    }
    authority.write_own_credentials()?;
    let disk = (store.as_path(), *store_bytes);
    let configured =
        configuration::write(&authority, &folder.path, nodes, disk, tls, *nats_version)?;
    for file in configured.files {
        print_line(format!("nats-server -c {}", file.display()))?;
    }
    let hub = folder.path.join(workers::nats::HUB_CREDENTIAL);
    print_line(format!("sci-recon serve --nats-creds {} ...", hub.display()))?;
    print_line(format!(
        "sci-recon cluster worker create --keys {} --pool NAME",
        folder.path.display()
    ))?;
    for warning in configured.warnings {
        eprintln!("warning: {warning}");
    }
    Ok(())
}

fn credentials(command: &WorkerCommand) -> Result<(), CliError> {
    match command {
        WorkerCommand::Create { folder, pool, name, days, out } => {
            let name = name.as_deref().unwrap_or(pool.as_str());
            let out = out.clone().unwrap_or_else(|| PathBuf::from(format!("{name}.creds")));
            Authority::open(&folder.path)?.create_worker(pool, name, *days, &out)?;
            print_line(out.display())?;
        }
        WorkerCommand::List { folder } => {
            print_line(format!("{:24} {:16} {:8} {:20} key", "name", "pool", "state", "expires"))?;
            let now = Timestamp::now().0 / 1000;
            for worker in Authority::open(&folder.path)?.workers() {
                let state = match worker.revoked_at {
                    Some(_) => "revoked",
                    None if worker.expires_at <= now => "expired",
                    None => "valid",
                };
                let expires = Timestamp(worker.expires_at * 1000).to_string();
                print_line(format!(
                    "{:24} {:16} {state:8} {:20} {}",
                    worker.name,
                    worker.pool.as_str(),
                    expires.get(..19).unwrap_or(&expires),
                    worker.key
                ))?;
            }
        }
        WorkerCommand::Revoke { folder, pool, name } => {
            let mut authority = Authority::open(&folder.path)?;
            let revoked = authority.revoke(pool, name.as_deref())?;
            // Repeats earlier revocations too, in case the message server has missed one.
            wait(authority.publish())?;
            for name in revoked {
                print_line(format!("revoked {name}"))?;
            }
        }
    }
    Ok(())
}

fn examine(check: &CheckArguments) -> Result<(), CliError> {
    let NatsArguments { nats, nats_creds } = &check.nats;
    let program = Program::of(VERSION, &NetworkSource::new(None, Device::Cpu));
    let checks = wait(Check::run(nats.as_deref(), nats_creds.as_deref(), program))?;
    let bad = checks.iter().filter(|check| !check.good).count();
    for Check { what, good, found } in checks {
        print_line(format!("{} {what}: {found}", if good { "ok     " } else { "missing" }))?;
    }
    if bad == 0 { Ok(()) } else { Err(CliError::Failure(format!("{bad} checks have failed"))) }
}

impl From<ClusterError> for CliError {
    fn from(error: ClusterError) -> Self {
        match error {
            ClusterError::Nats { .. } | ClusterError::Unreachable { .. } => {
                Self::Failure(error.to_string())
            }
            _ => Self::Input(error.to_string()),
        }
    }
}
