//! `sci-recon cluster`: the message server for workers on other machines, and who may use it.

use std::path::PathBuf;

use clap::{Args, Subcommand};

use super::CliError;
use super::wait::wait;
use crate::config::{NatsArguments, VERSION};
use engine::job::{Pool, Timestamp};
use workers::nats::{Authority, Check, ClusterError, Node, Program, ServerVersion, configuration};

/// Sets up the NATS server for workers on other machines, makes and revokes their credentials, and says
/// what is missing.
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

/// Makes keys, certificates, and a configuration of nats-server for each node.
#[derive(Debug, Args)]
struct Init {
    #[command(flatten)]
    folder: Folder,

    /// A node of the NATS server as workers reach it; again for each node, 3 of them for a server that
    /// outlives one.
    #[arg(long = "node", value_name = "HOST[:PORT]", default_value = "127.0.0.1:4222")]
    nodes: Vec<Node>,

    /// Folder for messages on the machine of a node [default: `store` in the folder of the keys].
    #[arg(long, value_name = "DIR")]
    store: Option<PathBuf>,

    /// The most bytes in it.
    #[arg(long, value_name = "N", default_value_t = 20 << 30)]
    store_bytes: u64,

    /// Version of the nodes' nats-server, such as 2.12 [default: that on this machine, or else a current one].
    #[arg(long, value_name = "VERSION")]
    nats_version: Option<ServerVersion>,

    /// Without encryption: for one machine, or a network of its own.
    #[arg(long)]
    no_tls: bool,
}

/// Credentials of workers.
#[derive(Debug, Args)]
struct Worker {
    #[command(subcommand)]
    command: WorkerCommand,
}

#[derive(Debug, Subcommand)]
enum WorkerCommand {
    /// Makes a credential for the workers of a pool: one file, which is all that they need.
    Create {
        #[command(flatten)]
        folder: Folder,
        /// The pool. Its workers see the tiles of every lab.
        #[arg(long)]
        pool: Pool,
        /// A name for it [default: the pool's].
        #[arg(long)]
        name: Option<String>,
        /// Days until it ends.
        #[arg(long, default_value_t = 365, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
        /// The file to write [default: NAME.creds].
        #[arg(long, value_name = "FILE")]
        out: Option<PathBuf>,
    },
    /// Lists the credentials that were made.
    List {
        #[command(flatten)]
        folder: Folder,
    },
    /// Revokes the credentials of a pool: who uses them is cut off at once.
    Revoke {
        #[command(flatten)]
        folder: Folder,
        /// The pool.
        #[arg(long)]
        pool: Pool,
        /// This one alone [default: all of the pool].
        #[arg(long)]
        name: Option<String>,
    },
}

/// Says in words whether a server, or a worker with its credential, can work, and what is missing.
#[derive(Debug, Args)]
struct CheckArguments {
    #[command(flatten)]
    nats: NatsArguments,
}

#[derive(Debug, Args)]
struct Folder {
    /// Folder with the keys of the cluster. Who has it can make credentials.
    #[arg(
        long = "keys",
        env = "SCI_RECON_CLUSTER_KEYS",
        value_name = "DIR",
        default_value = "cluster"
    )]
    path: PathBuf,
}

/// Does what was asked.
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
    let made = configuration::write(&authority, &folder.path, nodes, disk, tls, *nats_version)?;
    for file in made.files {
        println!("nats-server -c {}", file.display());
    }
    let hub = folder.path.join(workers::nats::HUB_CREDENTIAL);
    println!("sci-recon serve --nats-creds {} ...", hub.display());
    println!("sci-recon cluster worker create --keys {} --pool NAME", folder.path.display());
    for warning in made.warnings {
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
            println!("{}", out.display());
        }
        WorkerCommand::List { folder } => {
            println!("{:24} {:16} {:8} {:20} key", "name", "pool", "state", "ends");
            let now = Timestamp::now().0 / 1000;
            for worker in Authority::open(&folder.path)?.workers() {
                let state = match worker.revoked_at {
                    Some(_) => "revoked",
                    None if worker.expires_at <= now => "ended",
                    None => "good",
                };
                let ends = Timestamp(worker.expires_at * 1000).to_string();
                println!(
                    "{:24} {:16} {state:8} {:20} {}",
                    worker.name,
                    worker.pool.as_str(),
                    ends.get(..19).unwrap_or(&ends),
                    worker.key
                );
            }
        }
        WorkerCommand::Revoke { folder, pool, name } => {
            let mut authority = Authority::open(&folder.path)?;
            let revoked = authority.revoke(pool, name.as_deref())?;
            // Also when all were revoked before: the message server may not have been told.
            wait(authority.publish())?;
            for name in revoked {
                println!("revoked {name}");
            }
        }
    }
    Ok(())
}

fn examine(check: &CheckArguments) -> Result<(), CliError> {
    let NatsArguments { nats, nats_creds } = &check.nats;
    let checks = wait(Check::run(nats.as_deref(), nats_creds.as_deref(), Program::of(VERSION)))?;
    let bad = checks.iter().filter(|check| !check.good).count();
    for Check { what, good, found } in checks {
        println!("{} {what}: {found}", if good { "ok     " } else { "missing" });
    }
    if bad == 0 { Ok(()) } else { Err(CliError::Failure(format!("{bad} things are missing"))) }
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
