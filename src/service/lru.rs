//! A small cache bounded by weight: what was used least recently goes first.

use std::{
    collections::HashMap,
    hash::Hash,
    sync::{Mutex, MutexGuard, PoisonError},
};

/// Values by key, cheap clones of them given out; safe from any thread.
#[derive(Debug)]
pub(super) struct Lru<K, V> {
    weight_max: u64,
    inner: Mutex<Inner<K, V>>,
}

#[derive(Debug)]
struct Inner<K, V> {
    values: HashMap<K, Kept<V>>,
    weight: u64,
    clock: u64,
}

#[derive(Debug)]
struct Kept<V> {
    value: V,
    weight: u64,
    used: u64,
}

impl<K: Clone + Eq + Hash, V: Clone> Lru<K, V> {
    pub(super) fn new(weight_max: u64) -> Self {
        let inner = Inner { values: HashMap::new(), weight: 0, clock: 0 };
        Self { weight_max, inner: Mutex::new(inner) }
    }

    pub(super) fn find(&self, key: &K) -> Option<V> {
        let mut inner = self.lock();
        inner.clock += 1;
        let now = inner.clock;
        let kept = inner.values.get_mut(key)?;
        kept.used = now;
        Some(kept.value.clone())
    }

    /// Keeps a value; one heavier than the whole cache is not kept.
    pub(super) fn insert(&self, key: K, value: V, weight: u64) {
        let mut inner = self.lock();
        inner.take(&key);
        if weight > self.weight_max {
            return;
        }
        while inner.weight + weight > self.weight_max {
            let oldest = inner.values.iter().min_by_key(|(_, kept)| kept.used);
            let Some(key) = oldest.map(|(key, _)| key.clone()) else { break };
            inner.take(&key);
        }
        inner.clock += 1;
        let used = inner.clock;
        inner.weight += weight;
        inner.values.insert(key, Kept { value, weight, used });
    }

    fn lock(&self) -> MutexGuard<'_, Inner<K, V>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<K: Eq + Hash, V> Inner<K, V> {
    fn take(&mut self, key: &K) {
        if let Some(kept) = self.values.remove(key) {
            self.weight -= kept.weight;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_used_least_recently_goes_first_and_weights_are_given_back() {
        let lru = Lru::new(10);
        lru.insert("a", 1, 4);
        lru.insert("b", 2, 4);
        assert_eq!(lru.find(&"a"), Some(1), "a is now used last");
        lru.insert("c", 3, 4);
        assert_eq!((lru.find(&"a"), lru.find(&"b"), lru.find(&"c")), (Some(1), None, Some(3)));
        lru.insert("a", 7, 6);
        assert_eq!((lru.find(&"a"), lru.find(&"c")), (Some(7), Some(3)), "6 + 4 fit");
        lru.insert("d", 4, 11);
        assert_eq!(lru.find(&"d"), None, "heavier than all");
        assert_eq!(lru.lock().weight, 10);
    }
}
