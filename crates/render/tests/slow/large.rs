//! Scenes of many Gaussians.

use segsplat_render::{RenderRequest, Renderer, cpu::bin::pack};

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

/// More pairs than other sorts were found to lose, in more workgroups than a row of them: long
/// form, on hardware (`RUN_SLOW_TESTS=1`).
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
    let keys: Vec<u32> = (0..100_000_000).map(|_| random.bits() as u32).collect();
    let values: Vec<u32> = (0..100_000_000).collect();
    let mut want: Vec<u64> = keys.iter().zip(&values).map(|(&k, &v)| pack(k, v)).collect();
    want.sort_by_key(|pair| pair >> 32);
    let (keys, values) = gpu.internals().radix_sort(&keys, &values, 32).expect("a sort");
    let pairs = keys.iter().zip(&values).map(|(&k, &v)| pack(k, v));
    assert!(pairs.eq(want), "order differs");
}
