//! Scenes in memory, bounded by bytes; the least recently used one goes first.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use crate::scene::{Scene, SceneId};

/// Least-recently-used cache of scenes, bounded by the bytes of their arrays.
#[derive(Debug)]
pub(super) struct Cache {
    bytes_max: u64,
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    scenes: HashMap<SceneId, (Arc<Scene>, u64)>,
    size_bytes: u64,
    clock: u64,
}

impl Cache {
    pub(super) fn new(bytes_max: u64) -> Self {
        Self { bytes_max, inner: Mutex::default() }
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Arc<Scene>> {
        let mut inner = self.lock();
        inner.clock += 1;
        let now = inner.clock;
        let (scene, used) = inner.scenes.get_mut(id)?;
        *used = now;
        Some(Arc::clone(scene))
    }

    /// Keeps a scene; one larger than the whole cache is not kept.
    pub(super) fn insert(&self, scene: Arc<Scene>) {
        let size = scene.size_bytes();
        self.remove(&scene.meta.id);
        if size > self.bytes_max {
            return;
        }
        let mut inner = self.lock();
        while inner.size_bytes + size > self.bytes_max {
            let oldest = inner.scenes.iter().min_by_key(|(_, (_, used))| *used);
            let Some(id) = oldest.map(|(id, _)| id.clone()) else { break };
            inner.take(&id);
        }
        inner.clock += 1;
        let now = inner.clock;
        inner.size_bytes += size;
        inner.scenes.insert(scene.meta.id.clone(), (scene, now));
    }

    pub(super) fn size_bytes(&self) -> u64 {
        self.lock().size_bytes
    }

    pub(super) fn remove(&self, id: &SceneId) {
        self.lock().take(id);
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn take(&mut self, id: &SceneId) {
        if let Some((scene, _)) = self.scenes.remove(id) {
            self.size_bytes -= scene.size_bytes();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{
        Backdrop, Gaussians, HealthReport, Provenance, RawGaussians, SceneMeta, SourcePixel,
    };

    fn scene(id: u8, count: usize) -> Arc<Scene> {
        let raw = RawGaussians {
            means: vec![[0.0; 3]; count],
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            scales: vec![[1.0; 3]; count],
            opacities: vec![1.0; count],
            sh: vec![[0.0; 3]; count],
            semantic_index: vec![0; count],
            source: vec![SourcePixel::default(); count],
            ..RawGaussians::default()
        };
        let meta = SceneMeta {
            id: SceneId::from_bytes([id; 16]),
            created_ms: 0,
            cameras: Vec::new(),
            report: HealthReport::default(),
            provenance: Provenance::default(),
        };
        let gaussians = Gaussians::sanitize(raw).unwrap().0;
        Arc::new(Scene::new(meta, gaussians, Backdrop::default()))
    }

    fn has(cache: &Cache, id: u8) -> bool {
        cache.find(&SceneId::from_bytes([id; 16])).is_some()
    }

    #[test]
    fn the_least_recently_used_scene_goes_first() {
        let each = scene(0, 10).gaussians.size_bytes();
        let cache = Cache::new(2 * each);
        cache.insert(scene(1, 10));
        cache.insert(scene(2, 10));
        assert!(has(&cache, 1), "1 is now used last");
        cache.insert(scene(3, 10));
        assert!(has(&cache, 1) && !has(&cache, 2) && has(&cache, 3), "2 was used first");
    }

    #[test]
    fn bytes_are_counted_once_and_given_back() {
        let each = scene(0, 10).gaussians.size_bytes();
        let cache = Cache::new(2 * each);
        for _ in 0..5 {
            cache.insert(scene(1, 10));
        }
        cache.insert(scene(2, 10));
        assert!(has(&cache, 1) && has(&cache, 2), "the same scene again takes no more room");
        cache.insert(scene(4, 1000));
        assert!(has(&cache, 1) && has(&cache, 2) && !has(&cache, 4), "too large to keep");
        cache.remove(&SceneId::from_bytes([1; 16]));
        cache.remove(&SceneId::from_bytes([2; 16]));
        assert_eq!(cache.lock().size_bytes, 0);
    }
}
