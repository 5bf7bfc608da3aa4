//! A part of a picture is that part of the whole picture, and what qualities there are: the
//! renderer, the oracle and both doors.

use segsplat::{
    error::ErrorCode,
    render::{RenderRequest, Renderer, cpu::CpuRenderer, oracle},
    scene::Region,
};

use crate::common::{
    compare::{Tolerance, compare, oracle_samples, samples},
    doors::{Ask, Options, both},
    scenes::{camera, cloud, request},
    stand::{Stand, upload},
};

/// Two drawings of one f32 model whose sums of places are rounded apart.
const ROUNDING: Tolerance = Tolerance { interior: 1e-5, flips: 1e-3 };

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

/// The f32 values of an NPY file.
fn npy(file: &[u8]) -> Vec<f32> {
    let header = usize::from(u16::from_le_bytes([file[8], file[9]]));
    let (values, _) = file[10 + header..].as_chunks::<4>();
    values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

#[tokio::test]
async fn both_doors_give_a_part_and_take_a_quality() {
    let stand = Stand::start().await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&upload(), &Options::wait()).await.expect("a scene");
        let name = door.name();
        let ask = Ask::first().with("kind", "depth").with("format", "npy");
        let whole = npy(&door.view(&id, &ask).await.expect("the whole"));
        let crop = ask.clone().with("crop", "10,7,20,30");
        let part = npy(&door.view(&id, &crop).await.expect("a part"));
        assert_eq!(part.len(), 20 * 30, "values of a part by {name}");
        for (i, depth) in part.iter().enumerate() {
            let want = whole[(7 + i / 20) * 64 + 10 + i % 20];
            assert!((depth - want).abs() <= 1e-4 * want.max(1.0), "{name}: {depth}, not {want}");
        }
        for (case, ask, word) in [
            ("wide", ask.clone().with("crop", "10,7,60,30"), "60x30 px at 10,7"),
            ("empty", ask.clone().with("crop", "0,0,0,9"), "0x9 px at 0,0"),
        ] {
            let fault = door.view(&id, &ask).await.expect_err(case);
            assert_eq!(fault.code, "invalid_request", "{case} by {name}: {}", fault.message);
            assert!(fault.message.contains(word), "{case} by {name}: {}", fault.message);
        }
        let fast = npy(&door.view(&id, &ask.with("quality", "fast")).await.expect("a fast view"));
        for (fast, exact) in fast.iter().zip(&whole) {
            assert!((fast - exact).abs() < 0.05 * exact.max(1.0), "{name}: {fast}, not {exact}");
        }
    }
    for (query, word) in [
        ("from=0&crop=1,2,3", "3 numbers"),
        ("from=0&crop=1,2,3,-4", "-4"),
        ("from=0&quality=best", "exact or fast"),
    ] {
        let url = stand.url(&format!("/v1/scenes/{}/view?{query}", "0".repeat(32)));
        let answer = reqwest::get(url).await.expect("an answer");
        let fault = crate::common::doors::bytes(answer).await.expect_err(query);
        assert!(fault.message.contains(word), "{query}: {}", fault.message);
    }
}
