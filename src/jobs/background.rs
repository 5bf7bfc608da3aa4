//! Threads that others go before.

use std::sync::Arc;

use crate::error::{Error, Result};

/// Nice value: sched(7) gives such a thread 110 parts of the time where others have 1,024.
#[cfg(target_os = "linux")]
const NICE: libc::c_int = 10;

/// So many threads of low priority.
///
/// # Errors
/// `internal` when they cannot be started.
pub(super) fn background_threads(count: usize) -> Result<Arc<rayon::ThreadPool>> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(count)
        .thread_name(|i| format!("background-{i}"))
        .start_handler(|_| yield_to_others())
        .build()
        .map(Arc::new)
        .map_err(|error| {
            let why = format!("refine: {count} threads cannot be started");
            Error::internal(why).caused_by(error)
        })
}

/// Gives the calling thread a low priority: it gets a tenth of a core that another wants. Where the
/// system does not let it, it works as all others.
#[cfg(target_os = "linux")]
fn yield_to_others() {
    #[expect(unsafe_code, reason = "a call into the C library")]
    // SAFETY: it takes numbers alone. On Linux 0 is the calling thread, not its process.
    let _done = unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, NICE) };
}

#[cfg(not(target_os = "linux"))]
fn yield_to_others() {}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    /// Nice value of the calling thread: field 19 of proc(5).
    fn nice() -> i32 {
        let stat = std::fs::read_to_string("/proc/thread-self/stat").expect("proc(5)");
        let after_name = stat.rsplit(')').next().unwrap_or_default();
        after_name.split_whitespace().nth(19 - 3).expect("19 fields").parse().expect("a number")
    }

    #[test]
    fn its_threads_have_a_low_priority_and_others_keep_theirs() {
        let before = nice();
        let threads = background_threads(2).expect("two threads");
        let low = before.max(NICE);
        assert_eq!(threads.broadcast(|_| nice()), [low; 2]);
        assert_eq!(nice(), before);
    }
}
