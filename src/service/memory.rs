//! Memory in use and its budgets: an upload that does not fit is refused before it is read, a
//! picture before it is drawn, a file before it is written.

use std::{sync::Arc, time::Duration};

use fs_err as fs;
use parking_lot::Mutex;
use tokio::{sync::Notify, time::Instant};

use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
};

/// When to ask again, seconds: by then a scene or a render has ended.
const RETRY_AFTER_S: u32 = 5;
/// One answer may take this share of what is left, so that a few large ones leave room for small
/// ones.
const ROOM_SHARE: u64 = 4;
/// The share of the memory that answers may hold.
const ANSWERS_SHARE: u64 = 4;
/// An answer of so many bytes must also fit in the memory as it is now.
const LARGE_ANSWER_BYTES: u64 = 16 << 20;
/// How often it is looked whether there is room again.
const LOOK_AGAIN: Duration = Duration::from_millis(100);

/// Bytes or places of which there are not enough for all.
#[derive(Debug, Default)]
struct Budget {
    taken: Mutex<u64>,
    freed: Notify,
}

/// A part of a budget, given back when dropped.
#[derive(Debug)]
pub struct Share {
    of: Arc<Budget>,
    size: u64,
}

impl Share {
    /// Gives back all but `size`.
    pub(super) fn shrink(&mut self, size: u64) {
        let less = self.size.saturating_sub(size);
        self.size -= less;
        *self.of.taken.lock() -= less;
        self.of.freed.notify_waiters();
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        self.shrink(0);
    }
}

impl Budget {
    /// Takes `size` where `fits` says so of what is taken already; else says how much that is.
    fn take(self: &Arc<Self>, size: u64, fits: impl FnOnce(u64) -> bool) -> Result<Share, u64> {
        let mut taken = self.taken.lock();
        if !fits(*taken) {
            return Err(*taken);
        }
        *taken += size;
        Ok(Share { of: Arc::clone(self), size })
    }
}

/// The budgets of the process.
#[derive(Debug)]
pub(super) struct Memory {
    bytes_max: u64,
    /// Bytes of answers, from the start of their drawing until they are sent.
    answers: Arc<Budget>,
    /// Exports, and bytes that they take while they are written.
    exports: [Arc<Budget>; 2],
}

impl Memory {
    /// A budget of `bytes_max`; 0: four fifths of what the machine or the container has.
    pub(super) fn new(bytes_max: u64) -> Self {
        let found = || installed().map_or(u64::MAX, |bytes| bytes / 5 * 4);
        let bytes_max = if bytes_max == 0 { found() } else { bytes_max };
        Self { bytes_max, answers: Arc::default(), exports: Default::default() }
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

    /// Bytes for an answer, which are taken until they are sent.
    pub(super) fn answer(&self, bytes: u64, limits: &Limits) -> Result<Share> {
        if bytes >= LARGE_ANSWER_BYTES {
            self.admit(usize::try_from(bytes).unwrap_or(usize::MAX))?;
        }
        let max = limits.answers_bytes_max.min(self.bytes_max / ANSWERS_SHARE);
        let fits = |taken: u64| taken == 0 || bytes <= max.saturating_sub(taken) / ROOM_SHARE;
        self.answers.take(bytes, fits).map_err(|taken| {
            let message = format!(
                "answers of {} MiB are not sent yet; {} MiB more are too many of {} MiB",
                taken >> 20,
                bytes >> 20,
                max >> 20
            );
            Error::new(ErrorCode::Overloaded, message).retry_after_s(1)
        })
    }

    /// The same, where the caller can wait for room.
    pub(super) async fn answer_by(
        &self,
        bytes: u64,
        limits: &Limits,
        until: Instant,
    ) -> Result<Share> {
        loop {
            let freed = self.answers.freed.notified();
            match self.answer(bytes, limits) {
                Err(error) if Instant::now() >= until => return Err(error),
                // There may be room in the memory without a word from the budget.
                Err(_) => drop(tokio::time::timeout(LOOK_AGAIN, freed).await),
                share => return share,
            }
        }
    }

    /// A place for an export that takes so many bytes while it is written.
    pub(super) fn export(&self, bytes: u64, limits: &Limits) -> Result<[Share; 2]> {
        let [places, memory] = &self.exports;
        let (most, bytes_max) = (limits.exports_max, limits.exports_bytes_max);
        let refused =
            |why: String| Error::new(ErrorCode::Overloaded, why).retry_after_s(RETRY_AFTER_S);
        let place = places.take(1, |taken| taken < most as u64).map_err(|taken| {
            refused(format!("{taken} exports are being sent already; {most} may be"))
        })?;
        let bytes = bytes.min((bytes_max / 4 * 3).max(1));
        let fits = |taken: u64| taken == 0 || taken + bytes <= bytes_max;
        let bytes = memory.take(bytes, fits).map_err(|taken| {
            let [taken, more, max] = [taken, bytes, bytes_max].map(|bytes| bytes >> 20);
            refused(format!("exports take {taken} MiB already; {more} MiB more are over {max} MiB"))
        })?;
        Ok([place, bytes])
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

    #[test]
    fn large_answers_leave_room_for_small_ones_and_one_alone_may_be_larger() {
        let memory = Memory::new(u64::MAX);
        let limits = Limits { answers_bytes_max: 64 << 20, ..Limits::default() };
        let alone = memory.answer(80 << 20, &limits).unwrap();
        assert_eq!(memory.answer(1, &limits).unwrap_err().code(), ErrorCode::Overloaded);
        drop(alone);
        let mut large: Vec<_> = Vec::new();
        let refused = loop {
            match memory.answer(8 << 20, &limits) {
                Ok(share) => large.push(share),
                Err(refused) => break refused,
            }
        };
        assert_eq!(large.len(), 5, "then 24 MiB are left: {refused}");
        let small = memory.answer(4 << 20, &limits).unwrap();
        drop(large.pop());
        assert!(memory.answer(6 << 20, &limits).is_ok(), "what is dropped is given back");
        drop((large, small));
        assert_eq!(*memory.answers.taken.lock(), 0);
    }

    #[test]
    fn exports_are_bounded_by_number_and_by_bytes() {
        let memory = Memory::new(u64::MAX);
        let limits = Limits { exports_max: 3, exports_bytes_max: 100, ..Limits::default() };
        let huge = memory.export(1 << 40, &limits).unwrap();
        assert!(memory.export(40, &limits).is_err());
        assert!(memory.export(20, &limits).is_ok(), "the largest leaves room for small ones");
        drop(huge);
        let all: Vec<_> = (0..3).map(|_| memory.export(10, &limits).unwrap()).collect();
        let refused = memory.export(10, &limits).unwrap_err();
        assert_eq!((refused.code(), refused.retry_after()), (ErrorCode::Overloaded, Some(5)));
        drop(all);
        let [mut half, _place] = {
            let [place, bytes] = memory.export(60, &limits).unwrap();
            [bytes, place]
        };
        assert!(memory.export(60, &limits).is_err());
        half.shrink(40);
        assert!(memory.export(60, &limits).is_ok());
    }
}
