//! Which photos are the input of a target.

use glam::{DMat4, DVec3};
use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics, PosedPhoto};
use segsplat_lab::scenes::{inputs, overlap};

use crate::posed;

const LENS: Intrinsics =
    Intrinsics { fx: 30.0, fy: 32.0, cx: 19.0, cy: 16.0, width: 40, height: 30 };

/// A camera at `eye`, turned about y (to the right) and then about x, radians.
fn camera(eye: [f64; 3], [yaw, pitch]: [f64; 2]) -> Camera {
    let turn = DMat4::from_rotation_y(yaw) * DMat4::from_rotation_x(pitch);
    let matrix = DMat4::from_translation(DVec3::from(eye)) * turn;
    let rows = matrix.transpose().to_cols_array();
    Camera {
        camera_to_world: CameraToWorld::from_row_major(&rows, "pose").unwrap(),
        intrinsics: LENS,
    }
}

/// The share of `from`'s pixels of whose rays some of many points is in the picture of `to`.
fn marched(from: &Camera, to: &Camera) -> f64 {
    let (lens, out) = (from.intrinsics, to.intrinsics);
    let seen = |x: u32, y: u32| {
        let way = lens.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, 1.0);
        (0..4000).any(|step| {
            let depth = 10_f64.powf(f64::from(step) / 400.0 - 4.0);
            let point = from.camera_to_world.matrix().transform_point3(depth * way);
            let local = to.camera_to_world.viewmat().transform_point3(point);
            let (u, v) = out.project(local);
            local.z > 0.0
                && (0.0..=f64::from(out.width)).contains(&u)
                && (0.0..=f64::from(out.height)).contains(&v)
        })
    };
    let all = (0..lens.height).flat_map(|y| (0..lens.width).map(move |x| (x, y)));
    let count = all.filter(|&(x, y)| seen(x, y)).count();
    count as f64 / f64::from(lens.width * lens.height)
}

/// A second camera beside one at 0 that looks along z; and the overlap by MVSplat's own code
/// (`project_rays`, f64), in pixels of 1,200.
const PAIRS: [([f64; 3], [f64; 2], u32); 7] = [
    ([0.5, 0.1, 0.0], [0.0, 0.0], 1200),
    ([0.0, 0.0, 0.0], [0.4, 0.0], 722),
    ([0.5, 0.1, 0.0], [0.5, 0.1], 618),
    ([0.5, 0.1, 0.0], [-0.5, 0.1], 1139),
    ([0.3, 0.2, -0.6], [-0.9, 0.3], 213),
    ([0.0, 0.0, 3.0], [3.1, 0.0], 1200),
    ([1.0, 0.0, -1.0], [3.1, 0.0], 0),
];

#[test]
fn overlap_is_the_share_of_rays_that_come_into_the_other_picture() {
    let first = camera([0.0; 3], [0.0; 2]);
    for (eye, turned, official) in PAIRS {
        let second = camera(eye, turned);
        let found = overlap(&first, &second);
        assert_eq!(found, overlap(&second, &first), "{eye:?}");
        assert!((found - f64::from(official) / 1200.0).abs() < 1e-9, "{eye:?}: {found}");
        // Points on a ray miss what it only touches.
        let wanted = marched(&first, &second).min(marched(&second, &first));
        assert!((found - wanted).abs() < 0.005, "{eye:?}: {found}, {wanted} by points");
    }
}

#[test]
fn inputs_overlap_each_other_and_are_the_nearest_that_do() {
    // At 1, 2, 3 and 4 beside the target at 0. The nearest looks away; 2 overlaps 3 by 0.86 and 4
    // by 0.65, and they overlap by 0.29.
    let turned = [0.0, 2.5, 0.0, -0.5, 0.35];
    let photos: Vec<PosedPhoto> = turned
        .iter()
        .enumerate()
        .map(|(i, yaw)| posed(camera([i as f64, 0.0, 0.0], [*yaw, 0.0]), vec![0; 3600]))
        .collect();
    let of = |count, least| inputs(&photos, 0, count, least);
    assert_eq!(of(2, 0.0), Some(vec![1, 2]), "the nearest");
    assert_eq!(of(2, 0.6), Some(vec![2, 3]), "as the paper");
    assert_eq!(of(3, 0.2), Some(vec![2, 3, 4]));
    assert_eq!(of(3, 0.6), None, "each two overlap");
    assert_eq!(of(2, 0.9), None);
    assert_eq!(of(5, 0.0), None, "four beside it");
}
