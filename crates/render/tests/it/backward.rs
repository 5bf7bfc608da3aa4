//! The backward pass: the oracle against finite differences of the forward oracle, the CPU kernel
//! and the shaders against the oracle.

use std::sync::Arc;

use segsplat_core::scene::{Backdrop, CameraToWorld, Gaussians, RawGaussians, SourcePixel};
use segsplat_render::{
    Background, DifferentiableRenderer, Kinds, Layer, RenderRequest, Source,
    backward::{FrameGradients, Gradients},
    cpu::CpuRenderer,
    oracle,
    switches::{Switches, Width},
};
use segsplat_testing::{
    backward,
    compare::gradient_errors,
    scenes::{Random, camera, checked, cloud, push, request, two_views},
};

use crate::{
    common::{both_kernels, open},
    fuzz::{environment, poisoned},
};

/// A loss that is linear in every number of the frame.
pub(crate) fn linear(pixels: usize, seed: u64) -> FrameGradients {
    let mut random = Random(seed);
    let mut number = || random.range(-1.0, 1.0);
    FrameGradients {
        color: Some((0..pixels).map(|_| [number(), number(), number()]).collect()),
        depth: Some((0..pixels).map(|_| number()).collect()),
        alpha: Some((0..pixels).map(|_| number()).collect()),
    }
}

/// The same loss on some of the pixels.
pub(crate) fn only(loss: &FrameGradients, keep: &[bool]) -> FrameGradients {
    let mut loss = loss.clone();
    for (i, _) in keep.iter().enumerate().filter(|(_, keep)| !**keep) {
        loss.color.as_mut().unwrap()[i] = [0.0; 3];
        loss.depth.as_mut().unwrap()[i] = 0.0;
        loss.alpha.as_mut().unwrap()[i] = 0.0;
    }
    loss
}

/// Few Gaussians over a small picture: opaque ones, needles, some in front of many.
pub(crate) fn few(random: &mut Random, sh_degree: u8) -> RawGaussians {
    let mut raw = RawGaussians { sh_degree, ..RawGaussians::default() };
    for i in 0..14 {
        let depth = random.range(2.0, 6.0);
        let mean = [random.range(-0.7, 0.7) * depth, random.range(-0.7, 0.7) * depth, depth];
        let quat = [(); 4].map(|()| random.range(-1.0, 1.0));
        let scales = [(); 3].map(|()| random.range(0.05, 0.9));
        // The first ones are at the largest alpha and end rays.
        let opacity = if i < 3 { 1.0 } else { random.range(0.1, 0.97) };
        let sh: Vec<[f32; 3]> = (0..(usize::from(sh_degree) + 1).pow(2))
            .map(|_| [(); 3].map(|()| random.range(-1.0, 1.2)))
            .collect();
        push(&mut raw, mean, quat, scales, opacity, &sh);
        raw.source.last_mut().unwrap().view = i % 3;
    }
    raw
}

/// Every number of Gaussian `i` with its step: place, step, derivative of the oracle.
type Parameter = fn(&mut RawGaussians, usize) -> &mut f32;

fn places(sh_count: usize) -> Vec<(&'static str, usize, Parameter)> {
    let mut all: Vec<(&'static str, usize, Parameter)> = Vec::new();
    for k in 0..3 {
        all.push(("mean", k, |raw, at| &mut raw.means[at / 3][at % 3]));
        all.push(("scale", k, |raw, at| &mut raw.scales[at / 3][at % 3]));
    }
    for k in 0..4 {
        all.push(("quat", k, |raw, at| &mut raw.quats[at / 4][at % 4]));
    }
    all.push(("opacity", 0, |raw, at| &mut raw.opacities[at]));
    for k in 0..3 * sh_count {
        all.push(("sh", k, |raw, at| &mut raw.sh[at / 3][at % 3]));
    }
    all
}

/// Numbers a Gaussian has of a kind.
fn stride(kind: &str, sh_count: usize) -> usize {
    match kind {
        "mean" | "scale" => 3,
        "quat" => 4,
        "opacity" => 1,
        _ => 3 * sh_count,
    }
}

fn derivative(of: &Gradients<f64>, kind: &str, at: usize) -> f64 {
    match kind {
        "mean" => of.means[at / 3][at % 3],
        "scale" => of.scales[at / 3][at % 3],
        "quat" => of.quats[at / 4][at % 4],
        "opacity" => of.opacities[at],
        _ => of.sh[at / 3][at % 3],
    }
}

/// The loss of each pixel, and which Gaussians make it, for a check that no cliff was crossed.
pub(crate) fn losses(
    gaussians: &Gaussians,
    request: &RenderRequest,
    loss: &FrameGradients,
) -> Vec<(f64, Vec<usize>)> {
    let width = request.camera.intrinsics.width;
    let seen = oracle::render(gaussians, request).expect("the truth");
    let of_pixel = |(i, pixel): (usize, &oracle::OraclePixel)| {
        let at = [i as u32 % width, i as u32 / width];
        let who = oracle::contributions(gaussians, request, at, None).expect("contributions");
        let color = loss.color.as_ref().unwrap()[i];
        let sum: f64 = (0..3).map(|k| f64::from(color[k]) * pixel.color[k]).sum();
        let depth = f64::from(loss.depth.as_ref().unwrap()[i]) * pixel.depth;
        let alpha = f64::from(loss.alpha.as_ref().unwrap()[i]) * pixel.alpha;
        // Which are at the largest alpha is a cliff too.
        let mut before = 1.0;
        let clamped = who.iter().map(|c| {
            let alpha = c.weight / before;
            before -= c.weight;
            2 * c.gaussian + usize::from(alpha > 0.998_999)
        });
        (sum + depth + alpha, clamped.collect())
    };
    seen.iter().enumerate().map(of_pixel).collect()
}

/// Central differences of every number of some Gaussians.
fn check_differences(name: &str, raw: &RawGaussians, request: &RenderRequest) {
    let base = checked(raw.clone());
    assert_eq!(base.len(), raw.means.len(), "{name}: all are valid");
    let raw = base.clone().into_raw();
    let k = base.sh_count();
    let lens = request.camera.intrinsics;
    let loss = linear((lens.width * lens.height) as usize, 77);
    let at_rest = losses(&base, request, &loss);
    let (mut worst, mut checked_numbers, mut nonzero) = (0.0_f64, 0, 0);
    for (kind, offset, place) in places(k) {
        // An opacity of 1 has no derivative: it cannot be more.
        let first = if kind == "opacity" { 3 } else { 0 };
        for i in first..base.len() {
            let at = i * stride(kind, k) + offset;
            let step = 2.0_f32.powi(-9);
            let moved = |sign: f32| {
                let mut moved = raw.clone();
                let number = place(&mut moved, at);
                *number += sign * step;
                let value = f64::from(*number);
                // As it is: f64 scales quaternions to length 1, f32 would round them.
                (Gaussians::restore(moved.clone()).unwrap_or_else(|_| checked(moved)), value)
            };
            let ((up, high), (down, low)) = (moved(1.0), moved(-1.0));
            let (up, down) = (losses(&up, request, &loss), losses(&down, request, &loss));
            let keep: Vec<bool> = (0..up.len())
                .map(|p| up[p].1 == at_rest[p].1 && down[p].1 == at_rest[p].1)
                .collect();
            let difference: f64 = keep
                .iter()
                .enumerate()
                .filter(|(_, k)| **k)
                .map(|(p, _)| up[p].0 - down[p].0)
                .sum();
            let want = difference / (high - low);
            let found =
                backward::gradients(&base, request, &only(&loss, &keep)).expect("gradients");
            let got = derivative(&found, kind, at);
            // The third derivative times the step squared, and f32's rounding of a quaternion.
            let error = (got - want).abs() / (want.abs() + 0.05);
            assert!(error < 5e-3, "{name}: {kind} {offset} of {i} is {got}, not {want}");
            worst = worst.max(error);
            checked_numbers += 1;
            nonzero += usize::from(got != 0.0);
        }
    }
    println!("{name}: {checked_numbers} numbers, {nonzero} not 0, worst difference {worst:.1e}");
    assert!(nonzero * 2 > checked_numbers, "{name}: most numbers count");
}

/// Photos of a pixel of `scale` at depth 1, one of them behind: large pixels magnify.
fn sources(scale: f32) -> Arc<[Source]> {
    let source = |x: f32, layer: Layer| Source {
        center: [x, 0.1, -4.0],
        axis: [0.0, 0.0, 1.0],
        scale,
        layer,
    };
    [source(0.0, Layer::Front), source(0.3, Layer::Behind)].into()
}

fn sky() -> Background {
    let mut random = Random(4);
    let cells = 0..Backdrop::WIDTH * Backdrop::HEIGHT;
    let cells = cells.map(|_| [(); 3].map(|()| random.bits() as u8)).collect();
    Background::Backdrop(Arc::new(Backdrop::from_cells(cells).expect("all cells")))
}

fn small(width: u32, height: u32) -> RenderRequest {
    RenderRequest { kinds: Kinds::ALL, ..request(camera(width, height)) }
}

#[test]
fn the_oracle_agrees_with_finite_differences() {
    for (name, sh_degree, change) in [
        ("plain", 0, (|_| ()) as fn(&mut RenderRequest)),
        ("sky, degree 2", 2, |request| request.background = sky()),
        ("antialiased, degree 1", 1, |request| request.antialiased = true),
        ("layers and magnification", 0, |request| request.sources = sources(0.05)),
        ("shown smaller", 0, |request| request.sources = sources(0.02)),
    ] {
        let raw = few(&mut Random(3 + u64::from(sh_degree)), sh_degree);
        let mut request = small(9, 8);
        change(&mut request);
        check_differences(name, &raw, &request);
    }
}

/// Quantiles of the relative errors of derivatives, and the largest that is allowed. The last one
/// says that no derivative has the wrong sign: sums over pixels may cancel to a thousandth.
const ERRORS: [(f64, f64); 4] = [(0.5, 1e-4), (0.99, 1e-2), (0.999, 5e-2), (1.0, 0.99)];

/// A renderer against the oracle on pixels that are no cliff.
fn judge(
    name: &str,
    renderer: &dyn DifferentiableRenderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
) {
    let truth = oracle::render(gaussians, request).expect("the truth");
    let keep: Vec<bool> = truth.iter().map(|pixel| !pixel.cliff.any()).collect();
    let loss = only(&linear(truth.len(), 5), &keep);
    let want = backward::gradients(gaussians, request, &loss).expect("the truth");
    let mut got = Gradients::default();
    renderer.backward(gaussians, request, &mut |_| Ok(loss.clone()), &mut got).expect("gradients");
    let mut counts = want.opacities.iter().zip(&got.seen).filter(|(by, _)| **by != 0.0);
    assert!(counts.all(|(_, seen)| *seen), "{name}: what counts is seen");
    let errors = gradient_errors(&got, &want);
    let at = |share: f64| errors[(share * (errors.len() - 1) as f64) as usize];
    let found = ERRORS.map(|(share, _)| at(share));
    let told = found.map(|error| format!("{error:.1e}")).join(", ");
    println!("{name}: {} Gaussians, {} numbers: {told}", gaussians.len(), errors.len());
    for ((share, most), found) in ERRORS.into_iter().zip(found) {
        assert!(found <= most, "{name}: quantile {share} is {found:.1e}");
    }
}

/// Views in which a backward pass does all that it can.
fn judge_all(renderer: &dyn DifferentiableRenderer) {
    let (pair, middle) = two_views(32, 1);
    judge("two views", renderer, &pair, &RenderRequest { kinds: Kinds::ALL, ..request(middle) });
    for (name, sh_degree, change) in [
        ("cloud", 0, (|_| ()) as fn(&mut RenderRequest)),
        ("sky, degree 2", 2, |request| request.background = sky()),
        ("colour behind", 3, |request| request.background = Background::Color([0.3, 0.6, 0.9])),
        ("antialiased, degree 1", 1, |request| request.antialiased = true),
    ] {
        let mut request = small(70, 45);
        change(&mut request);
        judge(name, renderer, &cloud(3_000, sh_degree, 8), &request);
    }
    let mut raw = cloud(2_000, 0, 9).into_raw();
    for (i, source) in raw.source.iter_mut().enumerate() {
        *source = SourcePixel { view: (i % 3) as u16, ..*source };
    }
    for (name, scale) in [("layers and magnification", 0.05), ("shown smaller", 0.003)] {
        let request = RenderRequest { sources: sources(scale), ..small(64, 48) };
        judge(name, renderer, &checked(raw.clone()), &request);
    }
    // Most of 130 tiles each.
    let large = fog(200, 1.2, [0.4, 0.05]);
    judge("large ones", renderer, &large, &small(200, 150));
    // Lists of two and three runs of the sort, which end in either half of the pairs, and more
    // parts met than a workgroup holds at once.
    for count in [3_000, 5_000] {
        judge("one tile", renderer, &fog(count, 0.4, [0.6, 0.005]), &small(16, 16));
    }
}

/// Gaussians of shapes, places and lenses at the ends of their ranges.
fn judge_extremes(renderer: &dyn DifferentiableRenderer) {
    let wide = small(130, 70);
    let smooth = RenderRequest { antialiased: true, ..wide.clone() };
    let needles = |longest: f32| {
        shaped(400, [0.05, 0.6], move |random| [random.range(0.5, longest), 1e-4, 1e-5])
    };
    judge("needles of 0.5 to 5 m", renderer, &needles(5.0), &wide);
    judge("needles of 0.5 to 60 m", renderer, &needles(60.0), &wide);
    let needles = shaped(400, [0.05, 0.6], |random| {
        let long = random.range(0.2, 2.0);
        [long, long * 1e-2, long * 1e-2]
    });
    judge("needles of 100 to 1", renderer, &needles, &wide);
    judge("antialiased needles", renderer, &needles, &smooth);
    let mut raw = cloud(3_000, 0, 71).into_raw();
    raw.scales.iter_mut().for_each(|scale| scale[0] *= 200.0);
    judge("a cloud stretched 200 times", renderer, &checked(raw), &small(70, 45));
    let giants = shaped(60, [0.02, 0.05], |random| [(); 3].map(|()| random.range(1.0, 300.0)));
    judge("giants", renderer, &giants, &wide);
    let discs = shaped(400, [0.05, 0.6], |random| [random.range(0.01, 0.1), 1e-12, 0.05]);
    judge("discs", renderer, &discs, &wide);
    judge("antialiased discs", renderer, &discs, &smooth);
    let specks = shaped(2_000, [0.05, 0.6], |random| [1e-7, random.range(1e-7, 2e-7), 3e-7]);
    judge("specks", renderer, &specks, &wide);
    let mut raw = cloud(3_000, 1, 71).into_raw();
    raw.opacities.fill(1.0);
    judge("opaque", renderer, &checked(raw), &small(70, 45));
    let by = 2.0_f32.powi(-20);
    let mut raw = cloud(3_000, 0, 71).into_raw();
    raw.origin *= f64::from(by);
    raw.means.iter_mut().chain(&mut raw.scales).flatten().for_each(|value| *value *= by);
    let near = RenderRequest { near: 0.05 * by, ..small(70, 45) };
    judge("a millionth of the size", renderer, &checked(raw), &near);
    let mut raw = cloud(3_000, 1, 72).into_raw();
    raw.means.iter_mut().for_each(|mean| mean[0] += 1e7);
    let mut far = small(70, 45);
    let mut pose = far.camera.camera_to_world.to_row_major();
    pose[3] += 1e7;
    far.camera.camera_to_world = CameraToWorld::from_row_major(&pose, "far").expect("a pose");
    judge("ten million metres away", renderer, &checked(raw), &far);
    for degrees in [0.1_f64, 1.0, 133.0, 170.0] {
        let slope = (degrees.to_radians() / 2.0).tan();
        // What the lens of 60 degrees sees, as narrow or as wide.
        let by = (slope / 30.0_f64.to_radians().tan()) as f32;
        let mut raw = cloud(3_000, 0, 71).into_raw();
        raw.origin *= f64::from(by);
        raw.means.iter_mut().for_each(|mean| (mean[0], mean[1]) = (mean[0] * by, mean[1] * by));
        raw.scales.iter_mut().flatten().for_each(|scale| *scale *= by.min(1.0));
        let mut request = small(70, 45);
        let focal = 35.0 / slope;
        (request.camera.intrinsics.fx, request.camera.intrinsics.fy) = (focal, focal);
        judge(&format!("{degrees} degrees"), renderer, &checked(raw), &request);
    }
}

/// `count` Gaussians in front of the camera, of opacities between two, with scales by `scale`.
fn shaped(count: usize, opacity: [f32; 2], scale: impl Fn(&mut Random) -> [f32; 3]) -> Gaussians {
    let mut random = Random(2);
    let mut raw = RawGaussians::default();
    for _ in 0..count {
        let depth = random.range(1.0, 6.0);
        let mean = [random.range(-0.7, 0.7) * depth, random.range(-0.7, 0.7) * depth, depth];
        let color = [(); 3].map(|()| random.range(-1.0, 1.2));
        let (scale, opacity) = (scale(&mut random), random.range(opacity[0], opacity[1]));
        push(&mut raw, mean, random.quat(), scale, opacity, &[color]);
    }
    checked(raw)
}

/// A turned sphere is the same sphere. A rest of rounding would be a full step of Adam.
fn judge_spheres(renderer: &dyn DifferentiableRenderer) {
    let spheres = shaped(400, [0.05, 0.6], |random| [random.range(0.01, 0.4); 3]);
    let loss = linear(70 * 45, 5);
    for antialiased in [false, true] {
        let request = RenderRequest { antialiased, ..small(70, 45) };
        let mut found = Gradients::default();
        let loss = &mut |_: &_| Ok(loss.clone());
        renderer.backward(&spheres, &request, loss, &mut found).expect("gradients");
        assert!(found.scales.iter().filter(|by| by[0] != 0.0).count() > 300, "most are seen");
        assert!(found.quats.iter().flatten().all(|by| *by == 0.0), "a sphere is turned");
    }
}

/// `count` Gaussians of about `size` in front of the camera, within `spread` of its axis, of about
/// `opacity`.
fn fog(count: usize, size: f32, [spread, opacity]: [f32; 2]) -> Gaussians {
    let mut random = Random(91);
    let mut raw = RawGaussians::default();
    for _ in 0..count {
        let depth = random.range(2.0, 6.0);
        let mean = [random.range(-spread, spread) * depth, random.range(-spread, spread) * depth];
        let scales = [(); 3].map(|()| size * random.range(0.3, 1.0));
        let color = [(); 3].map(|()| random.range(-1.0, 1.2));
        let opacity = opacity * random.range(0.9, 1.9);
        push(&mut raw, [mean[0], mean[1], depth], random.quat(), scales, opacity, &[color]);
    }
    checked(raw)
}

#[test]
fn the_kernel_agrees_with_the_oracle() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    judge_all(&cpu);
    judge_extremes(&cpu);
    judge_spheres(&cpu);
}

#[test]
fn the_shaders_agree_with_the_oracle() {
    for gpu in both_kernels() {
        judge_all(gpu);
        judge_extremes(gpu);
        judge_spheres(gpu);
    }
}

#[test]
fn the_shaders_agree_with_the_kernel_whatever_the_loss_depends_on() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    let gaussians = cloud(2_000, 1, 12);
    let request = RenderRequest { background: sky(), ..small(60, 50) };
    let truth = oracle::render(&gaussians, &request).expect("the truth");
    let keep: Vec<bool> = truth.iter().map(|pixel| !pixel.cliff.any()).collect();
    let all = only(&linear(keep.len(), 8), &keep);
    let none = FrameGradients::default();
    let color = FrameGradients { color: all.color.clone(), ..none.clone() };
    let depth = FrameGradients { depth: all.depth.clone(), ..none.clone() };
    let alpha = FrameGradients { alpha: all.alpha, ..none.clone() };
    for gpu in both_kernels() {
        for (name, loss) in
            [("none", &none), ("colour", &color), ("depth", &depth), ("alpha", &alpha)]
        {
            let of = |renderer: &dyn DifferentiableRenderer| {
                let mut found = Gradients::default();
                let loss = &mut |_: &_| Ok(loss.clone());
                let frame = renderer.backward(&gaussians, &request, loss, &mut found);
                (found, frame.expect("a pass"))
            };
            let ((got, shown), (want, seen)) = (of(gpu), of(&cpu));
            let near = shown
                .color
                .unwrap()
                .iter()
                .flatten()
                .zip(seen.color.unwrap().as_flattened())
                .filter(|(a, b)| (*a - *b).abs() < 1e-3)
                .count();
            assert!(near * 100 > 99 * 3 * keep.len(), "{name}: the frame, {near} numbers");
            let errors = gradient_errors(&got, &want);
            if name == "none" {
                assert!(errors.is_empty() && got.sh.iter().flatten().all(|v| *v == 0.0));
                continue;
            }
            let (median, most) = (errors[errors.len() / 2], errors[errors.len() * 99 / 100]);
            println!("{name}: {} numbers, {median:.1e}, 99 % {most:.1e}", errors.len());
            // Both have errors of their own.
            assert!(median <= 2e-4 && most <= 2e-2, "{name}: {median:.1e}, 99 % {most:.1e}");
        }
    }
}

#[test]
fn the_shaders_give_the_same_bits_whatever_was_before() {
    let (one, other) = (cloud(3_000, 1, 30), cloud(9_000, 2, 31));
    for gpu in both_kernels() {
        let of = |gaussians: &Gaussians, width: u32, height: u32| {
            let loss = linear((width * height) as usize, 6);
            let request = RenderRequest { background: sky(), ..small(width, height) };
            let mut found = Gradients::default();
            gpu.backward(gaussians, &request, &mut |_| Ok(loss.clone()), &mut found).unwrap();
            found
        };
        let first = of(&one, 90, 70);
        assert!(first == of(&one, 90, 70), "twice the same");
        let _larger = of(&other, 120, 90);
        assert!(first == of(&one, 90, 70), "after others");
    }
}

#[test]
fn a_device_lost_between_frame_and_gradients_is_opened_again() {
    let Some(gpu) = open(|_| {}) else { return };
    let (gaussians, loss) = (cloud(500, 0, 3), linear(40 * 30, 6));
    let (mut asked, mut found) = (0, Gradients::default());
    let mut lossy = |_: &_| {
        asked += 1;
        if asked == 1 {
            gpu.internals().lose_devices();
        }
        Ok(loss.clone())
    };
    gpu.backward(&gaussians, &small(40, 30), &mut lossy, &mut found).expect("on a new device");
    assert_eq!(asked, 2, "of an equal frame");
    let mut again = Gradients::default();
    gpu.backward(&gaussians, &small(40, 30), &mut |_| Ok(loss.clone()), &mut again).unwrap();
    assert!(found == again, "the same numbers");
}

#[test]
fn no_gaussians_have_no_gradients() {
    let empty = checked(RawGaussians::default());
    let renderers: Vec<&dyn DifferentiableRenderer> =
        both_kernels().map(|gpu| gpu as &dyn DifferentiableRenderer).collect();
    let cpu = CpuRenderer::new(1).expect("a thread");
    for renderer in renderers.into_iter().chain([&cpu as &dyn DifferentiableRenderer]) {
        let (loss, mut found) = (linear(12, 6), Gradients::default());
        found.clear(3, 1);
        let frame =
            renderer.backward(&empty, &small(4, 3), &mut |_| Ok(loss.clone()), &mut found).unwrap();
        assert_eq!(frame.color.map(|color| color.len()), Some(12), "the background");
        assert!(found.means.is_empty() && found.seen.is_empty(), "nothing is left");
    }
}

#[test]
fn the_kernel_is_the_same_for_any_threads_and_near_for_any_lanes() {
    let gaussians = cloud(5_000, 1, 30);
    let request = RenderRequest { background: sky(), ..small(90, 70) };
    let loss = linear(90 * 70, 6);
    let of = |threads: usize, width: Option<Width>| {
        let switches = Switches { width, ..Switches::default() };
        let cpu = CpuRenderer::with_switches(threads, &switches).expect("threads");
        let mut found = Gradients::default();
        // Twice: what a pass leaves behind does not count.
        for _ in 0..2 {
            cpu.backward(&gaussians, &request, &mut |_| Ok(loss.clone()), &mut found).unwrap();
        }
        found
    };
    let one = of(1, None);
    assert!(one == of(3, None), "three threads give other numbers than one");
    for width in Width::ALL.into_iter().filter(|width| width.available()) {
        let other = of(2, Some(width));
        let same = one.means.iter().flatten().zip(other.means.iter().flatten());
        let mut apart: Vec<f32> = same.map(|(a, b)| (a - b).abs() / (a.abs() + 1e-6)).collect();
        apart.sort_by(f32::total_cmp);
        assert!(apart[apart.len() / 2] < 1e-5, "{width:?}: {}", apart[apart.len() / 2]);
    }
}

#[test]
fn a_view_of_more_pairs_than_are_held_is_refused() {
    let switches = || Switches { isects_max: Some(20), ..Switches::default() };
    let few = CpuRenderer::with_switches(1, &switches()).expect("a thread");
    check_refusals(&few, &CpuRenderer::new(1).expect("a thread"));
    if let Some(few) = open(|options| options.switches.isects_max = Some(20)) {
        both_kernels().take(1).for_each(|gpu| check_refusals(&few, gpu));
    }
}

/// `few` holds 20 pairs.
fn check_refusals(few: &dyn DifferentiableRenderer, renderer: &dyn DifferentiableRenderer) {
    let loss = linear(90 * 70, 6);
    let (scene, mut found) = (cloud(30, 0, 1), Gradients::default());
    let told = few.backward(&scene, &small(90, 70), &mut |_| Ok(loss.clone()), &mut found);
    assert!(told.expect_err("too many pairs").message().contains("20"), "names the bound");
    let none = &mut |_: &_| Ok(linear(3, 1));
    let told = renderer.backward(&scene, &small(90, 70), none, &mut found);
    assert!(told.expect_err("another size").message().contains("6300"), "names the size");
    let unasked = RenderRequest { kinds: Kinds::COLOR, ..small(90, 70) };
    let told = renderer.backward(&scene, &unasked, &mut |_| Ok(loss.clone()), &mut found);
    assert!(told.expect_err("no depth").message().contains("depth"), "names the picture");
}

#[test]
fn poisoned_gaussians_never_make_a_bad_gradient() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    fuzz(&cpu, environment("FUZZ_SCENES", 300), environment("FUZZ_GAUSSIANS", 80));
}

/// The long form: `FUZZ_SCENES=1000 FUZZ_GAUSSIANS=2001`, about 10^6 Gaussians for each form of the
/// kernels.
#[test]
fn poisoned_gaussians_never_make_a_bad_gradient_on_a_gpu() {
    for gpu in both_kernels() {
        fuzz(gpu, environment("FUZZ_SCENES", 40), environment("FUZZ_GAUSSIANS", 80));
    }
}

fn fuzz(renderer: &dyn DifferentiableRenderer, scenes: u64, most: u64) {
    let seed = environment("FUZZ_SEED", 41);
    let (mut fuzzed, mut told) = (0, 0);
    let mut found = Gradients::default();
    for iteration in 0..scenes {
        let mut random = Random(seed.wrapping_mul(7_001) + iteration);
        let sh_degree = (random.bits() % 4) as u8;
        let count = random.bits() % most;
        let raw = poisoned(&mut random, count, sh_degree);
        let (gaussians, _) = Gaussians::sanitize(raw).expect("arrays of equal length");
        let (width, height) = (1 + random.bits() as u32 % 50, 1 + random.bits() as u32 % 50);
        let near = [1e-30, 0.01, 1.0][random.bits() as usize % 3];
        let antialiased = random.bits().is_multiple_of(2);
        let request = RenderRequest { near, antialiased, ..small(width, height) };
        let loss = linear((width * height) as usize, iteration);
        renderer
            .backward(&gaussians, &request, &mut |_| Ok(loss.clone()), &mut found)
            .expect("a pass");
        let numbers = found.means.iter().flatten().chain(found.quats.iter().flatten());
        let numbers = numbers.chain(found.scales.iter().flatten()).chain(&found.opacities);
        for value in numbers.chain(found.sh.iter().flatten()) {
            assert!(value.is_finite(), "FUZZ_SEED={seed}, scene {iteration}: {value}");
            told += u64::from(*value != 0.0);
        }
        fuzzed += count;
    }
    println!("{fuzzed} Gaussians, {told} numbers that are not 0");
    assert!(told > 0, "no Gaussian was seen");
}
