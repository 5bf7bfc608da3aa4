//! From the device back to memory: one copy in the frame's own submission, one wait.

use std::{sync::mpsc, time::Duration};

use super::device::Gpu;
use crate::error::{Error, Result};

/// How long a submission may take before the device is given up. A software adapter needs seconds
/// for a large picture; a hardware one that takes this long hangs.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(120);

/// Waits for `submission` and hands the first `size_bytes` of `staging` to `take`.
///
/// # Errors
/// `gpu_unavailable` when the device is lost or does not answer, `internal` for another fault.
pub(super) fn read<T>(
    gpu: &Gpu,
    submission: wgpu::SubmissionIndex,
    staging: &wgpu::Buffer,
    size_bytes: u64,
    take: impl FnOnce(&[u8]) -> T,
) -> Result<T> {
    let slice = staging.slice(0..size_bytes);
    let (sender, mapped) = mpsc::channel();
    gpu.scoped("readback", || {
        slice.map_async(wgpu::MapMode::Read, move |result| {
            // Nobody listens any more when the wait below has failed.
            let _ = sender.send(result);
        });
    })?;
    let wait =
        wgpu::PollType::Wait { submission_index: Some(submission), timeout: Some(ANSWER_TIMEOUT) };
    if let Err(error) = gpu.device.poll(wait) {
        let message = "the GPU device did not answer in time".to_owned();
        return Err(gpu.give_up(message).caused_by(error));
    }
    gpu.check()?;
    // Whoever polls first is handed all answers that are due: another thread may be at ours still.
    match mapped.recv_timeout(ANSWER_TIMEOUT) {
        Ok(Ok(())) => {}
        Ok(Err(error)) => {
            gpu.check()?;
            return Err(Error::internal("the GPU's pictures cannot be read").caused_by(error));
        }
        Err(error) => {
            return Err(gpu
                .give_up("the GPU device did not hand back its pictures".to_owned())
                .caused_by(error));
        }
    }
    let value = {
        let view = slice.get_mapped_range().map_err(|error| {
            Error::internal("the GPU's pictures cannot be read").caused_by(error)
        })?;
        take(&view)
    };
    staging.unmap();
    Ok(value)
}
