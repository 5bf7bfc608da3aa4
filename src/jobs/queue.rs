//! A bounded queue of jobs, fair between owners. A place is reserved first, so that no acknowledged
//! job is refused.
//!
//! Each kind of job and each owner has a lane; lanes of a kind take turns, one job a turn. An owner
//! may fill half the places of a kind, so that others always find one.

use std::{
    collections::{HashMap, VecDeque},
    time::Duration,
};

use parking_lot::{Condvar, Mutex};

use super::kind::Kind;
use crate::scene::SceneId;

/// Whose jobs a lane holds.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Lane {
    kind: Kind,
    owner: Option<String>,
}

impl Lane {
    fn of(kind: Kind, owner: Option<&str>) -> Self {
        Self { kind, owner: owner.map(str::to_owned) }
    }
}

/// Waiting jobs: of one owner first in, first out; between owners in turns.
#[derive(Debug)]
pub(crate) struct Queue {
    /// Jobs of one kind that may wait.
    waiting_max: usize,
    state: Mutex<QueueState>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct QueueState {
    /// Lanes that have jobs; of each kind the one whose turn it is in front.
    lanes: VecDeque<(Lane, VecDeque<SceneId>)>,
    /// Places promised to uploads that are being written.
    reserved: HashMap<Lane, usize>,
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
pub(super) struct ReservedPlace<'a> {
    queue: &'a Queue,
    lane: Lane,
}

impl Drop for ReservedPlace<'_> {
    fn drop(&mut self) {
        let reserved = &mut self.queue.state.lock().reserved;
        if let Some(count) = reserved.get_mut(&self.lane) {
            *count -= 1;
        }
        reserved.retain(|_, count| *count > 0);
    }
}

impl ReservedPlace<'_> {
    /// Puts a job into the place.
    pub(super) fn fill(self, id: SceneId) {
        self.queue.push(self.lane.kind, id, self.lane.owner.as_deref());
    }
}

impl QueueState {
    /// Jobs that wait and places that are promised, of the lanes that `is` names.
    fn taken(&self, is: impl Fn(&Lane) -> bool) -> usize {
        let waiting = self.lanes.iter().filter(|(lane, _)| is(lane)).map(|(_, jobs)| jobs.len());
        let reserved = self.reserved.iter().filter(|(lane, _)| is(lane)).map(|(_, count)| count);
        waiting.sum::<usize>() + reserved.sum::<usize>()
    }

    fn next(&mut self, kind: Kind) -> Option<SceneId> {
        let turn = self.lanes.iter().position(|(lane, _)| lane.kind == kind)?;
        let (lane, mut jobs) = self.lanes.remove(turn)?;
        let id = jobs.pop_front();
        if !jobs.is_empty() {
            self.lanes.push_back((lane, jobs));
        }
        id
    }
}

impl Queue {
    pub(super) fn new(waiting_max: usize) -> Self {
        Self { waiting_max, state: Mutex::default(), changed: Condvar::new() }
    }

    /// A place for a job of `owner`.
    pub(super) fn reserve(
        &self,
        kind: Kind,
        owner: Option<&str>,
    ) -> Result<ReservedPlace<'_>, Full> {
        let lane = Lane::of(kind, owner);
        let mut state = self.state.lock();
        let share = self.waiting_max.div_ceil(2);
        if state.closed {
            return Err(Full::Closed);
        }
        if state.taken(|other| other.kind == kind) >= self.waiting_max {
            return Err(Full::All(self.waiting_max));
        }
        // Without owners there is nobody to share with.
        if owner.is_some() && state.taken(|other| *other == lane) >= share {
            return Err(Full::Share(share));
        }
        *state.reserved.entry(lane.clone()).or_default() += 1;
        Ok(ReservedPlace { queue: self, lane })
    }

    /// Adds a job beyond any bound: one that was acknowledged before a restart.
    pub(super) fn push(&self, kind: Kind, id: SceneId, owner: Option<&str>) {
        let (mut state, lane) = (self.state.lock(), Lane::of(kind, owner));
        match state.lanes.iter_mut().find(|(other, _)| *other == lane) {
            Some((_, jobs)) => jobs.push_back(id),
            None => state.lanes.push_back((lane, VecDeque::from([id]))),
        }
        // Workers of other kinds may wait too.
        self.changed.notify_all();
    }

    /// The next job of a kind; waits for one. `None` once the queue is closed.
    pub(super) fn pop(&self, kind: Kind) -> Option<SceneId> {
        let mut state = self.state.lock();
        loop {
            if state.closed {
                return None;
            }
            if let Some(id) = state.next(kind) {
                return Some(id);
            }
            self.changed.wait(&mut state);
        }
    }

    /// Takes the waiting jobs of a scene out; only those of a kind where one is given.
    pub(super) fn remove(&self, id: &SceneId, kind: Option<Kind>) {
        self.state.lock().lanes.retain_mut(|(lane, jobs)| {
            jobs.retain(|other| kind.is_some_and(|kind| lane.kind != kind) || other != id);
            !jobs.is_empty()
        });
    }

    /// Jobs of a kind that go before that of the scene `id` now; `None` when it does not wait.
    pub(super) fn ahead(&self, kind: Kind, id: &SceneId) -> Option<usize> {
        let state = self.state.lock();
        let lanes = state.lanes.iter().filter(|(lane, _)| lane.kind == kind);
        let lanes: Vec<&VecDeque<SceneId>> = lanes.map(|(_, jobs)| jobs).collect();
        let place = |jobs: &VecDeque<SceneId>| jobs.iter().position(|waiting| waiting == id);
        let (turn, place) =
            lanes.iter().enumerate().find_map(|(turn, jobs)| Some((turn, place(jobs)?)))?;
        // A lane whose turn comes earlier gives one job more.
        let before = |(other, jobs): (usize, &&VecDeque<SceneId>)| {
            jobs.len().min(place + usize::from(other < turn))
        };
        Some(lanes.iter().enumerate().map(before).sum())
    }

    /// Jobs of a kind that wait.
    pub(super) fn len(&self, kind: Kind) -> usize {
        let state = self.state.lock();
        let lanes = state.lanes.iter().filter(|(lane, _)| lane.kind == kind);
        lanes.map(|(_, jobs)| jobs.len()).sum()
    }

    /// Lets no worker take another job.
    pub(super) fn close(&self) {
        self.state.lock().closed = true;
        self.changed.notify_all();
    }

    /// Pauses the calling thread for `time`, less when the queue is closed; whether it is.
    pub(super) fn pause(&self, time: Duration) -> bool {
        let mut state = self.state.lock();
        self.changed.wait_while_for(&mut state, |state| !state.closed, time);
        state.closed
    }

    pub(super) fn is_closed(&self) -> bool {
        self.state.lock().closed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::{scene::SCENE, semantics::SEMANTICS};

    fn id(byte: u8) -> SceneId {
        SceneId::from_bytes([byte; 16])
    }

    #[test]
    fn a_reserved_place_counts_and_comes_back() {
        let queue = Queue::new(2);
        let reserve = || queue.reserve(SCENE, None);
        let (first, second) = (reserve().unwrap(), reserve().unwrap());
        assert_eq!(reserve().unwrap_err(), Full::All(2), "both places are promised");
        drop(second);
        reserve().unwrap().fill(id(2));
        first.fill(id(1));
        assert!(reserve().is_err(), "both places are filled");
        assert_eq!((queue.ahead(SCENE, &id(2)), queue.ahead(SCENE, &id(1))), (Some(0), Some(1)));
        assert_eq!(queue.pop(SCENE), Some(id(2)));
        assert!(reserve().is_ok());
    }

    #[test]
    fn a_removed_job_is_not_given_out() {
        let queue = Queue::new(8);
        (1..=3).for_each(|byte| queue.push(SCENE, id(byte), None));
        queue.remove(&id(2), None);
        assert_eq!((queue.pop(SCENE), queue.pop(SCENE)), (Some(id(1)), Some(id(3))));
    }

    #[test]
    fn closing_wakes_a_waiting_worker_and_refuses_new_jobs() {
        let queue = Queue::new(8);
        std::thread::scope(|scope| {
            let worker = scope.spawn(|| queue.pop(SCENE));
            queue.close();
            assert_eq!(worker.join().unwrap(), None);
        });
        assert_eq!(queue.reserve(SCENE, None).unwrap_err(), Full::Closed);
    }

    #[test]
    fn owners_take_turns_and_the_places_ahead_are_those_that_go_before() {
        let queue = Queue::new(20);
        for (byte, owner) in [(1, "a"), (2, "a"), (3, "a"), (4, "b"), (5, "c"), (6, "b")] {
            queue.push(SCENE, id(byte), Some(owner));
        }
        let ahead: Vec<_> = (1..=6).map(|byte| queue.ahead(SCENE, &id(byte)).unwrap()).collect();
        let order: Vec<_> = (0..6).map(|_| queue.pop(SCENE).unwrap()).collect();
        assert_eq!(order, [1, 4, 5, 2, 6, 3].map(id), "one each in turn, then the rest");
        let place = |byte| order.iter().position(|other| *other == id(byte)).unwrap();
        assert_eq!(ahead, (1..=6).map(place).collect::<Vec<_>>());
    }

    #[test]
    fn each_kind_has_its_own_places_and_turns() {
        let queue = Queue::new(1);
        let scene = queue.reserve(SCENE, None).unwrap();
        queue.reserve(SEMANTICS, None).unwrap().fill(id(2));
        scene.fill(id(1));
        assert_eq!((queue.len(SCENE), queue.ahead(SCENE, &id(2))), (1, None));
        assert_eq!(queue.pop(SEMANTICS), Some(id(2)));
        assert_eq!(queue.pop(SCENE), Some(id(1)));
    }

    #[test]
    fn one_owner_leaves_places_for_others() {
        let queue = Queue::new(4);
        let reserve = |owner| queue.reserve(SCENE, owner);
        let _being_written = reserve(Some("a")).unwrap();
        reserve(Some("a")).unwrap().fill(id(1));
        assert_eq!(reserve(Some("a")).unwrap_err(), Full::Share(2));
        reserve(Some("b")).unwrap().fill(id(2));
        reserve(None).unwrap().fill(id(3));
        assert_eq!(reserve(Some("c")).unwrap_err(), Full::All(4));
    }
}
