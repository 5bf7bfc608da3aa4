//! The backward pass on the device, in the buffers that the frame left: what the loss says of its
//! pictures goes up, what that means for each Gaussian comes down.

use std::slice;

use glam::DVec3;
use rayon::prelude::*;

use super::{
    batch_buffers::{BatchBuffers, BufferCopy},
    bindings::Inputs,
    buffers::GradientRow,
    drawing::{Drawing, Layout},
    frame::{ATTEMPTS_MAX, Tools},
    pipelines::{GRADIENT_WORDS, PAIR_SUMS},
    readback,
};
use crate::{
    DispatchTime, Frame, Kinds, RenderRequest,
    backward::{FrameGradients, Gradients},
    error::{Error, Result},
};

/// Fewest Gaussians that a thread reads.
const READ_MIN: usize = 1 << 14;

/// A view of which all stages have left their buffers.
struct DrawnView {
    layout: Layout,
    room: BatchBuffers,
    /// Columns and rows of tiles.
    tiles: [u32; 2],
    /// Gaussian-tile pairs.
    pairs: u64,
}

impl Tools<'_> {
    /// Draws a whole view, asks `loss` and writes `gradients`. Also the times of all dispatches,
    /// where they are marked.
    /// Errors: `limit_exceeded` when the pairs of the view are not held at once, and what `loss`
    /// says.
    pub(super) fn backward(
        &mut self,
        origin: DVec3,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<(Frame, Vec<DispatchTime>)> {
        let mut drawing = Drawing::new(origin, request, self.scene)?;
        let (layout, room) = self.whole(&mut drawing)?;
        let mut times = self.times()?;
        let tiles = drawing.tiles();
        let frame = drawing.finish(self.scratch)?;
        let by = loss(&frame)?;
        by.check_of(&frame)?;
        let drawn = DrawnView { layout, room, tiles, pairs: frame.stats.intersections };
        self.back(&drawn, &by, gradients)?;
        times.extend(self.times()?);
        Ok((frame, times))
    }

    /// Draws all rows of tiles in one submission; also where everything is left.
    fn whole(&mut self, drawing: &mut Drawing<'_>) -> Result<(Layout, BatchBuffers)> {
        let (layout, capacity_max) = (drawing.layout(drawing.whole(), 0), self.capacity_max(1));
        let (mut needed, mut attempts) = (0, 0);
        while attempts < ATTEMPTS_MAX && needed <= capacity_max {
            let capacity = self.capacity(1);
            let (alone, layouts) = (slice::from_mut(drawing), slice::from_ref(&layout));
            let (ended, room) = self.attempt(alone, layouts, capacity)?;
            if ended[0].complete {
                return Ok((layout, room));
            }
            needed = ended[0].plan.needed;
            attempts += 1;
        }
        Err(Error::limit("backward: Gaussian-tile pairs of a view", needed, capacity_max))
    }

    /// Goes back through a view.
    fn back(
        &mut self,
        DrawnView { layout, room, tiles, pairs }: &DrawnView,
        by: &FrameGradients,
        gradients: &mut Gradients,
    ) -> Result<()> {
        let (gpu, scene) = (self.gpu, self.scene);
        let numbers = u64::from(GRADIENT_WORDS) + 3 * u64::from(scene.sh_count);
        let gradient_bytes = 4 * u64::from(scene.count) * numbers;
        let sizes = [layout.picture_bytes(), 4 * pairs * u64::from(PAIR_SUMS), gradient_bytes];
        let backward = self.scratch.backward_room(gpu, sizes)?;
        let kinds = Kinds {
            color: by.color.is_some(),
            depth: by.depth.is_some(),
            alpha: by.alpha.is_some(),
        };
        let pictures: [(u32, Option<&[u8]>); 3] = [
            (layout.color, by.color.as_deref().map(bytemuck::cast_slice)),
            (layout.depth, by.depth.as_deref().map(bytemuck::cast_slice)),
            (layout.alpha, by.alpha.as_deref().map(bytemuck::cast_slice)),
        ];
        let inputs =
            Inputs { backward: Some(&backward), ..Inputs::new(self.kernels, room, Some(scene), 1) };
        gpu.scoped("backward", || {
            for (start, bytes) in pictures {
                if let Some(bytes) = bytes {
                    gpu.queue.write_buffer(&backward.by_pictures, u64::from(start) * 4, bytes);
                }
            }
            let mut stages = self.recorder(inputs, &[&backward.sums]);
            stages.backward(kinds, *tiles);
            stages.submit(&[BufferCopy {
                from: (&backward.gradients, 0),
                to: (&backward.staging, 0),
                bytes: gradient_bytes,
            }])
        })??;
        gradients.clear(scene.count as usize, scene.sh_count as usize);
        readback::read(gpu, &backward.staging, gradient_bytes, |bytes| take(bytes, gradients))
    }

    /// Times of the dispatches of the last submission; none where they are not marked.
    fn times(&self) -> Result<Vec<DispatchTime>> {
        self.marks.as_deref().map_or_else(|| Ok(Vec::new()), |marks| marks.read(self.gpu))
    }
}

/// Copies what the device wrote into `gradients`, which has the size of it.
fn take(bytes: &[u8], gradients: &mut Gradients) {
    let Gradients { means, quats, scales, opacities, sh, seen } = gradients;
    let (rows, by_sh) = bytes.split_at(means.len() * size_of::<GradientRow>());
    sh.copy_from_slice(bytemuck::cast_slice(by_sh));
    let rows: &[GradientRow] = bytemuck::cast_slice(rows);
    let out = means.par_iter_mut().zip(quats).zip(scales).zip(opacities).zip(seen);
    let out = out.zip(rows).with_min_len(READ_MIN);
    out.for_each(|(((((mean, quat), scale), opacity), seen), row)| {
        (*mean, *quat, *scale) = (row.mean, row.quat, row.scale);
        (*opacity, *seen) = (row.opacity, row.seen > 0.0);
    });
}
