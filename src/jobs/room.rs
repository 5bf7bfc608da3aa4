//! Photos at work at the same time, over all jobs: many small scenes run side by side, and large
//! ones take no more memory together than the largest one alone.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use parking_lot::{Condvar, Mutex};

use crate::{error::Result, scene::unless_cancelled};

/// Time between two looks at whether a waiting job is cancelled.
const CANCEL_LOOK: Duration = Duration::from_millis(50);

/// Room for photos.
#[derive(Debug)]
pub(super) struct Room {
    photos_max: usize,
    taken: Mutex<usize>,
    given_back: Condvar,
}

/// Room that a job has; given back when dropped.
#[derive(Debug)]
pub(super) struct Taken<'a> {
    room: &'a Room,
    photos: usize,
}

impl Room {
    pub(super) fn new(photos_max: usize) -> Self {
        Self { photos_max, taken: Mutex::default(), given_back: Condvar::new() }
    }

    /// Waits for room; a job of more photos than there is room for has it all.
    /// Fails with `cancelled`.
    pub(super) fn take(&self, photos: usize, cancel: &AtomicBool) -> Result<Taken<'_>> {
        let photos = photos.min(self.photos_max);
        let mut taken = self.taken.lock();
        while *taken + photos > self.photos_max && !cancel.load(Ordering::Acquire) {
            self.given_back.wait_for(&mut taken, CANCEL_LOOK);
        }
        unless_cancelled(cancel)?;
        *taken += photos;
        Ok(Taken { room: self, photos })
    }
}

impl Drop for Taken<'_> {
    fn drop(&mut self) {
        *self.room.taken.lock() -= self.photos;
        self.room.given_back.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_waits_until_its_photos_have_room_or_it_is_cancelled() {
        let (room, on, off) = (Room::new(8), AtomicBool::new(false), AtomicBool::new(true));
        let (six, two) = (room.take(6, &on).unwrap(), room.take(2, &on).unwrap());
        assert!(room.take(1, &off).is_err(), "cancelled while it waits");
        drop(two);
        assert!(room.take(2, &on).is_ok(), "there is room again");
        let got = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let all = scope.spawn(|| {
                let taken = room.take(64, &on);
                got.store(true, Ordering::Release);
                taken.map(|taken| taken.photos)
            });
            std::thread::sleep(Duration::from_millis(20));
            assert!(!got.load(Ordering::Acquire), "it waits for all the room");
            drop(six);
            assert_eq!(all.join().unwrap().unwrap(), 8, "a large job has all the room");
        });
        assert_eq!(*room.taken.lock(), 0, "all is given back");
    }
}
