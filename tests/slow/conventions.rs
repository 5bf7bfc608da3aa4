//! Photographs whose cameras are given in the wrong convention, over HTTP and gRPC.

use std::{ops::Range, path::Path};

use segsplat::scene::{Upload, UploadCameras, UploadFile};
use serde_json::{Value, json};

use crate::common::{
    cpu_server::CpuServer,
    doors::{Options, both},
    root, shared_scene,
};

/// Photographs of a folder and its transforms, changed.
fn changed(folder: &Path, frames: Range<usize>, change: impl Fn(&mut Value)) -> Upload {
    let text = std::fs::read(folder.join("transforms.json")).unwrap();
    let mut transforms: Value = serde_json::from_slice(&text).unwrap();
    let all = transforms["frames"].as_array_mut().unwrap();
    *all = all[frames].to_vec();
    let photos = all
        .iter()
        .map(|frame| {
            let name = frame["file_path"].as_str().unwrap().to_owned();
            let bytes = std::fs::read(folder.join(&name)).unwrap();
            UploadFile { name, bytes }
        })
        .collect();
    change(&mut transforms);
    let cameras = Some(UploadCameras::Transforms(transforms.to_string().into_bytes()));
    Upload { cameras, photos, ..Upload::default() }
}

fn matrices(transforms: &mut Value, change: impl Fn(&mut [[f64; 4]; 4])) {
    for frame in transforms["frames"].as_array_mut().unwrap() {
        let rows = frame["transform_matrix"].take();
        let mut m: [[f64; 4]; 4] = serde_json::from_value(rows).unwrap();
        change(&mut m);
        frame["transform_matrix"] = json!(m);
    }
}

#[tokio::test]
async fn wrong_conventions_are_named() {
    wrong_conventions(&root().join("tests/fixtures/room"), 0..6).await;
}

#[tokio::test]
async fn wrong_conventions_on_real_photographs_are_named() {
    // The first frames of `fox` stand on a line across their viewing direction, where flipped axes
    // make an equally good scene; these go round it.
    let Some(folder) = shared_scene("fox") else { return };
    wrong_conventions(&folder, 10..16).await;
}

/// Both transports name the usual mistakes with these photographs.
async fn wrong_conventions(folder: &Path, frames: Range<usize>) {
    let good = changed(folder, frames.clone(), |_| {});
    let axes = changed(folder, frames.clone(), |transforms| {
        matrices(transforms, |m| {
            for row in &mut m[..3] {
                (row[1], row[2]) = (-row[1], -row[2]);
            }
        });
    });
    let inverted = changed(folder, frames.clone(), |transforms| {
        matrices(transforms, |m| {
            let pose = glam::DMat4::from_cols_array_2d(m).transpose();
            *m = pose.inverse().transpose().to_cols_array_2d();
        });
    });
    let half = changed(folder, frames, |transforms| {
        for key in ["fl_x", "fl_y", "cx", "cy"] {
            transforms[key] = json!(transforms[key].as_f64().unwrap() / 2.0);
        }
    });
    let stand = CpuServer::start().await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&good, &Options::wait()).await.unwrap();
        let (_, warnings) = door.get(&id).await.unwrap();
        let wrong = ["axes_swapped", "pose_inverted", "intrinsics_scale"];
        assert!(
            !warnings.iter().any(|w| wrong.contains(&w.as_str())),
            "{warnings:?} of a good one"
        );
        for (upload, code) in [(&axes, wrong[0]), (&inverted, wrong[1]), (&half, wrong[2])] {
            let named = match door.create(upload, &Options::wait()).await {
                Ok((id, _)) => door.get(&id).await.unwrap().1,
                Err(fault) => vec![format!("{}: {}", fault.code, fault.message)],
            };
            assert!(named.iter().any(|name| name.contains(code)), "{code} is not in {named:?}");
        }
    }
}
