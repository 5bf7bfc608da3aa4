//! A bounded queue of scene ids, fair between owners. A place is reserved first: nothing
//! acknowledged is refused.
//!
//! Each owner has a lane; lanes take turns, one job a turn. An owner may fill half the places, so
//! that others always find one.

use std::{
    collections::{HashMap, VecDeque},
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
};

use crate::scene::SceneId;

type Owner = Option<String>;

/// Waiting jobs: of one owner first in, first out; between owners in turns.
#[derive(Debug)]
pub(super) struct Queue {
    waiting_max: usize,
    inner: Mutex<Inner>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Inner {
    /// Lanes that have jobs, the one whose turn it is in front.
    lanes: VecDeque<(Owner, VecDeque<SceneId>)>,
    /// Places promised to uploads that are being written.
    reserved: HashMap<Owner, usize>,
    closed: bool,
}

/// Why there is no place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Full {
    /// The queue is closed.
    Closed,
    /// Too many jobs wait.
    All(usize),
    /// Too many jobs of this owner wait.
    Share(usize),
}

/// A place in the queue; given back when dropped unused.
#[derive(Debug)]
pub(super) struct Place<'a> {
    queue: &'a Queue,
    owner: Owner,
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        let mut inner = self.queue.lock();
        let left = inner.reserved.get_mut(&self.owner).map(|count| {
            *count -= 1;
            *count
        });
        if left == Some(0) {
            inner.reserved.remove(&self.owner);
        }
    }
}

impl Place<'_> {
    /// Puts a job into the place.
    pub(super) fn fill(self, id: SceneId) {
        self.queue.push(id, self.owner.as_deref());
    }
}

impl Inner {
    fn waiting(&self) -> usize {
        self.lanes.iter().map(|(_, lane)| lane.len()).sum()
    }

    fn of(&self, owner: &Owner) -> usize {
        let lane = self.lanes.iter().find(|(of, _)| of == owner).map_or(0, |(_, lane)| lane.len());
        lane + self.reserved.get(owner).copied().unwrap_or(0)
    }
}

impl Queue {
    pub(super) fn new(waiting_max: usize) -> Self {
        Self { waiting_max, inner: Mutex::default(), changed: Condvar::new() }
    }

    /// A place for a job of `owner`.
    pub(super) fn reserve(&self, owner: Option<&str>) -> Result<Place<'_>, Full> {
        let owner = owner.map(str::to_owned);
        let mut inner = self.lock();
        let share = self.waiting_max.div_ceil(2);
        if inner.closed {
            return Err(Full::Closed);
        }
        if inner.waiting() + inner.reserved.values().sum::<usize>() >= self.waiting_max {
            return Err(Full::All(self.waiting_max));
        }
        // Who has no owner has nobody to share with.
        if owner.is_some() && inner.of(&owner) >= share {
            return Err(Full::Share(share));
        }
        *inner.reserved.entry(owner.clone()).or_default() += 1;
        Ok(Place { queue: self, owner })
    }

    /// Adds a job beyond any bound: one that was acknowledged before a restart.
    pub(super) fn push(&self, id: SceneId, owner: Option<&str>) {
        let mut inner = self.lock();
        match inner.lanes.iter_mut().find(|(of, _)| of.as_deref() == owner) {
            Some((_, lane)) => lane.push_back(id),
            None => inner.lanes.push_back((owner.map(str::to_owned), VecDeque::from([id]))),
        }
        self.changed.notify_one();
    }

    /// The next job; waits for one. `None` once the queue is closed.
    pub(super) fn pop(&self) -> Option<SceneId> {
        let mut inner = self.lock();
        loop {
            if inner.closed {
                return None;
            }
            if let Some((owner, mut lane)) = inner.lanes.pop_front() {
                let id = lane.pop_front();
                if !lane.is_empty() {
                    inner.lanes.push_back((owner, lane));
                }
                if id.is_some() {
                    return id;
                }
                continue;
            }
            inner = self.changed.wait(inner).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Takes a waiting job out; whether it was there.
    pub(super) fn remove(&self, id: &SceneId) -> bool {
        let mut inner = self.lock();
        let found = inner.lanes.iter_mut().any(|(_, lane)| {
            let place = lane.iter().position(|waiting| waiting == id);
            place.is_some_and(|place| lane.remove(place).is_some())
        });
        inner.lanes.retain(|(_, lane)| !lane.is_empty());
        found
    }

    /// Jobs that go before `id` as things stand; `None` when it does not wait.
    pub(super) fn ahead(&self, id: &SceneId) -> Option<usize> {
        let inner = self.lock();
        let place = |lane: &VecDeque<SceneId>| lane.iter().position(|waiting| waiting == id);
        let (turn, place) = inner
            .lanes
            .iter()
            .enumerate()
            .find_map(|(turn, (_, lane))| Some((turn, place(lane)?)))?;
        let before = inner.lanes.iter().enumerate().map(|(other, (_, lane))| {
            // A lane whose turn comes earlier gives one job more.
            lane.len().min(place + usize::from(other < turn))
        });
        Some(before.sum())
    }

    pub(super) fn len(&self) -> usize {
        self.lock().waiting()
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
        let first = queue.reserve(None).unwrap();
        let second = queue.reserve(None).unwrap();
        assert_eq!(queue.reserve(None).unwrap_err(), Full::All(2), "both places are promised");
        drop(second);
        queue.reserve(None).unwrap().fill(id(2));
        first.fill(id(1));
        assert!(queue.reserve(None).is_err(), "both places are filled");
        assert_eq!((queue.ahead(&id(2)), queue.ahead(&id(1))), (Some(0), Some(1)));
        assert_eq!(queue.pop(), Some(id(2)));
        assert!(queue.reserve(None).is_ok());
    }

    #[test]
    fn a_removed_job_is_not_given_out() {
        let queue = Queue::new(8);
        (1..=3).for_each(|byte| queue.push(id(byte), None));
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
        assert_eq!(queue.reserve(None).unwrap_err(), Full::Closed);
    }

    #[test]
    fn owners_take_turns_and_the_places_ahead_are_those_that_go_before() {
        let queue = Queue::new(20);
        for (byte, owner) in [(1, "a"), (2, "a"), (3, "a"), (4, "b"), (5, "c"), (6, "b")] {
            queue.push(id(byte), Some(owner));
        }
        let ahead: Vec<_> = (1..=6).map(|byte| queue.ahead(&id(byte)).unwrap()).collect();
        let order: Vec<_> = (0..6).map(|_| queue.pop().unwrap()).collect();
        assert_eq!(order, [1, 4, 5, 2, 6, 3].map(id), "one each in turn, then the rest");
        let went: Vec<_> = (1..=6)
            .map(|byte| order.iter().position(|other| *other == id(byte)).unwrap())
            .collect();
        assert_eq!(ahead, went);
    }

    #[test]
    fn one_owner_leaves_places_for_others() {
        let queue = Queue::new(4);
        let _being_written = queue.reserve(Some("a")).unwrap();
        queue.reserve(Some("a")).unwrap().fill(id(1));
        assert_eq!(queue.reserve(Some("a")).unwrap_err(), Full::Share(2));
        queue.reserve(Some("b")).unwrap().fill(id(2));
        queue.reserve(None).unwrap().fill(id(3));
        assert_eq!(queue.reserve(Some("c")).unwrap_err(), Full::All(4));
    }
}
