//! A part of a picture is that part of the whole picture: the CPU renderer and the oracle.

use segsplat_core::{error::ErrorCode, scene::Region};
use segsplat_render::{RenderRequest, Renderer, cpu::CpuRenderer, oracle};
use segsplat_testing::{
    compare::{Tolerance, compare, oracle_samples, samples},
    scenes::{camera, cloud, request},
};

/// Two drawings of one f32 model whose sums of places are rounded apart.
const ROUNDING: Tolerance = Tolerance { interior: 1e-5, flips: 1e-3, mean: 1e-5 };

#[test]
fn a_part_is_that_part_of_the_whole_picture() {
    let gaussians = cloud(4_000, 1, 81);
    let cpu = CpuRenderer::new(2).expect("two threads");
    let mut camera = camera(173, 131);
    (camera.intrinsics.cx, camera.intrinsics.cy) = (30.25, 100.0);
    let whole = request(camera);
    let all = samples(&cpu.render(&gaussians, &whole).expect("the whole"));
    let truth = oracle::render(&gaussians, &whole).expect("the truth");
    for (x, y, width, height) in
        [(0, 0, 173, 131), (0, 0, 1, 1), (172, 130, 1, 1), (13, 37, 70, 50), (96, 64, 77, 67)]
    {
        let crop = Some(Region { x, y, width, height });
        let part = RenderRequest { crop, ..whole.clone() };
        let frame = cpu.render(&gaussians, &part).expect("a part");
        assert_eq!((frame.width, frame.height), (width, height), "size");
        let inside: Vec<usize> = (y..y + height)
            .flat_map(|row| (x..x + width).map(move |column| (row * 173 + column) as usize))
            .collect();
        let want: Vec<_> = inside.iter().map(|&i| all[i]).collect();
        let cliff: Vec<bool> = inside.iter().map(|&i| truth[i].cliff.same_order()).collect();
        compare(&samples(&frame), &want, &cliff, ROUNDING).expect("the part of the whole");
        let judged = oracle::render(&gaussians, &part).expect("the truth of a part");
        let same: Vec<_> = inside.iter().map(|&i| truth[i].clone()).collect();
        assert!(judged == same, "the oracle's part at {x},{y} is another picture");
        compare(&samples(&frame), &oracle_samples(&judged), &cliff, Tolerance::ORACLE)
            .expect("the truth");
    }
}

#[test]
fn a_part_outside_the_picture_is_refused_by_name() {
    let cpu = CpuRenderer::new(1).expect("a thread");
    for (x, y, width, height) in
        [(0, 0, 0, 5), (0, 0, 5, 0), (20, 0, 1, 1), (0, 1, 20, 20), (u32::MAX, 0, 2, 1)]
    {
        let crop = Some(Region { x, y, width, height });
        let part = RenderRequest { crop, ..request(camera(20, 20)) };
        let error = cpu.render(&cloud(10, 0, 1), &part).expect_err("a part outside");
        assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
        assert!(error.message().contains("20x20"), "{error}");
    }
}
