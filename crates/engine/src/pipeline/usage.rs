//! What this process has used of the machine.

use std::fs;

use rustix::param::clock_ticks_per_second;
use rustix::time::{ClockId, clock_gettime};

/// Processor time, user and system together, of this process and of its children that have
/// ended, in seconds.
pub fn cpu_seconds() -> f64 {
    let own = clock_gettime(ClockId::ProcessCPUTime);
    let own = own.tv_sec as f64 + own.tv_nsec as f64 * 1e-9;
    own + ticks("/proc/self/stat", CUTIME)
}

/// The same of another process without its children, to a hundredth of a second; 0 if it is gone.
pub fn cpu_seconds_of(process: u32) -> f64 {
    ticks(&format!("/proc/{process}/stat"), UTIME)
}

/// The fields of a process's time in user mode and of that of its ended children, counted from the one after
/// its name; the time in the kernel follows each.
const UTIME: usize = 11;
const CUTIME: usize = 13;

/// Seconds in two fields that count clock ticks; 0 where /proc can't be read.
fn ticks(stat: &str, field: usize) -> f64 {
    let stat = fs::read_to_string(stat).unwrap_or_default();
    // The name stands in parentheses and may hold spaces.
    let after_name = stat.rsplit_once(')').map_or("", |(_, rest)| rest);
    let fields = after_name.split_whitespace().skip(field).take(2);
    let ticks: u64 = fields.filter_map(|field| field.parse::<u64>().ok()).sum();
    ticks as f64 / clock_ticks_per_second() as f64
}

/// Largest resident memory of this process so far in bytes (VmHWM); 0 where /proc can't be read.
pub fn peak_rss_bytes() -> u64 {
    peak_rss_in("/proc/self/status")
}

/// The same of another process; 0 if it is gone.
pub fn peak_rss_of(process: u32) -> u64 {
    peak_rss_in(&format!("/proc/{process}/status"))
}

fn peak_rss_in(status: &str) -> u64 {
    let status = fs::read_to_string(status).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kibibytes = line.and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok());
    kibibytes.unwrap_or(0) * 1024
}

/// How often the kernel has killed a process of this control group for want of memory; none if it does not
/// tell.
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
    fn work_shows() {
        let before = cpu_seconds();
        let mut sum = 0.0f64;
        let mut number = 0u32;
        while cpu_seconds() - before < 0.02 {
            number = number.wrapping_add(1);
            sum += f64::from(number).sqrt();
        }
        assert!(sum > 0.0);
        let (all, own) = (cpu_seconds(), cpu_seconds_of(std::process::id()));
        assert!(own <= all + 0.02 && own > 0.0, "{own} of {all}");
        let big = std::hint::black_box(vec![1u8; 64 << 20]);
        assert!(peak_rss_bytes() > big.len() as u64);
    }

    #[test]
    fn children_count_when_they_have_ended() {
        let before = cpu_seconds();
        let script = "i=0; while [ $i -lt 300000 ]; do i=$((i+1)); done";
        let status = std::process::Command::new("sh").args(["-c", script]).status().unwrap();
        assert!(status.success());
        assert!(cpu_seconds() - before > 0.05);
    }
}
