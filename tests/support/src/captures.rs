//! Captures in every layout that is read, written from photos with known cameras.

use std::{
    fmt::Write as _,
    io::{Cursor, Write as _},
};

use glam::{DMat3, DQuat, DVec3};
use segsplat_core::scene::{PosedPhoto, UploadFile};

/// The layouts that [`write()`] knows, and whether they hold the numbers of a pose as JSON, so that
/// not even a rounding is between two of them.
pub const LAYOUTS: [(&str, bool); 14] = [
    ("transforms", true),
    ("cameras", true),
    ("scannetpp", true),
    ("blender", false),
    ("polycam", true),
    ("polycam_corrected", true),
    ("llff", false),
    ("colmap_bin", false),
    ("colmap_txt", false),
    ("record3d", false),
    ("r3d", false),
    ("mvsnet", false),
    ("realestate", false),
    ("arkitscenes", false),
];

/// The file of a layout that holds the cameras, or those of the first photo.
#[must_use]
pub fn described_by(layout: &str) -> &'static str {
    match layout {
        "transforms" => "transforms.json",
        "cameras" => "cameras.json",
        "scannetpp" => "dslr/nerfstudio/transforms.json",
        "blender" => "transforms_train.json",
        "polycam" => "keyframes/cameras/1000.json",
        "polycam_corrected" => "keyframes/corrected_cameras/1000.json",
        "llff" => "poses_bounds.npy",
        "colmap_bin" => "sparse/0/images.bin",
        "colmap_txt" => "sparse/0/images.txt",
        "record3d" => "EXR_RGBD/metadata",
        "r3d" => "metadata",
        "mvsnet" => "cams/00000000_cam.txt",
        "realestate" => "clip.txt",
        "arkitscenes" => "41069021/lowres_wide.traj",
        other => panic!("no layout {other}"),
    }
}

/// A camera as layouts write it.
struct Numbers {
    /// Camera-to-world, rows, OpenCV axes.
    rows: [[f64; 4]; 3],
    /// The same, OpenGL axes.
    opengl: [[f64; 4]; 3],
    /// World-to-camera.
    rotation: DMat3,
    translation: DVec3,
    k: [f64; 4],
    size: [u32; 2],
}

impl Numbers {
    fn of(posed: &PosedPhoto) -> Self {
        let m = posed.camera.camera_to_world.to_row_major();
        let rows = [0, 1, 2].map(|r| [m[4 * r], m[4 * r + 1], m[4 * r + 2], m[4 * r + 3]]);
        let pose = &posed.camera.camera_to_world;
        let rotation = pose.rotation().transpose();
        let k = posed.camera.intrinsics;
        Self {
            rows,
            opengl: rows.map(|[x, y, z, t]| [x, -y, -z, t]),
            rotation,
            translation: -(rotation * pose.center()),
            k: [k.fx, k.fy, k.cx, k.cy],
            size: [k.width, k.height],
        }
    }

    /// World-to-camera: w x y z, and the translation.
    fn colmap(&self) -> [f64; 7] {
        let [x, y, z, w] = DQuat::from_mat3(&self.rotation).to_array();
        let t = self.translation;
        [w, x, y, z, t.x, t.y, t.z]
    }

    /// World-to-camera, rows.
    fn inverse(&self) -> [[f64; 4]; 3] {
        let r = self.rotation.transpose().to_cols_array_2d();
        let t = self.translation.to_array();
        [0, 1, 2].map(|i| [r[i][0], r[i][1], r[i][2], t[i]])
    }
}

fn joined<T: ToString>(numbers: impl IntoIterator<Item = T>, between: &str) -> String {
    numbers.into_iter().map(|n| n.to_string()).collect::<Vec<_>>().join(between)
}

/// A matrix as JSON, with its last row.
fn json_rows(rows: &[[f64; 4]; 3]) -> String {
    let rows = joined(rows.iter().map(|row| format!("[{}]", joined(row, ","))), ",");
    format!("[{rows},[0,0,0,1]]")
}

/// The files of a capture; `pngs[i]` is the file of `posed[i]`.
///
/// # Panics
/// Where there is no such layout.
#[must_use]
pub fn write(layout: &str, posed: &[PosedPhoto], pngs: &[UploadFile]) -> Vec<UploadFile> {
    let cameras: Vec<Numbers> = posed.iter().map(Numbers::of).collect();
    let mut files: Vec<(String, Vec<u8>)> = Vec::new();
    let mut photos: Vec<String> = (0..posed.len()).map(|i| format!("images/{i:04}.png")).collect();
    let main = described_by(layout).to_owned();
    match layout {
        "transforms" | "scannetpp" => {
            let mut frames = String::new();
            for (i, c) in cameras.iter().enumerate() {
                let name = match layout {
                    "transforms" => photos[i].clone(),
                    _ => format!("DSC{i:05}.png"),
                };
                let ([fx, fy, cx, cy], [w, h]) = (c.k, c.size);
                let comma = if i > 0 { "," } else { "" };
                let pose = json_rows(&c.opengl);
                let _ = write!(
                    frames,
                    "{comma}{{\"file_path\":\"{name}\",\"fl_x\":{fx},\"fl_y\":{fy},\"cx\":{cx},\
                     \"cy\":{cy},\"w\":{w},\"h\":{h},\"is_bad\":false,\"transform_matrix\":{pose}}}"
                );
            }
            let more = match layout {
                "transforms" => "\"applied_transform\":[[0,1,0,0],[1,0,0,0],[0,0,-1,0]]",
                _ => "\"test_frames\":[]",
            };
            if layout == "scannetpp" {
                photos = (0..posed.len())
                    .map(|i| format!("dslr/resized_images/DSC{i:05}.png"))
                    .collect();
            }
            files.push((main, format!("{{\"frames\":[{frames}],{more}}}").into()));
        }
        "blender" => {
            // One field of view for all photos, whose names have no ending.
            let frames = joined(
                cameras.iter().enumerate().map(|(i, c)| {
                    let pose = json_rows(&c.opengl);
                    format!("{{\"file_path\":\"./train/r_{i}\",\"transform_matrix\":{pose}}}")
                }),
                ",",
            );
            let c = &cameras[0];
            let angle = 2.0 * (f64::from(c.size[0]) / 2.0 / c.k[0]).atan();
            let json = format!("{{\"camera_angle_x\":{angle},\"frames\":[{frames}]}}");
            files.push((main, json.into()));
            photos = (0..posed.len()).map(|i| format!("train/r_{i}.png")).collect();
        }
        "cameras" => {
            let camera = |(name, c): (&String, &Numbers)| {
                let ([fx, fy, cx, cy], [w, h]) = (c.k, c.size);
                format!(
                    "{{\"file\":\"{name}\",\"intrinsics\":{{\"fx\":{fx},\"fy\":{fy},\"cx\":{cx},\
                     \"cy\":{cy},\"width\":{w},\"height\":{h}}},\"camera_to_world\":{}}}",
                    json_rows(&c.rows)
                )
            };
            let all = joined(photos.iter().zip(&cameras).map(camera), ",");
            files.push((main, format!("{{\"cameras\":[{all}]}}").into()));
        }
        "polycam" | "polycam_corrected" => {
            let before = layout.strip_prefix("polycam").unwrap_or_default().trim_start_matches('_');
            let before = if before.is_empty() { "" } else { "corrected_" };
            photos.clear();
            for (i, c) in cameras.iter().enumerate() {
                let ([fx, fy, cx, cy], [w, h]) = (c.k, c.size);
                let mut json = format!("{{\"fx\":{fx},\"fy\":{fy},\"cx\":{cx},\"cy\":{cy}");
                for (r, row) in c.opengl.iter().enumerate() {
                    for (column, value) in row.iter().enumerate() {
                        let _ = write!(json, ",\"t_{r}{column}\":{value}");
                    }
                }
                let _ = write!(json, ",\"width\":{w},\"height\":{h},\"blur_score\":90.5}}");
                let number = 1000 + i;
                files.push((format!("keyframes/{before}cameras/{number}.json"), json.into()));
                photos.push(format!("keyframes/{before}images/{number}.png"));
                if !before.is_empty() {
                    // The cameras before their correction are there, too, and are not read.
                    files
                        .push((format!("keyframes/cameras/{number}.json"), b"{\"t_00\":9}".into()));
                }
            }
            files.push(("mesh_info.json".to_owned(), b"{}".into()));
        }
        "llff" => {
            let mut npy = b"\x93NUMPY\x01\0".to_vec();
            let shape = format!("({}, 17)", posed.len());
            let header =
                format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n");
            npy.extend(u16::try_from(header.len()).unwrap_or_default().to_le_bytes());
            npy.extend(header.bytes());
            for c in &cameras {
                let last = [f64::from(c.size[1]), f64::from(c.size[0]), c.k[0]];
                for ([x, y, z, t], last) in c.rows.iter().zip(last) {
                    // Down, right, backwards.
                    [*y, *x, -*z, *t, last].iter().for_each(|v| npy.extend(v.to_le_bytes()));
                }
                [1.0_f64, 9.0].iter().for_each(|v| npy.extend(v.to_le_bytes()));
            }
            files.push((main, npy));
        }
        "colmap_bin" | "colmap_txt" => {
            let binary = layout == "colmap_bin";
            let count = posed.len() as u64;
            let (mut lenses, mut images) = (Vec::new(), Vec::new());
            if binary {
                lenses.extend(count.to_le_bytes());
                images.extend(count.to_le_bytes());
            } else {
                lenses.extend(b"# Camera list\n");
                images.extend(b"# Image list\n");
            }
            for (i, c) in cameras.iter().enumerate() {
                let (id, name) = (i + 1, format!("{i:04}.png"));
                if binary {
                    let id = u32::try_from(id).unwrap_or_default();
                    lenses.extend([id, 1].iter().flat_map(|v| v.to_le_bytes()));
                    lenses.extend(c.size.iter().flat_map(|v| u64::from(*v).to_le_bytes()));
                    lenses.extend(c.k.iter().flat_map(|v| v.to_le_bytes()));
                    images.extend(id.to_le_bytes());
                    images.extend(c.colmap().iter().flat_map(|v| v.to_le_bytes()));
                    images.extend(id.to_le_bytes());
                    images.extend(name.bytes().chain([0]));
                    images.extend(1_u64.to_le_bytes());
                    images.extend([0xFF; 24]);
                } else {
                    let [w, h] = c.size;
                    let k = joined(c.k, " ");
                    lenses.extend(format!("{id} PINHOLE {w} {h} {k}\n").bytes());
                    let points = if i % 2 == 0 { "" } else { "1.5 2.5 -1" };
                    let pose = joined(c.colmap(), " ");
                    images.extend(format!("{id} {pose} {id} {name}\n{points}\n").bytes());
                }
            }
            let ending = if binary { "bin" } else { "txt" };
            files.push((format!("sparse/0/cameras.{ending}"), lenses));
            files.push((main, images));
        }
        "record3d" | "r3d" => {
            let first = &cameras[0];
            let [fx, fy, cx, cy] = first.k;
            let [w, h] = first.size;
            let pose = |c: &Numbers| {
                // Camera-to-world in OpenGL axes.
                let [x, y, z, t] = [0, 1, 2, 3]
                    .map(|column| DVec3::from_array([0, 1, 2].map(|row| c.opengl[row][column])));
                let turn = DQuat::from_mat3(&DMat3::from_cols(x, y, z)).to_array();
                format!("[{}]", joined(turn.into_iter().chain(t.to_array()), ","))
            };
            let poses = joined(cameras.iter().map(pose), ",");
            let own = joined(cameras.iter().map(|c| format!("[{}]", joined(c.k, ","))), ",");
            let json = format!(
                "{{\"w\":{w},\"h\":{h},\"K\":[{fx},0,0,0,{fy},0,{cx},{cy},1],\"fps\":60,\
                 \"perFrameIntrinsicCoeffs\":[{own}],\"poses\":[{poses}]}}"
            );
            files.push((main, json.into()));
            // `Record3D`'s own file is a zip of another folder, with depth beside the photos.
            let folder = if layout == "r3d" { "rgbd" } else { "EXR_RGBD/rgb" };
            photos = (0..posed.len()).map(|i| format!("{folder}/{i}.png")).collect();
            if layout == "r3d" {
                let others = ["rgbd/0.depth", "rgbd/0.conf", "icon", "sound.m4a"];
                files.extend(others.map(|name| (name.to_owned(), b"?".to_vec())));
            }
        }
        "mvsnet" => {
            for (i, c) in cameras.iter().enumerate() {
                let rows = joined(c.inverse().map(|row| joined(row, " ")), "\n");
                let [fx, fy, cx, cy] = c.k;
                let text = format!(
                    "extrinsic\n{rows}\n0 0 0 1\n\nintrinsic\n{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n\n\
                     2.5 0.1 128 9.5\n"
                );
                files.push((format!("cams/{i:08}_cam.txt"), text.into()));
            }
            files.push(("cams/pair.txt".to_owned(), b"0\n".into()));
            photos = (0..posed.len()).map(|i| format!("blended_images/{i:08}.png")).collect();
        }
        "realestate" => {
            let mut text = "https://example.org/watch?v=1\n".to_owned();
            photos.clear();
            for (i, c) in cameras.iter().enumerate() {
                let [w, h] = c.size.map(f64::from);
                let [fx, fy, cx, cy] = c.k;
                let k = joined([fx / w, fy / h, cx / w, cy / h], " ");
                let rows = joined(c.inverse().as_flattened(), " ");
                let time = 33_366 * i;
                let _ = writeln!(text, "{time} {k} 0 0 {rows}");
                photos.push(format!("clip/{time}.png"));
            }
            files.push((main, text.into()));
        }
        "arkitscenes" => {
            let mut text = String::new();
            photos.clear();
            for (i, c) in cameras.iter().enumerate() {
                let (axis, angle) = DQuat::from_mat3(&c.rotation).to_axis_angle();
                let turn = (axis * angle).to_array().into_iter();
                let time = 305.377 + 0.1 * i as f64;
                let numbers = joined(turn.chain(c.translation.to_array()), " ");
                // The pose was taken three milliseconds later.
                let _ = writeln!(text, "{:.6} {numbers}", time + 0.003);
                let name = format!("41069021_{time:.3}");
                let lens = joined(c.size.map(f64::from).into_iter().chain(c.k), " ");
                let lens_file = format!("41069021/lowres_wide_intrinsics/{name}.pincam");
                files.push((lens_file, lens.into()));
                photos.push(format!("41069021/lowres_wide/{name}.png"));
            }
            files.push((main, text.into()));
        }
        other => panic!("no layout {other}"),
    }
    let pngs = photos.into_iter().zip(pngs).map(|(name, png)| (name, png.bytes.clone()));
    files.extend(pngs);
    files.into_iter().map(|(name, bytes)| UploadFile { name, bytes }).collect()
}

/// Files as a zip, their names behind `top`.
#[must_use]
pub fn zipped(files: &[UploadFile], top: &str) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for file in files {
        let name = format!("{top}{}", file.name);
        zip.start_file(name, zip::write::SimpleFileOptions::default()).expect("an entry");
        zip.write_all(&file.bytes).expect("in memory");
    }
    zip.finish().expect("in memory").into_inner()
}
