//! Coarser forms of a scene: every Gaussian is in each of them once, and a picture of what has come
//! of them is whole from the first form on.

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{
    Kinds, RenderRequest, Renderer,
    blocks::BLOCKS_MIN,
    coarse::{Coarse, FIRST_MAX, Form},
    compare::psnr,
    cpu::CpuRenderer,
    merged::GROUP,
};
use segsplat_testing::scenes::{camera, checked, cloud, request, two_views};

/// A scene that has forms, and they.
fn scene() -> (Gaussians, Coarse) {
    let (gaussians, _) = two_views(364, 1);
    assert!(gaussians.len() >= BLOCKS_MIN, "large enough");
    let coarse = Coarse::of(&gaussians, &camera(320, 320)).expect("forms");
    (gaussians, coarse.expect("a large scene has forms"))
}

/// Where the members of record `at` begin and end in the next form.
fn members(form: &Form, at: usize) -> std::ops::Range<usize> {
    let first = at.checked_sub(1).map_or(0, |before| form.ends[before]);
    first as usize..form.ends[at] as usize
}

#[test]
fn small_scenes_have_none() {
    let gaussians = cloud(3_000, 0, 1);
    assert!(Coarse::of(&gaussians, &camera(64, 48)).expect("no forms").is_none());
}

#[test]
fn each_form_is_the_whole_scene_in_the_order_of_the_next() {
    let (own, coarse) = scene();
    let mut all: Vec<u32> = coarse.order.clone();
    all.sort_unstable();
    assert!(all.into_iter().eq(0..own.len() as u32), "each of the scene's own once");
    let lengths: Vec<usize> = coarse.forms.iter().map(|form| form.order.len()).collect();
    assert!(lengths[0] <= FIRST_MAX && lengths.is_sorted(), "{lengths:?}");
    assert!(lengths.iter().all(|n| n * GROUP <= own.len()), "{lengths:?} of {}", own.len());
    // From the finest form up: the opacities that a record stands for are those of its members.
    let mut below: Vec<f64> =
        coarse.order.iter().map(|&i| f64::from(own.opacities()[i as usize])).collect();
    for form in coarse.forms.iter().rev() {
        assert_eq!(form.ends.last().map(|&end| end as usize), Some(below.len()));
        let sums: Vec<f64> =
            (0..form.order.len()).map(|at| below[members(form, at)].iter().sum()).collect();
        for (at, &sum) in sums.iter().enumerate() {
            let held = f64::from(coarse.merged.sums[form.order[at] as usize]);
            assert!((held - sum).abs() <= 0.03 * sum, "record {at}: {held} not {sum}");
        }
        below = sums;
    }
}

/// The Gaussians that are drawn when the members of the first `rows` records of the coarsest form
/// have come in the scene's own.
fn drawn(own: &Gaussians, coarse: &Coarse, rows: usize) -> Gaussians {
    let mut end = rows;
    for form in &coarse.forms {
        end = end.checked_sub(1).map_or(0, |last| form.ends[last] as usize);
    }
    let mut raw = RawGaussians { origin: own.origin(), ..RawGaussians::default() };
    let mut put = |of: &Gaussians, ids: &[u32]| {
        for i in ids.iter().map(|&i| i as usize) {
            raw.means.push(of.means()[i]);
            raw.quats.push(of.quats()[i]);
            raw.scales.push(of.scales()[i]);
            raw.opacities.push(of.opacities()[i]);
            raw.sh.push(of.sh()[i * of.sh_count()]);
            raw.semantic_index.push(0);
            raw.source.push(of.source()[i]);
        }
    };
    put(&coarse.merged.gaussians, &coarse.forms[0].order[rows..]);
    put(own, &coarse.order[..end]);
    checked(raw)
}

#[test]
fn what_has_come_is_a_picture_that_becomes_finer() {
    let (own, coarse) = scene();
    let cpu = CpuRenderer::new(2).expect("two threads");
    let request = RenderRequest { kinds: Kinds::COLOR, ..request(camera(320, 320)) };
    let draw = |gaussians: &Gaussians| {
        cpu.render(gaussians, &request).expect("a picture").color.expect("colour")
    };
    let truth = draw(&own);
    let first = coarse.forms[0].order.len();
    let shares = [0, first / 4, first / 2, first];
    let found = shares.map(|rows| psnr(&draw(&drawn(&own, &coarse, rows)), &truth, None));
    println!("{first} of {}: {found:.1?} dB", own.len());
    assert!(found[0] >= 21.0, "{found:?}");
    assert!(found.is_sorted() && found[3] > 60.0, "{found:?}");
}
