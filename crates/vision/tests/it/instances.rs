//! Instances of a scene: what is joined, what stays apart, and what is said of each.

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
    let options = InstanceOptions::default();
    let found = instances(&scene, &cameras(1), &options);
    let index = (0..800).map(|i| 1 + i / 400).collect();
    let two = scene.with_semantic_index(index).unwrap();
    assert!(Components::new(&two, &cameras(1), &options).touching_entries().is_empty());
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
    assert_eq!(components.touching_entries(), [[1, 2], [1, 3], [2, 3]]);
    for entries in [&[1][..], &[2], &[3], &[1, 2], &[1, 3], &[2, 3], &[1, 2, 3]] {
        let chosen = |i: &usize| entries.contains(&index[*i]);
        let alone: Vec<usize> = (0..sites.len()).filter(chosen).collect();
        let rest = gaussians(&alone.iter().map(|i| sites[*i]).collect::<Vec<_>>());
        let sizes = |instances: &[Instance]| -> Vec<(usize, Box3)> {
            instances
                .iter()
                .map(|instance| (instance.gaussians.len(), instance.aligned()))
                .collect()
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
    let Box3 { center, size, axes } = found[0].oriented();
    let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-3);
    assert!(near(size, [2.0, 1.0, 0.2]), "{size:?}");
    assert!(near(center, (DVec3::new(0.3, 0.2, 5.0) + ORIGIN).to_array()), "{center:?}");
    let (cos, sin) = (3.0_f64.sqrt() / 2.0, 0.5);
    assert!(near(axes[0], [cos, sin, 0.0]) && near(axes[1], [-sin, cos, 0.0]), "{axes:?}");
    let [a, b, c] = axes.map(DVec3::from_array);
    assert!((a.cross(b).dot(c) - 1.0).abs() < 1e-9, "right-handed");
    let aligned = found[0].aligned();
    assert!(near(aligned.size, [2.0 * cos + sin, 2.0 * sin + cos, 0.2]), "{aligned:?}");
    assert!(near(found[0].centroid, center));
}

#[test]
fn a_trimmed_box_forgets_a_stray() {
    let mut sites = patch(0, 0..20, 0..20, 4.0);
    // Joined to the patch by a thin chain of pixels.
    sites.extend(patch(0, 20..80, 10..11, 4.0));
    let scene = gaussians(&sites);
    let whole = InstanceOptions { sparse: 0.0, trim: 0.0, ..InstanceOptions::default() };
    let trimmed = InstanceOptions { trim: 0.1, ..whole };
    let width = |options: &InstanceOptions| {
        let found = instances(&scene, &cameras(1), options);
        assert_eq!(found.len(), 1);
        found[0].aligned().size[0]
    };
    assert!((width(&whole) - 79.0 * 0.04).abs() < 1e-4, "{}", width(&whole));
    assert!(width(&trimmed) < 40.0 * 0.04, "{}", width(&trimmed));
}

#[test]
fn a_box_ends_where_its_gaussians_get_sparse() {
    // A face of a box, and its edge's pixels that a network puts on the way to the wall behind.
    let face = patch(0, 20..60, 20..60, 4.0);
    let stray = |i: u16| {
        let (mean, source) = patch(0, 60..61, 20 + i..21 + i, 4.0 + f64::from(i) * 0.07)[0];
        (mean, source)
    };
    let strays: Vec<_> = (0..40).map(stray).collect();
    let depth = |sites: &[(DVec3, SourcePixel)], sparse: f64| {
        let options = InstanceOptions { same_depth: 0.1, sparse, ..InstanceOptions::default() };
        let found = instances(&gaussians(sites), &cameras(1), &options);
        assert_eq!((found.len(), found[0].gaussians.len()), (1, sites.len()));
        let boxes = [found[0].oriented(), found[0].upright(), found[0].aligned()];
        boxes.map(|held| held.size.into_iter().fold(0.0, f64::max))
    };
    let alone = depth(&face, 0.05);
    let both = [face, strays].concat();
    for (held, alone) in depth(&both, 0.05).into_iter().zip(alone) {
        assert!((held - alone).abs() < 0.1 * alone, "{held}, alone {alone}");
    }
    for (held, alone) in depth(&both, 0.0).into_iter().zip(alone) {
        assert!(held > 1.3 * alone, "{held}, alone {alone}");
    }
}

#[test]
fn an_upright_box_follows_two_sides_of_a_thing() {
    // Two walls of a corner, as photos see a box: the longer 3, the other 2, turned by 25 degrees.
    let turn = DMat3::from_rotation_y(25.0_f64.to_radians());
    let grid = |i: usize| (i % 21, f64::from(u32::try_from(i / 21).unwrap()) * 0.1);
    let long = |i| DVec3::new(grid(i).0 as f64 * 0.15, grid(i).1, 0.0);
    let short = |i| DVec3::new(0.0, grid(i).1, grid(i).0 as f64 * 0.1);
    let places = (0..210).map(long).chain((0..210).map(short));
    let places: Vec<DVec3> = places.map(|at| turn * at + DVec3::Z * 6.0).collect();
    let held = whole(&blobs(&places), &cameras(2)).upright();
    let near = |a: [f64; 3], b: DVec3| (DVec3::from_array(a) - b).length() < 0.1;
    assert!(near(held.size, DVec3::new(3.0, 2.0, 0.9)), "{held:?}");
}

#[test]
fn the_score_of_a_part_is_that_of_an_entry_that_is_more_than_an_edge() {
    let sites = patch(0, 0..40, 0..10, 4.0);
    // Entry 3 has 12 of 400 Gaussians, entry 2 a quarter.
    let entry = |i: usize| if i < 12 { 3 } else { 1 + u16::from(i.is_multiple_of(4)) };
    let scene = gaussians(&sites).with_semantic_index((0..400).map(entry).collect()).unwrap();
    let options = InstanceOptions::default();
    let found =
        Components::new(&scene, &cameras(1), &options).instances(&scene, &[1, 2, 3], &options);
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].entries, [(1, 291), (2, 97), (3, 12)]);
    assert_eq!(found[0].score(&[0.0, 0.6, 0.7, 0.9]), 0.7);
    assert_eq!(found[0].score(&[]), 0.0);
}

/// A number of -0.5 to 0.5 that differs from one `i` to the next.
fn noise(i: usize) -> f64 {
    (i as f64 * 12.9898).sin() * 43_758.545_3 % 1.0 / 2.0
}

/// Gaussians of any turn and size at these places, all of entry 1, without a photo that made them.
fn blobs(places: &[DVec3]) -> Gaussians {
    let n = places.len();
    let quat = |i: usize| [1.0, noise(i), noise(i + 7), noise(i + 13)].map(|v| v as f32);
    let scale = |i: usize| [0.1, 0.05, 0.02].map(|s| (s * (1.0 + noise(i))) as f32);
    let raw = RawGaussians {
        origin: ORIGIN,
        means: places.iter().map(|place| place.as_vec3().to_array()).collect(),
        quats: (0..n).map(quat).collect(),
        scales: (0..n).map(scale).collect(),
        opacities: vec![0.9; n],
        sh: vec![[0.0; 3]; n],
        semantic_index: vec![1; n],
        source: vec![SourcePixel::default(); n],
        ..RawGaussians::default()
    };
    Gaussians::sanitize(raw).unwrap().0
}

/// The one instance of all Gaussians, however few.
fn whole(of: &Gaussians, cameras: &[SceneCamera]) -> Instance {
    let options = InstanceOptions {
        reach: 1e3,
        count_min: 1,
        share_min: 0.0,
        sparse: 0.0,
        trim: 0.0,
        ..InstanceOptions::default()
    };
    let mut found = instances(of, cameras, &options);
    assert_eq!(found.len(), 1);
    found.remove(0)
}

/// Centroid and covariance by their definitions, number by number: those of many samples of the
/// mixture would be the same.
fn moments(of: &Gaussians) -> ([f64; 3], [[f64; 3]; 3]) {
    let n = of.len() as f64;
    let mean = |i: usize, a: usize| f64::from(of.means()[i][a]) + ORIGIN[a];
    let centre = [0, 1, 2].map(|a| (0..of.len()).map(|i| mean(i, a)).sum::<f64>() / n);
    let own = |i: usize, a: usize, b: usize| {
        let [w, x, y, z] = of.quats()[i].map(f64::from);
        let turn = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let scales = of.scales()[i].map(f64::from);
        (0..3).map(|k| turn[a][k] * scales[k].powi(2) * turn[b][k]).sum::<f64>()
    };
    let of_pair = |a: usize, b: usize| {
        let spread = |i: usize| (mean(i, a) - centre[a]) * (mean(i, b) - centre[b]);
        (0..of.len()).map(|i| own(i, a, b) + spread(i)).sum::<f64>() / n
    };
    (centre, [0, 1, 2].map(|a| [0, 1, 2].map(|b| of_pair(a, b))))
}

/// What every box keeps to: orthonormal right-handed axes, and all centres within.
fn holds(of: &Gaussians, held: &Box3) {
    let axes = held.axes.map(DVec3::from_array);
    for (a, one) in axes.iter().enumerate() {
        for (b, other) in axes.iter().enumerate() {
            assert!((one.dot(*other) - f64::from(a == b)).abs() < 1e-9, "{held:?}");
        }
    }
    assert!((axes[0].cross(axes[1]).dot(axes[2]) - 1.0).abs() < 1e-9, "{held:?}");
    for (axis, size) in axes.iter().zip(held.size) {
        let center = DVec3::from_array(held.center);
        let along =
            of.means().iter().map(|m| (DVec3::from(m.map(f64::from)) + ORIGIN - center).dot(*axis));
        let (least, most) = along.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        assert!((least + 0.5 * size).abs() < 1e-6 && (most - 0.5 * size).abs() < 1e-6, "{held:?}");
    }
}

#[test]
fn centroid_and_covariance_are_those_of_the_mixture() {
    let turn = DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(0.3);
    let place = |i: usize| turn * DVec3::new(4.0 * noise(i), 2.0 * noise(3 * i), noise(5 * i));
    let scene = blobs(&(0..500).map(|i| place(i) + DVec3::Z * 6.0).collect::<Vec<_>>());
    let found = whole(&scene, &cameras(1));
    let (centre, covariance) = moments(&scene);
    for a in 0..3 {
        assert!((found.centroid[a] - centre[a]).abs() < 1e-9, "{:?}", found.centroid);
        for b in 0..3 {
            let off = (found.covariance[a][b] - covariance[a][b]).abs();
            assert!(off < 1e-7, "{:?} {covariance:?}", found.covariance);
        }
    }
    // The box's axes are eigenvectors of the covariance.
    let matrix = DMat3::from_cols_array_2d(&covariance);
    let held = found.oriented();
    for axis in held.axes.map(DVec3::from_array) {
        assert!((matrix * axis).cross(axis).length() < 1e-6, "{held:?}");
    }
    assert!(held.size[0] >= held.size[1] && held.size[1] >= held.size[2], "{held:?}");
    [&held, &found.upright(), &found.aligned()].iter().for_each(|held| holds(&scene, held));
}

#[test]
fn an_upright_box_stands_on_the_ground() {
    // A table of 3 x 1 x 0.5, turned by 40 degrees on ground that tilts by 20 degrees.
    let ground = DMat3::from_rotation_z(20.0_f64.to_radians());
    let turn = ground * DMat3::from_rotation_y(40.0_f64.to_radians());
    let grid = |i: usize| DVec3::new((i % 31) as f64, (i / 31 % 6) as f64, (i / 186) as f64) * 0.1;
    let places: Vec<DVec3> = (0..31 * 6 * 11).map(|i| turn * grid(i) + DVec3::Z * 5.0).collect();
    let scene = blobs(&places);
    // Photos upright on that ground; y is down.
    let tilted = |camera: SceneCamera| {
        let [x, y, z] = [ground.row(0), ground.row(1), ground.row(2)];
        let at = camera.camera.camera_to_world.center();
        let m = [x.x, x.y, x.z, at.x, y.x, y.y, y.z, at.y, z.x, z.y, z.z, at.z, 0., 0., 0., 1.];
        let pose = CameraToWorld::from_row_major(&m, "test").unwrap();
        SceneCamera { camera: Camera { camera_to_world: pose, ..camera.camera }, ..camera }
    };
    let cameras: Vec<SceneCamera> = cameras(2).into_iter().map(tilted).collect();
    let held = whole(&scene, &cameras).upright();
    holds(&scene, &held);
    let near = |a: [f64; 3], b: DVec3| (DVec3::from_array(a) - b).length() < 1e-2;
    assert!(near(held.axes[2], -ground.y_axis), "{held:?}");
    assert!(near(held.axes[0], turn.x_axis) || near(held.axes[0], -turn.x_axis), "{held:?}");
    assert!(near(held.size, DVec3::new(3.0, 1.0, 0.5)), "{held:?}");
}

#[test]
fn up_is_that_of_gravity_though_the_photos_look_down() {
    let gravity = DMat3::from_rotation_z(0.5) * DMat3::from_rotation_x(0.2);
    // Down by 25 degrees, and to three sides. y of a camera is down.
    let looking = |(yaw, camera): (f64, SceneCamera)| {
        let turn = gravity
            * DMat3::from_rotation_y(yaw.to_radians())
            * DMat3::from_rotation_x(-25_f64.to_radians());
        let rows = [turn.row(0), turn.row(1), turn.row(2)];
        let m = rows.map(|row| [row.x, row.y, row.z, 0.0]).concat();
        let m = [&m[..], &[0.0, 0.0, 0.0, 1.0]].concat();
        let pose = CameraToWorld::from_row_major(&m.try_into().unwrap(), "test").unwrap();
        SceneCamera { camera: Camera { camera_to_world: pose, ..camera.camera }, ..camera }
    };
    let of = |yaws: [f64; 3]| -> Vec<SceneCamera> {
        yaws.into_iter().zip(cameras(3)).map(looking).collect()
    };
    let off = |up: DVec3| up.angle_between(-gravity.y_axis).to_degrees();
    let around = of([-40.0, 0.0, 30.0]);
    assert!(off(SceneCamera::level_up(&around)) < 1.0);
    assert!(off(SceneCamera::mean_up(&around)) > 20.0);
    // All to one side: no more is known than the mean says.
    let alike = of([10.0; 3]);
    let up = SceneCamera::level_up(&alike);
    assert!(up.angle_between(SceneCamera::mean_up(&alike)) < 1e-6);
    assert_eq!(SceneCamera::level_up(&[]), DVec3::NEG_Y);
}

#[test]
fn parts_of_one_point_a_line_or_a_plane_have_boxes() {
    type Place<'a> = &'a dyn Fn(usize) -> DVec3;
    let line = |i: usize| DVec3::new(1.0, 2.0, 2.0) / 3.0 * i as f64;
    let plane = |i: usize| DVec3::new((i % 8) as f64, (i / 8) as f64 * 0.5, 0.0);
    let cases: [(usize, Place<'_>, [f64; 3]); 4] = [
        (1, &|_| DVec3::Z, [0.0; 3]),
        (9, &|_| DVec3::ONE, [0.0; 3]),
        (5, &line, [4.0, 0.0, 0.0]),
        (32, &plane, [7.0, 1.5, 0.0]),
    ];
    for (count, place, size) in cases {
        let places: Vec<DVec3> = (0..count).map(place).collect();
        // Round and alike, so that the places alone say where the box points.
        let round = blobs(&places);
        let raw = RawGaussians { scales: vec![[0.1; 3]; count], ..round.into_raw() };
        let scene = Gaussians::sanitize(raw).unwrap().0;
        let found = whole(&scene, &[]);
        let held = found.oriented();
        let off = held.size.iter().zip(size).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 1e-5, "{count}: {held:?}");
        [&held, &found.upright(), &found.aligned()].iter().for_each(|held| holds(&scene, held));
        let variance = found.covariance[0][0];
        assert!(variance.is_finite() && variance > 0.009, "{count}: its own size counts");
        assert!(found.visibility.is_empty(), "no photos");
    }
}

#[test]
fn visibility_is_the_share_that_each_photo_shows() {
    // View 0 made columns 20 to 60 of a plane. View 1 stands one unit to the right, so that the
    // plane is 25 columns farther left there: it made columns 0 to 15, and a screen before the
    // rest.
    let sites = [
        patch(0, 20..60, 40..60, 4.0),
        patch(1, 0..15, 40..60, 4.0),
        patch(1, 15..60, 40..60, 2.0),
    ]
    .concat();
    let scene = gaussians(&sites);
    let index: Vec<u16> = (0..sites.len()).map(|i| 1 + u16::from(i >= 1100)).collect();
    let scene = scene.with_semantic_index(index).unwrap();
    let mut found = instances(&scene, &cameras(3), &InstanceOptions::default());
    assert_eq!((found.len(), found[0].gaussians.len()), (1, 1100));
    let seen = found.remove(0).visibility;
    // View 0 shows its own 800 and those 15 columns, where it has the plane too (25 to 40).
    // View 1 shows its own 300, and of the 40 columns those at 0 to 15 there. View 2 made nothing.
    for (seen, wanted) in seen.iter().zip([1.0, (300.0 + 300.0) / 1100.0, 0.0]) {
        assert!((f64::from(*seen) - wanted).abs() < 0.03, "{seen} is not {wanted}");
    }
    assert_eq!(seen.len(), 3);
}
