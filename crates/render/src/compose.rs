//! A scene's view from its parts: layers of Gaussians, magnified where need be, and the backdrop.

use crate::{
    Frame, RenderRequest, Renderer,
    error::Result,
    scene::{Camera, Scene},
};

/// Alpha from which a pixel needs nothing behind it.
const OPAQUE: f32 = 0.99;

/// Renders a scene; with `backdrop`, colour is over the scene's backdrop instead of the
/// request's background. Neither adds anything to labels.
///
/// # Errors
/// Those of the renderer, and `limit_exceeded` when the layers have too many entries together.
pub fn render_scene(
    renderer: &dyn Renderer,
    scene: &Scene,
    request: &RenderRequest,
    backdrop: bool,
) -> Result<Frame> {
    let layers = scene.layers(&request.camera);
    let draw = |gaussians, request: &RenderRequest| {
        let magnified = scene.magnified(gaussians, &request.camera);
        renderer.render(magnified.as_deref().unwrap_or(gaussians), request)
    };
    let backdrop = backdrop && request.kinds.color;
    if layers.is_none() && !backdrop {
        return draw(&scene.gaussians, request);
    }
    let mut bare = RenderRequest { background: [0.0; 3], ..request.clone() };
    bare.kinds.alpha = true;
    let mut frame = match layers.as_deref() {
        None => draw(&scene.gaussians, &bare)?,
        Some([front, behind]) => {
            let mut frame = draw(front, &bare)?;
            if frame.alpha.iter().flatten().any(|alpha| *alpha < OPAQUE) {
                put_behind(&mut frame, &draw(behind, &bare)?)?;
            }
            frame
        }
    };
    if let (Some(color), Some(alpha)) = (&mut frame.color, &frame.alpha) {
        if backdrop {
            let seen = Camera { intrinsics: request.lens(), ..request.camera };
            scene.backdrop.fill(&seen, color, alpha);
        } else {
            for (pixel, alpha) in color.iter_mut().zip(alpha) {
                for (value, behind) in pixel.iter_mut().zip(request.background) {
                    *value += (1.0 - alpha) * behind;
                }
            }
        }
    }
    if !request.kinds.alpha {
        frame.alpha = None;
    }
    Ok(frame)
}

/// `front` over `behind`, both over black and of one size.
fn put_behind(front: &mut Frame, behind: &Frame) -> Result<()> {
    let (Some(alphas), Some(behind_alphas)) = (&mut front.alpha, &behind.alpha) else {
        return Ok(());
    };
    if let (Some(entries), Some(under)) = (&mut front.entries, &behind.entries) {
        *entries = entries.over(under, |i| 1.0 - alphas[i])?;
    }
    for (i, (alpha, under)) in alphas.iter_mut().zip(behind_alphas).enumerate() {
        let room = (1.0 - *alpha) * under;
        if let (Some(color), Some(under)) = (&mut front.color, &behind.color) {
            for (value, under) in color[i].iter_mut().zip(under[i]) {
                *value += (1.0 - *alpha) * under;
            }
        }
        if let (Some(blend), Some(under)) = (&mut front.blend, &behind.blend) {
            for (value, under) in blend[i].iter_mut().zip(under[i]) {
                *value += (1.0 - *alpha) * under;
            }
        }
        if let (Some(depth), Some(under)) = (&mut front.depth, &behind.depth) {
            let total = *alpha + room;
            if total > 0.0 {
                depth[i] = (depth[i] * *alpha + under[i] * room) / total;
            }
        }
        *alpha += room;
    }
    front.stats.visible += behind.stats.visible;
    front.stats.intersections += behind.stats.intersections;
    Ok(())
}
