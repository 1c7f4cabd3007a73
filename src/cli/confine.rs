//! What processes may do that run networks of users: native code works on what a stranger has sent. They
//! get no more memory than was planned, make no connections, start no programs, and see the files that they
//! need and no others (Landlock, seccomp), as far as the kernel has it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use landlock::{
    ABI, Access, AccessFs, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetError, RulesetStatus,
    path_beneath_rules,
};
use rustix::process::{Resource, Rlimit, setrlimit};
use seccompiler::{BpfProgram, SeccompAction, SeccompFilter};

use crate::pipeline::networks::find_library;

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

/// Lets this process take so many bytes of memory.
pub(super) fn limit_memory(bytes: u64) -> Result<(), String> {
    let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
    setrlimit(Resource::Data, limit)
        .map_err(|error| format!("the memory can't be limited: {error}"))
}

/// Gives up what a worker or a check does not need: connections, programs, and all files but these and those
/// of the system. Before it starts any thread. Says what could not be given up.
pub(super) fn confine(readable: &[&Path], writable: &[&Path]) -> Result<(), String> {
    let files = restrict_files(readable, writable).map_err(|error| error.to_string())?;
    restrict_calls().map_err(|error| error.to_string())?;
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

fn restrict_calls() -> Result<(), Box<dyn std::error::Error>> {
    let denied = [
        libc::SYS_socket,
        libc::SYS_execve,
        libc::SYS_execveat,
        libc::SYS_ptrace,
        libc::SYS_process_vm_readv,
        libc::SYS_process_vm_writev,
    ];
    let rules: BTreeMap<i64, _> = denied.into_iter().map(|call| (call, Vec::new())).collect();
    let refuse = SeccompAction::Errno(u32::try_from(libc::EPERM)?);
    let here = std::env::consts::ARCH.try_into()?;
    let filter: BpfProgram =
        SeccompFilter::new(rules, SeccompAction::Allow, refuse, here)?.try_into()?;
    Ok(seccompiler::apply_filter(&filter)?)
}
