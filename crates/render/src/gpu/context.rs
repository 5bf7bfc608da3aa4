//! What a submission runs on: an open device, and buffers of its own.

use std::sync::Arc;

use parking_lot::Mutex;

use super::{
    buffers::{DeviceScene, SceneCache},
    device::Gpu,
    frame::Tools,
    pipelines::Kernels,
    profile::Marks,
    scratch::Scratch,
};
use crate::{RenderRequest, error::Result, scene::Gaussians, view::View};

/// A device, its kernels and its scenes. Clones share them.
#[derive(Clone, Debug)]
pub(super) struct OpenDevice {
    pub(super) gpu: Gpu,
    pub(super) kernels: Arc<Kernels>,
    pub(super) scenes: Arc<Mutex<SceneCache>>,
}

/// A device and scratch buffers for one submission.
#[derive(Debug)]
pub(super) struct Context {
    pub(super) on: OpenDevice,
    pub(super) scratch: Scratch,
}

impl Context {
    /// The tools that draw frames of `scene`.
    pub(super) fn tools<'a>(
        &'a mut self,
        scene: &'a DeviceScene,
        isects_max: u32,
        marks: Option<&'a mut Marks>,
    ) -> Tools<'a> {
        let (gpu, kernels, scratch) = (&self.on.gpu, &*self.on.kernels, &mut self.scratch);
        Tools { gpu, kernels, scratch, scene, isects_max, marks }
    }

    /// The Gaussians of a backward pass, which no view is expected to draw.
    pub(super) fn learnt(&mut self, gaussians: &Gaussians) -> Result<DeviceScene> {
        let learnt = &mut self.scratch.learnt;
        let scene = match learnt.take() {
            Some(scene) if scene.has_shape(gaussians.shape_identity()) => scene,
            old => DeviceScene::upload(&self.on.gpu, gaussians, old)?,
        };
        Ok(learnt.insert(scene).clone())
    }

    /// The Gaussians that `view`, all of `request` or a band of it, shows.
    pub(super) fn shown(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        view: &View,
    ) -> Result<DeviceScene> {
        self.on.scenes.lock().shown(&self.on.gpu, gaussians, request, view)
    }

    /// Whether the device has only parts of the scene of `gaussians`.
    pub(super) fn pages(&self, gaussians: &Gaussians, detailed: bool) -> bool {
        self.on.scenes.lock().pages(&self.on.gpu, gaussians, detailed)
    }

    /// The scene of `gaussians`; if `labelled`, with its entries; if `detailed`, with merged ones.
    pub(super) fn scene(
        &self,
        gaussians: &Gaussians,
        labelled: bool,
        detailed: bool,
    ) -> Result<DeviceScene> {
        self.on.scenes.lock().get(&self.on.gpu, gaussians, labelled, detailed)
    }
}
