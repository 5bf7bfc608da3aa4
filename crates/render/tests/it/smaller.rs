//! Views that show a scene smaller than it was learnt: like its own picture, averaged.

use std::sync::Arc;

use segsplat_core::scene::{Camera, Gaussians, RawGaussians};
use segsplat_render::{
    Kinds, Layer, RenderRequest, Renderer, Source,
    constants::OWN_SIZE,
    cpu::{
        footprint::Footprint,
        lanes::KernelOptions,
        project::{Projected, project},
    },
    oracle,
    view::View,
};
use segsplat_testing::{
    compare::{Tolerance, compare, oracle_samples, samples},
    scenes::{camera, checked, push, request, two_views},
};

use crate::common::{both_kernels, cpu, judge};

/// A side of the picture that the scene was learnt at, pixels.
const OWN: u32 = 256;

/// Two photos' Gaussians and a view of `side` pixels; whether their source pixels are `known`.
fn view(
    gaussians: &Gaussians,
    middle: Camera,
    side: u32,
    known: bool,
) -> (Gaussians, RenderRequest) {
    let mut raw = gaussians.clone().into_raw();
    let half = raw.means.len() / 2;
    raw.source.iter_mut().skip(half).for_each(|source| source.view = 1);
    let scale = if known { middle.intrinsics.fx.recip() as f32 } else { 0.0 };
    let source = |x: f32| Source {
        center: [x, 0.0, 0.0],
        axis: [0.0, 0.0, 1.0],
        scale,
        layer: Layer::Front,
    };
    let mut camera = middle;
    camera.intrinsics = middle.intrinsics.resized(side, side);
    let sources: Arc<[Source]> = [source(-0.4), source(0.4)].into();
    (checked(raw), RenderRequest { sources, ..request(camera) })
}

/// The kernels leave work out where no Gaussian of a few neighbours needs it.
#[test]
fn what_neighbours_need_changes_no_bit() {
    let (own, middle) = two_views(32, 5);
    let mut raw = own.into_raw();
    // One source pixel after the other: from much smaller than shown to much larger, in steps.
    let count = raw.means.len() as u16;
    raw.source.iter_mut().zip(0..).for_each(|(source, i)| source.view = i);
    let source = |i: u16| Source {
        center: [0.0; 3],
        axis: [0.0, 0.0, 1.0],
        scale: (0.2 * 40.0_f64.powf(f64::from(i) / f64::from(count)) / middle.intrinsics.fx) as f32,
        layer: Layer::Front,
    };
    let request = RenderRequest { sources: (0..count).map(source).collect(), ..request(middle) };
    let footprints = |order: &[usize]| {
        let raw = raw.clone();
        let scene = checked(RawGaussians {
            means: order.iter().map(|&i| raw.means[i]).collect(),
            quats: order.iter().map(|&i| raw.quats[i]).collect(),
            scales: order.iter().map(|&i| raw.scales[i]).collect(),
            opacities: order.iter().map(|&i| raw.opacities[i]).collect(),
            sh: order.iter().map(|&i| raw.sh[i]).collect(),
            semantic_index: vec![0; order.len()],
            source: order.iter().map(|&i| raw.source[i]).collect(),
            ..raw
        });
        let view = View::new(scene.origin(), &request).expect("a view");
        let mut projected = Projected::default();
        project(&scene, &request, &view, KernelOptions::default(), &mut projected);
        let mut found = vec![Footprint::default(); order.len()];
        for (&i, (footprint, tiles)) in
            order.iter().zip(projected.footprints.iter().zip(&projected.tiles_per_gauss))
        {
            if *tiles > 0 {
                found[i] = *footprint;
            }
        }
        found
    };
    let alike: Vec<usize> = (0..raw.means.len()).collect();
    // Each has neighbours of all sizes.
    let mut mixed = alike.clone();
    mixed.sort_by_key(|i| i.wrapping_mul(0x9e37_79b9) % 4_093);
    let (got, want) = (footprints(&alike), footprints(&mixed));
    assert!(want.iter().filter(|one| one.opacity > 0.0).count() > 1_500, "most are seen");
    for (i, (got, want)) in got.iter().zip(&want).enumerate() {
        assert!(got == want, "{i}: {got:?} is not {want:?}");
    }
}

fn each(check: impl Fn(&dyn Renderer)) {
    check(&cpu());
    both_kernels().for_each(|gpu| check(gpu));
}

fn color(
    renderer: &dyn Renderer,
    (gaussians, request): &(Gaussians, RenderRequest),
) -> Vec<[f32; 3]> {
    let request = RenderRequest { kinds: Kinds::COLOR, ..request.clone() };
    renderer.render(gaussians, &request).expect("a picture").color.expect("colour")
}

/// Means of squares of `by` x `by` pixels of a picture of [`OWN`].
fn averaged(picture: &[[f32; 3]], by: usize) -> Vec<[f32; 3]> {
    let side = OWN as usize;
    let mean = |at: usize| {
        let (x, y) = (at % (side / by) * by, at / (side / by) * by);
        let pixels = (0..by * by).map(|k| picture[(y + k / by) * side + x + k % by]);
        let sum = pixels.fold([0.0; 3], |sum: [f32; 3], pixel| {
            std::array::from_fn(|c| sum[c] + pixel[c].clamp(0.0, 1.0))
        });
        sum.map(|sum| sum / (by * by) as f32)
    };
    (0..(side / by).pow(2)).map(mean).collect()
}

fn psnr(got: &[[f32; 3]], want: &[[f32; 3]]) -> f64 {
    let both = got.as_flattened().iter().zip(want.as_flattened());
    let squares = both.map(|(got, want)| f64::from(got.clamp(0.0, 1.0) - want).powi(2));
    -10.0 * (squares.sum::<f64>() / (3 * want.len()) as f64).log10()
}

#[test]
fn small_views_are_the_mean_of_the_scenes_own_picture() {
    let (gaussians, middle) = two_views(OWN, 1);
    each(|renderer| {
        let own = color(renderer, &view(&gaussians, middle, OWN, true));
        for (by, least) in [(2, 35.0), (4, 34.0), (8, 31.0)] {
            let side = OWN / by as u32;
            let want = averaged(&own, by);
            let [plain, found] = [false, true]
                .map(|known| psnr(&color(renderer, &view(&gaussians, middle, side, known)), &want));
            println!("{}, 1/{by}: {found:.1} dB, {plain:.1} without", renderer.name());
            assert!(found >= least, "{}, 1/{by}: {found:.1} dB", renderer.name());
        }
    });
}

#[test]
fn views_of_the_own_size_are_the_same_bits() {
    let (gaussians, middle) = two_views(OWN, 1);
    each(|renderer| {
        let [plain, known] =
            [false, true].map(|known| color(renderer, &view(&gaussians, middle, OWN, known)));
        assert!(plain == known, "{}: another picture", renderer.name());
    });
}

#[test]
fn small_views_agree_with_the_oracle() {
    let (gaussians, middle) = two_views(OWN, 1);
    for side in [OWN / 4, OWN / 8] {
        let (gaussians, request) = view(&gaussians, middle, side, true);
        let truth = oracle::render(&gaussians, &request).expect("the truth");
        let cliff: Vec<bool> = truth.iter().map(|pixel| pixel.cliff.same_order()).collect();
        let frame = samples(&cpu().render(&gaussians, &request).expect("a picture"));
        compare(
            &frame,
            &oracle_samples(&truth),
            &cliff,
            Tolerance { flips: 0.05, ..Tolerance::ORACLE },
        )
        .unwrap_or_else(|told| panic!("{side}: {told}"));
        for gpu in both_kernels() {
            judge(gpu, &format!("two views at {side}"), &gaussians, &request);
        }
    }
}

/// One Gaussian of half a pixel, learnt at 640 x 640: what it adds to a picture is not lost in a
/// view of a tenth, or a thirtieth, of the size, in the mean over its places in a pixel. It may be
/// more by what counts as the own size.
#[test]
fn what_a_small_gaussian_adds_is_kept() {
    let own = camera(640, 640);
    let pixel = 4.0 / own.intrinsics.fx as f32;
    let source = Source {
        center: [0.0; 3],
        axis: [0.0, 0.0, 1.0],
        scale: own.intrinsics.fx.recip() as f32,
        layer: Layer::Front,
    };
    let sum = |renderer: &dyn Renderer, side: u32| -> f64 {
        let mut camera = own;
        camera.intrinsics = own.intrinsics.resized(side, side);
        let request = RenderRequest { sources: [source].into(), ..request(camera) };
        let places = (0..64).map(|k| {
            let mut raw = RawGaussians::default();
            let [x, y] = [k % 8, k / 8].map(|k| k as f32 / 8.0 * pixel * 640.0 / side as f32);
            push(&mut raw, [x, y, 4.0], [1.0, 0.0, 0.0, 0.0], [0.5 * pixel; 3], 0.8, &[[1.0; 3]]);
            let frame = renderer.render(&checked(raw), &request).expect("a picture");
            frame.alpha.expect("alpha").iter().map(|alpha| f64::from(*alpha)).sum::<f64>()
        });
        places.sum::<f64>() * f64::from(640 / side).powi(2)
    };
    each(|renderer| {
        let own = sum(renderer, 640);
        for side in [64, 20] {
            let share = sum(renderer, side) / own;
            println!("{}: {share:.3} of it at {side}", renderer.name());
            let most = f64::from(OWN_SIZE).powi(2);
            assert!(share > 0.98 && share < most, "{}: {share:.3} at {side}", renderer.name());
        }
    });
}
