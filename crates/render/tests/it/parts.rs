//! A scene that is over a device's budget is drawn by parts, with the same pixels as one that the
//! device holds.

use glam::DVec3;
use segsplat_core::{
    error::ErrorCode,
    scene::{Camera, Gaussians, Intrinsics},
};
use segsplat_render::{
    Frame, FrameStats, Kinds, Labels, RenderRequest, Renderer, Samples, gpu::GpuRenderer,
};
use segsplat_testing::{
    labels::labelled,
    scenes::{Random, camera, checked, cloud, look, request, two_views},
};

use crate::{blocks::any_request, common::open};

/// Bytes of a Gaussian without harmonics, and of its entry.
const ROW: usize = 62;

/// A renderer whose device may hold so many such Gaussians; blocks of all scenes.
fn holding(gaussians: usize) -> Option<GpuRenderer> {
    open(|options| {
        options.switches.blocks_min = Some(1);
        options.scene_bytes_max = (ROW * gaussians) as u64;
    })
}

/// The pictures: what a band shows of the scene is not known of the whole.
fn pictures(frame: Frame) -> Frame {
    Frame { stats: FrameStats::default(), ..frame }
}

/// Views that show some of a surface and of walls, whose Gaussians have equal depths; and views
/// from anywhere.
fn cases() -> Vec<(String, Gaussians, RenderRequest)> {
    let mut raw = cloud(40_000, 2, 8).into_raw();
    for (mean, scale) in raw.means.iter_mut().zip(&mut raw.scales) {
        mean[2] = mean[2].round();
        *scale = scale.map(|scale| scale.min(0.02));
    }
    let straight = camera(90, 70);
    let aside = |cx: f64| {
        let intrinsics = Intrinsics { cx, ..straight.intrinsics };
        request(Camera { intrinsics, ..straight })
    };
    let views = [40.0, 110.0, 150.0].map(aside);
    let mut random = Random(7);
    let mut cases = Vec::new();
    for (name, gaussians) in [("photos", two_views(160, 3).0), ("walls", checked(raw))] {
        let random = [(); 4].map(|()| any_request(&mut random));
        for (i, request) in views.iter().cloned().chain(random).enumerate() {
            cases.push((format!("{name} {i}"), gaussians.clone(), request));
        }
    }
    cases
}

#[test]
fn parts_of_a_scene_give_the_pictures_of_the_whole() {
    let Some(resident) = holding(1 << 20) else { return };
    let (mut drawn, mut refused) = (0, 0);
    for (name, gaussians, request) in cases() {
        let want = resident.render(&gaussians, &request).expect("a frame");
        for share in [0.8, 0.4, 0.2] {
            let Some(small) = holding((share * gaussians.len() as f64) as usize) else { return };
            match small.render(&gaussians, &request) {
                Ok(got) => {
                    drawn += 1;
                    assert!(pictures(got) == pictures(want.clone()), "{name}, {share}: parts show");
                }
                Err(error) => {
                    assert_eq!(error.code(), ErrorCode::LimitExceeded, "{name}: {error}");
                    assert!(error.message().contains("device_scene_bytes_max"), "{name}: {error}");
                    refused += 1;
                }
            }
        }
    }
    assert!(drawn >= 20 && refused >= 1, "{drawn} drawn, {refused} refused");
}

/// Cameras that turn around a surface: of each step a part is new, and a part was there before.
fn turning() -> Vec<RenderRequest> {
    let turn = |k: u32| {
        let angle = f64::from(k) * 0.35 - 1.4;
        let to = DVec3::new(4.0 * angle.sin(), 0.2, 4.0 * angle.cos());
        request(Camera { camera_to_world: look(DVec3::ZERO, to), ..camera(90, 70) })
    };
    (0..9).map(turn).collect()
}

#[test]
fn parts_come_and_go_as_the_camera_turns() {
    let (gaussians, _) = two_views(160, 3);
    let entries = (0..gaussians.len()).map(|i| (i / 100 % 7) as u16).collect();
    let gaussians = gaussians.with_semantic_index(entries).expect("as many");
    let (Some(resident), Some(small)) = (holding(1 << 20), holding(gaussians.len() * 6 / 10))
    else {
        return;
    };
    let labels =
        |request: &RenderRequest| RenderRequest { labels: Labels::Weights, ..request.clone() };
    let other = labelled(3_000, 8, 7);
    for (k, request) in turning().into_iter().chain(turning().into_iter().rev()).enumerate() {
        let draw = |gpu: &GpuRenderer, request: &RenderRequest| {
            pictures(gpu.render(&gaussians, request).expect("a frame"))
        };
        assert!(draw(&small, &request) == draw(&resident, &request), "view {k}");
        let labels = labels(&request);
        assert!(draw(&small, &labels) == draw(&resident, &labels), "labels of view {k}");
        if k == 9 {
            small.render(&other, &request).expect("another scene");
        }
    }
}

#[test]
fn bands_that_show_less_each_make_a_picture_that_shows_too_much() {
    // All of it is in the picture, a third of it in each third.
    let (gaussians, middle) = two_views(160, 3);
    let exact = request(middle);
    // Without depth: in steps that of bands is made by the host, which rounds otherwise.
    let levels = RenderRequest {
        kinds: Kinds { depth: false, ..Kinds::ALL },
        samples: Samples::Levels,
        labels: Labels::Weights,
        ..exact.clone()
    };
    let (Some(resident), Some(small)) = (holding(1 << 20), holding(gaussians.len() / 2)) else {
        return;
    };
    for request in [exact, levels] {
        let [got, want] = [&small, &resident].map(|gpu| gpu.render(&gaussians, &request).unwrap());
        assert!(want.stats.visible > gaussians.len() as u64 * 9 / 10, "most are in the picture");
        assert!(got.stats.visible < want.stats.visible, "no band shows all");
        assert!(pictures(got) == pictures(want), "bands show");
    }
}

/// Merged Gaussians and their members are never both drawn, whatever was drawn before.
#[test]
fn parts_have_merged_gaussians_where_a_view_permits_them() {
    let (gaussians, near) = two_views(160, 3);
    let (Some(resident), Some(small)) = (holding(1 << 20), holding(gaussians.len() * 8 / 10))
    else {
        return;
    };
    let far = Camera { camera_to_world: look(DVec3::NEG_Z * 30.0, DVec3::Z), ..near };
    for (k, (camera, detail)) in
        [(near, 0.0), (far, 8.0), (near, 0.0), (far, 16.0), (far, 8.0)].into_iter().enumerate()
    {
        let view = RenderRequest { detail, ..request(camera) };
        let draw = |gpu: &GpuRenderer| pictures(gpu.render(&gaussians, &view).expect("a frame"));
        assert!(draw(&small) == draw(&resident), "view {k}");
    }
}
