//! Wakes the threads of jobs when something that they wait for may have changed.

use std::{sync::atomic::AtomicBool, time::Duration};

use parking_lot::{Condvar, Mutex};

use crate::{error::Result, scene::unless_cancelled};

/// Without end, as the time of a wait.
pub(super) const FOREVER: Duration = Duration::MAX;

/// One for all jobs: rung after a record, a lock, the room or the list of jobs has changed.
#[derive(Debug, Default)]
pub(super) struct Bell {
    rings: Mutex<u64>,
    rung: Condvar,
}

impl Bell {
    pub(super) fn ring(&self) {
        *self.rings.lock() += 1;
        self.rung.notify_all();
    }

    /// Waits until `look` gives something. It looks at once, after each ring, and after the time
    /// that it gives instead.
    pub(super) fn wait<T>(&self, mut look: impl FnMut() -> Result<T, Duration>) -> T {
        loop {
            // Before the look, so that no ring is missed.
            let before = *self.rings.lock();
            let at_most = match look() {
                Ok(found) => return found,
                Err(at_most) => at_most,
            };
            let same = |rings: &mut u64| *rings == before;
            self.rung.wait_while_for(&mut self.rings.lock(), same, at_most);
        }
    }

    /// The same for a job.
    /// Fails with `cancelled`.
    pub(super) fn wait_in_job<T>(
        &self,
        cancel: &AtomicBool,
        mut look: impl FnMut() -> Result<T, Duration>,
    ) -> Result<T> {
        self.wait(|| match unless_cancelled(cancel) {
            Ok(()) => look().map(Ok),
            Err(cancelled) => Ok(Err(cancelled)),
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::Ordering;

    use super::*;

    #[test]
    fn a_ring_wakes_who_waits_and_none_is_missed() {
        let (bell, open, stop) = (Bell::default(), AtomicBool::new(false), AtomicBool::new(false));
        let look = || if open.load(Ordering::Acquire) { Ok(7) } else { Err(FOREVER) };
        std::thread::scope(|scope| {
            let waits = scope.spawn(|| bell.wait(look));
            open.store(true, Ordering::Release);
            bell.ring();
            assert_eq!(waits.join().unwrap(), 7);
            let stopped = scope.spawn(|| bell.wait_in_job::<()>(&stop, || Err(FOREVER)));
            stop.store(true, Ordering::Release);
            bell.ring();
            assert!(stopped.join().unwrap().is_err(), "cancelled");
        });
        let mut looks = 0;
        let late = || {
            looks += 1;
            if looks == 3 { Ok(looks) } else { Err(Duration::from_millis(1)) }
        };
        assert_eq!(bell.wait(late), 3, "it looks again after its time");
    }
}
