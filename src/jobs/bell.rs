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
    use std::{
        sync::{Arc, atomic::Ordering, mpsc},
        thread,
    };

    use super::*;

    /// How long a test waits for what must come.
    const PATIENCE: Duration = Duration::from_secs(60);

    /// What `wait` gives in a thread of its own.
    fn waiting<T: Send + 'static>(
        bell: &Arc<Bell>,
        wait: impl FnOnce(&Bell) -> T + Send + 'static,
    ) -> mpsc::Receiver<T> {
        let (bell, (tell, told)) = (Arc::clone(bell), mpsc::channel());
        thread::spawn(move || tell.send(wait(&bell)));
        told
    }

    #[test]
    fn a_ring_wakes_who_has_looked_and_waits() {
        let (bell, open) = (Arc::<Bell>::default(), Arc::<AtomicBool>::default());
        let (looks, looked) = mpsc::channel();
        let is_open = Arc::clone(&open);
        let found = waiting(&bell, move |bell| {
            bell.wait(|| {
                let found = is_open.load(Ordering::Acquire);
                looks.send(()).unwrap();
                if found { Ok(7) } else { Err(FOREVER) }
            })
        });
        looked.recv_timeout(PATIENCE).expect("it looks at once");
        open.store(true, Ordering::Release);
        bell.ring();
        assert_eq!(found.recv_timeout(PATIENCE), Ok(7), "it is woken");
    }

    #[test]
    fn a_ring_between_the_look_and_the_wait_is_not_missed() {
        let bell = Arc::<Bell>::default();
        let found = waiting(&bell, |bell| {
            let mut looks = 0;
            bell.wait(|| {
                looks += 1;
                if looks == 2 {
                    return Ok(looks);
                }
                bell.ring();
                Err(FOREVER)
            })
        });
        assert_eq!(found.recv_timeout(PATIENCE), Ok(2));
    }

    #[test]
    fn a_job_that_is_stopped_waits_no_more_and_a_time_that_is_over_is_a_look() {
        let (bell, stop) = (Arc::<Bell>::default(), Arc::<AtomicBool>::default());
        let (looks, looked) = mpsc::channel();
        let is_stopped = Arc::clone(&stop);
        let stopped = waiting(&bell, move |bell| {
            bell.wait_in_job::<()>(&is_stopped, || {
                looks.send(()).unwrap();
                Err(FOREVER)
            })
        });
        looked.recv_timeout(PATIENCE).expect("it looks at once");
        stop.store(true, Ordering::Release);
        bell.ring();
        assert!(stopped.recv_timeout(PATIENCE).expect("it is woken").is_err(), "cancelled");
        let mut looks = 0;
        let late = || {
            looks += 1;
            if looks == 3 { Ok(looks) } else { Err(Duration::from_millis(1)) }
        };
        assert_eq!(bell.wait(late), 3, "it looks again after its time");
    }
}
