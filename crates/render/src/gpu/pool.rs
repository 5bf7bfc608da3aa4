//! The queue of one device: who draws next, and with whom.
//!
//! A caller puts its request into a bounded queue and waits. The caller whose request is first
//! draws it, and with it every waiting request that fits one submission: of the same scene, drawn
//! by the same kernels. A request equal to one that waits or is being drawn is not drawn again: its
//! caller gets a copy. There is no thread besides the callers' own, so that nothing that they lend
//! has to be owned.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use crate::{
    Frame, Kinds, RenderRequest,
    error::{Error, ErrorCode, Result},
};

/// Callers that draw at once: the pictures of one submission are copied and the next is recorded
/// while the device draws the other. Three were slower on an H200, their submissions too small.
pub(super) const TURNS: usize = 2;
/// How long a caller waits for others of the crowd to come again: well under what a submission of
/// its own would cost them.
const GATHER: Duration = Duration::from_micros(150);

/// One request in the queue.
#[derive(Debug)]
pub(super) struct Job {
    /// [`crate::scene::Gaussians::identity`] of the scene.
    scene: u64,
    pub(super) request: RenderRequest,
    answer: Mutex<Option<Result<Frame>>>,
    /// Told when there is an answer, or the turn to draw.
    changed: Condvar,
    /// Whether it is its caller's turn.
    leads: AtomicBool,
    /// Callers that have not taken the answer yet; with none left it is gone.
    takers: AtomicUsize,
    answered: AtomicBool,
}

impl Job {
    /// Whether the other's answer would be this one's.
    fn equals(&self, scene: u64, request: &RenderRequest) -> bool {
        self.scene == scene && self.request == *request
    }

    /// Whether both may be drawn by one submission: by the same kernels, so that a view is the
    /// same to the last bit whoever else asks.
    fn joins(&self, other: &Self) -> bool {
        let kernels = |request: &RenderRequest| {
            let Kinds { color, depth, .. } = request.kinds;
            (color, depth, std::mem::discriminant(&request.labels))
        };
        self.scene == other.scene && kernels(&self.request) == kernels(&other.request)
    }

    pub(super) fn answer(&self, answer: Result<Frame>) {
        *lock(&self.answer) = Some(answer);
        self.answered.store(true, Ordering::Release);
        self.changed.notify_all();
    }

    /// One more taker, unless the last has been there.
    fn share(&self) -> bool {
        let more = |takers| (takers > 0).then_some(takers + 1);
        self.takers.fetch_update(Ordering::AcqRel, Ordering::Acquire, more).is_ok()
    }

    fn lead(&self) {
        // Under the lock, so that nobody looks before it and waits after it.
        let _answer = lock(&self.answer);
        self.leads.store(true, Ordering::Release);
        self.changed.notify_all();
    }

    /// Waits for the answer, or the turn of the caller that brought the request; which of them.
    fn wait(&self, mine: bool) -> bool {
        let mut answer = lock(&self.answer);
        while answer.is_none() {
            if mine && self.leads.load(Ordering::Acquire) {
                return true;
            }
            answer = self.changed.wait(answer).unwrap_or_else(PoisonError::into_inner);
        }
        false
    }

    /// The answer, for one of those who share it; the last of them gets it itself.
    fn take(&self) -> Result<Frame> {
        let mut answer = lock(&self.answer);
        if self.takers.fetch_sub(1, Ordering::AcqRel) == 1 {
            return answer.take().unwrap_or_else(|| Err(Error::internal("no answer was given")));
        }
        match &*answer {
            Some(Ok(frame)) => Ok(frame.clone()),
            Some(Err(error)) => Err(Error::new(error.code(), error.message())),
            None => Err(Error::internal("no answer was given")),
        }
    }
}

#[derive(Debug, Default)]
struct Waiting {
    /// In the order of arrival.
    jobs: VecDeque<Arc<Job>>,
    /// Being drawn.
    drawn: Vec<Arc<Job>>,
    /// Callers whose turn it is. There are [`TURNS`] while anyone waits for one.
    turns: usize,
    /// Requests at once, lately.
    crowd: usize,
}

impl Waiting {
    fn len(&self) -> usize {
        self.jobs.len() + self.drawn.len()
    }

    /// Gives free turns to those who have waited longest, but for those who will be drawn with one
    /// whose turn it is already.
    fn hand_on(&mut self) {
        while self.turns < TURNS {
            let leads = |job: &&Arc<Job>| job.leads.load(Ordering::Acquire);
            let joins = |job: &Arc<Job>| self.jobs.iter().filter(leads).any(|led| led.joins(job));
            let next = self.jobs.iter().find(|job| !leads(job) && !joins(job));
            let Some(job) = next else { break };
            self.turns += 1;
            job.lead();
        }
    }
}

/// The requests of one device.
#[derive(Debug)]
pub(super) struct Queue {
    waiting: Mutex<Waiting>,
    /// Told when a request has come.
    arrived: Condvar,
    waiting_max: usize,
}

/// One caller's drawing; its end, also by a panic, leaves nobody waiting for ever.
struct Turn<'a> {
    queue: &'a Queue,
    batch: Vec<Arc<Job>>,
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        let open = |job: &&Arc<Job>| !job.answered.load(Ordering::Acquire);
        for job in self.batch.iter().filter(open) {
            job.answer(Err(Error::internal("a drawing was broken off")));
        }
        let mut waiting = lock(&self.queue.waiting);
        let mine = |job: &Arc<Job>| self.batch.iter().any(|other| Arc::ptr_eq(job, other));
        waiting.drawn.retain(|job| !mine(job));
        waiting.turns -= 1;
        waiting.hand_on();
    }
}

impl Queue {
    pub(super) fn new(waiting_max: usize) -> Self {
        Self { waiting: Mutex::default(), arrived: Condvar::new(), waiting_max }
    }

    /// Requests that wait or are being drawn.
    pub(super) fn len(&self) -> usize {
        lock(&self.waiting).len()
    }

    /// Draws `request` of `scene`, alone or with others: `draw` answers every job it is given, of
    /// which there are at most `views_max`.
    ///
    /// # Errors
    /// `overloaded` when the queue is full, and what `draw` answers.
    pub(super) fn render(
        &self,
        scene: u64,
        request: &RenderRequest,
        views_max: usize,
        draw: impl FnOnce(&[Arc<Job>]),
    ) -> Result<Frame> {
        let (job, mine) = self.enter(scene, request)?;
        if job.wait(mine) {
            let turn = self.gather(&job, views_max);
            draw(&turn.batch);
        }
        job.take()
    }

    /// The job of `request`, and whether it is new.
    fn enter(&self, scene: u64, request: &RenderRequest) -> Result<(Arc<Job>, bool)> {
        let mut waiting = lock(&self.waiting);
        let mut known = waiting.jobs.iter().chain(&waiting.drawn);
        if let Some(job) = known.find(|job| job.equals(scene, request) && job.share()) {
            return Ok((Arc::clone(job), false));
        }
        if waiting.jobs.len() >= self.waiting_max {
            return Err(Error::new(
                ErrorCode::Overloaded,
                format!("{} views wait for the GPU already", waiting.jobs.len()),
            )
            .retry_after_s(1));
        }
        let job = Arc::new(Job {
            scene,
            request: request.clone(),
            answer: Mutex::default(),
            changed: Condvar::new(),
            leads: AtomicBool::new(false),
            takers: AtomicUsize::new(1),
            answered: AtomicBool::new(false),
        });
        waiting.jobs.push_back(Arc::clone(&job));
        waiting.crowd = waiting.crowd.max(waiting.len());
        waiting.hand_on();
        self.arrived.notify_all();
        Ok((job, true))
    }

    /// The requests to draw with `job`, whose turn it is.
    fn gather(&self, job: &Arc<Job>, views_max: usize) -> Turn<'_> {
        let fits = |other: &Arc<Job>| {
            let led = other.leads.load(Ordering::Acquire);
            Arc::ptr_eq(other, job) || (!led && job.joins(other))
        };
        let mut waiting = lock(&self.waiting);
        // Each turn's share of the crowd, waited for even while the others are being drawn: a
        // submission costs as much as several views.
        let expected = waiting.crowd.div_ceil(TURNS).min(views_max);
        let until = Instant::now() + GATHER;
        while waiting.jobs.iter().filter(|other| fits(other)).count() < expected {
            let Some(left) = until.checked_duration_since(Instant::now()) else { break };
            let woken = self.arrived.wait_timeout(waiting, left);
            waiting = woken.unwrap_or_else(PoisonError::into_inner).0;
        }
        let mut batch = vec![Arc::clone(job)];
        waiting.jobs.retain(|other| {
            let taken = batch.len() < views_max && fits(other) && !Arc::ptr_eq(other, job);
            if taken {
                batch.push(Arc::clone(other));
            }
            !taken && !Arc::ptr_eq(other, job)
        });
        waiting.crowd = waiting.len().max(waiting.crowd.saturating_sub(1)).max(1);
        waiting.drawn.extend_from_slice(&batch);
        waiting.hand_on();
        Turn { queue: self, batch }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics};

    fn request(near: f32) -> RenderRequest {
        let camera_to_world =
            CameraToWorld::look_at(glam::DVec3::ZERO, glam::DVec3::Z, glam::DVec3::NEG_Y, "test")
                .unwrap();
        let intrinsics = Intrinsics { fx: 9.0, fy: 9.0, cx: 4.0, cy: 4.0, width: 8, height: 8 };
        RenderRequest::plain(Camera { intrinsics, camera_to_world }, Kinds::COLOR, near)
    }

    fn frame(job: &Job) -> Frame {
        Frame { depth: Some(vec![job.request.near]), ..Frame::default() }
    }

    #[test]
    fn waiting_requests_of_a_scene_are_drawn_together_and_equal_ones_once() {
        let queue = Queue::new(64);
        let batches = Mutex::new(Vec::new());
        let gate = std::sync::Barrier::new(1 + TURNS);
        std::thread::scope(|scope| {
            // They hold all turns until everyone else waits.
            for other in 0..TURNS as u64 {
                let (queue, gate) = (&queue, &gate);
                scope.spawn(move || {
                    queue.render(90 + other, &request(1.0), 8, |jobs| {
                        gate.wait();
                        gate.wait();
                        jobs.iter().for_each(|job| job.answer(Ok(frame(job))));
                    })
                });
            }
            gate.wait();
            let near = [2.0, 3.0, 2.0, 4.0, 5.0, 3.0];
            for (i, near) in near.into_iter().enumerate() {
                let (queue, batches) = (&queue, &batches);
                // The last two views are of another scene.
                let scene = if i < 4 { 7 } else { 8 };
                scope.spawn(move || {
                    let got = queue.render(scene, &request(near), 8, |jobs| {
                        lock(batches).push(jobs.len());
                        jobs.iter().for_each(|job| job.answer(Ok(frame(job))));
                    });
                    assert_eq!(got.unwrap().depth, Some(vec![near]), "view {i}");
                });
            }
            while queue.len() < TURNS + 5 {
                std::thread::yield_now();
            }
            // Whoever asks for a view that waits already has joined by now or will find it drawn.
            std::thread::sleep(Duration::from_millis(50));
            gate.wait();
        });
        let mut batches = lock(&batches).clone();
        batches.sort_unstable();
        assert_eq!(batches, [2, 3], "two scenes, one view of the first wanted twice");
    }

    #[test]
    fn a_request_that_was_answered_and_taken_is_drawn_again() {
        let queue = Queue::new(64);
        let (gate, again) = (std::sync::Barrier::new(1 + TURNS), AtomicBool::new(false));
        let draw = |jobs: &[Arc<Job>]| jobs.iter().for_each(|job| job.answer(Ok(frame(job))));
        std::thread::scope(|scope| {
            for other in 0..TURNS as u64 {
                let (queue, gate) = (&queue, &gate);
                scope.spawn(move || {
                    queue.render(90 + other, &request(1.0), 8, |jobs| {
                        gate.wait();
                        gate.wait();
                        draw(jobs);
                    })
                });
            }
            gate.wait();
            // Two views that are drawn together, by a caller who goes on after the answers.
            let callers: Vec<_> = [2.0, 3.0]
                .map(|near| {
                    let (queue, again) = (&queue, &again);
                    let asked = queue.len() + 1;
                    let caller = scope.spawn(move || {
                        queue.render(7, &request(near), 8, |jobs| {
                            draw(jobs);
                            let begun = Instant::now();
                            while jobs.len() == 2
                                && !again.load(Ordering::Acquire)
                                && begun.elapsed() < Duration::from_secs(5)
                            {
                                std::thread::yield_now();
                            }
                        })
                    });
                    while queue.len() < asked {
                        std::thread::yield_now();
                    }
                    caller
                })
                .into();
            gate.wait();
            let mut callers = callers.into_iter();
            let (first, second) = (callers.next().unwrap(), callers.next().unwrap());
            assert!(second.join().unwrap().is_ok(), "answered while the first still draws");
            let got = queue.render(7, &request(3.0), 8, draw);
            again.store(true, Ordering::Release);
            assert_eq!(got.unwrap().depth, Some(vec![3.0]), "drawn again");
            assert!(first.join().unwrap().is_ok());
        });
    }

    #[test]
    fn a_full_queue_and_a_broken_drawing_are_errors_for_all_who_wait() {
        let queue = Queue::new(1);
        let gate = std::sync::Barrier::new(1 + TURNS);
        std::thread::scope(|scope| {
            let broken: Vec<_> = (0..TURNS as u64)
                .map(|other| {
                    let (queue, gate) = (&queue, &gate);
                    scope.spawn(move || {
                        queue.render(other, &request(1.0), 8, |_| {
                            gate.wait();
                            gate.wait();
                        })
                    })
                })
                .collect();
            gate.wait();
            let second = scope.spawn(|| {
                let answer = |jobs: &[Arc<Job>]| {
                    jobs.iter().for_each(|job| job.answer(Ok(frame(job))));
                };
                queue.render(1, &request(2.0), 8, answer)
            });
            while queue.len() < TURNS + 1 {
                std::thread::yield_now();
            }
            let third = queue.render(1, &request(3.0), 8, |_| {}).unwrap_err();
            assert_eq!((third.code(), third.retry_after()), (ErrorCode::Overloaded, Some(1)));
            gate.wait();
            for broken in broken {
                let error = broken.join().unwrap().unwrap_err();
                assert_eq!(error.code(), ErrorCode::Internal, "nobody answered it");
            }
            assert!(second.join().unwrap().is_ok(), "the next one is drawn");
        });
    }
}
