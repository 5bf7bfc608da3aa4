//! Frame times of a renderer on a generated scene, with the error beside them: `segsplat bench`
//! with `--gaussians`.
//!
//! The scene is what two photos give: a Gaussian a pixel on a wavy surface with steps, seen by two
//! cameras a fifth of the depth apart, drawn from between them.

use std::time::Instant;

use glam::{DVec3, Quat, Vec3};
use serde::Serialize;

use crate::{
    config::Config,
    error::{Error, Result},
    render::{
        Frame, Kinds, Labels, RenderRequest, Renderer,
        cpu::CpuRenderer,
        oracle,
        select::{AdapterReport, select},
    },
    scene::{Camera, CameraToWorld, Gaussians, Intrinsics, RawGaussians, SourcePixel},
};

/// Pixels apart by more than this are looked at by the oracle: one level of an 8-bit picture.
pub const DIFFERENCE_MAX: f32 = 1.0 / 255.0;
/// Most Gaussians that a bench makes.
pub const GAUSSIANS_MAX: usize = 16 << 20;

/// What to time.
#[derive(Clone, Copy, Debug)]
pub struct BenchArgs {
    /// Gaussians, 2 and more; rounded down to two square photos.
    pub gaussians: usize,
    /// Side of the square picture, pixels.
    pub size: u32,
    /// Frames after the first.
    pub frames: usize,
    /// Whether to compare with the CPU renderer.
    pub compare_cpu: bool,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct BenchReport {
    /// Name of the renderer.
    pub renderer: String,
    /// Adapters found, the one used marked.
    pub adapters: Vec<AdapterReport>,
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// Side of the picture, pixels.
    pub size: u32,
    /// Frames timed.
    pub frames: usize,
    /// Opening the renderer: adapter, device, kernels, threads.
    pub open_ms: f64,
    /// First frame: upload, room, warm-up.
    pub first_ms: f64,
    /// Median of the frames after it.
    pub median_ms: f64,
    /// Fastest of the frames after it.
    pub min_ms: f64,
    /// Gaussians that touch the picture.
    pub visible: u64,
    /// Gaussian-tile pairs.
    pub intersections: u64,
    /// Difference to the CPU renderer, where it was asked for.
    pub compared: Option<Compared>,
}

/// How a picture differs from the CPU renderer's: colour, alpha, and depth relative to depth.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Compared {
    /// Pixels compared.
    pub pixels: usize,
    /// Largest difference of the pixels that are not `flips`.
    pub max: f32,
    /// Mean difference of all pixels.
    pub mean: f64,
    /// Pixels apart by more than 1/255 where the oracle stands at a cliff.
    pub flips: usize,
    /// Pixels apart by more than 1/255 elsewhere: faults.
    pub faults: usize,
    /// Median frame of the CPU renderer, for scale.
    pub cpu_median_ms: f64,
}

/// Renders the scene of `args` with the renderer that `config` asks for.
///
/// # Errors
/// `invalid_request` when `args` are out of range, and those of [`select`] and of the renderer.
pub fn run(args: &BenchArgs, config: &Config) -> Result<BenchReport> {
    if !(2..=GAUSSIANS_MAX).contains(&args.gaussians) || args.size == 0 || args.frames == 0 {
        return Err(Error::invalid(format!(
            "bench: {} Gaussians at {} px, {} frames; there must be 2 to {GAUSSIANS_MAX}, 1 and 1",
            args.gaussians, args.size, args.frames
        )));
    }
    let (gaussians, camera) = scene(args)?;
    let request = RenderRequest {
        camera,
        kinds: Kinds { color: true, depth: args.compare_cpu, alpha: args.compare_cpu },
        labels: Labels::None,
        background: [0.1, 0.2, 0.3],
        antialiased: false,
        near: 0.05,
    };
    let begun = Instant::now();
    let (renderer, adapters) = select(config)?;
    let open_ms = ms(begun);
    let begun = Instant::now();
    let frame = renderer.render(&gaussians, &request)?;
    let first_ms = ms(begun);
    let times = times(&*renderer, &gaussians, &request, args.frames)?;
    let compared = if args.compare_cpu {
        let cpu = CpuRenderer::new(config.threads)?;
        let want = cpu.render(&gaussians, &request)?;
        let mut compared = compare(&frame, &want, &gaussians, &request)?;
        let times = self::times(&cpu, &gaussians, &request, args.frames.min(20))?;
        compared.cpu_median_ms = times[times.len() / 2];
        Some(compared)
    } else {
        None
    };
    Ok(BenchReport {
        renderer: renderer.name(),
        adapters,
        gaussians: gaussians.len(),
        size: args.size,
        frames: args.frames,
        open_ms,
        first_ms,
        median_ms: times[times.len() / 2],
        min_ms: times[0],
        visible: frame.stats.visible,
        intersections: frame.stats.intersections,
        compared,
    })
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Sorted times of `frames` frames, milliseconds.
fn times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frames: usize,
) -> Result<Vec<f64>> {
    let mut times = Vec::with_capacity(frames);
    for _ in 0..frames {
        let begun = Instant::now();
        renderer.render(gaussians, request)?;
        times.push(ms(begun));
    }
    times.sort_by(f64::total_cmp);
    Ok(times)
}

/// Largest difference of each pixel over its channels; a NaN is infinitely far.
fn differences(got: &Frame, want: &Frame) -> Vec<f32> {
    let empty = Vec::new();
    let colors = |frame: &Frame| frame.color.clone().unwrap_or_default();
    let (got_color, want_color) = (colors(got), colors(want));
    let depths = (got.depth.as_ref().unwrap_or(&empty), want.depth.as_ref().unwrap_or(&empty));
    let alphas = (got.alpha.as_ref().unwrap_or(&empty), want.alpha.as_ref().unwrap_or(&empty));
    (0..want_color.len())
        .map(|i| {
            let [r, g, b] = [0, 1, 2].map(|k| got_color[i][k] - want_color[i][k]);
            let depth = (depths.0[i] - depths.1[i]) / depths.1[i].abs().max(1.0);
            [r, g, b, depth, alphas.0[i] - alphas.1[i]].into_iter().fold(0.0, |worst: f32, d| {
                if d.is_nan() { f32::INFINITY } else { worst.max(d.abs()) }
            })
        })
        .collect()
}

fn compare(
    got: &Frame,
    want: &Frame,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Result<Compared> {
    let apart = differences(got, want);
    let far: Vec<usize> = (0..apart.len()).filter(|&i| apart[i] > DIFFERENCE_MAX).collect();
    let pixels: Vec<[u32; 2]> =
        far.iter().map(|&i| [i as u32 % want.width, i as u32 / want.width]).collect();
    let truth = oracle::render_pixels(gaussians, request, oracle::DepthKey::F32, &pixels)?;
    let flips = truth.iter().filter(|pixel| pixel.cliff.any()).count();
    let near = apart.iter().copied().filter(|&d| d <= DIFFERENCE_MAX);
    Ok(Compared {
        pixels: apart.len(),
        max: near.fold(0.0, f32::max),
        mean: apart.iter().map(|&d| f64::from(d)).sum::<f64>() / apart.len().max(1) as f64,
        flips,
        faults: far.len() - flips,
        cpu_median_ms: 0.0,
    })
}

/// A small seeded generator (splitmix64): the same scene on every machine.
struct Random(u64);

impl Random {
    fn range(&mut self, low: f32, high: f32) -> f32 {
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
pub fn scene(args: &BenchArgs) -> Result<(Gaussians, Camera)> {
    let lens = |side: u32| {
        let size = f64::from(side);
        let focal = 0.5 * size / 30.0_f64.to_radians().tan();
        let center = 0.5 * size;
        Intrinsics { fx: focal, fy: focal, cx: center, cy: center, width: side, height: side }
    };
    let mut random = Random(1);
    let side = (args.gaussians / 2).isqrt() as u32;
    let photo = lens(side);
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
            raw.semantic_index.push(0);
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
    Ok((gaussians, Camera { intrinsics: lens(args.size), camera_to_world }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::RendererChoice;

    #[test]
    fn a_wrong_pixel_is_a_fault_and_nan_is_far() {
        let args = BenchArgs { gaussians: 800, size: 24, frames: 1, compare_cpu: true };
        let config = Config { renderer: RendererChoice::Cpu, threads: 1, ..Config::default() };
        let report = run(&args, &config).expect("a bench of the CPU against itself");
        let compared = report.compared.expect("a comparison");
        assert_eq!((compared.max, compared.flips, compared.faults), (0.0, 0, 0), "itself");
        assert!(report.visible > 0, "the scene is seen");

        let (gaussians, camera) = scene(&args).expect("a scene");
        let request = RenderRequest {
            camera,
            kinds: Kinds::ALL,
            labels: Labels::None,
            background: [0.0; 3],
            antialiased: false,
            near: 0.05,
        };
        let want = CpuRenderer::new(1)
            .and_then(|cpu| cpu.render(&gaussians, &request))
            .expect("a picture");
        for wrong in [0.5, f32::NAN] {
            let mut got = want.clone();
            got.color.as_mut().expect("colour")[100][1] += wrong;
            let found = compare(&got, &want, &gaussians, &request).expect("a comparison");
            assert_eq!(found.flips + found.faults, 1, "{wrong}: {found:?}");
        }
    }
}
