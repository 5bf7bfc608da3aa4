//! Times of the stages by the device's own clock.

use wgpu::BufferUsages;

use super::{device::Gpu, readback};
use crate::{error::Result, renderer::DispatchTime};

/// Dispatches of a frame, at most, and its start.
const MARKS_MAX: u32 = 64;

/// The device's clock after every dispatch of a submission.
#[derive(Debug)]
pub(super) struct Marks {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    names: Vec<&'static str>,
    /// Whether every dispatch is marked, or the start and the end alone.
    each: bool,
}

impl Marks {
    /// Marks for one submission.
    pub(super) fn new(gpu: &Gpu, each: bool) -> Result<Self> {
        let bytes = u64::from(MARKS_MAX) * 8;
        let resolve = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        let staging = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        Ok(Self {
            queries: gpu.scoped("timestamps", || {
                gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                    label: None,
                    ty: wgpu::QueryType::Timestamp,
                    count: MARKS_MAX,
                })
            })?,
            resolved: gpu.create_buffer("timestamps", bytes, resolve)?,
            staging: gpu.create_buffer("timestamps", bytes, staging)?,
            names: Vec::new(),
            each,
        })
    }

    pub(super) fn start(&mut self, pass: &mut wgpu::ComputePass<'_>) {
        self.names.clear();
        pass.write_timestamp(&self.queries, 0);
    }

    pub(super) fn mark(&mut self, pass: &mut wgpu::ComputePass<'_>, name: &'static str) {
        if self.each {
            self.write(pass, name);
        }
    }

    /// After the last dispatch, inside its pass.
    pub(super) fn end(&mut self, pass: &mut wgpu::ComputePass<'_>) {
        if !self.each {
            self.write(pass, "frame");
        }
    }

    fn write(&mut self, pass: &mut wgpu::ComputePass<'_>, name: &'static str) {
        let at = 1 + self.names.len() as u32;
        if at < MARKS_MAX {
            pass.write_timestamp(&self.queries, at);
            self.names.push(name);
        }
    }

    pub(super) fn resolve(&self, encoder: &mut wgpu::CommandEncoder) {
        let count = 1 + self.names.len() as u32;
        encoder.resolve_query_set(&self.queries, 0..count, &self.resolved, 0);
        let bytes = u64::from(count) * 8;
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, Some(bytes));
    }

    /// Times of the dispatches of the last submission, which is waited for here.
    pub(super) fn read(&self, gpu: &Gpu) -> Result<Vec<DispatchTime>> {
        let bytes = (1 + self.names.len() as u64) * 8;
        let period = f64::from(gpu.queue.get_timestamp_period()) * 1e-6;
        readback::read(gpu, &self.staging, bytes, |bytes| {
            let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(bytes);
            let spans = ticks.windows(2).map(|pair| pair[1].saturating_sub(pair[0]) as f64);
            self.names
                .iter()
                .zip(spans)
                .map(|(&stage, span)| DispatchTime { stage, ms: span * period })
                .collect()
        })
    }
}
