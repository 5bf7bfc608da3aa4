//! A cache bounded by weight: the value that was used least recently leaves first.

use std::{
    collections::{BTreeMap, HashMap},
    hash::Hash,
    sync::{Mutex, MutexGuard, PoisonError},
};

/// Values by key. It gives out clones, which must be cheap. Any thread may use it.
#[derive(Debug)]
pub struct Cache<K, V> {
    inner: Mutex<Inner<K, V>>,
}

#[derive(Debug)]
struct Inner<K, V> {
    values: HashMap<K, Kept<V>>,
    /// Keys by their last use.
    by_use: BTreeMap<u64, K>,
    weight: u64,
    weight_max: u64,
    uses: u64,
}

#[derive(Debug)]
struct Kept<V> {
    value: V,
    weight: u64,
    used: u64,
}

impl<K: Clone + Eq + Hash, V: Clone> Cache<K, V> {
    /// Keeps values of at most `weight_max` together, in the unit of [`Self::insert`].
    #[must_use]
    pub fn new(weight_max: u64) -> Self {
        let (values, by_use) = (HashMap::new(), BTreeMap::new());
        Self { inner: Mutex::new(Inner { values, by_use, weight: 0, weight_max, uses: 0 }) }
    }

    /// Changes the most that it keeps.
    pub fn set_weight_max(&self, weight_max: u64) {
        let mut inner = self.lock();
        inner.weight_max = weight_max;
        inner.make_room(0);
    }

    /// Weight of all values.
    pub fn weight(&self) -> u64 {
        self.lock().weight
    }

    /// The value of a key.
    pub fn find(&self, key: &K) -> Option<V> {
        let mut inner = self.lock();
        inner.uses += 1;
        let now = inner.uses;
        let kept = inner.values.get_mut(key)?;
        let before = std::mem::replace(&mut kept.used, now);
        let value = kept.value.clone();
        let key = inner.by_use.remove(&before)?;
        inner.by_use.insert(now, key);
        Some(value)
    }

    /// Keeps a value in place of the key's old one. A value heavier than the whole cache is not
    /// kept.
    pub fn insert(&self, key: K, value: V, weight: u64) {
        let mut inner = self.lock();
        inner.remove(&key);
        if weight > inner.weight_max {
            return;
        }
        inner.make_room(weight);
        inner.uses += 1;
        let used = inner.uses;
        inner.weight += weight;
        inner.by_use.insert(used, key.clone());
        inner.values.insert(key, Kept { value, weight, used });
    }

    /// Drops the value of a key.
    pub fn remove(&self, key: &K) {
        self.lock().remove(key);
    }

    /// Drops every value for which `keep` is false.
    pub fn retain(&self, keep: impl Fn(&V) -> bool) {
        let mut inner = self.lock();
        let gone = inner.values.iter().filter(|(_, kept)| !keep(&kept.value));
        let gone: Vec<K> = gone.map(|(key, _)| key.clone()).collect();
        gone.iter().for_each(|key| inner.remove(key));
    }

    fn lock(&self) -> MutexGuard<'_, Inner<K, V>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<K: Clone + Eq + Hash, V> Inner<K, V> {
    fn remove(&mut self, key: &K) {
        if let Some(kept) = self.values.remove(key) {
            self.weight -= kept.weight;
            self.by_use.remove(&kept.used);
        }
    }

    /// Drops values until `weight` more fits.
    fn make_room(&mut self, weight: u64) {
        while self.weight.saturating_add(weight) > self.weight_max {
            let Some((_, key)) = self.by_use.pop_first() else { break };
            if let Some(kept) = self.values.remove(&key) {
                self.weight -= kept.weight;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_leaves_first_and_weights_are_given_back() {
        let cache = Cache::new(10);
        cache.insert("a", 1, 4);
        cache.insert("b", 2, 4);
        assert_eq!(cache.find(&"a"), Some(1), "a is now used last");
        cache.insert("c", 3, 4);
        let found = ["a", "b", "c"].map(|key| cache.find(&key));
        assert_eq!(found, [Some(1), None, Some(3)], "b was used first");
        cache.insert("a", 7, 6);
        assert_eq!((cache.find(&"a"), cache.find(&"c")), (Some(7), Some(3)), "6 + 4 fit");
        cache.insert("d", 4, 11);
        assert_eq!(cache.find(&"d"), None, "heavier than all");
        assert_eq!(cache.weight(), 10, "of a and c");
        for _ in 0..5 {
            cache.insert("c", 3, 4);
        }
        assert_eq!(cache.weight(), 10, "the same key again takes no more room");
        cache.remove(&"c");
        cache.retain(|value| *value != 7);
        assert_eq!((cache.weight(), cache.find(&"a")), (0, None), "all given back");
        let inner = cache.lock();
        assert!(inner.values.is_empty() && inner.by_use.is_empty());
    }

    #[test]
    fn a_smaller_bound_drops_what_no_longer_fits() {
        let cache = Cache::new(10);
        (0..10).for_each(|key| cache.insert(key, (), 1));
        cache.set_weight_max(3);
        let left: Vec<i32> = (0..10).filter(|key| cache.find(key).is_some()).collect();
        assert_eq!(left, [7, 8, 9], "the last three");
    }
}
