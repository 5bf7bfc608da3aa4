//! One set of Gaussians, and layers: what hides the surface that other photos see goes, and the
//! surface stays.

use std::sync::atomic::AtomicBool;

use glam::DMat4;
use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics, ViewGaussians};
use segsplat_vision::lift::{FuseOptions, Fusion, Lifted, UnionOptions, lift};

const SIDE: usize = 16;
const FOCAL: f64 = 16.0;
const WALL: f32 = 4.0;

/// Photo `photo` of cameras in a line that look at a wall; its pixels in the middle have `depth`.
fn view(photo: u16, depth: f32) -> ViewGaussians {
    let (side, middle) = (SIDE as u32, SIDE as f64 / 2.0);
    let intrinsics =
        Intrinsics { fx: FOCAL, fy: FOCAL, cx: middle, cy: middle, width: side, height: side };
    let pose = DMat4::from_translation(glam::DVec3::new(0.25 * f64::from(photo), 0.0, 0.0));
    let camera_to_world =
        CameraToWorld::from_row_major(&pose.transpose().to_cols_array(), "test").unwrap();
    let mean = |i: usize| {
        let (x, y) = (i % SIDE, i / SIDE);
        let inner = (6..10).contains(&x) && (6..10).contains(&y);
        let z = if inner { depth } else { WALL };
        let away = |k: usize| (k as f32 + 0.5 - middle as f32) / FOCAL as f32 * z;
        [away(x), away(y), z]
    };
    let count = SIDE * SIDE;
    ViewGaussians {
        photo,
        camera: Camera { intrinsics, camera_to_world },
        frame_to_world: camera_to_world,
        near_far: [1.0, 10.0],
        means: (0..count).map(mean).collect(),
        scales: vec![[0.1, 3.0, 0.1]; count],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacities: vec![0.5; count],
        sh_degree: 0,
        sh: vec![[0.0; 3]; count],
        confidence: vec![1.0; count],
        valid: None,
    }
}

/// Photos of the wall as one set; in the third the middle stands at `depth`.
fn lifted(photos: u16, depth: f32) -> Lifted {
    fused(photos, depth, &Fusion::OneSet(UnionOptions::default()))
}

fn fused(photos: u16, depth: f32, fusion: &Fusion) -> Lifted {
    let views: Vec<ViewGaussians> =
        (0..photos).map(|i| view(i, if i == 2 { depth } else { WALL })).collect();
    let cameras: Vec<Camera> = views.iter().map(|view| view.camera).collect();
    let go_on = AtomicBool::new(false);
    lift(views, &cameras, true, fusion, None, &go_on).unwrap()
}

fn dropped(lifted: &Lifted, reason: &str) -> u64 {
    lifted.dropped.iter().find(|entry| entry.reason == reason).map_or(0, |entry| entry.count)
}

#[test]
fn what_stands_in_the_free_space_of_other_photos_is_dropped() {
    let with = lifted(6, 2.0);
    assert_eq!(dropped(&with, "free_space"), 16, "{:?}", with.dropped);
    let depth = |i: usize| f64::from(with.gaussians.means()[i][2]) + with.gaussians.origin().z;
    let nearest = (0..with.gaussians.len()).map(depth).fold(f64::INFINITY, f64::min);
    assert!((nearest - f64::from(WALL)).abs() < 1e-3, "the wall alone is left: {nearest}");
    // Within the tolerance it is the wall; behind the wall it hides nothing.
    for depth in [WALL, 3.9, 6.0] {
        assert_eq!(dropped(&lifted(6, depth), "free_space"), 0, "{depth}");
    }
}

#[test]
fn of_layers_only_what_many_photos_see_through_is_dropped() {
    let layers = |photos, depth| {
        let mut options = FuseOptions::default();
        options.free_space.parallax_px = 0.5; // these photos are small and near each other
        dropped(&fused(photos, depth, &Fusion::Layers(options)), "free_space")
    };
    // Five against one are more than four times as many, four are not.
    assert_eq!((layers(6, 2.0), layers(5, 2.0)), (16, 0));
    assert_eq!(layers(4, 2.0), 0, "few photos stay as the network made them");
    // By a tenth of the depth, not less; behind the wall it hides nothing.
    for depth in [WALL, 3.7, 6.0] {
        assert_eq!(layers(6, depth), 0, "{depth}");
    }
}

#[test]
fn few_photos_stay_as_the_network_made_them() {
    let few = lifted(4, 2.0);
    assert_eq!(few.gaussians.len(), 4 * SIDE * SIDE, "{:?}", few.dropped);
    assert_eq!(few.gaussians.opacities()[0], 0.5);
    assert_eq!(few.gaussians.scales()[0], [0.1, 3.0, 0.1]);
}

#[test]
fn of_many_photos_scales_are_bounded_and_opacities_make_up_for_layers() {
    let many = lifted(6, WALL);
    assert!(dropped(&many, "duplicate") > 0, "{:?}", many.dropped);
    let gained = 1.0 - 0.5_f32.powf(1.5);
    // 1.5 pixels of a quarter.
    for i in 0..many.gaussians.len() {
        let (scale, opacity) = (many.gaussians.scales()[i], many.gaussians.opacities()[i]);
        assert!((scale[1] - 0.375).abs() < 1e-5 && scale[0] == 0.1, "{scale:?}");
        assert!((opacity - gained).abs() < 1e-6, "{opacity}");
    }
}
