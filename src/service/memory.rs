//! Memory in use and its budget: an upload that does not fit is refused before it is read.

use fs_err as fs;

use crate::error::{Error, ErrorCode, Result};

/// When to ask again, seconds: by then a scene or a render has ended.
const RETRY_AFTER_S: u32 = 5;

/// The budget of the process.
#[derive(Debug)]
pub(super) struct Memory {
    bytes_max: u64,
}

impl Memory {
    /// A budget of `bytes_max`; 0: four fifths of what the machine or the container has.
    pub(super) fn new(bytes_max: u64) -> Self {
        let found = || installed().map_or(u64::MAX, |bytes| bytes / 5 * 4);
        Self { bytes_max: if bytes_max == 0 { found() } else { bytes_max } }
    }

    /// Refuses `more` bytes where they do not fit.
    pub(super) fn admit(&self, more: usize) -> Result<()> {
        let used = resident().unwrap_or(0);
        if used.saturating_add(more as u64) <= self.bytes_max {
            return Ok(());
        }
        let (max, mib) = (self.bytes_max >> 20, 20);
        let message = format!(
            "memory: {} MiB in use and {} MiB sent are over {max} MiB",
            used >> mib,
            more >> mib
        );
        Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(RETRY_AFTER_S))
    }
}

/// Resident bytes of this process; `None` where the system does not say.
fn resident() -> Option<u64> {
    kib(&fs::read_to_string("/proc/self/status").ok()?, "VmRSS:")
}

/// Bytes that this process may use: the container's bound, else the machine's.
fn installed() -> Option<u64> {
    let machine = kib(&fs::read_to_string("/proc/meminfo").ok()?, "MemTotal:")?;
    let bounds = ["/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"];
    let container =
        bounds.iter().find_map(|path| fs::read_to_string(path).ok()?.trim().parse::<u64>().ok());
    Some(container.map_or(machine, |bytes| bytes.min(machine)))
}

/// A line `NAME 123 kB` as bytes.
fn kib(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find(|line| line.starts_with(name))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fits_is_admitted_and_one_byte_more_is_not() {
        let used = resident().expect("the system says") >> 20 << 20;
        let memory = Memory::new(used + (1 << 30));
        assert!(memory.admit(1 << 29).is_ok());
        let refused = memory.admit((1 << 30) + (64 << 20)).unwrap_err();
        assert_eq!((refused.code(), refused.retry_after()), (ErrorCode::Overloaded, Some(5)));
        assert!(installed().is_some_and(|bytes| bytes > 1 << 28));
    }
}
