//! The generated scene, made from a seed, and the file that gives it to other renderers.

use std::path::Path;

use glam::{DVec3, Quat, Vec3};
use safetensors::{Dtype, tensor::TensorView};

use super::Args;
use crate::{
    error::{Error, Result},
    render::{Frame, RenderRequest},
    scene::{Camera, CameraToWorld, Gaussians, Intrinsics, RawGaussians, SourcePixel},
};

/// A small seeded generator (splitmix64): the same scene on every machine.
pub(super) struct Random(pub(super) u64);

impl Random {
    pub(super) fn range(&mut self, low: f32, high: f32) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        low + (high - low) * (((z ^ (z >> 31)) >> 40) as f32 / (1_u64 << 24) as f32)
    }
}

/// The scene and the camera between its two photos.
///
/// # Errors
/// `internal` when the scene is no set of Gaussians.
pub fn scene(args: &Args) -> Result<(Gaussians, Camera)> {
    let lens = |side: u32| {
        let size = f64::from(side);
        let focal = 0.5 * size / 30.0_f64.to_radians().tan();
        let center = 0.5 * size;
        Intrinsics { fx: focal, fy: focal, cx: center, cy: center, width: side, height: side }
    };
    let mut random = Random(1);
    let side = (args.gaussians / 2).isqrt() as u32;
    let photo = lens(side);
    let patches = f64::from(args.bank).sqrt().ceil();
    let mut raw = RawGaussians::default();
    for shift in [-0.4, 0.4] {
        for i in 0..side * side {
            let (u, v) = (f64::from(i % side) + 0.5, f64::from(i / side) + 0.5);
            let (s, t) = (u / f64::from(side) + 0.1 * shift, v / f64::from(side));
            let step = if (s * 5.0).fract() + (t * 4.0).fract() < 0.7 { -1.2 } else { 0.0 };
            let z = 4.0 + 0.8 * (6.0 * s).sin() * (5.0 * t).cos() + step;
            let pixel = (z / photo.fx) as f32;
            let axis = Vec3::from_array([(); 3].map(|()| random.range(-1.0, 1.0)));
            let turn = Quat::from_axis_angle(axis.normalize_or(Vec3::Z), random.range(-3.1, 3.1));
            raw.means.push((photo.unproject(u, v, z) + DVec3::X * shift).as_vec3().into());
            raw.quats.push([turn.w, turn.x, turn.y, turn.z]);
            raw.scales.push([0.5, 0.5, 0.15].map(|k| pixel * k * random.range(0.6, 1.8)));
            raw.opacities.push(random.range(0.15, 0.98));
            raw.sh.push(
                [s * 9.0, t * 7.0, (s + t) * 5.0]
                    .map(|phase| 1.2 * phase.sin() as f32 + random.range(-0.2, 0.2)),
            );
            // The same patches in both photos: (s, t) is the place on the surface.
            let patch = |share: f64| (share.clamp(0.0, 0.999) * patches).floor();
            let label = (patch(s) + patches * patch(t)) as usize % usize::from(args.bank.max(1));
            raw.semantic_index.push(if args.bank == 0 { 0 } else { 1 + label as u16 });
            raw.source.push(SourcePixel::default());
        }
    }
    let camera_to_world = CameraToWorld::look_at(
        DVec3::new(0.07, -0.03, 0.0),
        DVec3::new(0.0, 0.0, 4.0),
        DVec3::NEG_Y,
        "bench",
    )?;
    let (gaussians, _) = Gaussians::sanitize(raw)?;
    let square = lens(args.size);
    let (width, cx) = (args.width(), 0.5 * f64::from(args.width()));
    Ok((gaussians, Camera { intrinsics: Intrinsics { width, cx, ..square }, camera_to_world }))
}

/// Writes a safetensors file: the scene as its arrays, `camera` as `[viewmat 16, fx, fy, cx, cy,
/// width, height, near, background 3]`, `color` as the renderer drew it.
pub(super) fn dump(
    path: &Path,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frame: &Frame,
) -> Result<()> {
    let n = gaussians.len();
    let lens = request.camera.intrinsics;
    let viewmat = request.camera.camera_to_world.viewmat().transpose().to_cols_array();
    let mut camera: Vec<f32> = viewmat.iter().map(|&v| v as f32).collect();
    camera.extend([lens.fx, lens.fy, lens.cx, lens.cy].map(|v| v as f32));
    camera.extend([lens.width as f32, lens.height as f32, request.near]);
    camera.extend(request.background);
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
    let views = arrays
        .into_iter()
        .map(|(name, dtype, shape, bytes)| Ok((name, TensorView::new(dtype, shape, bytes)?)))
        .collect::<std::result::Result<Vec<_>, safetensors::SafeTensorError>>()
        .map_err(fault)?;
    let bytes = safetensors::serialize(views, None).map_err(fault)?;
    fs_err::write(path, bytes).map_err(|e| Error::internal(format!("{}: {e}", path.display())))
}
