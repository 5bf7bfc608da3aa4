//! Tests of files as other programs write them: far scenes, the renderer's mode, nearly Gaussians,
//! any comment, an SPZ in a GLB.

use std::io::Cursor;

use glam::DVec3;
use serde_json::json;

use segsplat_core::{
    error::{ErrorCode, Result},
    limits::Limits,
    scene::{Gaussians, RawGaussians, SH_C0, SourcePixel},
};
use segsplat_formats::{
    splats::{COMPRESSED_PLY, GLB, PLY, SOG, SPLAT, SPZ, SPZ4, SplatFile, SplatFormat, SplatsRead},
    table::{read_splats, splat_formats},
};

const COUNT: usize = 600;

/// Gaussians of some centimetres within five units of a place.
fn room(origin: DVec3) -> Gaussians {
    let part = |i: usize, of: usize| (i * of % 997) as f32 / 997.0;
    let all = 0..COUNT;
    let raw = RawGaussians {
        origin,
        means: all.clone().map(|i| [7, 31, 101].map(|of| part(i, of) * 10.0 - 5.0)).collect(),
        quats: all.clone().map(|i| [1.0, part(i, 3), part(i, 5), part(i, 11)]).collect(),
        scales: all.clone().map(|i| [17, 41, 61].map(|of| 0.01 + 0.03 * part(i, of))).collect(),
        opacities: all.clone().map(|i| 0.2 + 0.7 * part(i, 13)).collect(),
        sh_degree: 0,
        sh: all.map(|i| [19, 23, 29].map(|of| part(i, of) - 0.5)).collect(),
        semantic_index: vec![0; COUNT],
        source: vec![SourcePixel::default(); COUNT],
    };
    Gaussians::sanitize(raw).unwrap().0
}

fn bytes_of(file: &SplatFile) -> Vec<u8> {
    let mut bytes = Vec::new();
    file.write(&mut bytes).unwrap();
    assert_eq!(file.size_bytes().unwrap_or(bytes.len() as u64), bytes.len() as u64);
    bytes
}

fn read(format: &SplatFormat, bytes: &[u8]) -> Result<SplatsRead> {
    let name = format!("a.{}", format.ending);
    read_splats(&mut Cursor::new(bytes), &name, &Limits::default())
}

/// World position of Gaussian `i`.
fn world(gaussians: &Gaussians, i: usize) -> DVec3 {
    gaussians.origin() + DVec3::from_array(gaussians.means()[i].map(f64::from))
}

/// How far the places of what comes back are from those that went in, at most; of formats with an
/// order of their own from the nearest one.
fn moved(to: &Gaussians, back: &Gaussians) -> f64 {
    assert_eq!(to.len(), back.len());
    let nearest = |i: usize| {
        let away = |j: usize| world(to, i).distance(world(back, j));
        (0..back.len()).map(away).fold(f64::INFINITY, f64::min)
    };
    (0..to.len()).map(nearest).fold(0.0, f64::max)
}

/// UTM coordinates of a real place, in metres.
const UTM: DVec3 = DVec3::new(447_123.4, 5_411_987.6, 312.3);

#[test]
fn a_far_scene_keeps_its_places_or_is_refused_with_its_step() {
    let far = room(UTM);
    for format in [&PLY, &GLB, &SOG] {
        let file = SplatFile::new(format, far.clone(), None).unwrap();
        let back = read(format, &bytes_of(&file)).unwrap();
        let moved = moved(&far, &back.gaussians);
        assert!(moved < 2e-4, "{}: {moved}", format.name);
    }
    for (format, step) in [(&SPLAT, "0.5"), (&COMPRESSED_PLY, "0.5"), (&SPZ, "1"), (&SPZ4, "1")] {
        let refused = SplatFile::new(format, far.clone(), None).map(drop).unwrap_err();
        assert_eq!(refused.code(), ErrorCode::LimitExceeded);
        let name = format.name;
        let says = format!("{name}: step of positions, world units: {step} is over 0.00");
        assert!(refused.message().starts_with(&says), "{refused}");
        assert!(refused.message().contains("ply, glb and sog keep it"), "{refused}");
    }
}

#[test]
fn a_ply_has_double_positions_where_float_loses_and_says_so() {
    for (origin, is_double) in [(DVec3::ZERO, false), (UTM * 1e-3, false), (UTM, true)] {
        let file = SplatFile::new(&PLY, room(origin), None).unwrap();
        let bytes = bytes_of(&file);
        let text = String::from_utf8_lossy(&bytes[..1_200]);
        assert_eq!(
            text.contains("property double x\nproperty double y\nproperty double z\n"),
            is_double
        );
        assert_eq!(text.contains("comment step 0.5 of float positions is over 0.00"), is_double);
    }
    // A first vertex without a place does not take the places of the others.
    let mut file = bytes_of(&SplatFile::new(&PLY, room(UTM), None).unwrap());
    let head = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    file[head..head + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    let back = read(&PLY, &file).unwrap();
    assert_eq!((back.gaussians.len(), back.dropped.not_finite), (COUNT - 1, 1));
    assert!(moved(&back.gaussians, &room(UTM).only(|i| i > 0)) < 1e-6);
}

/// No scene near zero is refused for its small, flat or scattered Gaussians.
#[test]
fn scenes_about_zero_are_written_in_every_format() {
    let mut raw = room(DVec3::ZERO).into_raw();
    raw.scales.fill([1e-12; 3]);
    let points = Gaussians::sanitize(raw.clone()).unwrap().0;
    // One of twenty is a sky, a thousand units away.
    for i in (0..COUNT).step_by(20) {
        raw.means[i] = raw.means[i].map(|x| x * 200.0);
    }
    raw.scales.fill([0.004, 0.004, 1e-6]);
    let flat = Gaussians::sanitize(raw).unwrap().0;
    for gaussians in [points, flat] {
        for format in splat_formats() {
            SplatFile::new(format, gaussians.clone(), None).unwrap();
        }
    }
}

#[test]
fn the_mode_of_the_renderer_travels_with_the_file() {
    for format in splat_formats() {
        for mode in [false, true] {
            let file = SplatFile::new(format, room(DVec3::ZERO), None).unwrap().antialiased(mode);
            let back = read(format, &bytes_of(&file)).unwrap();
            // `.splat` has no header.
            assert_eq!(back.antialiased, mode && format.name != SPLAT.name, "{}", format.name);
            let scene = back.into_scene(&Default::default()).unwrap();
            assert_eq!(scene.meta.report.antialiased, mode && format.name != SPLAT.name);
        }
    }
}

/// The bytes of a PLY with this text in place of its line of the mode.
fn commented(comment: &[u8]) -> Vec<u8> {
    let file = bytes_of(&SplatFile::new(&PLY, room(DVec3::ZERO), None).unwrap());
    let line = b"comment SplatRenderMode: default\n";
    let at = file.windows(line.len()).position(|w| w == line).unwrap();
    [&file[..at], comment, &file[at + line.len()..]].concat()
}

#[test]
fn modes_are_read_as_other_programs_write_them() {
    for (comment, mode) in [
        ("comment SplatRenderMode: mip\n", true),
        ("comment splatrendermode=MIP\r\n", true),
        ("comment SplatRenderMode: 2dgs\n", false),
        ("comment antialiased 1\n", true),
        ("obj_info antialiased: true\n", true),
        ("comment antialiased 0\n", false),
        ("comment antialiased 1\ncomment SplatRenderMode: default\n", false),
        ("comment not antialiased 1\n", false),
        ("", false),
    ] {
        let read = read(&PLY, &commented(comment.as_bytes())).unwrap();
        assert_eq!(read.antialiased, mode, "{comment}");
    }
}

#[test]
fn no_comment_refuses_a_file() {
    let long = [b"comment ", &vec![b'a'; 200_000][..], b"\n"].concat();
    let all: Vec<u8> = (0..=255).filter(|byte| *byte != b'\n').collect();
    for comment in [
        b"comment Gr\xfc\xdfe aus K\xf6ln\n".to_vec(),
        b"obj_info \xff\xfe\0a\n".to_vec(),
        [b"comment ", &all[..], b"\n"].concat(),
        b"comment\n\n  \ncomment\t\xe9\n".to_vec(),
        long,
    ] {
        assert_eq!(read(&PLY, &commented(&comment)).unwrap().gaussians.len(), COUNT);
    }
}

/// A PLY of these columns: name, type and the bytes of each of two vertices.
fn ply(columns: &[(&str, &str, [Vec<u8>; 2])]) -> Vec<u8> {
    let lines: String =
        columns.iter().map(|(name, kind, _)| format!("property {kind} {name}\n")).collect();
    let head =
        format!("ply\nformat binary_little_endian 1.0\nelement vertex 2\n{lines}end_header\n");
    let rows = (0..2).flat_map(|i| columns.iter().flat_map(move |(.., rows)| rows[i].clone()));
    head.into_bytes().into_iter().chain(rows).collect()
}

fn floats<'a>(names: &[&'a str], value: f32) -> Vec<(&'a str, &'a str, [Vec<u8>; 2])> {
    let bytes = value.to_le_bytes().to_vec();
    names.iter().map(|name| (*name, "float", [bytes.clone(), bytes.clone()])).collect()
}

fn level(v: u8) -> f32 {
    (f32::from(v) / 255.0 - 0.5) / SH_C0
}

#[test]
fn colours_without_harmonics_are_drawn() {
    let xyz = floats(&["x", "y", "z"], 2.0);
    let bytes = |v: [u8; 2]| v.map(|v| vec![v]);
    let rgb = [
        ("red", "uchar", bytes([255, 10])),
        ("green", "uchar", bytes([0, 20])),
        ("blue", "uchar", bytes([128, 30])),
    ];
    // As scanners have it: points with colours and nothing else.
    let read_of = |columns: &[_]| read(&PLY, &ply(columns)).unwrap().gaussians;
    let points = read_of(&[&xyz[..], &rgb[..]].concat());
    let near = |a: f32, b: f32| (a - b).abs() < 1e-6;
    for (found, v) in points.sh().iter().flatten().zip([255, 0, 128, 10, 20, 30]) {
        assert!(near(*found, level(v)), "{found} for {v}");
    }
    assert_eq!(points.opacities(), [1.0; 2]);
    assert_eq!(points.scales(), [[0.01; 3]; 2]);
    assert_eq!(points.quats(), [[1.0, 0.0, 0.0, 0.0]; 2]);
    // With alpha, 16 bits, floats, and other names.
    let alpha = [("alpha", "uchar", bytes([255, 51]))];
    let points = read_of(&[&xyz[..], &rgb[..], &alpha[..]].concat());
    assert_eq!(points.opacities(), [1.0, 0.2]);
    let wide = |v: u16| [v.to_le_bytes().to_vec(), v.to_le_bytes().to_vec()];
    let rgb16 = ["r", "g", "b"].map(|name| (name, "ushort", wide(65_535)));
    assert!(near(read_of(&[&xyz[..], &rgb16[..]].concat()).sh()[0][0], level(255)));
    let diffuse = floats(&["diffuse_red", "diffuse_green", "diffuse_blue"], 1.0);
    assert!(near(read_of(&[xyz.clone(), diffuse].concat()).sh()[0][2], level(255)));
    // Harmonics come first where both are there.
    let dc = floats(&["f_dc_0", "f_dc_1", "f_dc_2"], 0.25);
    assert_eq!(read_of(&[&xyz[..], &rgb[..], &dc[..]].concat()).sh()[0], [0.25; 3]);
    // Places alone are no Gaussians.
    let refused = read(&PLY, &ply(&xyz)).unwrap_err();
    assert!(refused.message().contains("no `f_dc_0`"), "{refused}");
}

#[test]
fn flat_round_and_degenerate_gaussians_are_drawn() {
    let mut base = floats(&["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"], 1.0);
    let read_with = |more: Vec<_>| {
        let read = read(&PLY, &ply(&[&base[..], &more].concat())).unwrap();
        assert_eq!(read.gaussians.len(), 2, "{:?}", read.dropped);
        (read.gaussians.scales()[0], read.gaussians.quats()[0])
    };
    let ([a, b, thin], _) = read_with(floats(&["scale_0", "scale_1"], -2.0));
    assert!(a == b && (a - 0.135_335).abs() < 1e-5 && thin > 0.0 && thin <= 1e-3 * a, "{thin}");
    let (round, _) = read_with(floats(&["scale_0"], -2.0));
    assert_eq!(round, [a; 3]);
    let flat = [floats(&["scale_0"], f32::NEG_INFINITY), floats(&["scale_1", "scale_2"], -2.0)];
    let ([thin, b, _], _) = read_with(flat.concat());
    assert!(thin > 0.0 && thin <= 1e-3 * b, "{thin}");
    let (point, quat) = read_with(
        [
            floats(&["scale_0", "scale_1", "scale_2"], -1e30),
            floats(&["rot_0", "rot_1", "rot_2", "rot_3"], 0.0),
        ]
        .concat(),
    );
    assert_eq!((point, quat), ([Gaussians::SCALE_MIN; 3], [1.0, 0.0, 0.0, 0.0]));
    // What is half there is a fault.
    base.extend(floats(&["scale_0", "scale_2"], -2.0));
    let refused = read(&PLY, &ply(&base)).unwrap_err();
    assert!(refused.message().contains("no `scale_1`"), "{refused}");
}

/// A GLB whose node holds a file in a buffer view.
fn enclosing(spz: &[u8], extensions: &serde_json::Value, node: &serde_json::Value) -> Vec<u8> {
    let names: Vec<&String> = extensions.as_object().unwrap().keys().collect();
    let document = json!({
        "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": [0] }], "nodes": [node],
        "extensionsUsed": names, "extensionsRequired": names,
        "meshes": [{ "primitives": [{ "attributes": {}, "mode": 0, "extensions": extensions }] }],
        "buffers": [{ "byteLength": spz.len() }],
        "bufferViews": [{ "buffer": 0, "byteLength": spz.len() }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut binary = spz.to_vec();
    binary.resize(binary.len().next_multiple_of(4), 0);
    let word = |n: usize| (n as u32).to_le_bytes();
    let all = 12 + 8 + text.len() + 8 + binary.len();
    [
        b"glTF\x02\0\0\0",
        &word(all)[..],
        &word(text.len()),
        b"JSON",
        &text,
        &word(binary.len()),
        b"BIN\0",
        &binary,
    ]
    .concat()
}

#[test]
fn an_spz_in_a_glb_is_read() {
    let spz2 = "KHR_gaussian_splatting_compression_spz_2";
    let new = |words: serde_json::Value| {
        let mut extension = words;
        extension["extensions"] = json!({ spz2: { "bufferView": 0 } });
        json!({ "KHR_gaussian_splatting": extension })
    };
    let words = json!({ "kernel": "ellipse", "colorSpace": "srgb_rec709_display" });
    let old = json!({
        "KHR_gaussian_splatting": {},
        "KHR_spz_gaussian_splats_compression": { "bufferView": 0 },
    });
    for format in [&SPZ, &SPZ4] {
        let file = SplatFile::new(format, room(DVec3::ZERO), None).unwrap().antialiased(true);
        let spz = bytes_of(&file);
        let alone = read(format, &spz).unwrap().gaussians;
        for extensions in [&new(words.clone()), &new(json!({})), &old] {
            let back = read(&GLB, &enclosing(&spz, extensions, &json!({ "mesh": 0 }))).unwrap();
            assert!(back.antialiased);
            assert_eq!(back.gaussians.means(), alone.means());
            assert_eq!(back.gaussians.scales(), alone.scales());
            assert_eq!(back.gaussians.sh(), alone.sh());
            assert_eq!(back.gaussians.quats(), alone.quats());
        }
        // It lies where its node lies: y up, z back.
        let node = json!({ "mesh": 0, "translation": [1e6, 2.0, 3.0], "scale": [2.0, 2.0, 2.0] });
        let back = read(&GLB, &enclosing(&spz, &new(words.clone()), &node)).unwrap().gaussians;
        for i in 0..COUNT {
            let wanted = 2.0 * world(&alone, i) + DVec3::new(1e6, -2.0, -3.0);
            assert!(world(&back, i).distance(wanted) < 1e-5);
            assert_eq!(back.scales()[i], alone.scales()[i].map(|s| 2.0 * s));
        }
        let cut = enclosing(&spz[..spz.len() / 2], &new(words.clone()), &json!({ "mesh": 0 }));
        let refused = read(&GLB, &cut).unwrap_err();
        assert!(refused.message().starts_with("GLB: SPZ: "), "{refused}");
    }
    let other = new(json!({ "kernel": "cube" }));
    let refused = read(&GLB, &enclosing(&[], &other, &json!({ "mesh": 0 }))).unwrap_err();
    assert!(refused.message().contains("kernel is \"cube\""), "{refused}");
}
