//! What workers may do, and the processes that run networks of users, where native code works on what a
//! stranger has sent. They get no more memory than was planned, make no connections, and see the files that they
//! need and no others; a network's process also starts no programs and sends no signals (Landlock, seccomp), as
//! far as the kernel has it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use landlock::{
    ABI, Access, AccessFs, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetError, RulesetStatus,
    path_beneath_rules,
};
use rustix::process::{Resource, Rlimit, setrlimit};
use seccompiler::{BpfProgram, SeccompAction, SeccompFilter};

use crate::config::EngineArguments;
use engine::pipeline::networks::find_library;

/// The newest version of Landlock that was tried; older kernels do what they can.
const LANDLOCK: ABI = ABI::V5;
/// Where libraries lie, and what they look at: processors, devices.
const SYSTEM: [&str; 11] = [
    "/usr",
    "/lib",
    "/lib64",
    "/opt",
    "/nix",
    "/proc",
    "/sys",
    "/etc/ld.so.cache",
    "/etc/ld.so.conf",
    "/etc/ld.so.conf.d",
    "/etc/localtime",
];

/// What leads to other processes.
const CONNECTIONS: [i64; 4] =
    [libc::SYS_socket, libc::SYS_ptrace, libc::SYS_process_vm_readv, libc::SYS_process_vm_writev];
/// What a network does not need, either.
const OTHERS: [i64; 5] = [
    libc::SYS_execve,
    libc::SYS_execveat,
    libc::SYS_kill,
    libc::SYS_tkill,
    libc::SYS_pidfd_send_signal,
];

/// Lets this process take so many bytes of memory.
pub(super) fn limit_memory(bytes: u64) -> Result<(), String> {
    let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
    setrlimit(Resource::Data, limit)
        .map_err(|error| format!("the memory can't be limited: {error}"))
}

/// Gives up what a worker does not need: connections, and all files but these and those of the system. Before
/// it starts any thread. Says what could not be given up.
pub(super) fn confine_worker(readable: &[&Path], writable: &[&Path]) -> Result<(), String> {
    confine(readable, writable, &CONNECTIONS)
}

/// Gives up what a network of a user's does not need: also programs and signals, and all files but the system's
/// and `readable`. Before it starts any thread. Says what could not be given up.
pub(super) fn confine_network(readable: &[&Path]) -> Result<(), String> {
    confine(readable, &[], &[&CONNECTIONS[..], &OTHERS].concat())
}

/// Whether files are kept from networks of users; if not, why.
pub(super) fn confinement(engine: &EngineArguments) -> Result<(), String> {
    let why = if engine.unconfined {
        "--unconfined was given".to_owned()
    } else if engine.device != "cpu" {
        "the driver of a GPU opens what it wants".to_owned()
    } else {
        let Err(why) = files_can_be_kept() else { return Ok(()) };
        why
    };
    Err(format!("networks of users can read every file that the service can: {why}"))
}

/// Whether this kernel can keep files from a process; if not, why. Tried on a thread, which ends.
fn files_can_be_kept() -> Result<(), String> {
    let tried = std::thread::spawn(|| restrict_files(&[], &[]).map_err(|error| error.to_string()));
    enforced(tried.join().unwrap_or_else(|_| Err("Landlock can't be tried".into()))?)
}

fn confine(readable: &[&Path], writable: &[&Path], denied: &[i64]) -> Result<(), String> {
    let files = restrict_files(readable, writable).map_err(|error| error.to_string())?;
    deny(denied).map_err(|error| error.to_string())?;
    enforced(files)
}

fn enforced(files: RulesetStatus) -> Result<(), String> {
    match files {
        RulesetStatus::NotEnforced => Err("this kernel has no Landlock".into()),
        RulesetStatus::FullyEnforced | RulesetStatus::PartiallyEnforced => Ok(()),
    }
}

fn restrict_files(readable: &[&Path], writable: &[&Path]) -> Result<RulesetStatus, RulesetError> {
    // Also where the dynamic linker was told to look.
    let linked = std::env::var_os("LD_LIBRARY_PATH").unwrap_or_default();
    let linked: Vec<PathBuf> = std::env::split_paths(&linked).collect();
    let system = SYSTEM.iter().map(PathBuf::from).chain(linked);
    let program = std::env::current_exe().ok().and_then(|path| Some(path.parent()?.to_owned()));
    let readable = readable.iter().map(|path| path.to_path_buf());
    let readable: Vec<PathBuf> = system.chain(program).chain(readable).collect();
    // Of what is not there no rule is made.
    let status = Ruleset::default()
        .handle_access(AccessFs::from_all(LANDLOCK))?
        .create()?
        .add_rules(path_beneath_rules(readable, AccessFs::from_read(LANDLOCK)))?
        .add_rules(path_beneath_rules(writable, AccessFs::from_all(LANDLOCK)))?
        .add_rules(path_beneath_rules(["/dev"], AccessFs::from_all(LANDLOCK)))?
        .restrict_self()?;
    Ok(status.ruleset)
}

/// The folder of the libonnxruntime that is named, or near the program, and that which it leads to.
pub(super) fn folders_of(named: Option<&Path>) -> Vec<PathBuf> {
    let Ok(library) = find_library(named) else { return Vec::new() };
    let paths = [library.canonicalize().ok(), Some(library)];
    paths.into_iter().flatten().filter_map(|path| Some(path.parent()?.to_owned())).collect()
}

fn deny(calls: &[i64]) -> Result<(), Box<dyn std::error::Error>> {
    let rules: BTreeMap<i64, _> = calls.iter().map(|&call| (call, Vec::new())).collect();
    let refuse = SeccompAction::Errno(u32::try_from(libc::EPERM)?);
    let here = std::env::consts::ARCH.try_into()?;
    let filter: BpfProgram =
        SeccompFilter::new(rules, SeccompAction::Allow, refuse, here)?.try_into()?;
    Ok(seccompiler::apply_filter(&filter)?)
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::process::Command;

    use super::{confine_network, confine_worker, files_can_be_kept};

    /// What a process finds that it can do, after it was confined: on a thread of its own, as both hold for a
    /// thread and what it starts.
    fn found<T: Send>(
        confine: impl FnOnce(&[&Path]) -> Result<(), String> + Send,
        folder: &Path,
        what: impl FnOnce() -> T + Send,
    ) -> T {
        std::thread::scope(|scope| {
            let confined = scope.spawn(|| {
                confine(&[folder]).unwrap();
                what()
            });
            confined.join().unwrap()
        })
    }

    #[test]
    fn a_network_reads_no_files_makes_no_connections_and_starts_nothing() {
        if let Err(why) = files_can_be_kept() {
            eprintln!("SKIPPED: {why}");
            return;
        }
        let (own, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        for folder in [&own, &other] {
            std::fs::write(folder.path().join("file"), "text").unwrap();
        }
        let read = |folder: &Path| std::fs::read(folder.join("file")).is_ok();
        let may = || {
            [
                read(own.path()),
                read(other.path()),
                std::fs::write(own.path().join("new"), "text").is_ok(),
                std::net::UdpSocket::bind("127.0.0.1:0").is_ok(),
                Command::new("true").status().is_ok(),
                rustix::process::test_kill_process(rustix::process::getpid()).is_ok(),
            ]
        };
        assert_eq!(may(), [true; 6]);
        let found_by_network = found(confine_network, own.path(), may);
        assert_eq!(found_by_network, [true, false, false, false, false, false]);
        // A worker starts the processes of networks, and ends them.
        let found_by_worker = found(|readable| confine_worker(readable, &[]), own.path(), may);
        assert_eq!(found_by_worker, [true, false, false, false, true, true]);
        assert_eq!(may(), [true; 6], "another thread was confined");
    }
}
