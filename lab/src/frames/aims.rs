//! What a view costs that shows little of a scene: views of the generated scene aimed at it, half
//! past it and away from it, with and without the blocks of the renderer.

use glam::DVec3;
use serde_json::json;

use super::{Args, Drawing};
use crate::{
    error::Result,
    render::{DeviceTimes, RenderRequest, Skip, Switches, compare::differences},
    rows::{Rows, median},
    scene::{Camera, CameraToWorld},
};

/// Rounds in which all are timed.
const ROUNDS: usize = 3;

/// The view of the scene from its middle, and the same camera turned.
fn aims(request: &RenderRequest) -> Result<[(&'static str, RenderRequest); 4]> {
    let eye = request.camera.camera_to_world.center();
    let turned = |toward: DVec3| -> Result<RenderRequest> {
        let camera_to_world = CameraToWorld::look_at(eye, eye + toward, DVec3::NEG_Y, "bench")?;
        Ok(RenderRequest {
            camera: Camera { camera_to_world, ..request.camera },
            ..request.clone()
        })
    };
    Ok([
        ("all", request.clone()),
        ("aside", turned(DVec3::new(0.8, 0.0, 1.0))?),
        ("beside", turned(DVec3::X)?),
        ("away", turned(DVec3::NEG_Z)?),
    ])
}

/// Makes a row for each aim; its error is the difference between the frames with blocks and
/// without. Times are medians: of calls, and of the device where it has a clock. `share` is the
/// time with blocks over that of the aim `all`, of the device where it has a clock.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    args.check()?;
    let (gaussians, request) = args.scene()?;
    let open = |without| args.setup.renderer(Switches { without, ..args.switches() });
    let renderers = [open(None)?.0, open(Some(Skip::Blocks))?.0];
    let mut all_ms = None;
    for (aim, request) in aims(&request)? {
        let of = |at: usize| Drawing {
            renderer: &*renderers[at],
            gaussians: &gaussians,
            request: &request,
        };
        let frames = [of(0).frame()?, of(1).frame()?];
        let apart = differences(&frames[0], &frames[1]);
        let mut calls = [const { Vec::new() }; 2];
        let mut devices: [Vec<DeviceTimes>; 2] = [const { Vec::new() }; 2];
        for _ in 0..ROUNDS {
            for at in 0..2 {
                let frames = args.frames.div_ceil(ROUNDS);
                calls[at].extend(of(at).times(frames)?);
                devices[at].extend(of(at).device_times(frames)?);
            }
        }
        let device = devices.each_ref().map(|runs| {
            let total = runs.iter().map(|run| run.total_ms).collect::<Vec<_>>();
            (!total.is_empty()).then(|| median(total))
        });
        let [call_ms, plain_call_ms] = calls.map(median);
        let ms = device[0].unwrap_or(call_ms);
        let share = ms / *all_ms.get_or_insert(ms);
        let row = json!({
            "renderer": renderers[0].name(),
            "gaussians": gaussians.len(),
            "width": args.width(),
            "height": args.size,
            "aim": aim,
            "visible": frames[0].stats.visible,
            "call_ms": call_ms,
            "device_ms": device[0],
            "share": share,
            "without_call_ms": plain_call_ms,
            "without_device_ms": device[1],
            "stages": devices[0].last().map(|run| &run.stages),
        });
        let error = json!({
            "pixels": apart.iter().filter(|&&d| d > 0.0).count(),
            "max": apart.into_iter().fold(0.0, f32::max),
        });
        rows.push(error, row)?;
    }
    Ok(())
}
