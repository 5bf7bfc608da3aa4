//! Photos at work at the same time, over all jobs: many small scenes run side by side, and large
//! ones take no more memory together than the largest one alone.

use std::sync::{Arc, atomic::AtomicBool};

use parking_lot::Mutex;

use super::bell::{Bell, FOREVER};
use crate::error::Result;

/// Room for photos.
#[derive(Debug, Default)]
pub(super) struct Room {
    taken: Mutex<usize>,
    bell: Arc<Bell>,
}

/// Room that a job has; given back when dropped.
#[derive(Debug)]
pub(super) struct RoomShare<'a> {
    room: &'a Room,
    photos: usize,
}

impl Room {
    pub(super) fn new(bell: Arc<Bell>) -> Self {
        Self { taken: Mutex::default(), bell }
    }

    /// Waits for room among `photos_max`; a job of more photos than that has it all.
    /// Fails with `cancelled`.
    pub(super) fn take(
        &self,
        photos: usize,
        photos_max: usize,
        cancel: &AtomicBool,
    ) -> Result<RoomShare<'_>> {
        let photos = photos.min(photos_max);
        self.bell.wait_in_job(cancel, || {
            let mut taken = self.taken.lock();
            if *taken + photos > photos_max {
                return Err(FOREVER);
            }
            *taken += photos;
            Ok(())
        })?;
        Ok(RoomShare { room: self, photos })
    }
}

impl Drop for RoomShare<'_> {
    fn drop(&mut self) {
        *self.room.taken.lock() -= self.photos;
        self.room.bell.ring();
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::atomic::Ordering, time::Duration};

    use super::*;

    #[test]
    fn a_job_waits_until_its_photos_have_room_or_it_is_cancelled() {
        let (room, on, off) = (Room::default(), AtomicBool::new(false), AtomicBool::new(true));
        let (six, two) = (room.take(6, 8, &on).unwrap(), room.take(2, 8, &on).unwrap());
        assert!(room.take(1, 8, &off).is_err(), "cancelled while it waits");
        drop(two);
        assert!(room.take(2, 8, &on).is_ok(), "there is room again");
        let got = AtomicBool::new(false);
        std::thread::scope(|scope| {
            let all = scope.spawn(|| {
                let taken = room.take(64, 8, &on);
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
