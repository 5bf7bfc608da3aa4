//! The generated scene, made from a seed, and the file that gives it to other renderers.

use std::path::Path;

use safetensors::{Dtype, tensor::TensorView};
use segsplat_testing::scenes;

use crate::{
    error::{Error, Result},
    render::{Background, Frame, RenderRequest},
    scene::{Camera, Gaussians, Intrinsics},
};

/// A scene of about so many Gaussians with a bank of so many entries, and the camera between its
/// two photos.
pub(super) fn scene(
    gaussians: usize,
    bank: u16,
    [width, height]: [u32; 2],
) -> Result<(Gaussians, Camera)> {
    let side = (gaussians / 2).isqrt() as u32;
    let (gaussians, camera) = scenes::two_views(side, 1);
    // The same patches in both photos: (s, t) is the place on the surface.
    let patches = f64::from(bank).sqrt().ceil();
    let patch = |share: f64| (share.clamp(0.0, 0.999) * patches).floor();
    let entry = |i: u32| {
        let shift = if i < side * side { -0.04 } else { 0.04 };
        let place = |pixel: u32| (f64::from(pixel) + 0.5) / f64::from(side);
        let (s, t) = (place(i % side) + shift, place(i / side % side));
        let label = (patch(s) + patches * patch(t)) as usize % usize::from(bank.max(1));
        if bank == 0 { 0 } else { 1 + label as u16 }
    };
    let gaussians = gaussians.with_semantic_index((0..2 * side * side).map(entry).collect())?;
    let square = scenes::camera(height, height).intrinsics;
    let cx = 0.5 * f64::from(width);
    Ok((gaussians, Camera { intrinsics: Intrinsics { width, cx, ..square }, ..camera }))
}

/// The same with harmonics of a degree: small ones, that differ between neighbours.
pub(super) fn with_degree(gaussians: Gaussians, degree: u8) -> Gaussians {
    let count = (usize::from(degree) + 1).pow(2);
    let mut raw = gaussians.into_raw();
    raw.sh_degree = degree;
    let more = |(i, first): (usize, &[f32; 3])| {
        let small = move |k: usize| [0.05 * ((i + 7 * k) as f32 * 0.37).sin(); 3];
        std::iter::once(*first).chain((1..count).map(small))
    };
    raw.sh = raw.sh.iter().enumerate().flat_map(more).collect();
    scenes::checked(raw)
}

/// Writes a safetensors file: the scene as its arrays, `camera` as `[viewmat 16, fx, fy, cx, cy,
/// width, height, near, background 3]`, `color` as the renderer drew it, and `more` by name,
/// `[n, m]`.
pub(super) fn dump(
    path: &Path,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frame: &Frame,
    more: &[(&str, [usize; 2], &[f32])],
) -> Result<()> {
    let n = gaussians.len();
    let lens = request.camera.intrinsics;
    let viewmat = request.camera.camera_to_world.viewmat().transpose().to_cols_array();
    let mut camera: Vec<f32> = viewmat.iter().map(|&v| v as f32).collect();
    camera.extend([lens.fx, lens.fy, lens.cx, lens.cy].map(|v| v as f32));
    camera.extend([lens.width as f32, lens.height as f32, request.near]);
    let Background::Color(background) = request.background else {
        return Err(Error::internal("a generated scene has a backdrop"));
    };
    camera.extend(background);
    let color = frame.color.as_deref().unwrap_or_default();
    let (width, height) = (frame.width as usize, frame.height as usize);
    let k = gaussians.sh_count();
    let arrays: [(&str, Dtype, Vec<usize>, &[u8]); 8] = [
        ("means", Dtype::F32, vec![n, 3], bytemuck::cast_slice(gaussians.means())),
        ("quats", Dtype::F32, vec![n, 4], bytemuck::cast_slice(gaussians.quats())),
        ("scales", Dtype::F32, vec![n, 3], bytemuck::cast_slice(gaussians.scales())),
        ("opacities", Dtype::F32, vec![n], bytemuck::cast_slice(gaussians.opacities())),
        ("sh", Dtype::F32, vec![n, k, 3], bytemuck::cast_slice(gaussians.sh())),
        ("index", Dtype::U16, vec![n], bytemuck::cast_slice(gaussians.semantic_index())),
        ("camera", Dtype::F32, vec![camera.len()], bytemuck::cast_slice(&camera)),
        ("color", Dtype::F32, vec![height, width, 3], bytemuck::cast_slice(color)),
    ];
    let fault = |e| Error::internal("bench: the scene cannot be written").caused_by(e);
    let more = more.iter().map(|(name, shape, numbers)| {
        (*name, Dtype::F32, shape.to_vec(), bytemuck::cast_slice::<f32, u8>(numbers))
    });
    let views = arrays
        .into_iter()
        .chain(more)
        .map(|(name, dtype, shape, bytes)| Ok((name, TensorView::new(dtype, shape, bytes)?)))
        .collect::<std::result::Result<Vec<_>, safetensors::SafeTensorError>>()
        .map_err(fault)?;
    let bytes = safetensors::serialize(views, None).map_err(fault)?;
    fs_err::write(path, bytes).map_err(|e| Error::internal(format!("{}: {e}", path.display())))
}
