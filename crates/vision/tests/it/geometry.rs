//! A stand-in network whose answer is known (every pixel on the plane z = near of its camera):
//! what comes out of it must lie where the photos' own cameras say, whatever their shape.

use std::{collections::HashSet, sync::atomic::AtomicBool};

use glam::{DMat3, DMat4, DVec3};
use segsplat_core::{
    error::{ErrorCode, Result},
    scene::{Camera, CameraToWorld, Intrinsics, Photo, PosedPhoto, ViewGaussians},
};
use segsplat_vision::{
    lift::{Fusion, Lifted, lift},
    models::{Bundle, Geometry, GeometryInput, Runtime},
};

use segsplat_testing::{opened, root};

use crate::network_options;

/// Depth of the plane, world units.
const DEPTH: f64 = 4.0;

static GO_ON: AtomicBool = AtomicBool::new(false);

fn network() -> Option<Geometry> {
    let bundle = Bundle::open(&root().join("tests/fixtures/plane")).unwrap();
    let runtime = opened(Runtime::load(&network_options()))?;
    Some(Geometry::open(&runtime, &bundle, &network_options()).unwrap())
}

/// A photo whose red is the column and green the row.
fn photo(width: u32, height: u32, center: DVec3, turn: f64) -> PosedPhoto {
    let rotation = DMat3::from_rotation_y(turn);
    let pose = DMat4::from_cols(
        rotation.x_axis.extend(0.0),
        rotation.y_axis.extend(0.0),
        rotation.z_axis.extend(0.0),
        center.extend(1.0),
    );
    let camera_to_world =
        CameraToWorld::from_row_major(&pose.transpose().to_cols_array(), "test").unwrap();
    let (w, h) = (f64::from(width), f64::from(height));
    // Off-centre, and not the same focal length both ways.
    let intrinsics =
        Intrinsics { fx: 0.9 * w, fy: 1.1 * w, cx: 0.43 * w, cy: 0.56 * h, width, height };
    let rgb =
        (0..height).flat_map(|y| (0..width).flat_map(move |x| [x as u8, y as u8, 90])).collect();
    PosedPhoto {
        file: format!("{width}x{height}"),
        photo: Photo { width, height, rgb, valid: None },
        camera: Camera { intrinsics, camera_to_world },
        intrinsics_made_for: None,
    }
}

/// The CPU's file is made by a script that looks for the sweeps in an export. Without the operator
/// all samples of a sweep are in memory: 576 MB for four photos, and their products.
#[test]
fn the_embedded_file_for_cpus_sweeps_by_the_operator_of_this_program() {
    let file = std::fs::read(root().join("models/embedded/geometry_cpu.onnx")).unwrap();
    // Field 4 of a node, its type: the tag, the length, the name.
    let nodes = |name: &str| {
        let field = [&[0x22, name.len() as u8], name.as_bytes()].concat();
        file.windows(field.len()).filter(|bytes| **bytes == *field).count()
    };
    assert_eq!((nodes("Correlate"), nodes("GridSample")), (2, 1));
}

fn run(network: &Geometry, photos: &[PosedPhoto]) -> Result<Vec<ViewGaussians>> {
    let views: Vec<usize> = (0..photos.len()).collect();
    let count = (photos.len() - 1).min(3);
    let neighbors: Vec<Vec<usize>> = views
        .iter()
        .map(|v| views.iter().copied().filter(|w| w != v).take(count).collect())
        .collect();
    network.run(&GeometryInput {
        photos,
        views: &views,
        near_far: &vec![[DEPTH, 10.0 * DEPTH]; photos.len()],
        median_depth: DEPTH,
        neighbors: &neighbors,
    })
}

fn lifted(network: &Geometry, photos: &[PosedPhoto]) -> Lifted {
    let cameras: Vec<Camera> = photos.iter().map(|p| p.camera).collect();
    lift(run(network, photos).unwrap(), &cameras, true, &Fusion::default(), None, &GO_ON).unwrap()
}

#[test]
fn a_plane_of_known_depth_lies_where_the_photos_own_cameras_say() {
    let Some(network) = network() else { return };
    let far_away = DVec3::new(4000.0, -20.0, 900.0);
    for (width, height) in [(90, 60), (60, 90), (80, 80), (121, 60)] {
        let photos = [
            photo(width, height, far_away, 0.1),
            photo(width, height, far_away + DVec3::new(0.7, 0.1, -0.2), -0.15),
        ];
        let result = lifted(&network, &photos);
        let gaussians = &result.gaussians;
        assert!(gaussians.len() > 1_500, "{} of {width}x{height}", gaussians.len());
        assert!((result.median_depth - DEPTH).abs() < 1e-3, "median depth {}", result.median_depth);
        for i in 0..gaussians.len() {
            let camera = &photos[usize::from(gaussians.source()[i].view)].camera;
            let mean = glam::Vec3::from_array(gaussians.means()[i]).as_dvec3();
            let seen = camera.camera_to_world.viewmat().transform_point3(mean + gaussians.origin());
            assert!((seen.z - DEPTH).abs() < 1e-3, "{width}x{height}: depth {}", seen.z);
            // Its colour is the colour that the whole photo has where its own camera sees it.
            let (u, v) = camera.intrinsics.project(seen);
            let value = |c: usize| 255.0 * (0.5 + 0.282_094_79 * f64::from(gaussians.sh()[i][c]));
            // Away from the border, where the filter has only one side.
            let inner = |x: f64, side: u32| x > 6.0 && x < f64::from(side) - 6.0;
            if inner(u, width) && inner(v, height) {
                let off = (value(0) - (u - 0.5)).abs().max((value(1) - (v - 0.5)).abs());
                assert!(off < 0.05, "{width}x{height} at ({u}, {v}): {off} px off");
            }
        }
        let scale = gaussians.scales()[0][0];
        let baseline = photos[0].camera.camera_to_world.center();
        let baseline = baseline.distance(photos[1].camera.camera_to_world.center());
        assert!((f64::from(scale) - 0.1 * baseline).abs() < 1e-5, "scale {scale}");
    }
}

#[test]
fn six_photos_of_one_plane_keep_four_layers_and_no_hole() {
    let Some(network) = network() else { return };
    // Parallel cameras in one line: their planes are the same plane.
    let photos: Vec<PosedPhoto> =
        (0..6).map(|i| photo(64, 64, DVec3::new(0.05 * f64::from(i), 0.0, 0.0), 0.0)).collect();
    let result = lifted(&network, &photos);
    let total: u64 = result.dropped.iter().map(|d| d.count).sum();
    assert_eq!(result.gaussians.len() as u64 + total, 6 * 32 * 32, "all are accounted for");
    assert!(result.dropped.iter().any(|d| d.reason == "duplicate"), "{:?}", result.dropped);

    // Around every place that all six see, at least four photos and at most five have a Gaussian.
    let pixel = DEPTH / (0.9 * 32.0);
    for (x, y) in [(0.0, 0.0), (0.6, -0.4), (-0.5, 0.7)] {
        let place = DVec3::new(x, y, DEPTH);
        let near: HashSet<u16> = (0..result.gaussians.len())
            .filter(|&i| {
                let mean = glam::Vec3::from_array(result.gaussians.means()[i]).as_dvec3();
                let off = mean + result.gaussians.origin() - place;
                off.x.abs() <= 0.6 * pixel && off.y.abs() <= 0.6 * pixel
            })
            .map(|i| result.gaussians.source()[i].view)
            .collect();
        assert!((4..=5).contains(&near.len()), "({x}, {y}): layers of photos {near:?}");
    }
}

#[test]
fn photos_from_one_place_are_refused() {
    let Some(network) = network() else { return };
    let photos = [photo(64, 64, DVec3::ZERO, 0.0), photo(64, 64, DVec3::ZERO, 0.2)];
    let error = run(&network, &photos).unwrap_err();
    assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
    assert!(error.message().contains("one place"), "{error}");
}
