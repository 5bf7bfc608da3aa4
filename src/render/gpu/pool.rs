//! The queue of one device: who draws next, and with whom.
//!
//! A caller puts its request into a bounded queue and waits. The caller whose request is first
//! draws it, and with it every waiting request that fits one submission: of the same scene, drawn
//! by the same kernels. A request equal to one that waits or is being drawn is not drawn again:
//! its caller gets a copy. There is no thread besides the callers' own, so that nothing that they
//! lend has to be owned.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Condvar, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use crate::{
    error::{Error, ErrorCode, Result},
    render::{Frame, Kinds, RenderRequest},
};

/// How long a caller waits for those that were drawn with the last one to come again: well under
/// what a submission of its own would cost them.
const GATHER: Duration = Duration::from_micros(150);

/// One request in the queue.
#[derive(Debug)]
pub(super) struct Job {
    /// [`crate::scene::Gaussians::identity`] of the scene.
    scene: u64,
    pub(super) request: RenderRequest,
    answer: Mutex<Option<Result<Frame>>>,
    /// Callers that have not taken the answer yet.
    takers: AtomicUsize,
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
    }

    fn answered(&self) -> bool {
        lock(&self.answer).is_some()
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
    busy: bool,
    /// Views of the last submission.
    last_views: usize,
}

/// The requests of one device.
#[derive(Debug)]
pub(super) struct Queue {
    waiting: Mutex<Waiting>,
    changed: Condvar,
    waiting_max: usize,
}

/// Ends a turn, also when its work panics: nobody waits for ever.
struct Turn<'a> {
    queue: &'a Queue,
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        let mut waiting = lock(&self.queue.waiting);
        for job in std::mem::take(&mut waiting.drawn) {
            if !job.answered() {
                job.answer(Err(Error::internal("a drawing was broken off")));
            }
        }
        waiting.busy = false;
        drop(waiting);
        self.queue.changed.notify_all();
    }
}

impl Queue {
    pub(super) fn new(waiting_max: usize) -> Self {
        Self { waiting: Mutex::default(), changed: Condvar::new(), waiting_max }
    }

    /// Requests that wait or are being drawn.
    pub(super) fn len(&self) -> usize {
        let waiting = lock(&self.waiting);
        waiting.jobs.len() + waiting.drawn.len()
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
        let mut waiting = lock(&self.waiting);
        let known = waiting.jobs.iter().chain(&waiting.drawn);
        let known = known.into_iter().find(|job| job.equals(scene, request)).cloned();
        let mine = known.is_none();
        let job = match known {
            Some(job) => {
                job.takers.fetch_add(1, Ordering::AcqRel);
                job
            }
            None if waiting.jobs.len() >= self.waiting_max => {
                return Err(Error::new(
                    ErrorCode::Overloaded,
                    format!("{} views wait for the GPU already", waiting.jobs.len()),
                )
                .retry_after_s(1));
            }
            None => {
                let (answer, takers) = (Mutex::new(None), AtomicUsize::new(1));
                let job = Arc::new(Job { scene, request: request.clone(), answer, takers });
                waiting.jobs.push_back(Arc::clone(&job));
                self.changed.notify_all();
                job
            }
        };
        loop {
            if job.answered() {
                drop(waiting);
                return job.take();
            }
            let first = waiting.jobs.front().is_some_and(|first| Arc::ptr_eq(first, &job));
            if mine && first && !waiting.busy {
                break;
            }
            waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        waiting.busy = true;
        let turn = Turn { queue: self };
        let batch = self.gather(waiting, &job, views_max);
        draw(&batch);
        drop(turn);
        job.take()
    }

    /// The requests to draw with `job`, which is the first of the queue.
    fn gather<'a>(
        &'a self,
        mut waiting: MutexGuard<'a, Waiting>,
        job: &Arc<Job>,
        views_max: usize,
    ) -> Vec<Arc<Job>> {
        let fit = |waiting: &Waiting| waiting.jobs.iter().filter(|other| job.joins(other)).count();
        let expected = waiting.last_views.min(views_max);
        let until = Instant::now() + GATHER;
        while expected > 1 && fit(&waiting) < expected {
            let Some(left) = until.checked_duration_since(Instant::now()) else { break };
            let woken = self.changed.wait_timeout(waiting, left);
            waiting = woken.unwrap_or_else(PoisonError::into_inner).0;
        }
        let mut batch = Vec::new();
        waiting.jobs.retain(|other| {
            let taken = batch.len() < views_max && job.joins(other);
            if taken {
                batch.push(Arc::clone(other));
            }
            !taken
        });
        waiting.last_views = batch.len();
        waiting.drawn.clone_from(&batch);
        batch
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        render::{Labels, Quality},
        scene::{Camera, CameraToWorld, Intrinsics},
    };

    fn request(near: f32) -> RenderRequest {
        let camera_to_world =
            CameraToWorld::look_at(glam::DVec3::ZERO, glam::DVec3::Z, glam::DVec3::NEG_Y, "test")
                .unwrap();
        let intrinsics = Intrinsics { fx: 9.0, fy: 9.0, cx: 4.0, cy: 4.0, width: 8, height: 8 };
        RenderRequest {
            camera: Camera { intrinsics, camera_to_world },
            kinds: Kinds::COLOR,
            labels: Labels::None,
            background: [0.0; 3],
            antialiased: false,
            near,
            quality: Quality::Exact,
            crop: None,
        }
    }

    fn frame(job: &Job) -> Frame {
        Frame { depth: Some(vec![job.request.near]), ..Frame::default() }
    }

    #[test]
    fn waiting_requests_of_a_scene_are_drawn_together_and_equal_ones_once() {
        let queue = Queue::new(64);
        let batches = Mutex::new(Vec::new());
        let gate = std::sync::Barrier::new(2);
        std::thread::scope(|scope| {
            // Holds the device until everyone else waits.
            scope.spawn(|| {
                queue.render(9, &request(1.0), 8, |jobs| {
                    gate.wait();
                    gate.wait();
                    jobs.iter().for_each(|job| job.answer(Ok(frame(job))));
                })
            });
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
            while queue.len() < 1 + 5 {
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
    fn a_full_queue_and_a_broken_drawing_are_errors_for_all_who_wait() {
        let queue = Queue::new(1);
        let gate = std::sync::Barrier::new(2);
        std::thread::scope(|scope| {
            let broken = scope.spawn(|| {
                queue.render(1, &request(1.0), 8, |_| {
                    gate.wait();
                    gate.wait();
                })
            });
            gate.wait();
            let second = scope.spawn(|| {
                let answer = |jobs: &[Arc<Job>]| {
                    jobs.iter().for_each(|job| job.answer(Ok(frame(job))));
                };
                queue.render(1, &request(2.0), 8, answer)
            });
            while queue.len() < 2 {
                std::thread::yield_now();
            }
            let third = queue.render(1, &request(3.0), 8, |_| {}).unwrap_err();
            assert_eq!((third.code(), third.retry_after()), (ErrorCode::Overloaded, Some(1)));
            gate.wait();
            let error = broken.join().unwrap().unwrap_err();
            assert_eq!(error.code(), ErrorCode::Internal, "nobody answered it");
            assert!(second.join().unwrap().is_ok(), "the next one is drawn");
        });
    }
}
