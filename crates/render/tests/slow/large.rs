//! Scenes of many Gaussians.

use segsplat_render::{RenderRequest, Renderer, oracle};
use segsplat_testing::{
    compare::{Tolerance, compare, oracle_samples, samples},
    scenes::{Random, request, two_views},
};

use crate::common::{both_kernels, cpu, judge, open};

#[test]
fn pictures_of_131072_gaussians_are_the_same() {
    for gpu in both_kernels() {
        let (gaussians, middle) = two_views(256, 1);
        assert_eq!(gaussians.len(), 131_072, "a Gaussian a pixel of two photos");
        let frame = judge(gpu, "two_views 256", &gaussians, &request(middle));
        // The second time the scene and all room are there.
        let again = gpu.render(&gaussians, &request(middle)).expect("a picture");
        assert!(frame == again, "two renders of one view differ");
        judge(
            gpu,
            "two_views 256 antialiased",
            &gaussians,
            &RenderRequest { antialiased: true, ..request(middle) },
        );
    }
}

/// Scratch of more than two million Gaussians is kept for the scene that it was for. What lies in
/// it from other views and scenes is in no picture.
#[test]
fn kept_scratch_of_large_scenes_is_in_no_other_picture() {
    let kept = cpu();
    let scene = |side, seed| {
        let (gaussians, mut camera) = two_views(side, seed);
        camera.intrinsics = camera.intrinsics.resized(96, 96);
        (gaussians, request(camera))
    };
    let (large, small, larger) = (scene(1_030, 1), scene(64, 2), scene(1_060, 3));
    assert!(large.0.len() > 2 << 20, "{} Gaussians lie in small scratch", large.0.len());
    for (name, (gaussians, request)) in
        [("large", &large), ("small", &small), ("larger", &larger), ("large again", &large)]
    {
        let fresh = cpu().render(gaussians, request).expect("a picture");
        let frame = kept.render(gaussians, request).expect("a picture");
        assert!(frame == fresh, "{name}: another picture than that of a new renderer");
    }
}

/// Lists far longer than what a workgroup sorts at once, in more pairs than other sorts were found
/// to lose: long form, on hardware (`RUN_SLOW_TESTS=1`).
#[test]
fn a_hundred_million_pairs_are_sorted() {
    if std::env::var_os("RUN_SLOW_TESTS").is_none() {
        println!("skipped: RUN_SLOW_TESTS is not set");
        return;
    }
    let Some(gpu) = open(|options| options.switches.portable = false) else { return };
    if gpu.adapter().software {
        println!("skipped: no hardware adapter");
        return;
    }
    let mut random = Random(3);
    let mut list = |count: u32| -> Vec<[u32; 2]> {
        (0..count).map(|i| [(random.bits() % 1_000_000) as u32, i]).collect()
    };
    let mut lists: Vec<_> = (0..49).map(|_| list(2_000_000)).collect();
    lists.extend((0..1_000).map(|_| list(2_000)));
    let got = gpu.internals().tile_sort(&lists).expect("a sort");
    for (got, mut want) in got.into_iter().zip(lists) {
        want.sort_unstable();
        assert!(got == want, "{} pairs: order differs", want.len());
    }
}

/// 10,008,338 Gaussians, at sampled pixels: long form (`RUN_SLOW_TESTS=1`).
#[test]
fn ten_million_gaussians_agree_with_the_oracle() {
    if std::env::var_os("RUN_SLOW_TESTS").is_none() {
        println!("skipped: RUN_SLOW_TESTS is not set");
        return;
    }
    let (gaussians, mut camera) = two_views(2_237, 1);
    assert_eq!(gaussians.len(), 10_008_338);
    camera.intrinsics = camera.intrinsics.resized(480, 480);
    let request = request(camera);
    let mut random = Random(9);
    let pixels: Vec<[u32; 2]> =
        (0..256).map(|_| [(); 2].map(|()| (random.bits() % 480) as u32)).collect();
    let truth = oracle::render_pixels(&gaussians, &request, &pixels).expect("the truth");
    let cpu = cpu();
    let all = samples(&cpu.render(&gaussians, &request).expect("a picture"));
    let got: Vec<_> = pixels.iter().map(|[x, y]| all[(y * 480 + x) as usize]).collect();
    let cliff: Vec<bool> = truth.iter().map(|pixel| pixel.cliff.same_order()).collect();
    let bound = Tolerance { flips: 0.1, ..Tolerance::ORACLE };
    compare(&got, &oracle_samples(&truth), &cliff, bound).expect("the same pixels");
}
