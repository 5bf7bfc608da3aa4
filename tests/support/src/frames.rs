//! What comes out of a renderer by the plain definition, pixel by pixel.

use segsplat_render::{
    Background, DepthSteps, Frame, Levels, RenderRequest, Samples, levels::level,
};

/// What lies behind a pixel (column, row of the part drawn).
pub fn behind(request: &RenderRequest, [x, y]: [u32; 2]) -> [f32; 3] {
    match &request.background {
        Background::Color(color) => *color,
        Background::Backdrop(backdrop) => {
            let (u, v) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
            let ray = request.lens().unproject(u, v, 1.0);
            backdrop.color(request.camera.camera_to_world.rotation() * ray)
        }
    }
}

/// A frame of f32 pictures in the numbers that were asked for. Colour is that over the background.
pub fn rounded(frame: Frame, samples: Samples) -> Frame {
    if samples == Samples::F32 {
        return frame;
    }
    let Frame { color, depth, alpha, .. } = frame;
    let alpha = alpha.map(|alpha| alpha.into_iter().map(level).collect::<Vec<_>>());
    let rgb = color.map(|color| color.into_iter().map(|rgb| rgb.map(level)).collect::<Vec<_>>());
    let mut levels = Levels {
        depth: depth.map(|depth| DepthSteps::of(&depth)),
        alpha: alpha.clone(),
        ..Levels::default()
    };
    match (samples, rgb) {
        (Samples::LevelsRgba, Some(rgb)) => {
            let alpha = alpha.expect("alpha beside colour");
            let joined = rgb.into_iter().zip(alpha).map(|([r, g, b], alpha)| [r, g, b, alpha]);
            levels.rgba = Some(joined.collect());
        }
        (_, rgb) => levels.rgb = rgb,
    }
    Frame { color: None, depth: None, alpha: None, levels, ..frame }
}
