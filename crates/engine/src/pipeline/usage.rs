//! Resource usage of processes: CPU time, peak memory, and out-of-memory kills.

use std::fs;

use rustix::param::clock_ticks_per_second;
use rustix::time::{ClockId, clock_gettime};

/// CPU time (user and system) in seconds of this process and its terminated children.
pub fn cpu_seconds() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    let time = time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9;
    time + seconds_in_fields("/proc/self/stat", CUTIME)
}

/// CPU time in seconds of another process without its children, with a resolution of 10 ms; 0 if the process does not
/// exist.
pub fn cpu_seconds_of(process: u32) -> f64 {
    seconds_in_fields(&format!("/proc/{process}/stat"), UTIME)
}

/// Index of the user time in `/proc/PID/stat`, counted after the process name. The system time follows it.
const UTIME: usize = 11;
/// Index of the user time of terminated children. Their system time follows it.
const CUTIME: usize = 13;

/// Sum, in seconds, of a field in clock ticks and the next one; 0 if the file can't be read.
fn seconds_in_fields(stat: &str, field: usize) -> f64 {
    let stat = fs::read_to_string(stat).unwrap_or_default();
    // The process name is in parentheses and may contain spaces.
    let after_name = stat.rsplit_once(')').map_or("", |(_, rest)| rest);
    let fields = after_name.split_whitespace().skip(field).take(2);
    let ticks: u64 = fields.filter_map(|field| field.parse::<u64>().ok()).sum();
    ticks as f64 / clock_ticks_per_second() as f64
}

/// Peak resident memory (VmHWM) of this process in bytes; 0 if /proc can't be read.
pub fn peak_rss_bytes() -> u64 {
    peak_rss_in("/proc/self/status")
}

/// Peak resident memory of another process in bytes; 0 if the process does not exist.
pub fn peak_rss_of(process: u32) -> u64 {
    peak_rss_in(&format!("/proc/{process}/status"))
}

fn peak_rss_in(status: &str) -> u64 {
    let status = fs::read_to_string(status).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kibibytes = line.and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok());
    kibibytes.unwrap_or(0) * 1024
}

/// Number of out-of-memory kills in the control group of this process; `None` if the kernel does not report it.
pub fn kills_for_memory() -> Option<u64> {
    let groups = fs::read_to_string("/proc/self/cgroup").ok()?;
    let file = groups.lines().find_map(|line| {
        let (controllers, path) = line.split_once(':')?.1.split_once(':')?;
        let path = path.trim_end_matches('/');
        match controllers {
            "" => Some(format!("/sys/fs/cgroup{path}/memory.events")),
            "memory" => Some(format!("/sys/fs/cgroup/memory{path}/memory.oom_control")),
            _ => None,
        }
    })?;
    let events = fs::read_to_string(file).ok()?;
    let line = events.lines().find_map(|line| line.strip_prefix("oom_kill "))?;
    line.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::{cpu_seconds, cpu_seconds_of, peak_rss_bytes};

    #[test]
    fn cpu_time_and_peak_memory_grow_with_work() {
        let before = cpu_seconds();
        let mut sum = 0.0f64;
        let mut number = 0u32;
        while cpu_seconds() - before < 0.02 {
            number = number.wrapping_add(1);
            sum += f64::from(number).sqrt();
        }
        assert!(sum > 0.0);
        let (all, process) = (cpu_seconds(), cpu_seconds_of(std::process::id()));
        assert!(process <= all + 0.02 && process > 0.0, "{process} of {all}");
        let big = std::hint::black_box(vec![1u8; 64 << 20]);
        assert!(peak_rss_bytes() > big.len() as u64);
    }

    #[test]
    fn terminated_children_are_included() {
        let before = cpu_seconds();
        let script = "i=0; while [ $i -lt 300000 ]; do i=$((i+1)); done";
        let status = std::process::Command::new("sh").args(["-c", script]).status().unwrap();
        assert!(status.success());
        assert!(cpu_seconds() - before > 0.05);
    }
}
