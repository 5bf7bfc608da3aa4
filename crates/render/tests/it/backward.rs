//! The backward pass: the oracle against finite differences of the forward oracle, the CPU kernel
//! against the oracle.

use std::sync::Arc;

use segsplat_core::scene::{Backdrop, Gaussians, RawGaussians, SourcePixel};
use segsplat_render::{
    Background, Kinds, RenderRequest, Source,
    backward::{DifferentiableRenderer as _, FrameGradients, Gradients, oracle as backward},
    cpu::{CpuRenderer, lanes::Width},
    oracle,
    switches::Switches,
};
use segsplat_testing::scenes::{Random, camera, checked, cloud, push, request, two_views};

use crate::fuzz::{environment, poisoned};

/// A loss that is linear in every number of the frame.
fn linear(pixels: usize, seed: u64) -> FrameGradients {
    let mut random = Random(seed);
    let mut number = || random.range(-1.0, 1.0);
    FrameGradients {
        color: Some((0..pixels).map(|_| [number(), number(), number()]).collect()),
        depth: Some((0..pixels).map(|_| number()).collect()),
        alpha: Some((0..pixels).map(|_| number()).collect()),
    }
}

/// The same loss on some of the pixels.
fn only(loss: &FrameGradients, keep: &[bool]) -> FrameGradients {
    let mut loss = loss.clone();
    for (i, _) in keep.iter().enumerate().filter(|(_, keep)| !**keep) {
        loss.color.as_mut().unwrap()[i] = [0.0; 3];
        loss.depth.as_mut().unwrap()[i] = 0.0;
        loss.alpha.as_mut().unwrap()[i] = 0.0;
    }
    loss
}

/// Few Gaussians over a small picture: opaque ones, needles, some in front of many.
fn few(random: &mut Random, sh_degree: u8) -> RawGaussians {
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
type Place = fn(&mut RawGaussians, usize) -> &mut f32;

fn places(sh_count: usize) -> Vec<(&'static str, usize, Place)> {
    let mut all: Vec<(&'static str, usize, Place)> = Vec::new();
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
fn losses(
    gaussians: &Gaussians,
    request: &RenderRequest,
    loss: &FrameGradients,
) -> Vec<(f64, Vec<usize>)> {
    let width = request.camera.intrinsics.width;
    let seen = oracle::render(gaussians, request).expect("the truth");
    let of_pixel = |(i, pixel): (usize, &oracle::OraclePixel)| {
        let at = [i as u32 % width, i as u32 / width];
        let who = oracle::contributions(gaussians, request, at).expect("contributions");
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
    let raw = base.as_raw().clone();
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

/// Photos that magnify, one of them behind.
fn sources() -> Arc<[Source]> {
    let source = |x: f32, behind: bool| Source {
        center: [x, 0.1, -4.0],
        axis: [0.0, 0.0, 1.0],
        scale: 0.05,
        behind,
    };
    [source(0.0, false), source(0.3, true)].into()
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
        ("layers and magnification", 0, |request| request.sources = sources()),
    ] {
        let raw = few(&mut Random(3 + u64::from(sh_degree)), sh_degree);
        let mut request = small(9, 8);
        change(&mut request);
        check_differences(name, &raw, &request);
    }
}

/// Relative errors of all numbers that are over 1e-6 of the largest of their kind, sorted.
fn errors(got: &Gradients, want: &Gradients<f64>) -> Vec<f64> {
    fn flat<const N: usize>(got: &[[f32; N]], want: &[[f64; N]]) -> Vec<(f64, f64)> {
        got.iter().flatten().map(|&v| f64::from(v)).zip(want.iter().flatten().copied()).collect()
    }
    let opacities = got.opacities.iter().map(|&v| f64::from(v)).zip(want.opacities.iter().copied());
    let kinds = [
        flat(&got.means, &want.means),
        flat(&got.quats, &want.quats),
        flat(&got.scales, &want.scales),
        opacities.collect(),
        flat(&got.sh, &want.sh),
    ];
    let mut errors = Vec::new();
    for kind in kinds {
        let most = kind.iter().fold(0.0_f64, |most, (_, want)| most.max(want.abs()));
        let counted = kind.iter().filter(|(_, want)| want.abs() > 1e-6 * most);
        errors.extend(counted.map(|(got, want)| (got - want).abs() / want.abs()));
    }
    errors.sort_by(f64::total_cmp);
    errors
}

/// The kernel against the oracle on pixels that are no cliff.
fn judge(name: &str, cpu: &CpuRenderer, gaussians: &Gaussians, request: &RenderRequest) {
    let truth = oracle::render(gaussians, request).expect("the truth");
    let keep: Vec<bool> = truth.iter().map(|pixel| !pixel.cliff.any()).collect();
    let loss = only(&linear(truth.len(), 5), &keep);
    let want = backward::gradients(gaussians, request, &loss).expect("the truth");
    let mut got = Gradients::default();
    cpu.backward(gaussians, request, &mut |_| Ok(loss.clone()), &mut got).expect("gradients");
    let errors = errors(&got, &want);
    let at = |share: f64| errors[(share * (errors.len() - 1) as f64) as usize];
    println!(
        "{name}: {} Gaussians, {} numbers: relative error median {:.1e}, 99 % {:.1e}, max {:.1e}",
        gaussians.len(),
        errors.len(),
        at(0.5),
        at(0.99),
        at(1.0)
    );
    assert!(at(0.5) <= 1e-4, "{name}: median {:.1e}", at(0.5));
    assert!(at(0.99) <= 1e-2, "{name}: 99 % {:.1e}", at(0.99));
}

#[test]
fn the_kernel_agrees_with_the_oracle() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    let (pair, middle) = two_views(32, 1);
    judge("two views", &cpu, &pair, &RenderRequest { kinds: Kinds::ALL, ..request(middle) });
    for (name, sh_degree, change) in [
        ("cloud", 0, (|_| ()) as fn(&mut RenderRequest)),
        ("sky, degree 2", 2, |request| request.background = sky()),
        ("colour behind", 3, |request| request.background = Background::Color([0.3, 0.6, 0.9])),
        ("antialiased, degree 1", 1, |request| request.antialiased = true),
    ] {
        let mut request = small(70, 45);
        change(&mut request);
        judge(name, &cpu, &cloud(3_000, sh_degree, 8), &request);
    }
    let mut raw = cloud(2_000, 0, 9).into_raw();
    for (i, source) in raw.source.iter_mut().enumerate() {
        *source = SourcePixel { view: (i % 3) as u16, ..*source };
    }
    let request = RenderRequest { sources: sources(), ..small(64, 48) };
    judge("layers and magnification", &cpu, &checked(raw), &request);
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
    let switches = Switches { isects_max: Some(20), ..Switches::default() };
    let cpu = CpuRenderer::with_switches(1, &switches).expect("a thread");
    let loss = linear(90 * 70, 6);
    let (scene, mut found) = (cloud(30, 0, 1), Gradients::default());
    let told = cpu.backward(&scene, &small(90, 70), &mut |_| Ok(loss.clone()), &mut found);
    assert!(told.expect_err("too many pairs").message().contains("20"), "names the bound");
    let none = &mut |_: &_| Ok(linear(3, 1));
    let told = CpuRenderer::new(1).unwrap().backward(&scene, &small(90, 70), none, &mut found);
    assert!(told.expect_err("another size").message().contains("6300"), "names the size");
}

#[test]
fn poisoned_gaussians_never_make_a_bad_gradient() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    let (seed, scenes) = (environment("FUZZ_SEED", 41), environment("FUZZ_SCENES", 300));
    let most = environment("FUZZ_GAUSSIANS", 80);
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
        cpu.backward(&gaussians, &request, &mut |_| Ok(loss.clone()), &mut found).expect("a pass");
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
