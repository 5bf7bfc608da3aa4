//! A stand-in network whose answer is known (every pixel on the plane z = near of its camera):
//! what comes out of it must lie where the photos' own cameras say, whatever their shape.

use std::{collections::HashSet, path::Path, sync::atomic::AtomicBool};

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
use sha2::{Digest, Sha256};

use crate::network_options;

/// Depth of the plane, world units.
const DEPTH: f64 = 4.0;

static GO_ON: AtomicBool = AtomicBool::new(false);

fn network() -> Option<Geometry> {
    opened_in(&root().join("tests/fixtures/plane"))
}

fn opened_in(dir: &Path) -> Option<Geometry> {
    let runtime = opened(Runtime::load(&network_options()))?;
    let bundle = Bundle::open(dir).unwrap();
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
fn the_embedded_files_for_cpus_sweep_by_the_operator_of_this_program() {
    let bundle = Bundle::open(&root().join("models/embedded")).unwrap();
    let weights = bundle.geometry().weights();
    assert_eq!(weights.len(), 2, "for few views and for many");
    for file in weights.iter().map(|weights| weights.cpu_file.unwrap()) {
        let file = std::fs::read(bundle.path(file)).unwrap();
        // Field 4 of a node, its type: the tag, the length, the name.
        let nodes = |name: &str| {
            let field = [&[0x22, name.len() as u8], name.as_bytes()].concat();
            file.windows(field.len()).filter(|bytes| **bytes == *field).count()
        };
        assert_eq!((nodes("Correlate"), nodes("GridSample")), (2, 1));
    }
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

#[test]
fn a_set_goes_through_the_weights_for_its_number_of_views() {
    let from = root().join("tests/fixtures/plane");
    let dir = tempfile::tempdir().unwrap();
    let file = std::fs::read(from.join("plane.onnx")).unwrap();
    std::fs::write(dir.path().join("plane.onnx"), &file).unwrap();
    // The same network with opacities of 0.5, not 0.75.
    let solid = 0.75_f32.to_le_bytes();
    let at: Vec<usize> = (0..file.len() - 3).filter(|&i| file[i..i + 4] == solid).collect();
    assert_eq!(at.len(), 1, "the opacity stands once in the file");
    let mut many = file;
    many[at[0]..at[0] + 4].copy_from_slice(&0.5_f32.to_le_bytes());
    std::fs::write(dir.path().join("many.onnx"), &many).unwrap();
    let sha256: String = Sha256::digest(&many).iter().map(|b| format!("{b:02x}")).collect();
    let section = "[geometry.many]\nviews_min = 4\nfile = \"many.onnx\"\nsha256 = ";
    let text = std::fs::read_to_string(from.join("bundle.toml")).unwrap();
    let text =
        text.replace("[geometry.inputs]", &format!("{section}{sha256:?}\n[geometry.inputs]"));
    std::fs::write(dir.path().join("bundle.toml"), text).unwrap();
    let Some(network) = opened_in(dir.path()) else { return };
    for (views, opacity) in [(2, 0.75), (3, 0.75), (4, 0.5), (8, 0.5)] {
        let place = |i: u32| DVec3::new(0.3 * f64::from(i), 0.0, 0.0);
        let photos: Vec<PosedPhoto> = (0..views).map(|i| photo(60, 60, place(i), 0.0)).collect();
        let made = run(&network, &photos).unwrap();
        assert_eq!(made.len(), photos.len());
        assert!(made.iter().flat_map(|view| &view.opacities).all(|&a| a == opacity), "{views}");
    }
    for part in ["geometry", "geometry.many"] {
        assert!(network.network(part).is_some(), "{part}");
    }
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
