//! What this process has used of the machine.

use std::fs;

use rustix::param::clock_ticks_per_second;
use rustix::time::{ClockId, clock_gettime};

/// Processor time, user and system together, of this process and of its children that have
/// ended, in seconds.
pub fn cpu_seconds() -> f64 {
    let own = clock_gettime(ClockId::ProcessCPUTime);
    let own = own.tv_sec as f64 + own.tv_nsec as f64 * 1e-9;
    own + children_ticks() as f64 / clock_ticks_per_second() as f64
}

/// Clock ticks of children that have been waited for; 0 where /proc can't be read.
fn children_ticks() -> u64 {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The second field is the program's name in parentheses and may hold spaces; cutime and
    // cstime are fields 16 and 17, so the 14th and 15th after it.
    let after_name = stat.rsplit_once(')').map_or("", |(_, rest)| rest);
    after_name.split_whitespace().skip(13).take(2).filter_map(|f| f.parse::<u64>().ok()).sum()
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

#[cfg(test)]
mod tests {
    use super::{cpu_seconds, peak_rss_bytes};

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
