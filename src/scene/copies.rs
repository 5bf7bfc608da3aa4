//! Copies of Gaussians that some view needs (layers, magnified scales), kept for the next view like
//! it: a copy has an identity of its own, so a renderer on a device would upload each anew.
//!
//! One store for the whole process, bounded by bytes; the least recently used goes first.

use std::{
    collections::BTreeMap,
    sync::{Mutex, MutexGuard, PoisonError},
};

/// Answers kept at most, those that hold no bytes too.
const ANSWERS_MAX: usize = 1_024;

/// What a copy was made of: the identity of the Gaussians, and the bits of all else that counts.
pub(super) type Key = (u64, Vec<u64>);

/// Copies of one kind.
#[derive(Debug)]
pub(super) struct Copies<T> {
    bytes_max: u64,
    inner: Mutex<Inner<T>>,
}

#[derive(Debug)]
struct Inner<T> {
    /// Copy, its bytes, and when it was used last.
    held: BTreeMap<Key, (T, u64, u64)>,
    size_bytes: u64,
    clock: u64,
}

impl<T: Clone> Copies<T> {
    /// Keeps at most `bytes_max` bytes.
    pub(super) const fn new(bytes_max: u64) -> Self {
        let inner = Inner { held: BTreeMap::new(), size_bytes: 0, clock: 0 };
        Self { bytes_max, inner: Mutex::new(inner) }
    }

    /// The copy of `key`, or what `make` gives with its bytes. Nothing waits while it is made.
    pub(super) fn get(&self, key: Key, make: impl FnOnce() -> (T, u64)) -> T {
        if let Some(copy) = self.lock().find(&key) {
            return copy;
        }
        let (copy, size) = make();
        let mut inner = self.lock();
        // Somebody may have made it meanwhile: everybody goes on with the first.
        if let Some(first) = inner.find(&key) {
            return first;
        }
        if size <= self.bytes_max {
            while inner.size_bytes + size > self.bytes_max || inner.held.len() >= ANSWERS_MAX {
                inner.drop_oldest();
            }
            inner.size_bytes += size;
            let now = inner.clock;
            inner.held.insert(key, (copy.clone(), size, now));
        }
        copy
    }

    fn lock(&self) -> MutexGuard<'_, Inner<T>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Clone> Inner<T> {
    fn find(&mut self, key: &Key) -> Option<T> {
        self.clock += 1;
        let (copy, _, used) = self.held.get_mut(key)?;
        *used = self.clock;
        Some(copy.clone())
    }

    fn drop_oldest(&mut self) {
        let oldest = self.held.iter().min_by_key(|(_, (_, _, used))| *used);
        if let Some(key) = oldest.map(|(key, _)| key.clone())
            && let Some((_, size, _)) = self.held.remove(&key)
        {
            self.size_bytes -= size;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_are_made_once_and_the_oldest_leave_first() {
        let copies = Copies::new(10);
        let get = |n: u64, size| {
            let mut made = false;
            let copy = copies.get((n, vec![7]), || {
                made = true;
                (n, size)
            });
            assert_eq!(copy, n, "the copy of another key");
            made
        };
        assert!(get(1, 4), "the first time");
        assert!(!get(1, 4), "the second time");
        assert!(get(2, 4) && !get(2, 4), "another key");
        // Used last: 1. So 2 leaves.
        assert!(!get(1, 4));
        assert!(get(3, 4));
        assert!(!get(1, 4) && get(2, 4), "2 was the oldest");
        assert!(get(9, 11) && get(9, 11), "one larger than everything is not kept");
        for n in 100..100 + 2 * ANSWERS_MAX as u64 {
            get(n, 0);
        }
        assert!(copies.lock().held.len() <= ANSWERS_MAX, "answers without bytes are bounded");
    }
}
