//! Scratch that workers hand on from one task to the next.

use parking_lot::Mutex;

/// Values that are used again.
#[derive(Debug, Default)]
pub(super) struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    pub(super) fn take(&self) -> T {
        self.0.lock().pop().unwrap_or_default()
    }

    pub(super) fn give(&self, thing: T) {
        self.0.lock().push(thing);
    }
}
