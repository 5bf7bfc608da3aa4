//! Copies of Gaussians that some view needs (layers, magnified scales), kept for the next view like
//! it: a copy has an identity of its own, so a renderer on a device would upload each anew.
//!
//! One store of each kind for the whole process, bounded by bytes; the least recently used goes
//! first, and before it whatever was made of Gaussians that nobody holds any more.

use std::{
    collections::BTreeMap,
    sync::{
        Mutex, MutexGuard, PoisonError, Weak,
        atomic::{AtomicU64, Ordering},
    },
};

use crate::scene::Gaussians;

/// Answers kept at most, those that hold no bytes too.
const ANSWERS_MAX: usize = 1_024;

/// What a copy was made of: the identity of the Gaussians, and the bits of all else that counts.
type Key = (u64, Vec<u64>);

/// Copies of one kind.
#[derive(Debug)]
pub(super) struct Copies<T> {
    bytes_max: AtomicU64,
    inner: Mutex<Inner<T>>,
}

#[derive(Debug)]
struct Inner<T> {
    held: BTreeMap<Key, Held<T>>,
    size_bytes: u64,
    clock: u64,
}

#[derive(Debug)]
struct Held<T> {
    copy: T,
    size_bytes: u64,
    /// When it was used last.
    used: u64,
    /// Gone with the last of the Gaussians that it was made of.
    of: Weak<()>,
}

impl<T: Clone> Copies<T> {
    /// Keeps at most `bytes_max` bytes.
    pub(super) const fn new(bytes_max: u64) -> Self {
        let inner = Inner { held: BTreeMap::new(), size_bytes: 0, clock: 0 };
        Self { bytes_max: AtomicU64::new(bytes_max), inner: Mutex::new(inner) }
    }

    /// Keeps at most so many bytes from the next copy on.
    pub(super) fn set_bytes_max(&self, bytes_max: u64) {
        self.bytes_max.store(bytes_max, Ordering::Relaxed);
    }

    /// The copy made of these Gaussians and all that counts beside, or what `make` gives with its
    /// bytes. Nothing waits while it is made.
    pub(super) fn get(&self, of: &Gaussians, rest: Vec<u64>, make: impl FnOnce() -> (T, u64)) -> T {
        let key = (of.identity(), rest);
        if let Some(copy) = self.lock().find(&key) {
            return copy;
        }
        let (copy, size) = make();
        let mut inner = self.lock();
        // Somebody may have made it meanwhile: everybody goes on with the first.
        if let Some(first) = inner.find(&key) {
            return first;
        }
        inner.drop_orphans();
        let bytes_max = self.bytes_max.load(Ordering::Relaxed);
        if size <= bytes_max {
            while inner.size_bytes + size > bytes_max || inner.held.len() >= ANSWERS_MAX {
                inner.drop_oldest();
            }
            inner.size_bytes += size;
            let used = inner.clock;
            let held = Held { copy: copy.clone(), size_bytes: size, used, of: of.life() };
            inner.held.insert(key, held);
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
        let held = self.held.get_mut(key)?;
        held.used = self.clock;
        Some(held.copy.clone())
    }

    fn drop_oldest(&mut self) {
        let oldest = self.held.iter().min_by_key(|(_, held)| held.used);
        if let Some(key) = oldest.map(|(key, _)| key.clone())
            && let Some(held) = self.held.remove(&key)
        {
            self.size_bytes -= held.size_bytes;
        }
    }

    /// Nobody can ask again for what was made of a scene that was deleted or left the memory: read
    /// once more it has another identity.
    fn drop_orphans(&mut self) {
        self.held.retain(|_, held| held.of.strong_count() > 0);
        self.size_bytes = self.held.values().map(|held| held.size_bytes).sum();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RawGaussians;

    fn some(count: usize) -> Vec<Gaussians> {
        let one = || Gaussians::sanitize(RawGaussians::default()).expect("none is fine").0;
        (0..count).map(|_| one()).collect()
    }

    #[test]
    fn copies_are_made_once_and_the_oldest_leave_first() {
        let (copies, of) = (Copies::new(10), some(10 + 2 * ANSWERS_MAX));
        let get = |n: usize, size| {
            let mut made = false;
            let copy = copies.get(&of[n], vec![7], || {
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
        copies.set_bytes_max(11);
        assert!(get(9, 11) && !get(9, 11), "now it is");
        for n in 10..of.len() {
            get(n, 0);
        }
        assert!(copies.lock().held.len() <= ANSWERS_MAX, "answers without bytes are bounded");
    }

    #[test]
    fn copies_of_gaussians_that_nobody_holds_leave_first_of_all() {
        let (copies, mut of) = (Copies::new(100), some(3));
        let kept = of[0].clone();
        for of in &of[..2] {
            copies.get(of, vec![], || ((), 10));
        }
        of.drain(..2);
        assert_eq!(copies.lock().size_bytes, 20);
        copies.get(&of[0], vec![], || ((), 10));
        let inner = copies.lock();
        let left = (inner.held.len(), inner.size_bytes);
        assert_eq!(left, (2, 20), "a clone holds the first, nobody the second");
        drop(kept);
    }
}
