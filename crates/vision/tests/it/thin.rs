//! Thinning: what is merged, what stays, and that the mass in the picture stays.

use std::sync::atomic::AtomicBool;

use glam::{DMat3, DQuat, DVec3};
use segsplat_core::scene::{
    BLUR_PX2, Camera, CameraToWorld, Gaussians, Intrinsics, SH_C0, ViewGaussians,
};
use segsplat_vision::lift::{Fusion, ThinOptions, lift};

const SIDE: usize = 16;
const FOCAL: f64 = 20.0;

/// A wall across the axis at depth 4 seen by `SIDE` x `SIDE` pixels, a Gaussian a pixel; `colour`
/// and `depth` may give another colour and depth.
fn wall(
    colour: impl Fn(usize, usize) -> f32,
    depth: impl Fn(usize, usize) -> f32,
) -> ViewGaussians {
    let (side, middle) = (SIDE as u32, SIDE as f64 / 2.0);
    let intrinsics =
        Intrinsics { fx: FOCAL, fy: FOCAL, cx: middle, cy: middle, width: side, height: side };
    let identity = glam::DMat4::IDENTITY.to_cols_array();
    let camera_to_world = CameraToWorld::from_row_major(&identity, "test").unwrap();
    let pixels = || (0..SIDE * SIDE).map(|i| (i % SIDE, i / SIDE));
    let mean = |(x, y): (usize, usize)| {
        let z = depth(x, y);
        let away = |k: usize| (k as f32 + 0.5 - middle as f32) / FOCAL as f32 * z;
        [away(x), away(y), z]
    };
    ViewGaussians {
        photo: 0,
        camera: Camera { intrinsics, camera_to_world },
        frame_to_world: camera_to_world,
        near_far: [1.0, 10.0],
        means: pixels().map(mean).collect(),
        scales: vec![[0.08, 0.1, 0.05]; SIDE * SIDE],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; SIDE * SIDE],
        opacities: vec![0.4; SIDE * SIDE],
        sh_degree: 0,
        sh: pixels().map(|(x, y)| [colour(x, y) / SH_C0; 3]).collect(),
        confidence: vec![1.0; SIDE * SIDE],
        valid: None,
    }
}

fn lifted(view: ViewGaussians, options: Option<&ThinOptions>) -> Gaussians {
    let cameras = [view.camera];
    let go_on = AtomicBool::new(false);
    lift(vec![view], &cameras, true, &Fusion::default(), options, &go_on).unwrap().gaussians
}

fn thinned(view: ViewGaussians) -> Gaussians {
    lifted(view, Some(&ThinOptions::default()))
}

/// Pixels of the Gaussians that are left.
fn kept(of: &Gaussians) -> Vec<usize> {
    of.source().iter().map(|s| usize::from(s.y) * SIDE + usize::from(s.x)).collect()
}

/// Mass in the picture, `sum a A` in px², and where its middle is.
fn mass(of: &Gaussians) -> (f64, DVec3) {
    let (mut sum, mut middle) = (0.0, DVec3::ZERO);
    for i in 0..of.len() {
        let mean = DVec3::from_array(of.means()[i].map(f64::from));
        let pixel = mean.z / FOCAL;
        let [w, x, y, z] = of.quats()[i].map(f64::from);
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
        let variances = DVec3::from_array(of.scales()[i].map(|s| f64::from(s).powi(2)));
        let s = rotation * DMat3::from_diagonal(variances) * rotation.transpose();
        let blur = f64::from(BLUR_PX2);
        let at = |a: usize, b: usize| s.col(a)[b] / (pixel * pixel);
        let area = ((at(0, 0) + blur) * (at(1, 1) + blur) - at(0, 1).powi(2)).sqrt();
        sum += f64::from(of.opacities()[i]) * area;
        middle += f64::from(of.opacities()[i]) * area * mean;
    }
    (sum, middle / sum)
}

#[test]
fn a_flat_wall_keeps_one_of_sixteen_with_the_mass_and_the_middle_of_all() {
    let view = wall(|_, _| 0.2, |_, _| 4.0);
    let (before, middle) = mass(&lifted(view.clone(), None));
    let left = thinned(view);
    assert_eq!(left.len(), SIDE * SIDE / 16);
    let (after, still) = mass(&left);
    // Opacity would pass its bound, so some of the mass is given up: never more than is said.
    let opacity_max = ThinOptions::default().opacity_max;
    assert!(left.opacities().iter().all(|&a| f64::from(a) <= opacity_max + 1e-6));
    assert!(middle.distance(still) < 1e-5, "{middle} {still}");
    assert!(after <= before * (1.0 + 1e-5) && after > before / 4.0, "{before} {after}");
    let blocks: Vec<_> = kept(&left).iter().map(|i| (i % SIDE / 4, i / SIDE / 4)).collect();
    assert!((0..16).all(|b| blocks.contains(&(b % 4, b / 4))), "one a block: {blocks:?}");
}

#[test]
fn faint_gaussians_keep_all_their_mass() {
    let mut view = wall(|_, _| 0.2, |_, _| 4.0);
    view.opacities.fill(0.05);
    let (before, _) = mass(&lifted(view.clone(), None));
    let left = lifted(view, Some(&ThinOptions { levels: 1, ..ThinOptions::default() }));
    assert_eq!(left.len(), SIDE * SIDE / 4);
    let (after, _) = mass(&left);
    assert!((after / before - 1.0).abs() < 1e-5, "{before} {after}");
}

#[test]
fn texture_edges_of_depth_and_what_is_beside_them_stay() {
    let texture = wall(|x, y| 0.1 * ((x + y) % 2) as f32, |_, _| 4.0);
    assert_eq!(thinned(texture).len(), SIDE * SIDE, "a texture");

    // An edge between columns 7 and 8, and so between blocks: the ring sees it.
    for (colour, depth) in [(0.3, 4.0), (0.0, 6.0)] {
        let view =
            wall(|x, _| if x < 8 { 0.0 } else { colour }, |x, _| if x < 8 { 4.0 } else { depth });
        let left = kept(&thinned(view));
        let beside = |i: &&usize| (6..10).contains(&(**i % SIDE));
        assert_eq!(left.iter().filter(beside).count(), 4 * SIDE, "{colour} {depth}");
        assert!(left.len() < SIDE * SIDE * 3 / 4, "{} left", left.len());
    }
}

#[test]
fn what_is_no_gaussian_any_more_merges_with_nothing() {
    let mut view = wall(|_, _| 0.2, |_, _| 4.0);
    view.valid = Some((0..SIDE * SIDE).map(|i| i != 0).collect());
    view.scales[5] = [f32::NAN; 3];
    let left = thinned(view);
    let pixels = kept(&left);
    assert!(!pixels.contains(&0), "it has no source");
    assert!([1, SIDE, SIDE + 1, 4].iter().all(|i| pixels.contains(i)), "{pixels:?}");
    assert!(left.means().iter().flatten().all(|v| v.is_finite()));
}
