//! Instances of a scene: what is joined, what stays apart, and the boxes.

use glam::{DMat3, DVec3};
use segsplat_core::scene::{
    Camera, CameraToWorld, Gaussians, Intrinsics, RawGaussians, SceneCamera, SourcePixel,
};
use segsplat_vision::semantics::{Box3, Components, Instance, InstanceOptions};

const ORIGIN: DVec3 = DVec3::new(1000.0, -50.0, 3.0);

fn cameras(count: usize) -> Vec<SceneCamera> {
    let lens = Intrinsics { fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0, width: 100, height: 100 };
    let pose = |i: usize| {
        let x = ORIGIN.x + i as f64;
        let m = [1., 0., 0., x, 0., 1., 0., ORIGIN.y, 0., 0., 1., ORIGIN.z];
        let m = [&m[..], &[0., 0., 0., 1.]].concat();
        CameraToWorld::from_row_major(&m.try_into().unwrap(), "test").unwrap()
    };
    let camera = |i| Camera { intrinsics: lens, camera_to_world: pose(i) };
    let input = |i| SceneCamera { file: String::new(), camera: camera(i), network: Some(lens) };
    (0..count).map(input).collect()
}

fn gaussians(at: &[(DVec3, SourcePixel)]) -> Gaussians {
    let n = at.len();
    let raw = RawGaussians {
        origin: ORIGIN,
        means: at.iter().map(|(mean, _)| mean.as_vec3().to_array()).collect(),
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        scales: vec![[0.01; 3]; n],
        opacities: vec![0.9; n],
        sh: vec![[0.0; 3]; n],
        semantic_index: vec![1; n],
        source: at.iter().map(|(_, source)| *source).collect(),
        ..RawGaussians::default()
    };
    Gaussians::sanitize(raw).unwrap().0
}

/// What camera `view` sees as columns `x`, rows `y` of a plane at depth `z`.
fn patch(
    view: u16,
    x: std::ops::Range<u16>,
    y: std::ops::Range<u16>,
    z: f64,
) -> Vec<(DVec3, SourcePixel)> {
    let one = |x: u16, y: u16| {
        let ray = |v: u16| (f64::from(v) + 0.5 - 50.0) / 100.0 * z;
        (DVec3::new(ray(x) + f64::from(view), ray(y), z), SourcePixel { view, x, y })
    };
    y.flat_map(|y| x.clone().map(move |x| one(x, y))).collect()
}

/// Parts of all Gaussians of entry 1.
fn instances(of: &Gaussians, cameras: &[SceneCamera], options: &InstanceOptions) -> Vec<Instance> {
    Components::new(of, cameras, options).instances(of, &[1], options)
}

#[test]
fn things_apart_are_two_parts_and_the_largest_comes_first() {
    let sites = [patch(0, 0..10, 0..10, 4.0), patch(0, 40..60, 0..10, 4.0)].concat();
    let scene = gaussians(&sites);
    let found = instances(&scene, &cameras(1), &InstanceOptions::default());
    let sizes: Vec<usize> = found.iter().map(|instance| instance.gaussians.len()).collect();
    assert_eq!(sizes, [200, 100]);
    assert_eq!(found[1].gaussians[..3], [0, 1, 2]);
}

#[test]
fn one_surface_seen_by_two_photos_is_one_part() {
    // View 1 stands one unit to the right: its patch continues that of view 0.
    let sites = [patch(0, 50..75, 40..60, 4.0), patch(1, 50..75, 40..60, 4.08)].concat();
    let scene = gaussians(&sites);
    let found = instances(&scene, &cameras(2), &InstanceOptions::default());
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].gaussians.len(), 1000);
}

#[test]
fn near_and_far_things_are_joined_alike_and_a_step_in_depth_parts() {
    let sites = [patch(0, 0..20, 0..20, 0.5), patch(0, 20..40, 0..20, 50.0)].concat();
    let scene = gaussians(&sites);
    let found = instances(&scene, &cameras(1), &InstanceOptions::default());
    assert_eq!(found.len(), 2, "neighbouring pixels, far apart in depth");
    assert!(found.iter().all(|instance| instance.gaussians.len() == 400));
}

#[test]
fn specks_are_left_out() {
    let sites = [patch(0, 0..30, 0..30, 4.0), patch(0, 80..83, 80..83, 4.0)].concat();
    let scene = gaussians(&sites);
    let found = instances(&scene, &cameras(1), &InstanceOptions::default());
    assert_eq!(found.len(), 1);
    let fine = InstanceOptions { count_min: 1, share_min: 0.0, ..InstanceOptions::default() };
    assert_eq!(instances(&scene, &cameras(1), &fine).len(), 2);
    let components = Components::new(&scene, &cameras(1), &fine);
    assert!(components.instances(&scene, &[], &fine).is_empty());
    assert!(components.instances(&scene, &[7], &fine).is_empty(), "no such entry");
}

#[test]
fn parts_of_some_entries_are_those_of_their_gaussians_alone() {
    // Stripes of three entries across one plane, a hole between, and a far thing of entry 2.
    let sites =
        [patch(0, 0..60, 0..20, 4.0), patch(1, 10..40, 30..60, 4.1), patch(0, 70..90, 70..90, 9.0)]
            .concat();
    let stripe = |i: usize| 1 + (i % 60 / 7) as u16 % 3;
    let entry = |i: usize| if i < 1200 { stripe(i) } else { 2 + (i / 1500) as u16 % 2 };
    let index: Vec<u16> = (0..sites.len()).map(entry).collect();
    let scene = gaussians(&sites).with_semantic_index(index.clone()).unwrap();
    let options = InstanceOptions { count_min: 1, share_min: 0.0, ..InstanceOptions::default() };
    let components = Components::new(&scene, &cameras(2), &options);
    for entries in [&[1][..], &[2], &[3], &[1, 2], &[1, 3], &[2, 3], &[1, 2, 3]] {
        let chosen = |i: &usize| entries.contains(&index[*i]);
        let alone: Vec<usize> = (0..sites.len()).filter(chosen).collect();
        let rest = gaussians(&alone.iter().map(|i| sites[*i]).collect::<Vec<_>>());
        let sizes = |instances: &[Instance]| -> Vec<(usize, Box3)> {
            instances.iter().map(|instance| (instance.gaussians.len(), instance.aligned)).collect()
        };
        let found = components.instances(&scene, entries, &options);
        assert_eq!(sizes(&found), sizes(&instances(&rest, &cameras(2), &options)), "{entries:?}");
        assert!(!found.is_empty(), "{entries:?}");
    }
}

#[test]
fn boxes_have_the_things_size_place_and_turn() {
    // A slab of 2 x 1 x 0.2, turned by 30 degrees about the camera's axis.
    let turn = DMat3::from_rotation_z(30.0_f64.to_radians());
    let mut sites = Vec::new();
    for i in 0..=40 {
        for j in 0..=20 {
            for k in 0..=4 {
                let own = DVec3::new(
                    f64::from(i) * 0.05 - 1.0,
                    f64::from(j) * 0.05 - 0.5,
                    f64::from(k) * 0.05 - 0.1,
                );
                let mean = turn * own + DVec3::new(0.3, 0.2, 5.0);
                let source = SourcePixel { view: 0, x: i as u16, y: (j * 5 + k) as u16 };
                sites.push((mean, source));
            }
        }
    }
    let scene = gaussians(&sites);
    let options = InstanceOptions { trim: 0.0, ..InstanceOptions::default() };
    let found = instances(&scene, &cameras(1), &options);
    assert_eq!(found.len(), 1);
    let Box3 { center, size, axes } = found[0].oriented;
    let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-3);
    assert!(near(size, [2.0, 1.0, 0.2]), "{size:?}");
    assert!(near(center, (DVec3::new(0.3, 0.2, 5.0) + ORIGIN).to_array()), "{center:?}");
    let (cos, sin) = (3.0_f64.sqrt() / 2.0, 0.5);
    assert!(near(axes[0], [cos, sin, 0.0]) && near(axes[1], [-sin, cos, 0.0]), "{axes:?}");
    let [a, b, c] = axes.map(DVec3::from_array);
    assert!((a.cross(b).dot(c) - 1.0).abs() < 1e-9, "right-handed");
    let aligned = found[0].aligned;
    assert!(near(aligned.size, [2.0 * cos + sin, 2.0 * sin + cos, 0.2]), "{aligned:?}");
    assert!(near(found[0].centroid, center));
}

#[test]
fn a_trimmed_box_forgets_a_stray() {
    let mut sites = patch(0, 0..20, 0..20, 4.0);
    // Joined to the patch by a thin chain of pixels.
    sites.extend(patch(0, 20..80, 10..11, 4.0));
    let scene = gaussians(&sites);
    let whole = InstanceOptions { trim: 0.0, ..InstanceOptions::default() };
    let trimmed = InstanceOptions { trim: 0.1, ..InstanceOptions::default() };
    let width = |options: &InstanceOptions| {
        let found = instances(&scene, &cameras(1), options);
        assert_eq!(found.len(), 1);
        found[0].aligned.size[0]
    };
    assert!((width(&whole) - 79.0 * 0.04).abs() < 1e-4, "{}", width(&whole));
    assert!(width(&trimmed) < 40.0 * 0.04, "{}", width(&trimmed));
}
