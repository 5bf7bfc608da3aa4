//! Frame times of a renderer on a generated scene, with the error beside them: `segsplat bench`
//! with `--gaussians`.
//!
//! The scene is what two photos give: a Gaussian a pixel on a wavy surface with steps, seen by two
//! cameras a fifth of the depth apart, drawn from between them. Its Gaussians carry bank indices in
//! patches, as things are: `--labels` times labels beside colour.

use std::{collections::BTreeMap, time::Instant};

use glam::{DVec3, Quat, Vec3};
use serde::Serialize;

use crate::{
    config::Config,
    error::{Error, Result},
    render::{
        Frame, Kinds, Labels, Quality, RenderRequest, Renderer,
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
    /// Labels to time beside colour.
    pub labels: Option<BenchLabels>,
    /// Rows of the bank (M): indices that occur in the scene.
    pub bank: u16,
}

/// Labels that a bench times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BenchLabels {
    /// Four numbers of a table's row, blended.
    Blend,
    /// The sparse weights of every index.
    Entries,
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
    /// Times of labels, where they were asked for.
    pub labels: Option<LabelTimes>,
}

/// What labels cost beside colour: medians of frames drawn in turn.
#[derive(Clone, Debug, Serialize)]
pub struct LabelTimes {
    /// Labels timed.
    pub labels: BenchLabels,
    /// Rows of the bank.
    pub bank: u16,
    /// Colour alone.
    pub color_ms: f64,
    /// Labels alone.
    pub labels_ms: f64,
    /// Colour and labels in one pass.
    pub both_ms: f64,
    /// `labels_ms / color_ms`.
    pub ratio: f64,
    /// Entries of the view; 0 for a blend.
    pub entries: usize,
    /// Difference to the labels of the CPU renderer, where it was asked for.
    pub compared: Option<Compared>,
}

/// How a picture differs from the CPU renderer's: colour, alpha, labels, and depth relative to
/// depth.
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
        quality: Quality::Exact,
        crop: None,
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
    let labels = match args.labels {
        Some(labels) => Some(label_times(&*renderer, &gaussians, &request, args, labels, config)?),
        None => None,
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
        labels,
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

/// Draws colour, labels and both in turn, so that a noisy machine is as noisy to each.
fn label_times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    args: &BenchArgs,
    labels: BenchLabels,
    config: &Config,
) -> Result<LabelTimes> {
    let mut random = Random(2);
    let wanted = match labels {
        BenchLabels::Entries => Labels::Entries,
        BenchLabels::Blend => Labels::Blend(
            (0..=args.bank)
                .map(|m| [(); 4].map(|()| if m == 0 { 0.0 } else { random.range(-1.0, 1.0) }))
                .collect(),
        ),
    };
    let with = |kinds, labels| RenderRequest { kinds, labels, ..request.clone() };
    let alone = with(Kinds::NONE, wanted.clone());
    let requests = [with(Kinds::COLOR, Labels::None), alone.clone(), with(Kinds::COLOR, wanted)];
    let mut runs = [const { Vec::new() }; 3];
    // The first round warms up.
    for round in 0..=args.frames {
        for (request, times) in requests.iter().zip(&mut runs) {
            let begun = Instant::now();
            renderer.render(gaussians, request)?;
            if round > 0 {
                times.push(ms(begun));
            }
        }
    }
    let [color_ms, labels_ms, both_ms] = runs.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    });
    let frame = renderer.render(gaussians, &alone)?;
    let compared = match args.compare_cpu {
        true => {
            let want = CpuRenderer::new(config.threads)?.render(gaussians, &alone)?;
            Some(compare(&frame, &want, gaussians, &alone)?)
        }
        false => None,
    };
    Ok(LabelTimes {
        labels,
        bank: args.bank,
        color_ms,
        labels_ms,
        both_ms,
        ratio: labels_ms / color_ms,
        entries: frame.entries.map_or(0, |entries| entries.index.len()),
        compared,
    })
}

/// Largest difference of each pixel over its channels; a NaN is infinitely far.
fn differences(got: &Frame, want: &Frame) -> Vec<f32> {
    fn pair<'a, T>(
        got: Option<&'a Vec<T>>,
        want: Option<&'a Vec<T>>,
    ) -> Option<(&'a [T], &'a [T])> {
        Some((got?.as_slice(), want?.as_slice()))
    }
    let colors = pair(got.color.as_ref(), want.color.as_ref());
    let depths = pair(got.depth.as_ref(), want.depth.as_ref());
    let alphas = pair(got.alpha.as_ref(), want.alpha.as_ref());
    let blends = pair(got.blend.as_ref(), want.blend.as_ref());
    let entries = got.entries.as_ref().zip(want.entries.as_ref());
    let pixels = want.width as usize * want.height as usize;
    (0..pixels)
        .map(|i| {
            let mut worst = 0.0_f32;
            let mut add = |difference: f32| {
                let d = if difference.is_nan() { f32::INFINITY } else { difference.abs() };
                worst = worst.max(d);
            };
            if let Some((got, want)) = colors {
                (0..3).for_each(|k| add(got[i][k] - want[i][k]));
            }
            if let Some((got, want)) = depths {
                add((got[i] - want[i]) / want[i].abs().max(1.0));
            }
            if let Some((got, want)) = alphas {
                add(got[i] - want[i]);
            }
            if let Some((got, want)) = blends {
                (0..4).for_each(|k| add(got[i][k] - want[i][k]));
            }
            if let Some((got, want)) = entries {
                let mut sums: BTreeMap<u16, f32> = got.pixel(i).collect();
                want.pixel(i).for_each(|(m, weight)| *sums.entry(m).or_default() -= weight);
                sums.into_values().for_each(&mut add);
            }
            worst
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
    Ok((gaussians, Camera { intrinsics: lens(args.size), camera_to_world }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::RendererChoice;

    #[test]
    fn a_wrong_pixel_is_a_fault_and_nan_is_far() {
        let args = BenchArgs {
            gaussians: 800,
            size: 24,
            frames: 1,
            compare_cpu: true,
            labels: Some(BenchLabels::Entries),
            bank: 24,
        };
        let config = Config { renderer: RendererChoice::Cpu, threads: 1, ..Config::default() };
        let report = run(&args, &config).expect("a bench of the CPU against itself");
        let compared = report.compared.expect("a comparison");
        assert_eq!((compared.max, compared.flips, compared.faults), (0.0, 0, 0), "itself");
        assert!(report.visible > 0, "the scene is seen");
        let labels = report.labels.expect("labels were timed");
        let compared = labels.compared.expect("labels were compared");
        assert_eq!((compared.max, compared.flips, compared.faults), (0.0, 0, 0), "itself");
        assert!(labels.entries > 24, "{} entries", labels.entries);

        let (gaussians, camera) = scene(&args).expect("a scene");
        let request = RenderRequest {
            camera,
            kinds: Kinds::ALL,
            labels: Labels::None,
            background: [0.0; 3],
            antialiased: false,
            near: 0.05,
            quality: Quality::Exact,
            crop: None,
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
        for labels in [Labels::Entries, Labels::Blend([[1.0; 4]; 25].into())] {
            let request = RenderRequest { labels, kinds: Kinds::NONE, ..request.clone() };
            let want = CpuRenderer::new(1).and_then(|cpu| cpu.render(&gaussians, &request));
            let want = want.expect("labels");
            let mut got = want.clone();
            if let Some(blend) = &mut got.blend {
                blend[7][3] += 0.5;
            }
            if let Some(entries) = &mut got.entries {
                entries.index[0] += 1;
            }
            let found = compare(&got, &want, &gaussians, &request).expect("a comparison");
            assert_eq!(found.flips + found.faults, 1, "a wrong label: {found:?}");
        }
    }
}
