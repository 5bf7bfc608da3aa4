//! Coarser forms of a scene: every Gaussian is in each of them once, and a picture of what has come
//! of them is whole from the first form on.

use std::sync::atomic::{AtomicUsize, Ordering};

use glam::Vec3;
use segsplat_core::error::Error;
use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{
    Kinds, RenderRequest, Renderer,
    blocks::BLOCKS_MIN,
    coarse::{Coarse, FIRST_MAX},
    compare::psnr,
    cpu::CpuRenderer,
    merged::GROUP,
};
use segsplat_testing::scenes::{camera, checked, cloud, push, request, two_views};

/// A scene that has forms, and they.
fn scene() -> (Gaussians, Coarse) {
    let (gaussians, _) = two_views(364, 1);
    assert!(gaussians.len() >= BLOCKS_MIN, "large enough");
    let coarse = Coarse::of(&gaussians, &camera(320, 320)).expect("forms");
    (gaussians, coarse.expect("a large scene has forms"))
}

#[test]
fn small_scenes_have_none() {
    let gaussians = cloud(3_000, 0, 1);
    assert!(Coarse::of(&gaussians, &camera(64, 48)).expect("no forms").is_none());
}

#[test]
fn they_are_left_half_made_where_nobody_wants_them_any_more() {
    let (gaussians, _) = two_views(364, 1);
    let asked = AtomicUsize::new(0);
    let unless = || match asked.fetch_add(1, Ordering::Relaxed) {
        0..100 => Ok(()),
        _ => Err(Error::internal("nobody wants them")),
    };
    let left = Coarse::of_unless(&gaussians, &camera(64, 48), &unless).map(drop).expect_err("left");
    assert_eq!(left.message(), "nobody wants them");
    let (asked, blocks) = (asked.into_inner(), gaussians.len() / 256);
    assert!((101..blocks / 2).contains(&asked), "{asked} of {blocks} blocks");
}

#[test]
fn each_form_is_the_whole_scene_in_the_order_of_the_next() {
    let (own, coarse) = scene();
    let mut all = coarse.order.clone();
    all.sort_unstable();
    assert!(all.into_iter().eq(0..own.len() as u32), "each of the scene's own once");
    let lengths: Vec<usize> = coarse.ends.iter().map(Vec::len).collect();
    assert!(lengths[0] <= FIRST_MAX && lengths.is_sorted(), "{lengths:?}");
    assert!(lengths.iter().all(|n| n * GROUP <= own.len()), "{lengths:?} of {}", own.len());
    assert_eq!(lengths.iter().sum::<usize>(), coarse.gaussians.len());
    let mut id = 0;
    for (form, length) in lengths.into_iter().enumerate() {
        let mut next = 0;
        for at in 0..length {
            let of = coarse.own_of(form, at);
            assert!(of.start == next && of.end > next, "{of:?} after {next}");
            next = of.end;
            // Its place is among those that it stands for.
            let of = coarse.order[of].iter().map(|&i| Vec3::from(own.means()[i as usize]));
            let (low, high) = of.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), at| {
                (low.min(at), high.max(at))
            });
            let (mean, slack) = (Vec3::from(coarse.gaussians.means()[id]), Vec3::splat(1e-5));
            let is_inside = mean.cmpge(low - slack).all() && mean.cmple(high + slack).all();
            assert!(is_inside, "form {form}, {at}: {mean} outside {low} to {high}");
            id += 1;
        }
        assert_eq!(next, own.len(), "form {form} is all of the scene");
    }
}

#[test]
fn entries_are_those_with_most_opacity() {
    let (own, coarse) = scene();
    let entries = (0..own.len()).map(|i| (i / 1000 % 7) as u16).collect();
    let own = own.with_semantic_index(entries).expect("as many");
    let found = coarse.entries(&own);
    let ids = coarse.ends.iter().enumerate();
    let ids = ids.flat_map(|(form, ends)| (0..ends.len()).map(move |at| (form, at)));
    for (id, (form, at)) in ids.enumerate() {
        let mut sums = [0.0_f32; 7];
        for &i in &coarse.order[coarse.own_of(form, at)] {
            sums[usize::from(own.semantic_index()[i as usize])] += own.opacities()[i as usize];
        }
        let most = sums.into_iter().fold(0.0, f32::max);
        assert!(sums[usize::from(found[id])] >= most * (1.0 - 1e-5), "form {form}, {at}");
    }
}

/// The Gaussians that are drawn when the members of the first `known` of the coarsest form have
/// come in the scene's own.
fn drawn(own: &Gaussians, coarse: &Coarse, known: usize) -> Gaussians {
    let end = known.checked_sub(1).map_or(0, |last| coarse.own_of(0, last).end);
    let mut raw = RawGaussians { origin: own.origin(), ..RawGaussians::default() };
    let mut put = |of: &Gaussians, i: usize| {
        let sh = &of.sh()[i..=i];
        push(&mut raw, of.means()[i], of.quats()[i], of.scales()[i], of.opacities()[i], sh);
    };
    (known..coarse.ends[0].len()).for_each(|i| put(&coarse.gaussians, i));
    coarse.order[..end].iter().for_each(|&i| put(own, i as usize));
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
    let (truth, first) = (draw(&own), coarse.ends[0].len());
    let found = [0, first / 4, first / 2, first]
        .map(|known| psnr(&draw(&drawn(&own, &coarse, known)), &truth, None));
    println!("{first} of {}: {found:.1?} dB", own.len());
    assert!(found[0] >= 21.0, "{found:?}");
    assert!(found.is_sorted() && found[3] > 60.0, "{found:?}");
}
