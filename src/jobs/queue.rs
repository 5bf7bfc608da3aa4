//! A bounded queue of scene ids. A place is reserved first: nothing acknowledged is refused.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
};

use crate::scene::SceneId;

/// Waiting jobs, first in, first out.
#[derive(Debug)]
pub(super) struct Queue {
    waiting_max: usize,
    inner: Mutex<Inner>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Inner {
    waiting: VecDeque<SceneId>,
    /// Places promised to uploads that are being written.
    reserved: usize,
    closed: bool,
}

/// A place in the queue; given back when dropped unused.
#[derive(Debug)]
pub(super) struct Place<'a>(&'a Queue);

impl Drop for Place<'_> {
    fn drop(&mut self) {
        self.0.lock().reserved -= 1;
    }
}

impl Place<'_> {
    /// Puts a job into the place.
    pub(super) fn fill(self, id: SceneId) {
        self.0.push(id);
    }
}

impl Queue {
    pub(super) fn new(waiting_max: usize) -> Self {
        Self { waiting_max, inner: Mutex::default(), changed: Condvar::new() }
    }

    /// A place, or `None` when the queue is full or closed.
    pub(super) fn reserve(&self) -> Option<Place<'_>> {
        let mut inner = self.lock();
        if inner.closed || inner.waiting.len() + inner.reserved >= self.waiting_max {
            return None;
        }
        inner.reserved += 1;
        Some(Place(self))
    }

    /// Adds a job beyond any bound: one that was acknowledged before a restart.
    pub(super) fn push(&self, id: SceneId) {
        self.lock().waiting.push_back(id);
        self.changed.notify_one();
    }

    /// The next job; waits for one. `None` once the queue is closed.
    pub(super) fn pop(&self) -> Option<SceneId> {
        let mut inner = self.lock();
        loop {
            if inner.closed {
                return None;
            }
            if let Some(id) = inner.waiting.pop_front() {
                return Some(id);
            }
            inner = self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Takes a waiting job out; whether it was there.
    pub(super) fn remove(&self, id: &SceneId) -> bool {
        let mut inner = self.lock();
        let place = inner.waiting.iter().position(|waiting| waiting == id);
        place.is_some_and(|place| inner.waiting.remove(place).is_some())
    }

    /// Jobs that go before `id`; `None` when it does not wait.
    pub(super) fn ahead(&self, id: &SceneId) -> Option<usize> {
        self.lock().waiting.iter().position(|waiting| waiting == id)
    }

    pub(super) fn len(&self) -> usize {
        self.lock().waiting.len()
    }

    /// Lets no worker take another job.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    pub(super) fn is_closed(&self) -> bool {
        self.lock().closed
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(byte: u8) -> SceneId {
        SceneId::from_bytes([byte; 16])
    }

    #[test]
    fn a_reserved_place_counts_and_comes_back() {
        let queue = Queue::new(2);
        let first = queue.reserve().unwrap();
        let second = queue.reserve().unwrap();
        assert!(queue.reserve().is_none(), "both places are promised");
        drop(second);
        queue.reserve().unwrap().fill(id(2));
        first.fill(id(1));
        assert!(queue.reserve().is_none(), "both places are filled");
        assert_eq!((queue.ahead(&id(2)), queue.ahead(&id(1))), (Some(0), Some(1)));
        assert_eq!(queue.pop(), Some(id(2)));
        assert!(queue.reserve().is_some());
    }

    #[test]
    fn a_removed_job_is_not_given_out() {
        let queue = Queue::new(8);
        (1..=3).for_each(|byte| queue.push(id(byte)));
        assert!(queue.remove(&id(2)));
        assert!(!queue.remove(&id(2)), "it is gone");
        assert_eq!((queue.pop(), queue.pop()), (Some(id(1)), Some(id(3))));
    }

    #[test]
    fn closing_wakes_a_waiting_worker_and_refuses_new_jobs() {
        let queue = Queue::new(8);
        std::thread::scope(|scope| {
            let worker = scope.spawn(|| queue.pop());
            queue.close();
            assert_eq!(worker.join().unwrap(), None);
        });
        assert!(queue.reserve().is_none());
    }
}
