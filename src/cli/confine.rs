//! Confinement of the processes that run native code on a stranger's data: workers, and networks of users.
//!
//! `RLIMIT_DATA` limits each process to the planned memory. A worker opens no connections and reads only the data
//! folder and the system's libraries. A network's process is limited to an allow-list of system calls: it can use
//! threads and open files for reading. It can't start processes, map shared memory or signal other processes.
//! Landlock restricts the files if the kernel supports it. Seccomp filters the system calls in any case.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use landlock::{
    ABI, Access, AccessFs, AccessNet, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetError,
    RulesetStatus, Scope, path_beneath_rules,
};
use rustix::process::{Resource, Rlimit, setrlimit};
use seccompiler::{
    BackendError, BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition,
    SeccompFilter, SeccompRule,
};

use crate::config::EngineArguments;
use engine::pipeline::networks::find_library;

/// Newest version of Landlock that was tested. Older kernels apply the rules that they support.
const LANDLOCK: ABI = ABI::V6;
/// Paths of libraries, and of information on processors and devices that libraries read.
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

/// Devices that a confined process may open.
const DEVICES: [&str; 5] = ["/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom"];

/// System calls that a worker may not make: they open connections, reach into other processes, or escape the limits.
const DENIED_TO_WORKERS: [i64; 10] = [
    libc::SYS_socket,
    libc::SYS_ptrace,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_io_uring_setup,
    libc::SYS_io_uring_enter,
    libc::SYS_io_uring_register,
    libc::SYS_unshare,
    libc::SYS_setns,
    libc::SYS_pidfd_getfd,
];

/// System calls that a network may make with any arguments: input and output on open files, private memory, threads,
/// time, and information about the process and the machine.
#[rustfmt::skip]
const ALLOWED_TO_NETWORKS: &[i64] = &[
    libc::SYS_read, libc::SYS_write, libc::SYS_readv, libc::SYS_writev, libc::SYS_pread64, libc::SYS_lseek,
    libc::SYS_close, libc::SYS_fstat, libc::SYS_newfstatat, libc::SYS_statx, libc::SYS_fstatfs, libc::SYS_statfs,
    libc::SYS_readlinkat, libc::SYS_faccessat, libc::SYS_faccessat2, libc::SYS_getdents64, libc::SYS_getcwd,
    libc::SYS_ppoll, libc::SYS_brk, libc::SYS_mprotect, libc::SYS_munmap, libc::SYS_mremap, libc::SYS_madvise,
    libc::SYS_futex, libc::SYS_sched_yield, libc::SYS_sched_getaffinity, libc::SYS_membarrier, libc::SYS_rseq,
    libc::SYS_set_robust_list, libc::SYS_nanosleep, libc::SYS_clock_nanosleep, libc::SYS_clock_gettime,
    libc::SYS_clock_getres, libc::SYS_gettimeofday, libc::SYS_getrandom, libc::SYS_getpid, libc::SYS_gettid,
    libc::SYS_getuid, libc::SYS_geteuid, libc::SYS_getgid, libc::SYS_getegid, libc::SYS_getrusage, libc::SYS_uname,
    libc::SYS_sysinfo, libc::SYS_rt_sigaction, libc::SYS_rt_sigprocmask, libc::SYS_rt_sigreturn,
    libc::SYS_sigaltstack, libc::SYS_restart_syscall, libc::SYS_exit, libc::SYS_exit_group,
    // `without_clone3` makes the C library use `clone` instead.
    libc::SYS_clone3,
];

/// Further allowed calls of x86-64, which newer architectures lack.
#[cfg(target_arch = "x86_64")]
#[rustfmt::skip]
const ALLOWED_LEGACY: &[i64] = &[
    libc::SYS_stat, libc::SYS_lstat, libc::SYS_access, libc::SYS_readlink, libc::SYS_poll, libc::SYS_arch_prctl,
    libc::SYS_time, libc::SYS_getdents, libc::SYS_getrlimit,
];
#[cfg(not(target_arch = "x86_64"))]
const ALLOWED_LEGACY: &[i64] = &[];

/// Limits the memory of this process.
pub(super) fn limit_memory(bytes: u64) -> Result<(), String> {
    let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
    setrlimit(Resource::Data, limit)
        .map_err(|error| format!("the memory can't be limited: {error}"))
}

/// Confines this process as a worker, which may read the folders in `readable` and those of the system, and write
/// to those in `writable`. Must run before the process starts a thread.
/// Errors: the kernel lacks a part of the confinement; the text names it.
pub(super) fn confine_worker(readable: &[&Path], writable: &[&Path]) -> Result<(), String> {
    let rules = DENIED_TO_WORKERS.iter().map(|&call| (call, Vec::new())).collect();
    let filter = filter(rules, SeccompAction::Allow, refusal(libc::EPERM)).map_err(text)?;
    confine(readable, writable, &[filter])
}

/// Confines this process as the network of a user, which may read the system's libraries and `readable`. Must run
/// before the process starts a thread.
/// Errors: the kernel lacks a part of the confinement; the text names it.
pub(super) fn confine_network(readable: &[&Path]) -> Result<(), String> {
    let rules = network_rules().map_err(text)?;
    let allowed = filter(rules, refusal(libc::EPERM), SeccompAction::Allow).map_err(text)?;
    // The allow-list comes last, because it forbids to install another filter.
    confine(readable, &[], &[without_clone3().map_err(text)?, allowed])
}

/// Checks whether networks of users are kept from files. The error is the reason why they are not.
pub(super) fn confinement(engine: &EngineArguments) -> Result<(), String> {
    let reason = if engine.unconfined {
        "--unconfined was given".to_owned()
    } else {
        let Err(reason) = check_landlock() else { return Ok(()) };
        reason
    };
    Err(format!("networks of users can read every file that the service can: {reason}"))
}

/// Checks on a short-lived thread whether this kernel can restrict the files of a process.
fn check_landlock() -> Result<(), String> {
    let thread = std::thread::spawn(|| restrict_files(&[], &[]).map_err(|error| error.to_string()));
    enforced(thread.join().unwrap_or_else(|_| Err("Landlock can't be tested".into()))?)
}

fn confine(readable: &[&Path], writable: &[&Path], filters: &[BpfProgram]) -> Result<(), String> {
    let files = restrict_files(readable, writable).map_err(text)?;
    filters.iter().try_for_each(|filter| seccompiler::apply_filter(filter)).map_err(text)?;
    enforced(files)
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

fn enforced(files: RulesetStatus) -> Result<(), String> {
    match files {
        RulesetStatus::NotEnforced => Err("this kernel has no Landlock".into()),
        RulesetStatus::FullyEnforced | RulesetStatus::PartiallyEnforced => Ok(()),
    }
}

fn restrict_files(readable: &[&Path], writable: &[&Path]) -> Result<RulesetStatus, RulesetError> {
    // The dynamic linker also searches these folders.
    let library_path = std::env::var_os("LD_LIBRARY_PATH").unwrap_or_default();
    let library_path: Vec<PathBuf> = std::env::split_paths(&library_path).collect();
    let system = SYSTEM.iter().map(PathBuf::from).chain(library_path);
    let program = std::env::current_exe().ok().and_then(|path| Some(path.parent()?.to_owned()));
    let readable = readable.iter().map(|path| path.to_path_buf());
    let readable: Vec<PathBuf> = system.chain(program).chain(readable).collect();
    // Paths that do not exist get no rule.
    let status = Ruleset::default()
        .handle_access(AccessFs::from_all(LANDLOCK))?
        .handle_access(AccessNet::from_all(LANDLOCK))?
        .scope(Scope::from_all(LANDLOCK))?
        .create()?
        .add_rules(path_beneath_rules(readable, AccessFs::from_read(LANDLOCK)))?
        .add_rules(path_beneath_rules(writable, AccessFs::from_all(LANDLOCK)))?
        .add_rules(path_beneath_rules(DEVICES, AccessFs::from_file(LANDLOCK)))?
        .restrict_self()?;
    Ok(status.ruleset)
}

/// The folder of libonnxruntime, and the folder that the library links to. The library is the one that is named, or one
/// near the program.
pub(super) fn folders_of(named: Option<&Path>) -> Vec<PathBuf> {
    let Ok(library) = find_library(named) else { return Vec::new() };
    let paths = [library.canonicalize().ok(), Some(library)];
    paths.into_iter().flatten().filter_map(|path| Some(path.parent()?.to_owned())).collect()
}

type Rules = BTreeMap<i64, Vec<SeccompRule>>;

/// The allow-list of a network's process.
fn network_rules() -> Result<Rules, BackendError> {
    let mut rules: Rules = [ALLOWED_TO_NETWORKS, ALLOWED_LEGACY]
        .concat()
        .into_iter()
        .map(|call| (call, Vec::new()))
        .collect();
    let bits = |argument, mask: libc::c_int, value: libc::c_int| {
        let (mask, value) = (mask.unsigned_abs().into(), value.unsigned_abs().into());
        SeccompCondition::new(
            argument,
            SeccompCmpArgLen::Dword,
            SeccompCmpOp::MaskedEq(mask),
            value,
        )
    };
    let equals = |argument, value: u64| {
        SeccompCondition::new(argument, SeccompCmpArgLen::Qword, SeccompCmpOp::Eq, value)
    };
    let mut allow = |call, conditions: Vec<SeccompCondition>| -> Result<(), BackendError> {
        rules.entry(call).or_default().push(SeccompRule::new(conditions)?);
        Ok(())
    };
    // Allows threads but no processes.
    allow(libc::SYS_clone, vec![bits(0, libc::CLONE_THREAD, libc::CLONE_THREAD)?])?;
    // Shared mappings outlive a process and escape its limit of memory.
    let kind = libc::MAP_SHARED | libc::MAP_PRIVATE;
    allow(libc::SYS_mmap, vec![bits(3, kind, libc::MAP_PRIVATE)?])?;
    // Files open only for reading, even without Landlock.
    let writes = libc::O_ACCMODE | libc::O_CREAT | libc::O_TRUNC;
    allow(libc::SYS_openat, vec![bits(2, writes, libc::O_RDONLY)?])?;
    #[cfg(target_arch = "x86_64")]
    allow(libc::SYS_open, vec![bits(1, writes, libc::O_RDONLY)?])?;
    // Signals reach only this process; `abort` needs them.
    let process = rustix::process::getpid().as_raw_nonzero().get().unsigned_abs();
    allow(libc::SYS_tgkill, vec![equals(0, process.into())?])?;
    // Limits can be read but not set.
    allow(libc::SYS_prlimit64, vec![equals(0, 0)?, equals(2, 0)?])?;
    let commands =
        [libc::F_GETFD, libc::F_SETFD, libc::F_GETFL, libc::F_DUPFD, libc::F_DUPFD_CLOEXEC];
    for command in commands {
        allow(libc::SYS_fcntl, vec![equals(1, command.unsigned_abs().into())?])?;
    }
    allow(libc::SYS_ioctl, vec![equals(1, libc::TCGETS)?])?;
    for option in [libc::PR_SET_NAME, libc::PR_GET_NAME] {
        allow(libc::SYS_prctl, vec![equals(0, option.unsigned_abs().into())?])?;
    }
    Ok(rules)
}

/// Answers `clone3` like a kernel that lacks it, so that the C library calls `clone`. A filter can't see the flags of
/// `clone3`, which lie in memory.
fn without_clone3() -> Result<BpfProgram, BackendError> {
    filter([(libc::SYS_clone3, vec![])].into(), SeccompAction::Allow, refusal(libc::ENOSYS))
}

fn refusal(error: libc::c_int) -> SeccompAction {
    SeccompAction::Errno(error.unsigned_abs())
}

/// A filter that answers calls with `matched` if a rule applies, and with `otherwise` if none does.
fn filter(
    rules: Rules,
    otherwise: SeccompAction,
    matched: SeccompAction,
) -> Result<BpfProgram, BackendError> {
    SeccompFilter::new(rules, otherwise, matched, std::env::consts::ARCH.try_into()?)?.try_into()
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::process::Command;

    use super::{check_landlock, confine_network, confine_worker};

    /// Runs `action` on a thread that is confined. Confinement applies to a thread and its children.
    fn when_confined<T: Send>(
        confine: impl FnOnce(&[&Path]) -> Result<(), String> + Send,
        folder: &Path,
        action: impl FnOnce() -> T + Send,
    ) -> T {
        std::thread::scope(|scope| {
            let confined = scope.spawn(|| {
                confine(&[folder]).unwrap();
                action()
            });
            confined.join().unwrap()
        })
    }

    #[test]
    fn a_network_reads_no_files_makes_no_connections_and_starts_nothing() {
        if let Err(reason) = check_landlock() {
            eprintln!("SKIPPED: {reason}");
            return;
        }
        let (allowed, denied) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        for folder in [&allowed, &denied] {
            std::fs::write(folder.path().join("file"), "text").unwrap();
        }
        let read = |folder: &Path| std::fs::read(folder.join("file")).is_ok();
        let permissions = || {
            [
                read(allowed.path()),
                read(denied.path()),
                std::fs::write(allowed.path().join("new"), "text").is_ok(),
                std::net::UdpSocket::bind("127.0.0.1:0").is_ok(),
                Command::new("true").status().is_ok(),
                rustix::process::test_kill_process(rustix::process::getpid()).is_ok(),
            ]
        };
        assert_eq!(permissions(), [true; 6]);
        let network_permissions = when_confined(confine_network, allowed.path(), permissions);
        assert_eq!(network_permissions, [true, false, false, false, false, false]);
        // A worker must start and end the processes of networks.
        let confine = |readable: &[&Path]| confine_worker(readable, &[]);
        let worker_permissions = when_confined(confine, allowed.path(), permissions);
        assert_eq!(worker_permissions, [true, false, false, false, true, true]);
        assert_eq!(permissions(), [true; 6], "another thread was confined");
    }
}
