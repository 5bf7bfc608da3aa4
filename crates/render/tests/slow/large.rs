//! Scenes of many Gaussians.

use segsplat_render::{RenderRequest, Renderer};

use crate::common::{both_kernels, judge, open};
use segsplat_testing::scenes::{Random, request, two_views};

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
