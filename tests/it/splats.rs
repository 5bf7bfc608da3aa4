//! Gaussians as files of other programs: what each format loses, files that others wrote, files
//! that are damaged, and the calls that give them.

use std::{
    collections::HashSet,
    io::{Cursor, Read as _, Write as _},
};

use axum::http::header;
use flate2::{Compression, read::GzDecoder, write::GzEncoder};
use glam::DVec3;
use segsplat::{
    error::{ErrorCode, Result},
    formats::{
        splats::{COMPRESSED_PLY, GLB, PLY, SOG, SPLAT, SPZ, SPZ4, SplatFile, SplatFormat},
        table::{read_splats, splat_formats},
    },
    limits::Limits,
    render::{Kinds, RenderRequest, Renderer as _, compare::psnr, cpu::CpuRenderer},
    scene::{
        Bank, BankMask, Gaussians, IndexMap, RowViews, SanitizeReport, SceneOptions, Semantics,
        SemanticsReport,
    },
};
use segsplat_testing::scenes::{camera, cloud};

use crate::common::{
    client,
    cpu_server::{CpuServer, upload},
    doors::{self, form, json},
    root,
};

const COUNT: usize = 3_000;

fn bytes_of(format: &'static SplatFormat, gaussians: &Gaussians) -> Vec<u8> {
    let file = SplatFile::new(format, gaussians.clone(), None).unwrap();
    let mut bytes = Vec::new();
    file.write(&mut bytes).unwrap();
    assert_eq!(file.size_bytes().unwrap_or(bytes.len() as u64), bytes.len() as u64);
    bytes
}

type Read = (Gaussians, SanitizeReport, Option<Semantics>);

fn limits(gaussians_max: usize) -> Limits {
    Limits { gaussians_max, ..Limits::default() }
}

fn read(format: &SplatFormat, bytes: &[u8]) -> Result<Read> {
    let name = format!("a.{}", format.ending);
    let read = read_splats(&mut Cursor::new(bytes), &name, &limits(100_000))?;
    assert_eq!(read.format.name, format.name);
    Ok((read.gaussians, read.dropped, read.semantics))
}

fn round_trip(format: &'static SplatFormat, gaussians: &Gaussians) -> Gaussians {
    let (back, report, _) = read(format, &bytes_of(format, gaussians)).unwrap();
    assert_eq!(report, SanitizeReport::default(), "{}", format.name);
    assert_eq!((back.len(), back.sh_degree()), (gaussians.len(), degree(format, gaussians)));
    back
}

/// Harmonics that are left.
fn degree(format: &SplatFormat, gaussians: &Gaussians) -> u8 {
    if format.name == SPLAT.name { 0 } else { gaussians.sh_degree() }
}

fn world(gaussians: &Gaussians, i: usize) -> DVec3 {
    gaussians.origin() + DVec3::from_array(gaussians.means()[i].map(f64::from))
}

/// Largest differences: position, logarithm of scale, opacity, rotation (of any number, q and -q
/// being one), coefficient of degree 0, coefficient above.
fn differences(a: &Gaussians, b: &Gaussians) -> [f64; 6] {
    let (ka, kb) = (a.sh_count(), b.sh_count());
    let mut most = [0.0_f64; 6];
    for i in 0..a.len() {
        let mut see = |of: usize, difference: f64| most[of] = most[of].max(difference);
        see(0, (world(a, i) - world(b, i)).abs().max_element());
        for k in 0..3 {
            see(1, f64::from((a.scales()[i][k].ln() - b.scales()[i][k].ln()).abs()));
        }
        see(2, f64::from((a.opacities()[i] - b.opacities()[i]).abs()));
        let (p, q) = (a.quats()[i], b.quats()[i]);
        let sign = p.iter().zip(q).map(|(p, q)| p * q).sum::<f32>().signum();
        p.iter().zip(q).for_each(|(p, q)| see(3, f64::from((p - sign * q).abs())));
        for j in 0..kb.min(ka) {
            let (p, q) = (a.sh()[i * ka + j], b.sh()[i * kb + j]);
            let worst = p.iter().zip(q).map(|(p, q)| (p - q).abs()).fold(0.0, f32::max);
            see(if j == 0 { 4 } else { 5 }, f64::from(worst));
        }
    }
    most
}

/// Every number comes back within half a step of its format.
#[test]
fn numbers_come_back_to_the_step_of_the_format() {
    // Position, ln scale, opacity, rotation, degree 0, degrees above.
    let exact = 3e-6;
    let (bits, color) = (2_f64.powi(-19), 0.5 / 255.0 / 0.15);
    let spz = [bits, 0.5 / 16.0, 0.5 / 255.0, 2.2 / 723.0, color, 8.51 / 128.0];
    let cases = [
        (&PLY, [1e-6, exact, exact, exact, 0.0, 0.0]),
        (&GLB, [0.0; 6]),
        (&SPLAT, [1e-6, exact, 0.5 / 255.0, 1.1 / 128.0, 0.5 / 255.0 / 0.282, 9.0]),
        (&SPZ, spz),
        (&SPZ4, spz),
    ];
    for degree in 0..=3 {
        let gaussians = cloud(COUNT, degree, 5);
        for (format, most) in cases {
            let found = differences(&gaussians, &round_trip(format, &gaussians));
            for (of, (found, most)) in found.into_iter().zip(most).enumerate() {
                let name = format.name;
                assert!(
                    found <= most + 1e-7,
                    "{name}, degree {degree}: {of} is {found} off, {most}"
                );
            }
        }
    }
}

/// SOG has the Gaussians in another order, positions in steps of a logarithm, and scales and
/// colours in tables that follow their density.
#[test]
fn sog_keeps_numbers_to_the_steps_of_its_tables() {
    let gaussians = cloud(400, 2, 5);
    let back = round_trip(&SOG, &gaussians);
    let order = nearest(&back, &gaussians);
    let mut all = order.clone();
    all.sort_unstable();
    assert!(all.into_iter().eq(0..400), "each Gaussian is there once");
    let [position, scale, opacity, rotation, color, rest] =
        differences(&chosen(&gaussians, &order), &back);
    assert!(position < 5e-4 && opacity <= 0.5 / 255.0 + 1e-6, "{position} {opacity}");
    assert!(rotation < 2.2 * 0.5 * 2_f64.sqrt() / 255.0, "{rotation}");
    // No number is farther from its table than 1/256 of their range.
    let range = |numbers: &mut dyn Iterator<Item = f32>| {
        let ends = numbers.fold([f32::MAX, f32::MIN], |[a, b], v| [a.min(v), b.max(v)]);
        f64::from(ends[1] - ends[0]) / 256.0 + 1e-4
    };
    let scales = range(&mut gaussians.scales().iter().flatten().map(|scale| scale.ln()));
    let colors = range(&mut gaussians.sh().iter().step_by(9).flatten().copied());
    assert!(scale < scales && color < colors, "{scale} of {scales}, {color} of {colors}");
    // Each of so few has its own row of the palette.
    let above = gaussians.sh().chunks_exact(9).flat_map(|row| row[1..].iter().flatten());
    let above = range(&mut above.copied());
    assert!(rest < above && rest > 0.0, "{rest} of {above}");
}

/// For each Gaussian the number of the nearest of others.
fn nearest(of: &Gaussians, among: &Gaussians) -> Vec<usize> {
    let nearest = |i: usize| {
        let far = |j: &usize| world(of, i).distance(world(among, *j));
        (0..among.len()).min_by(|a, b| far(a).total_cmp(&far(b))).unwrap()
    };
    (0..of.len()).map(nearest).collect()
}

/// What was read once does not change any more.
#[test]
fn a_second_round_trip_changes_nothing() {
    let gaussians = cloud(COUNT, 2, 6);
    for format in [&GLB, &SPZ, &SPZ4, &SPLAT] {
        let once = round_trip(format, &gaussians);
        let [position, scale, opacity, _, color, rest] =
            differences(&once, &round_trip(format, &once));
        // The largest number of a rotation can be another one of two that are nearly equal.
        assert_eq!((position, rest), (0.0, 0.0), "{}", format.name);
        assert!(scale.max(opacity).max(color) < 1e-6, "{}", format.name);
    }
}

/// The picture that each format costs, against the picture of the Gaussians that went in.
/// docs/formats.md has the figures.
#[test]
fn every_format_keeps_the_picture() {
    let gaussians = cloud(COUNT, 0, 9);
    let kinds = Kinds { color: true, depth: false, alpha: false };
    let request = RenderRequest::plain(camera(160, 120), kinds, 0.01);
    let renderer = CpuRenderer::new(1).unwrap();
    let draw = |gaussians: &Gaussians| renderer.render(gaussians, &request).unwrap().color.unwrap();
    let truth = draw(&gaussians);
    for (format, floor) in [
        (&PLY, 105.0),
        (&GLB, 120.0),
        (&SPLAT, 58.0),
        (&SPZ, 49.0),
        (&SPZ4, 49.0),
        (&SOG, 49.0),
        (&COMPRESSED_PLY, 46.0),
    ] {
        let found = psnr(&draw(&round_trip(format, &gaussians)), &truth, None);
        println!("{}: {found:.1} dB", format.name);
        assert!(found > floor, "{}: {found:.1} dB, not {floor}", format.name);
    }
}

/// A colour that depends on the direction does so in the axes of the format too.
#[test]
fn harmonics_turn_with_the_axes() {
    let gaussians = cloud(COUNT, 3, 11);
    let kinds = Kinds { color: true, depth: false, alpha: false };
    let request = RenderRequest::plain(camera(160, 120), kinds, 0.01);
    let renderer = CpuRenderer::new(1).unwrap();
    let draw = |gaussians: &Gaussians| renderer.render(gaussians, &request).unwrap().color.unwrap();
    let truth = draw(&gaussians);
    for (format, floor) in
        [(&GLB, 90.0), (&SPZ, 32.0), (&SPZ4, 32.0), (&SOG, 30.0), (&COMPRESSED_PLY, 30.0)]
    {
        let found = psnr(&draw(&round_trip(format, &gaussians)), &truth, None);
        println!("{} of degree 3: {found:.1} dB", format.name);
        assert!(found > floor, "{}: {found:.1} dB, not {floor}", format.name);
    }
}

fn semantics() -> Semantics {
    let masks = [(0, 0, 1), (0, 1, 2), (1, 0, 1)];
    Semantics {
        bank: Bank { dim: 2, rows: vec![0.5, 0.25, -1.0, 3.0] },
        views: RowViews { entries: vec![1, 1], rows: vec![1.0, 0.0, 0.0, 1.0] },
        index: (0..50).map(|i| i % 3).collect(),
        photos: vec![IndexMap { width: 2, height: 1, index: vec![1, 2] }],
        masks: masks.map(|(photo, mask, entry)| BankMask { photo, mask, entry }).to_vec(),
        report: SemanticsReport::default(),
    }
}

#[test]
fn a_glb_carries_the_entries_and_the_bank() {
    let semantics = semantics();
    let gaussians = cloud(50, 1, 2).with_semantic_index(semantics.index.clone()).unwrap();
    let file = SplatFile::new(&GLB, gaussians, Some(&semantics)).unwrap();
    let mut bytes = Vec::new();
    file.write(&mut bytes).unwrap();
    assert_eq!(file.size_bytes(), Some(bytes.len() as u64));
    let (back, _, found) = read(&GLB, &bytes).unwrap();
    assert_eq!(back.semantic_index(), semantics.index);
    assert_eq!(found, Some(semantics));
    *bytes.last_mut().unwrap() ^= 1;
    // The last bytes may be padding: of the container one is spoilt for sure.
    let end = bytes.len() - 8;
    bytes[end] ^= 1;
    assert_eq!(read(&GLB, &bytes).unwrap_err().code(), ErrorCode::InvalidRequest);
}

/// The document follows the specification of the extension and of glTF.
#[test]
fn a_glb_is_what_its_specification_asks() {
    let gaussians = cloud(50, 1, 2);
    let bytes = bytes_of(&GLB, &gaussians);
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let json = word(12);
    assert!(json % 4 == 0 && word(20 + json) % 4 == 0, "chunks are of whole words");
    let document: serde_json::Value = serde_json::from_slice(&bytes[20..20 + json]).unwrap();
    assert_eq!(document["extensionsUsed"], serde_json::json!(["KHR_gaussian_splatting"]));
    let primitive = &document["meshes"][0]["primitives"][0];
    let attributes = primitive["attributes"].as_object().unwrap();
    for name in ["POSITION", "COLOR_0", "_SEMANTIC_INDEX"] {
        assert!(attributes.contains_key(name), "{name}");
    }
    let own = ["ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", "SH_DEGREE_1_COEF_2"];
    for name in own {
        assert!(attributes.contains_key(&format!("KHR_gaussian_splatting:{name}")), "{name}");
    }
    for view in document["bufferViews"].as_array().unwrap() {
        let end = view["byteOffset"].as_u64().unwrap() + view["byteLength"].as_u64().unwrap();
        assert!(view["byteOffset"].as_u64().unwrap() % 4 == 0);
        assert!(end <= document["buffers"][0]["byteLength"].as_u64().unwrap());
    }
    // y is up: the highest Gaussian of the file is the one with the least y of the scene.
    let top = document["accessors"][0]["max"][1].as_f64().unwrap();
    let least = gaussians.means().iter().map(|mean| mean[1]).fold(f32::MAX, f32::min);
    assert_eq!(top, -f64::from(least));
    let origin = gaussians.origin();
    let node = serde_json::json!([origin.x, -origin.y, -origin.z]);
    assert_eq!(document["nodes"][0]["translation"], node);
}

/// A far scene keeps its f64 origin in a GLB and its places as f64 in a PLY; SPZ says what it
/// cannot hold.
#[test]
fn a_far_scene_is_exact_or_refused() {
    let mut raw = cloud(50, 0, 2).into_raw();
    raw.origin = DVec3::new(512_345.678_901, 1e7, -1.0 / 3.0);
    let far = Gaussians::sanitize(raw).unwrap().0;
    let [position, .., rotation, color, rest] = differences(&far, &round_trip(&GLB, &far));
    assert_eq!((position, color, rest), (0.0, 0.0, 0.0));
    assert!(rotation < 1e-7, "it is scaled to length 1 once more: {rotation}");
    let [position, ..] = differences(&far, &round_trip(&PLY, &far));
    // Rounded to f32 about the origin that the reader chooses.
    assert!(position < 1e-6, "PLY: {position}");
    let error = SplatFile::new(&SPZ, far, None).unwrap_err();
    assert!(error.message().contains("8388607"), "{error}");
    for format in splat_formats().filter(|format| format.name != PLY.name) {
        let error = SplatFile::new(format, Gaussians::default(), None).unwrap_err();
        assert!(error.message().contains("no Gaussians to write"), "{error}");
    }
}

fn fixture(name: &str) -> Vec<u8> {
    std::fs::read(root().join("tests/fixtures/splats").join(name)).unwrap()
}

/// The same Gaussians by splat-transform (`PlayCanvas`) in each format, against its source.
#[test]
fn files_of_another_program_are_read() {
    let (source, _, _) = read(&PLY, &fixture("source.ply")).unwrap();
    assert_eq!((source.len(), source.sh_degree()), (40, 1));
    let theirs = |format: &SplatFormat, name: &str| {
        let (read, report, _) = read(format, &fixture(name)).unwrap();
        assert_eq!((read.len(), report), (40, SanitizeReport::default()), "{name}");
        read
    };
    // Their order is along a curve: the nearest of the source is the same Gaussian.
    let packed = theirs(&COMPRESSED_PLY, "theirs.compressed.ply");
    let found = differences(&chosen(&source, &nearest(&packed, &source)), &packed);
    assert!(found[0] < 2e-3 && found[1] < 2e-3 && found[2] < 3e-3, "{found:?}");
    assert!(found[3] < 2e-3 && found[4] < 0.01 && found[5] < 0.032, "{found:?}");
    let sog = theirs(&SOG, "theirs.sog");
    let found = differences(&chosen(&source, &nearest(&sog, &source)), &sog);
    // It rounds down, and its palette of harmonics has fewer rows than there are Gaussians.
    assert!(found[0] < 5e-4 && found[1] < 0.06 && found[2] < 4e-3 && found[3] < 8e-3, "{found:?}");
    assert!(found[4] < 0.03 && found[5] < 0.8, "{found:?}");
    // It writes the numbers of the PLY into SPZ as they are. The format's axes are y up, z back.
    for (format, name) in [(&SPZ, "theirs.spz"), (&SPZ4, "theirs.v4.spz")] {
        let untold = theirs(format, name);
        let untold = half_turn(&untold, [1.0, -1.0, -1.0], [1.0, 1.0, -1.0, -1.0]);
        let found = differences(&source, &untold);
        assert!(found[0] < 2.0_f64.powi(-12) && found[1] < 0.032 && found[3] < 2e-3, "{found:?}");
    }
    // It turns a PLY about z into glTF's axes, we turn about x: between both is half a turn about
    // y.
    let glb = theirs(&GLB, "theirs.glb");
    for i in 0..40 {
        let difference = world(&glb, i) - world(&source, i) * DVec3::new(-1.0, 1.0, -1.0);
        assert!(difference.length() < 1e-6, "{difference}");
    }
    let found = differences(&half_turn(&source, [-1.0, 1.0, -1.0], [0.0; 4]), &glb);
    assert!(found[1] < 1e-5 && found[2] < 1e-5 && found[4] < 1e-6, "{found:?}");
}

/// The Gaussians of these numbers, in this order.
fn chosen(from: &Gaussians, order: &[usize]) -> Gaussians {
    let (all, k) = (from.clone().into_raw(), from.sh_count());
    let mut raw = segsplat::scene::RawGaussians {
        origin: all.origin,
        sh_degree: all.sh_degree,
        ..Default::default()
    };
    for &i in order {
        raw.means.push(all.means[i]);
        raw.quats.push(all.quats[i]);
        raw.scales.push(all.scales[i]);
        raw.opacities.push(all.opacities[i]);
        raw.sh.extend_from_slice(&all.sh[i * k..(i + 1) * k]);
        raw.semantic_index.push(0);
        raw.source.push(all.source[i]);
    }
    Gaussians::sanitize(raw).unwrap().0
}

/// Positions and rotations with other signs; rotations stay where all are 0.
fn half_turn(from: &Gaussians, position: [f64; 3], quat: [f32; 4]) -> Gaussians {
    let mut raw = from.clone().into_raw();
    raw.origin *= DVec3::from_array(position);
    for mean in &mut raw.means {
        *mean = [0, 1, 2].map(|k| mean[k] * position[k] as f32);
    }
    if quat != [0.0; 4] {
        raw.quats.iter_mut().for_each(|q| *q = [0, 1, 2, 3].map(|k| q[k] * quat[k]));
    }
    Gaussians::sanitize(raw).unwrap().0
}

/// SPZ before version 3: half floats in version 1, three bytes a rotation.
#[test]
fn older_spz_files_are_read() {
    let packed = |version: u8, positions: &[u8]| {
        let mut bytes = b"NGSP".to_vec();
        bytes.extend([version, 0, 0, 0, 1, 0, 0, 0, 0, 12, 0, 0]);
        bytes.extend(positions);
        // Opacity, colour, scale (ln 1/e), rotation: half a turn about z.
        bytes.extend([128, 255, 128, 0, 144, 144, 160, 128, 128, 255]);
        gzip(&bytes)
    };
    let halves = [1.5_f32, -2.0, 0.25].map(|v| half_bits(v).to_le_bytes());
    let steps = [1.5_f32, -2.0, 0.25].map(|v| ((v * 4096.0) as i32).to_le_bytes());
    let steps: Vec<u8> = steps.iter().flat_map(|word| word[..3].to_vec()).collect();
    for (version, positions) in [(1, halves.concat()), (2, steps)] {
        let (read, _, _) = read(&SPZ, &packed(version, &positions)).unwrap();
        assert_eq!(world(&read, 0), DVec3::new(1.5, 2.0, -0.25), "version {version}");
        let [w, x, y, z] = read.quats()[0];
        assert!(
            w.abs() < 0.1 && x.abs() < 0.01 && y.abs() < 0.01 && z < -0.99,
            "{:?}",
            read.quats()
        );
        let scales = read.scales()[0].map(f32::ln);
        assert!(scales.iter().zip([-1.0, -1.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}

/// The bits of a half float that holds this small number exactly.
fn half_bits(value: f32) -> u16 {
    let bits = value.to_bits();
    let exponent = ((bits >> 23) & 0xff) as i32 - 127 + 15;
    ((bits >> 16) as u16 & 0x8000) | ((exponent as u16) << 10) | ((bits >> 13) as u16 & 0x3ff)
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut to = GzEncoder::new(Vec::new(), Compression::fast());
    to.write_all(bytes).unwrap();
    to.finish().unwrap()
}

/// A file with some bytes replaced.
fn patched(file: &[u8], at: usize, bytes: &[u8]) -> Vec<u8> {
    let mut file = file.to_vec();
    file[at..at + bytes.len()].copy_from_slice(bytes);
    file
}

/// A file of text and numbers with a word replaced.
fn reworded(file: &[u8], from: &str, to: &str) -> Vec<u8> {
    let at = file.windows(from.len()).position(|w| w == from.as_bytes()).expect(from);
    [&file[..at], to.as_bytes(), &file[at + from.len()..]].concat()
}

/// A GLB whose document is another one.
fn redocumented(file: &[u8], change: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
    let length = u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize;
    let mut document = serde_json::from_slice(&file[20..20 + length]).unwrap();
    change(&mut document);
    let text = document.to_string();
    let length = (text.len() as u32).to_le_bytes();
    [&file[..12], &length, b"JSON", text.as_bytes(), &file[20 + length_of(file)..]].concat()
}

fn length_of(file: &[u8]) -> usize {
    u32::from_le_bytes(file[12..16].try_into().unwrap()) as usize
}

/// Each file is refused as the caller's fault, in words that name the format and what is wrong:
/// when it is read, or when a scene is made of it.
fn refused(format: &SplatFormat, cases: Vec<(Vec<u8>, &str)>) {
    let files: HashSet<&[u8]> = cases.iter().map(|(file, _)| &file[..]).collect();
    assert!(files.len() == cases.len() && files.len() >= 20, "{}: {}", format.name, files.len());
    println!("{}: {} damaged files", format.name, files.len());
    let name = format!("a.{}", format.ending);
    for (i, (file, says)) in cases.into_iter().enumerate() {
        let read = read_splats(&mut &file[..], &name, &limits(100_000));
        let error = read.and_then(|read| read.into_scene(&SceneOptions::default())).unwrap_err();
        let codes = [ErrorCode::InvalidRequest, ErrorCode::LimitExceeded];
        assert!(codes.contains(&error.code()), "{} {i}: {error}", format.name);
        assert!(error.message().contains(says), "{} {i}: {error:?} says not {says:?}", format.name);
    }
}

/// A file whose rows, from the byte `start` on, all have this number in the byte `at`.
fn poisoned(file: &[u8], [start, stride, at]: [usize; 3], number: f32) -> Vec<u8> {
    let mut file = file.to_vec();
    let rows = file[start..].chunks_exact_mut(stride);
    rows.for_each(|row| row[at..at + 4].copy_from_slice(&number.to_le_bytes()));
    file
}

#[test]
fn damaged_plys_are_refused_by_name() {
    let good = bytes_of(&PLY, &cloud(30, 1, 3));
    let re = |from: &str, to: &str| reworded(&good, from, to);
    let head = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let stride = (good.len() - head) / 30;
    let column = |name: &str, number| {
        let text = String::from_utf8_lossy(&good[..head]).into_owned();
        let at = text.lines().filter(|line| line.starts_with("property"));
        let at = at.take_while(|line| !line.ends_with(&format!(" {name}"))).count() * 4;
        poisoned(&good, [head, stride, at], number)
    };
    let many: String = (0..300).map(|i| format!("property float a{i}\n")).collect();
    let cases = vec![
        (Vec::new(), "none of Gaussians"),
        (b"plyx\n".to_vec(), "does not begin"),
        ([b"ply".to_vec(), vec![b'a'; 1 << 20]].concat(), "is missing in the first"),
        (b"ply\n\xff\xfe\n".to_vec(), "not text"),
        (re("format binary_little_endian 1.0\n", ""), "no `format`"),
        (re("binary_little_endian", "ascii"), "only binary"),
        (re("element vertex 30", "element vertex -3"), "number of vertices"),
        (re("element vertex 30", "element vertex 99999999999999999999"), "number of vertices"),
        (re("element vertex 30", "element vertex 100001"), "100001 is over 100000"),
        (re("element vertex 30", "element vertex 90000"), "ends after 30 of 90000"),
        (re("element vertex 30", "element vertex 0"), "it has none"),
        (re("element vertex 30", "element face 30"), "before the vertices"),
        (re("element vertex 30\n", ""), "PLY: "),
        (re("property float rot_2\n", ""), "no `rot_2`"),
        (re("property float scale_1\n", ""), "no `scale_1`"),
        (re("property float f_dc_1\n", ""), "no `f_dc_1`"),
        (re("property float y", "property float x"), "twice"),
        (re("property float y", "property quad y"), "is not known"),
        (re("property float y", "property list uchar float y"), "is not known"),
        (re("end_header\n", &format!("{many}end_header\n")), "is over 256"),
        (re("end_header\n", ""), "PLY: the header"),
        (re("property float f_rest_8", "property float g_rest_8"), "8 `f_rest_`"),
        (re("comment SplatRenderMode: default", "comment segsplat_semantics_bytes -1"), "-1"),
        (re("comment SplatRenderMode: default", "comment segsplat_semantics_bytes 9"), "0 of 9"),
        (
            re("comment SplatRenderMode: default", "comment segsplat_semantics_bytes 9999999999"),
            "9999999999 is over",
        ),
        (good[..head].to_vec(), "ends after 0 of 30"),
        (good[..good.len() - 1].to_vec(), "ends after 29 of 30"),
        (column("x", f32::NAN), "30 not_finite"),
        (column("z", 1e30), "30 too_far"),
        (column("opacity", -20.0), "30 opacity_below_1_255"),
        (column("scale_1", f32::INFINITY), "30 not_finite"),
    ];
    refused(&PLY, cases);
    for length in 0..good.len() {
        assert!(read(&PLY, &good[..length]).is_err(), "cut to {length} bytes");
    }
}

#[test]
fn damaged_spz_files_are_refused_by_name() {
    let good = bytes_of(&SPZ, &cloud(30, 1, 3));
    let mut whole = Vec::new();
    GzDecoder::new(&good[..]).read_to_end(&mut whole).unwrap();
    let with = |at: usize, bytes: &[u8]| gzip(&patched(&whole, at, bytes));
    let cut = |to: usize| gzip(&whole[..to]);
    let mut torn = good.clone();
    torn.truncate(good.len() / 2);
    let mut bent = good.clone();
    bent[good.len() / 2] ^= 0xff;
    bent[good.len() / 2 + 1] ^= 0xff;
    let n = 30;
    let cases = vec![
        (cut(0), "ends after 0"),
        (cut(15), "header"),
        (cut(16), "0 of 30 positions"),
        (cut(16 + 9 * n - 1), "29 of 30 positions"),
        (cut(16 + 9 * n), "0 of 30 opacities"),
        (cut(16 + 10 * n), "0 of 30 colours"),
        (cut(16 + 13 * n), "0 of 30 scales"),
        (cut(16 + 16 * n), "0 of 30 rotations"),
        (cut(16 + 20 * n), "0 of 30 harmonics"),
        (cut(16 + 29 * n - 1), "29 of 30 harmonics"),
        (with(0, b"NGSQ"), "NGSP"),
        (with(4, &[0]), "version 0"),
        (with(4, &[4]), "version 4"),
        (with(4, &[255, 255, 255, 255]), "version 4294967295"),
        (with(8, &[0, 0, 0, 0]), "0 Gaussians"),
        (with(8, &[255, 255, 255, 255]), "4294967295"),
        (with(8, &[0x00, 0x00, 0x01, 0]), "ends after"),
        (with(12, &[4]), "degree 4"),
        (with(12, &[255]), "degree 255"),
        (with(13, &[31]), "31 bits"),
        (torn, "SPZ"),
        (bent, "SPZ"),
        (vec![0x1f, 0x8b], "SPZ"),
        (b"NGSP\x04\0\0\0".to_vec(), "bytes of the header"),
        (b"PK\x03\x04".to_vec(), "zip"),
        (Vec::new(), "none of Gaussians"),
    ];
    refused(&SPZ, cases);
}

#[test]
fn damaged_glb_files_are_refused_by_name() {
    let good = bytes_of(&GLB, &cloud(30, 1, 3));
    let changed = |change: fn(&mut serde_json::Value)| redocumented(&good, change);
    let primitive = "/meshes/0/primitives/0";
    assert!(redocumented(&good, |d| assert!(d.pointer(primitive).is_some())).len() > 100);
    let cases = vec![
        (good[..8].to_vec(), "header"),
        (patched(&good, 4, &[1]), "version 1"),
        (good[..16].to_vec(), "the JSON"),
        (good[..100].to_vec(), "the JSON ends after"),
        (patched(&good, 12, &[255; 4]), "the JSON"),
        (patched(&good, 16, b"BIN\0"), "where the JSON must be"),
        (patched(&good, 20, b"\xff"), "JSON"),
        (good[..good.len() - 1].to_vec(), "the binary chunk ends after"),
        (good[..20 + length_of(&good)].to_vec(), "the binary chunk"),
        (changed(|d| d["scene"] = 7.into()), "no scene 7"),
        (changed(|d| d["scenes"][0]["nodes"][0] = 7.into()), "no node 7"),
        (changed(|d| d["nodes"][0]["mesh"] = 7.into()), "no mesh 7"),
        (changed(|d| d["nodes"][0]["children"] = serde_json::json!([0])), "nodes"),
        (changed(|d| d["nodes"][0]["scale"] = serde_json::json!([1, 2, 1])), "differently"),
        (changed(|d| d["nodes"][0]["rotation"] = serde_json::json!([1, 0, 0, 0])), "turned"),
        (changed(|d| d["accessors"][0]["count"] = 31.into()), "POSITION"),
        (changed(|d| d["accessors"][0]["count"] = 4_000_000_000_u64.into()), "4000000000"),
        (changed(|d| d["accessors"][3]["count"] = 29.into()), "29 of another"),
        (changed(|d| d["accessors"][0]["type"] = "VEC2".into()), "VEC2"),
        (changed(|d| d["accessors"][0]["componentType"] = 5130.into()), "5130"),
        (changed(|d| d["accessors"][0]["bufferView"] = 99.into()), "buffer view 99"),
        (changed(|d| d["accessors"][0]["sparse"] = serde_json::json!({})), "sparse"),
        (changed(|d| d["accessors"][0]["byteOffset"] = u64::MAX.into()), "POSITION"),
        (changed(|d| d["bufferViews"][0]["byteOffset"] = 100_000.into()), "buffer view 0"),
        (changed(|d| d["bufferViews"][0]["byteLength"] = u64::MAX.into()), "buffer view 0"),
        (changed(|d| d["bufferViews"][0]["buffer"] = 1.into()), "buffer view 0"),
        (changed(|d| d["buffers"][0]["uri"] = "../x.bin".into()), "other file"),
        (
            changed(|d| d["extensionsRequired"] = serde_json::json!(["EXT_meshopt_compression"])),
            "EXT_meshopt_compression",
        ),
        (
            changed(|d| {
                let extension = &mut d["meshes"][0]["primitives"][0]["extensions"];
                extension["KHR_gaussian_splatting"]["kernel"] = "cube".into();
            }),
            "cube",
        ),
        (
            changed(|d| {
                let extension = &mut d["meshes"][0]["primitives"][0]["extensions"];
                extension["KHR_gaussian_splatting"]["colorSpace"] = "lin_rec709_display".into();
            }),
            "lin_rec709_display",
        ),
        (
            changed(|d| d["meshes"][0]["primitives"][0]["extensions"] = serde_json::json!({})),
            "no primitive",
        ),
        (
            changed(|d| {
                let attributes = d["meshes"][0]["primitives"][0]["attributes"].as_object_mut();
                attributes.unwrap().remove("KHR_gaussian_splatting:SCALE");
            }),
            "no KHR_gaussian_splatting:SCALE",
        ),
        (changed(|d| d["extras"] = serde_json::json!({"segsplat": {"semantics": 99}})), "99"),
    ];
    refused(&GLB, cases);
}

/// The blocks of both versions are alike, and the reference skips records that it does not know.
#[test]
fn spz_4_has_the_blocks_of_spz_3_and_skips_unknown_records() {
    let gaussians = cloud(300, 2, 3);
    let of = |format| differences(&gaussians, &round_trip(format, &gaussians));
    assert_eq!(of(&SPZ4), of(&SPZ));
    let good = bytes_of(&SPZ4, &gaussians);
    let record = |kind: u32| {
        let mut file = patched(&good[..32], 14, &[2]);
        file = patched(&file, 16, &(32_u32 + 12).to_le_bytes());
        let words = [kind, 4, 7].map(u32::to_le_bytes).concat();
        [&file, &words, &good[32..]].concat()
    };
    assert_eq!(read(&SPZ4, &record(0x0001_0001)).unwrap().0.len(), 300);
    let refused = read(&SPZ4, &record(0xADBE_0003)).unwrap_err();
    assert!(refused.message().contains("SPZ_ADOBE_coordinate_system"), "{refused}");
    // The same record at the end of a file of version 3.
    let mut whole = Vec::new();
    GzDecoder::new(&bytes_of(&SPZ, &gaussians)[..]).read_to_end(&mut whole).unwrap();
    whole[14] = 2;
    whole.extend([0xADBE_0003_u32, 4, 7].map(u32::to_le_bytes).concat());
    let refused = read(&SPZ, &gzip(&whole)).unwrap_err();
    assert!(refused.message().contains("SPZ_ADOBE_coordinate_system"), "{refused}");
}

#[test]
fn damaged_spz_4_files_are_refused_by_name() {
    let good = bytes_of(&SPZ4, &cloud(30, 1, 3));
    let with = |at: usize, bytes: &[u8]| patched(&good, at, bytes);
    let cut = |to: usize| good[..to].to_vec();
    let mut bent = good.clone();
    let last = bent.len() - 4;
    bent[last..].fill(0xff);
    let size = |stream: usize| 32 + 16 * stream;
    let cases = vec![
        (cut(4), "bytes of the header"),
        (cut(15), "bytes of the header"),
        (cut(31), "bytes of the header"),
        (cut(40), "the table of the streams ends after 8 of 16"),
        (cut(size(6)), "stream 0 ends after 0"),
        (cut(good.len() - 1), "stream 5 ends after"),
        (with(4, &3_u32.to_le_bytes()), "version 3"),
        (with(4, &5_u32.to_le_bytes()), "version 5"),
        (with(8, &0_u32.to_le_bytes()), "0 Gaussians"),
        (with(8, &200_000_u32.to_le_bytes()), "200000"),
        (with(8, &31_u32.to_le_bytes()), "stream 0 is of 270 bytes; it must be of 279"),
        (with(12, &[4]), "degree 4"),
        (with(12, &[0]), "6 streams; of degree 0 there are 5"),
        (with(12, &[2]), "stream 5 is of 270 bytes; it must be of 720"),
        (with(13, &[31]), "31 bits"),
        (with(15, &[5]), "5 streams"),
        (with(16, &31_u32.to_le_bytes()), "byte 31"),
        (with(16, &u32::MAX.to_le_bytes()), "byte 4294967295"),
        (with(16, &1_000_000_u32.to_le_bytes()), "the block of extensions ends after"),
        (with(size(0) + 8, &u64::MAX.to_le_bytes()), "stream 0 is of"),
        (with(size(0), &u64::MAX.to_le_bytes()), "stream 0 ends after"),
        (with(size(0), &3_u64.to_le_bytes()), "stream 0: the compressed bytes are damaged"),
        (with(size(6), &[0; 4]), "stream 0: the compressed bytes are damaged"),
        (bent, "stream 5: the compressed bytes are damaged"),
    ];
    refused(&SPZ4, cases);
}

/// The bundle with another `meta.json`, and with other bytes of a file, or without it.
fn rebundled(
    bundle: &[u8],
    change: impl FnOnce(&mut serde_json::Value),
    other: Option<(&str, Option<&[u8]>)>,
) -> Vec<u8> {
    let mut zip = zip::ZipArchive::new(Cursor::new(bundle)).unwrap();
    let mut to = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let mut change = Some(change);
    for i in 0..zip.len() {
        let mut file = zip.by_index(i).unwrap();
        let name = file.name().unwrap().into_owned();
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).unwrap();
        if name == "meta.json" {
            let mut meta = serde_json::from_slice(&bytes).unwrap();
            change.take().unwrap()(&mut meta);
            bytes = meta.to_string().into_bytes();
        }
        match other.filter(|(wanted, _)| *wanted == name) {
            Some((_, None)) => continue,
            Some((_, Some(new))) => bytes = new.to_vec(),
            None => {}
        }
        to.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
        to.write_all(&bytes).unwrap();
    }
    to.finish().unwrap().into_inner()
}

#[test]
fn damaged_sog_files_are_refused_by_name() {
    let good = fixture("theirs.sog");
    let meta = |change: fn(&mut serde_json::Value)| rebundled(&good, change, None);
    let file = |name: &str, bytes: Option<&[u8]>| rebundled(&good, |_| {}, Some((name, bytes)));
    let one = |side: u32| {
        let mut webp = Cursor::new(Vec::new());
        image::RgbaImage::new(side, side).write_to(&mut webp, image::ImageFormat::WebP).unwrap();
        webp.into_inner()
    };
    let mut many = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for i in 0..65 {
        many.start_file(i.to_string(), zip::write::SimpleFileOptions::default()).unwrap();
    }
    let cases = vec![
        (good[..20].to_vec(), "the zip is damaged"),
        (good[..good.len() - 30].to_vec(), "the zip is damaged"),
        (b"PK\x05\x06".to_vec(), "the zip is damaged"),
        (many.finish().unwrap().into_inner(), "65"),
        (file("meta.json", None), "the zip has no \"meta.json\""),
        (file("meta.json", Some(b"{")), "meta.json: EOF"),
        (file("meta.json", Some(&vec![b' '; 2 << 20])), "1048576"),
        (meta(|m| m["version"] = 3.into()), "version 3"),
        (meta(|m| m["version"] = serde_json::Value::Null), "version 1 is not read"),
        (meta(|m| m["count"] = 0.into()), "0 Gaussians"),
        (meta(|m| m["count"] = (-1).into()), "meta.json: "),
        (meta(|m| m["count"] = 100_001.into()), "100001"),
        (meta(|m| m["count"] = 5_000.into()), "5000 to"),
        (meta(|m| m["means"] = serde_json::Value::Null), "no \"means\""),
        (meta(|m| m["sh0"] = serde_json::Value::Null), "no \"sh0\""),
        (meta(|m| m["scales"]["codebook"] = "x".into()), "meta.json: "),
        (meta(|m| m["quats"]["files"][0] = "../q.webp".into()), "has no \"../q.webp\""),
        (meta(|m| m["shN"]["bands"] = 4.into()), "degree 4"),
        (meta(|m| m["shN"]["bands"] = 2.into()), "shN_centroids.webp"),
        (meta(|m| m["shN"]["count"] = 1.into()), "there are 1 centroids"),
        (meta(|m| m["shN"]["count"] = 70_000.into()), "70000"),
        (file("quats.webp", None), "has no \"quats.webp\""),
        (file("quats.webp", Some(b"RIFF")), "is no WebP picture"),
        (file("means_l.webp", Some(&one(2))), "\"means_l.webp\" has 2 x 2 pixels; 40 to"),
        (file("scales.webp", Some(&one(1100))), "1100 x 1100 pixels"),
    ];
    refused(&SOG, cases);
}

#[test]
fn damaged_compressed_plys_are_refused_by_name() {
    let good = bytes_of(&COMPRESSED_PLY, &cloud(300, 1, 3));
    let re = |from: &str, to: &str| reworded(&good, from, to);
    let head = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let cases = vec![
        (good[..3].to_vec(), "ply"),
        (good[..50].to_vec(), "end_header"),
        (good[..head].to_vec(), "0 of 2 chunks"),
        (good[..head + 143].to_vec(), "1 of 2 chunks"),
        (good[..head + 144].to_vec(), "0 of 300 Gaussians"),
        (good[..head + 144 + 16 * 300 - 1].to_vec(), "299 of 300 Gaussians"),
        (good[..head + 144 + 16 * 300].to_vec(), "0 of 300 rows of harmonics"),
        (good[..good.len() - 1].to_vec(), "299 of 300 rows of harmonics"),
        (re("element chunk 2", "element chunk 3"), "3 chunks for 300"),
        (re("element chunk 2", "element chunk 0"), "0 chunks for 300"),
        (re("element chunk 2", "element chunk -2"), "number of chunk"),
        (re("element vertex 300", "element vertex 99999999999999999999"), "number of vertices"),
        (re("element vertex 300", "element vertex 400000"), "400000"),
        (re("element vertex", "element vortex"), "before the vertices"),
        (re("element sh 300", "element sh 299"), "299 rows"),
        (re("float min_x", "double min_x"), "min_x"),
        (re("float min_x", "float mum_x"), "min_x"),
        (re("float max_b", "float max_c"), "max_b"),
        (re("uint packed_rotation", "int packed_rotation"), "packed_rotation"),
        (re("uint packed_color", "uint packed_colour"), "packed_color"),
        (re("uchar f_rest_8", "uchar f_rest_9"), "harmonics"),
        (re("uchar f_rest_0", "char f_rest_0"), "harmonics"),
        (re("binary_little_endian", "binary_big_endian"), "little-endian"),
        (re("binary_little_endian", "ascii"), "only binary"),
        (re("element chunk 2", "element chunk 2\nelement chunk 2"), "before the vertices"),
    ];
    refused(&COMPRESSED_PLY, cases);
}

#[test]
fn damaged_splat_files_are_refused_by_name() {
    let good = bytes_of(&SPLAT, &cloud(30, 0, 3));
    let cut = |to: usize| good[..to].to_vec();
    let column = |at: usize, number| poisoned(&good, [0, 32, at], number);
    let bytes = |at: std::ops::Range<usize>, byte: u8| {
        let mut file = good.clone();
        file.chunks_exact_mut(32).for_each(|row| row[at.clone()].fill(byte));
        file
    };
    let mut cases: Vec<_> = [1, 4, 12, 24, 31].map(|to| (cut(to), "0 of 1")).into();
    cases.extend([33, 63].map(|to| (cut(to), "1 of 2")));
    cases.extend([
        (cut(32 * 30 - 1), "29 of 30"),
        ([&good[..], b"\n"].concat(), "30 of 31"),
        (vec![b'x'; 32 * 100_001], "100000"),
        (Vec::new(), "the file is empty"),
        (column(0, f32::NAN), "30 not_finite"),
        (column(4, f32::INFINITY), "30 not_finite"),
        (column(8, f32::NEG_INFINITY), "30 not_finite"),
        (column(8, 1e30), "30 too_far"),
        (column(12, f32::NAN), "30 not_finite"),
        (column(20, -1.0), "30 zero_scale"),
        (column(20, f32::INFINITY), "30 not_finite"),
        (bytes(27..28, 0), "30 opacity_below_1_255"),
        (vec![0; 32 * 30], "30 opacity_below_1_255"),
        (vec![0xff; 32 * 30], "30 not_finite"),
    ]);
    refused(&SPLAT, cases);
    // What has no name with this ending is not taken for it.
    let error = read_splats(&mut Cursor::new(&good), "a.bin", &limits(100)).unwrap_err();
    assert!(error.message().contains("none of Gaussians"), "{error}");
    // Numbers that are none are dropped and counted.
    let nan = patched(&good, 0, &f32::NAN.to_le_bytes());
    let (read, report, _) = read(&SPLAT, &nan).unwrap();
    assert_eq!((read.len(), report.not_finite), (29, 1));
}

#[tokio::test]
async fn both_doors_give_every_format() {
    let stand = CpuServer::start().await;
    let [http, grpc] = doors::both(stand.addr).await;
    let created = client().post(stand.url("/v1/scenes?wait_ms=120000")).multipart(form(&upload()));
    let scene = json(created.send().await.unwrap()).await.unwrap();
    let id = scene["id"].as_str().unwrap();
    let mut sizes = Vec::new();
    for format in splat_formats() {
        let url = stand.url(&format!("/v1/scenes/{id}/export?format={}", format.name));
        let answer = client().get(&url).send().await.unwrap();
        let headers = answer.headers();
        assert_eq!(headers[header::CONTENT_TYPE], format.media_type);
        let disposition = headers[header::CONTENT_DISPOSITION].to_str().unwrap();
        assert!(disposition.ends_with(&format!(".{}\"", format.ending)), "{disposition}");
        let known = client().get(&url).header(header::IF_NONE_MATCH, &headers[header::ETAG]);
        assert_eq!(known.send().await.unwrap().status().as_u16(), 304);
        let file = http.export_as(id, format.name).await.unwrap();
        assert!(grpc.export_as(id, format.name).await.unwrap() == file, "{}", format.name);
        sizes.push(read(format, &file).unwrap().0.len());
    }
    assert!(sizes.iter().all(|size| *size == sizes[0] && *size > 0), "{sizes:?}");
    assert_eq!(Some(sizes[0] as u64), scene["report"]["gaussians"].as_u64());
}

#[test]
fn the_command_line_turns_each_format_into_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let at = |format: &SplatFormat| folder.path().join(format!("a.{}", format.ending));
    std::fs::write(at(&PLY), bytes_of(&PLY, &cloud(300, 0, 3))).unwrap();
    let run = |arguments: &[&std::ffi::OsStr]| {
        let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_segsplat"));
        let done = program.arg("--json").args(arguments).output().unwrap();
        let text = if done.status.success() { done.stdout } else { done.stderr };
        let json: serde_json::Value = serde_json::from_slice(&text).unwrap();
        (done.status.code(), json)
    };
    for from in [&PLY, &GLB, &SPLAT, &SPZ, &SPZ4, &SOG, &COMPRESSED_PLY] {
        for to in splat_formats() {
            let (source, target) = (at(from), folder.path().join(format!("b.{}", to.ending)));
            let words = ["export".as_ref(), source.as_os_str(), "-o".as_ref(), target.as_os_str()];
            let (code, told) = run(&words);
            assert_eq!((code, told["gaussians"].as_u64()), (Some(0), Some(300)), "{told}");
            let (_, inside) = run(&["inspect".as_ref(), target.as_os_str()]);
            assert_eq!(
                (&inside["format"], inside["gaussians"].as_u64()),
                (&to.name.into(), Some(300))
            );
            // The next format is read from what was written first.
            std::fs::copy(&target, at(to)).unwrap();
        }
    }
    let wrong = folder.path().join("a.obj");
    let source = at(&PLY);
    let (code, told) =
        run(&["export".as_ref(), source.as_os_str(), "-o".as_ref(), wrong.as_os_str()]);
    assert!(code == Some(2) && told.to_string().contains("compressed.ply"), "{code:?} {told}");
}
