//! Adapters: a list, a choice, and a device whose faults become errors.
//!
//! A software adapter (llvmpipe, lavapipe, `SwiftShader`) is used only when it is named.

use std::sync::{
    Arc,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

use parking_lot::Mutex;
use wgpu::{BufferUsages, ErrorFilter, Features};

use crate::{
    error::{Error, ErrorCode, Result},
    options::AdapterReport,
    switches::{FaultsToCome, Switches},
};

/// Names of software adapters. Their device type is not always right.
const SOFTWARE_NAMES: [&str; 5] =
    ["llvmpipe", "lavapipe", "swiftshader", "softpipe", "basic render driver"];

/// How storage buffers are used.
pub(super) const STORAGE: BufferUsages =
    BufferUsages::STORAGE.union(BufferUsages::COPY_SRC).union(BufferUsages::COPY_DST);
/// Bytes written to the queue at once: its staging copy has the same size.
const UPLOAD_CHUNK: usize = 32 << 20;

/// Storage buffers that a stage of the kernels needs.
const STORAGE_BUFFERS: u32 = 8;
/// Bytes of workgroup storage that the kernels need.
const WORKGROUP_BYTES: u32 = 16 << 10;

/// Features without which the device gives no times.
const TIMES: Features = Features::TIMESTAMP_QUERY.union(Features::TIMESTAMP_QUERY_INSIDE_PASSES);

const REFUSED: &str = "the GPU adapter refused a device";

fn used_up(what: &str) -> Error {
    let why = format!("{what}: the GPU's memory is used up");
    Error::new(ErrorCode::LimitExceeded, why)
}

/// Describes all adapters of `backends`, in their order.
fn list(backends: wgpu::Backends) -> Vec<(wgpu::Adapter, AdapterReport)> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends,
        // The kernels size their own dispatches within the limits, so wgpu need not check each.
        flags: wgpu::InstanceFlags::from_build_config()
            .difference(wgpu::InstanceFlags::VALIDATION_INDIRECT_CALL),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    pollster::block_on(instance.enumerate_adapters(backends))
        .into_iter()
        .map(|adapter| {
            let report = describe(&adapter.get_info());
            (adapter, report)
        })
        .collect()
}

fn describe(info: &wgpu::AdapterInfo) -> AdapterReport {
    let text = format!("{} {} {}", info.name, info.driver, info.driver_info).to_lowercase();
    let software = info.device_type == wgpu::DeviceType::Cpu
        || SOFTWARE_NAMES.iter().any(|name| text.contains(name));
    AdapterReport {
        name: info.name.clone(),
        kind: format!("{:?}", info.device_type),
        backend: info.backend.to_string(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        software,
        chosen: false,
    }
}

/// Adapters found, and those taken, the best first: by parts of their names, else all hardware
/// ones.
pub(super) fn choose(
    name: Option<&str>,
) -> (Vec<AdapterReport>, Result<Vec<(wgpu::Adapter, AdapterReport)>>) {
    let mut found = list(wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12);
    let taken = pick(&found, name);
    taken.iter().for_each(|&at| found[at].1.chosen = true);
    let reports: Vec<_> = found.iter().map(|(_, report)| report.clone()).collect();
    if !taken.is_empty() {
        let chosen = taken.into_iter().map(|at| found[at].clone()).collect();
        return (reports, Ok(chosen));
    }
    let names: Vec<_> = reports.iter().map(|report| format!("{:?}", report.name)).collect();
    let seen = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
    let message = match name {
        Some(name) => format!("no GPU adapter has {name:?} in its name; there are: {seen}"),
        None => format!(
            "no hardware GPU adapter; there are: {seen}. A software one must be named by `adapter`"
        ),
    };
    (reports, Err(Error::new(ErrorCode::GpuUnavailable, message)))
}

/// Places of the adapters to use. `name` may hold several names, with commas between.
fn pick(found: &[(wgpu::Adapter, AdapterReport)], name: Option<&str>) -> Vec<usize> {
    let Some(names) = name else {
        use wgpu::DeviceType::{DiscreteGpu, IntegratedGpu, VirtualGpu};
        let of_type = |wanted| {
            let all = found.iter().enumerate().filter(|(_, (_, report))| !report.software);
            all.filter(move |(_, (adapter, _))| adapter.get_info().device_type == wanted)
        };
        let best_first = [DiscreteGpu, IntegratedGpu, VirtualGpu].into_iter().flat_map(of_type);
        return best_first.map(|(at, _)| at).collect();
    };
    let mut taken = Vec::new();
    for name in names.split(',').map(|name| name.trim().to_lowercase()) {
        // Mesa's Vulkan driver of that name calls its adapter llvmpipe.
        let name = if name == "lavapipe" { "llvmpipe" } else { name.as_str() };
        let called = |at: &usize| found[*at].1.name.to_lowercase().contains(name);
        let new = (0..found.len()).filter(|at| !name.is_empty() && called(at));
        let new: Vec<_> = new.filter(|at| !taken.contains(at)).collect();
        taken.extend(new);
    }
    taken
}

/// Faults outside of any error scope.
#[derive(Debug, Default)]
struct Faults {
    lost: AtomicBool,
    message: Mutex<Option<String>>,
}

impl Faults {
    fn report(&self, message: String) {
        self.message.lock().get_or_insert(message);
    }
}

/// A device and its queue. No fault of it ends the process. Clones share the device.
#[derive(Clone, Debug)]
pub(super) struct Gpu {
    pub(super) device: wgpu::Device,
    pub(super) queue: wgpu::Queue,
    /// Largest storage binding, bytes.
    pub(super) binding_bytes_max: u64,
    /// Whether it can measure times of stages.
    pub(super) has_times: bool,
    /// Number of buffers made so far.
    generation: Arc<AtomicU64>,
    faults: Arc<Faults>,
    to_come: Arc<FaultsToCome>,
}

impl Gpu {
    /// Opens a device with the limits of the adapter, or with the smallest limits of WebGPU.
    /// Errors: `gpu_unavailable` when the adapter refuses or its limits are too small for the
    /// kernels.
    pub(super) fn open(adapter: &wgpu::Adapter, switches: &Switches) -> Result<Self> {
        let to_come = switches.faults();
        if FaultsToCome::comes(&to_come.open) {
            return Err(Error::new(ErrorCode::GpuUnavailable, REFUSED));
        }
        let offered = adapter.limits();
        let wgpu::Limits {
            max_storage_buffers_per_shader_stage: buffers,
            max_compute_invocations_per_workgroup: invocations,
            max_compute_workgroup_storage_size: bytes,
            max_compute_workgroups_per_dimension: groups,
            ..
        } = offered;
        for (what, has, needs) in [
            ("storage buffers a stage", buffers, STORAGE_BUFFERS),
            ("invocations a workgroup", invocations, 256),
            ("bytes of workgroup storage", bytes, WORKGROUP_BYTES),
            ("workgroups a dimension", groups, 65_535),
        ] {
            if has < needs {
                let why = format!("the GPU adapter has {has} {what}; {needs} are needed");
                return Err(Error::new(ErrorCode::GpuUnavailable, why));
            }
        }
        let limits = if switches.portable() { wgpu::Limits::default() } else { offered };
        let binding_bytes_max =
            limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) & !0xff;
        let has_times = adapter.features().contains(TIMES);
        let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("segsplat"),
            required_features: (TIMES | Features::SUBGROUP) & adapter.features(),
            required_limits: limits,
            ..Default::default()
        }))
        .map_err(|e| Error::new(ErrorCode::GpuUnavailable, REFUSED).caused_by(e))?;
        let faults = Arc::new(Faults::default());
        let uncaptured = Arc::clone(&faults);
        device.on_uncaptured_error(Arc::new(move |error| uncaptured.report(error.to_string())));
        let lost = Arc::clone(&faults);
        device.set_device_lost_callback(move |reason, message| {
            if reason != wgpu::DeviceLostReason::Destroyed {
                lost.lost.store(true, Ordering::Release);
                lost.report(message);
            }
        });
        let generation = Arc::default();
        Ok(Self { device, queue, binding_bytes_max, has_times, generation, faults, to_come })
    }

    /// Changes when a buffer is made or dropped. Bind groups of an older generation are invalid.
    pub(super) fn generation(&self) -> u64 {
        self.generation.load(Ordering::Acquire)
    }

    /// Starts a new [`Self::generation`] after buffers were dropped.
    pub(super) fn forget(&self) {
        self.generation.fetch_add(1, Ordering::AcqRel);
    }

    /// Whether the device is lost.
    pub(super) fn is_lost(&self) -> bool {
        self.faults.lost.load(Ordering::Acquire)
    }

    /// Marks the device as lost for all its users. It is not destroyed, because someone may still
    /// read its memory.
    pub(super) fn give_up(&self, message: String) -> Error {
        self.faults.lost.store(true, Ordering::Release);
        Error::new(ErrorCode::GpuUnavailable, message)
    }

    /// Checks for faults outside of any scope since the last call.
    /// Errors: `gpu_unavailable` when the device is lost, `internal` for any other fault.
    pub(super) fn check(&self) -> Result<()> {
        if FaultsToCome::comes(&self.to_come.lost) {
            return Err(self.give_up("the GPU device was lost".to_owned()));
        }
        let message = self.faults.message.lock().take();
        if self.is_lost() {
            return Err(Error::new(ErrorCode::GpuUnavailable, "the GPU device was lost")
                .caused_by(message.unwrap_or_default()));
        }
        match message {
            Some(message) => Err(Error::internal("the GPU reported an error").caused_by(message)),
            None => Ok(()),
        }
    }

    /// Runs `work` inside error scopes, so that its faults are told from others.
    /// Errors: `limit_exceeded` when memory ran out, `gpu_unavailable` when the device is lost,
    /// `internal` otherwise; the message begins with `what`.
    pub(super) fn scoped<T>(&self, what: &str, work: impl FnOnce() -> T) -> Result<T> {
        let memory = self.device.push_error_scope(ErrorFilter::OutOfMemory);
        let validation = self.device.push_error_scope(ErrorFilter::Validation);
        let internal = self.device.push_error_scope(ErrorFilter::Internal);
        let value = work();
        let internal = pollster::block_on(internal.pop());
        let validation = pollster::block_on(validation.pop());
        let memory = pollster::block_on(memory.pop());
        self.check()?;
        if let Some(error) = memory {
            return Err(used_up(what).caused_by(error));
        }
        match internal.or(validation) {
            Some(error) => {
                Err(Error::internal(format!("{what}: the GPU reported an error")).caused_by(error))
            }
            None => Ok(value),
        }
    }

    /// A buffer of `size_bytes`, rounded up to 256.
    /// Errors: `limit_exceeded` when the adapter cannot bind as much or its memory is used up.
    pub(super) fn create_buffer(
        &self,
        label: &'static str,
        size_bytes: u64,
        usage: BufferUsages,
    ) -> Result<wgpu::Buffer> {
        let size = size_bytes.max(1).next_multiple_of(256);
        if size > self.binding_bytes_max {
            let what = format_args!("bytes of {label} on this GPU adapter");
            return Err(Error::limit(what, size, self.binding_bytes_max));
        }
        if FaultsToCome::comes(&self.to_come.memory) {
            return Err(used_up(label));
        }
        self.forget();
        self.scoped(label, || {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size,
                usage,
                mapped_at_creation: false,
            })
        })
    }

    /// A storage buffer that holds these parts, one after the other: `old`, where that has room
    /// for them.
    pub(super) fn upload(
        &self,
        label: &'static str,
        parts: &[&[u8]],
        old: Option<wgpu::Buffer>,
    ) -> Result<wgpu::Buffer> {
        let size = parts.iter().map(|part| part.len() as u64).sum();
        let buffer = match old.filter(|old| old.size() >= size) {
            Some(old) => old,
            None => self.create_buffer(label, size, STORAGE)?,
        };
        self.scoped(label, || {
            let mut to = 0;
            for bytes in parts.iter().flat_map(|part| part.chunks(UPLOAD_CHUNK)) {
                self.queue.write_buffer(&buffer, to, bytes);
                self.queue.submit([]);
                to += bytes.len() as u64;
            }
        })?;
        Ok(buffer)
    }
}
