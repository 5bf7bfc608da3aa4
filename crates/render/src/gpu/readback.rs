//! Reads buffers of the device: one copy in the frame's own submission, one wait.

use std::{
    sync::mpsc::{self, Receiver, TryRecvError},
    thread,
    time::{Duration, Instant},
};

use super::device::Gpu;
use crate::error::{Error, Result};

/// How long a submission may take before the device is given up. A software adapter needs seconds
/// for a large picture; a hardware one that takes this long hangs.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(120);
/// How long the device is looked at without a nap. Most views are done by then, and a nap of the
/// system takes three times as long as asked for.
const WATCH: Duration = Duration::from_micros(400);
/// Least and greatest time between two looks at the device.
const NAP_MIN: Duration = Duration::from_micros(20);
const NAP_MAX: Duration = Duration::from_millis(1);
/// A nap's share of the time waited so far.
const NAP_SHARE: u32 = 8;

/// Bytes of a buffer that were asked for and are not here yet.
#[derive(Debug)]
pub(super) struct PendingRead {
    staging: wgpu::Buffer,
    size_bytes: u64,
    mapped: Receiver<Result<(), wgpu::BufferAsyncError>>,
}

/// Waits until the device is done with `staging` and hands its first `size_bytes` to `take`.
/// Errors: `gpu_unavailable` when the device is lost or does not answer, `internal` for another
/// fault.
pub(super) fn read<T>(
    gpu: &Gpu,
    staging: &wgpu::Buffer,
    size_bytes: u64,
    take: impl FnOnce(&[u8]) -> T,
) -> Result<T> {
    wait(gpu, ask(gpu, staging, size_bytes)?, take)
}

/// Asks for the first `size_bytes` of `staging`, as they are after what was submitted so far. No
/// submission may use it before they were taken.
/// Errors: those of the device.
pub(super) fn ask(gpu: &Gpu, staging: &wgpu::Buffer, size_bytes: u64) -> Result<PendingRead> {
    let (sender, mapped) = mpsc::channel();
    gpu.scoped("readback", || {
        staging.slice(0..size_bytes).map_async(wgpu::MapMode::Read, move |result| {
            // Nobody listens any more when the wait has failed.
            let _ = sender.send(result);
        });
    })?;
    Ok(PendingRead { staging: staging.clone(), size_bytes, mapped })
}

/// Waits for what was asked for.
/// Errors: as [`read`].
pub(super) fn wait<T>(gpu: &Gpu, asked: PendingRead, take: impl FnOnce(&[u8]) -> T) -> Result<T> {
    let PendingRead { staging, size_bytes, mapped } = asked;
    // Not `PollType::Wait`: while one thread waits in the driver, no other can submit (an H200 then
    // stood idle between two callers), and a lone caller is woken later than by its own clock.
    // Others that have work get the processor while this one watches.
    let begun = Instant::now();
    loop {
        if let Err(error) = gpu.device.poll(wgpu::PollType::Poll) {
            let message = "the GPU device cannot be asked for its pictures".to_owned();
            return Err(gpu.give_up(message).caused_by(error));
        }
        match mapped.try_recv() {
            Ok(Ok(())) => break,
            Ok(Err(error)) => {
                gpu.check()?;
                return Err(Error::internal("the GPU's pictures cannot be read").caused_by(error));
            }
            Err(TryRecvError::Disconnected) => {
                let message = "the GPU device did not hand back its pictures".to_owned();
                return Err(gpu.give_up(message));
            }
            Err(TryRecvError::Empty) if begun.elapsed() > ANSWER_TIMEOUT => {
                return Err(gpu.give_up("the GPU device did not answer in time".to_owned()));
            }
            Err(TryRecvError::Empty) if begun.elapsed() < WATCH => thread::yield_now(),
            Err(TryRecvError::Empty) => {
                thread::sleep((begun.elapsed() / NAP_SHARE).clamp(NAP_MIN, NAP_MAX));
            }
        }
    }
    gpu.check()?;
    let value = {
        let view = staging.slice(0..size_bytes).get_mapped_range().map_err(|error| {
            Error::internal("the GPU's pictures cannot be read").caused_by(error)
        })?;
        take(&view)
    };
    staging.unmap();
    Ok(value)
}
