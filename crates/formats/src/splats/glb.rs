//! Binary glTF with `KHR_gaussian_splatting` (kernel `ellipse`, `srgb_rec709_display`).
//!
//! One node, one mesh, one primitive of points. All numbers of the Gaussians are f32, so nothing is
//! lost but the photos that they come from; the node's translation is the scene's origin. `COLOR_0`
//! (linear, u16) is for programs that do not know the extension. `_SEMANTIC_INDEX` (f32) is the
//! entry of the bank. `extras.segsplat.semantics` of the document is the number of a buffer view
//! with the container of the semantics, where they are made. Axes: y up, z back, as glTF has them.
//!
//! `extras.segsplat.antialiased` says that opacity is to be compensated for the blur of small
//! Gaussians.
//!
//! Read are all primitives of the scene that have the extension, with attributes of any of its
//! types, or with an SPZ of any version in a buffer view, whose axes are those of the node. Refused
//! by name: attributes in other compressions, sparse ones, other files, other kernels and colour
//! spaces, scales of nodes that differ between axes, and turned nodes with harmonics over degree 0.

use std::{
    collections::BTreeMap,
    io::{self, BufRead, Read, Write},
};

use glam::{DAffine3, DMat4, DQuat, DVec3};
use serde::Deserialize;
use serde_json::json;

use super::{
    SplatFile, SplatFormat, SplatsRead, TURN, TURN_QUAT, TURN_SH, begun, check_count, cut_short,
    fill_rest, some, spz, times, unreadable,
};
use crate::{
    container::read_semantics,
    error::{Error, Result, short},
    limits::Limits,
    scene::{Gaussians, RawGaussians, SH_C0, SceneId, Semantics},
};

/// Binary glTF with `KHR_gaussian_splatting`.
pub static GLB: SplatFormat = SplatFormat {
    name: "glb",
    ending: "glb",
    media_type: "model/gltf-binary",
    semantics: true,
    begins: b"glTF",
    read,
    check,
    size_bytes: |file| Some(size_bytes(file)),
    write,
};

const MAGIC: u32 = u32::from_le_bytes(*b"glTF");
const JSON: u32 = u32::from_le_bytes(*b"JSON");
const BIN: u32 = u32::from_le_bytes(*b"BIN\0");
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Extensions by which the Gaussians of a primitive are an SPZ in a buffer view, the newest first.
const SPZS: [&str; 3] = [
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
];
const INDEX: &str = "_SEMANTIC_INDEX";
/// Largest JSON that is read, bytes.
const JSON_BYTES_MAX: usize = 8 << 20;
/// Most nodes that are looked at, and how deep one may lie.
const NODES_MAX: usize = 65_536;
const DEPTH_MAX: usize = 64;
const FLOAT: u32 = 5126;
const U16: u32 = 5123;

/// An array of the primitive: its name, numbers a Gaussian, and their bytes.
struct Column {
    name: String,
    kind: &'static str,
    component: u32,
    bytes: usize,
    write: fn(&Gaussians, usize, usize, &mut Vec<u8>),
}

/// The name of coefficient `j`.
fn sh_name(j: usize) -> String {
    let degree = j.isqrt();
    format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{}", j - degree * degree)
}

fn put(to: &mut Vec<u8>, numbers: impl IntoIterator<Item = f32>) {
    numbers.into_iter().for_each(|number| to.extend_from_slice(&number.to_le_bytes()));
}

/// sRGB of 0..1 to linear light, as `COLOR_0` has it.
fn linear(c: f32) -> f32 {
    if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

fn columns(gaussians: &Gaussians) -> Vec<Column> {
    let own = |name: &str| format!("{EXTENSION}:{name}");
    let float = |name, kind, numbers: usize, write| Column {
        name,
        kind,
        component: FLOAT,
        bytes: 4 * numbers,
        write,
    };
    let mut all = vec![
        float("POSITION".to_owned(), "VEC3", 3, |g, i, _, to| put(to, times(g.means()[i], TURN))),
        Column {
            name: "COLOR_0".to_owned(),
            kind: "VEC4",
            component: U16,
            bytes: 8,
            write: |g, i, _, to| {
                let color =
                    g.sh()[i * g.sh_count()].map(|c| linear((SH_C0 * c + 0.5).clamp(0.0, 1.0)));
                let levels = color.into_iter().chain([g.opacities()[i]]);
                levels
                    .for_each(|part| to.extend((super::steps(part, 65_535) as u16).to_le_bytes()));
            },
        },
        float(own("ROTATION"), "VEC4", 4, |g, i, _, to| {
            let [w, x, y, z] = times(g.quats()[i], TURN_QUAT);
            put(to, [x, y, z, w]);
        }),
        float(own("SCALE"), "VEC3", 3, |g, i, _, to| put(to, g.scales()[i])),
        float(own("OPACITY"), "SCALAR", 1, |g, i, _, to| put(to, [g.opacities()[i]])),
    ];
    all.extend((0..gaussians.sh_count()).map(|j| {
        float(sh_name(j), "VEC3", 3, |g, i, j, to| {
            put(to, g.sh()[i * g.sh_count() + j].map(|c| c * TURN_SH[j]));
        })
    }));
    all.push(float(INDEX.to_owned(), "SCALAR", 1, |g, i, _, to| {
        put(to, [f32::from(g.semantic_index()[i])]);
    }));
    all
}

/// Bytes of the binary chunk.
fn binary_bytes(file: &SplatFile) -> usize {
    let each: usize = columns(&file.gaussians).iter().map(|column| column.bytes).sum();
    file.gaussians.len() * each + file.semantics.len().next_multiple_of(4)
}

fn document(file: &SplatFile) -> Vec<u8> {
    let gaussians = &file.gaussians;
    let n = gaussians.len();
    let (mut views, mut accessors, mut attributes) = (Vec::new(), Vec::new(), json!({}));
    let mut offset = 0;
    let fold = |f: fn(f32, f32) -> f32, start| {
        let turned = gaussians.means().iter().map(|mean| times(*mean, TURN));
        turned.fold([start; 3], |a, b| std::array::from_fn(|k| f(a[k], b[k]))).map(f64::from)
    };
    for (i, column) in columns(gaussians).iter().enumerate() {
        let bytes = n * column.bytes;
        views.push(json!({
            "buffer": 0, "byteOffset": offset, "byteLength": bytes, "target": 34962
        }));
        let mut accessor = json!({
            "bufferView": i, "componentType": column.component, "count": n, "type": column.kind
        });
        if i == 0 {
            accessor["min"] = json!(fold(f32::min, f32::INFINITY));
            accessor["max"] = json!(fold(f32::max, f32::NEG_INFINITY));
        }
        if column.component == U16 {
            accessor["normalized"] = json!(true);
        }
        accessors.push(accessor);
        attributes[&column.name] = json!(i);
        offset += bytes;
    }
    let mut document = json!({
        "asset": { "version": "2.0", "generator": concat!("segsplat ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "translation": turned(gaussians.origin()).to_array() }],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": attributes,
            "extensions": { EXTENSION: {
                "kernel": "ellipse", "colorSpace": "srgb_rec709_display",
                "projection": "perspective", "sortingMethod": "cameraDistance",
            } },
        }] }],
        "buffers": [{ "byteLength": binary_bytes(file) }],
        "accessors": accessors,
    });
    if file.antialiased {
        document["extras"]["segsplat"]["antialiased"] = json!(true);
    }
    if !file.semantics.is_empty() {
        document["extras"]["segsplat"]["semantics"] = json!(views.len());
        let bytes = file.semantics.len();
        views.push(json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes }));
    }
    document["bufferViews"] = json!(views);
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    text
}

fn turned(at: DVec3) -> DVec3 {
    at * DVec3::from_array(TURN.map(f64::from))
}

fn size_bytes(file: &SplatFile) -> u64 {
    (12 + 8 + document(file).len() + 8 + binary_bytes(file)) as u64
}

fn check(file: &SplatFile) -> Result<()> {
    some(file)?;
    match u32::try_from(size_bytes(file)) {
        Ok(_) => Ok(()),
        Err(_) => Err(Error::limit("glb: bytes", size_bytes(file), u32::MAX)),
    }
}

fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    let (document, binary) = (document(file), binary_bytes(file));
    let whole = 12 + 8 + document.len() + 8 + binary;
    let mut words = |words: &[u32], bytes: &[u8]| -> io::Result<()> {
        words.iter().try_for_each(|word| to.write_all(&word.to_le_bytes()))?;
        to.write_all(bytes)
    };
    words(&[MAGIC, 2, whole as u32, document.len() as u32, JSON], &document)?;
    words(&[binary as u32, BIN], &[])?;
    let mut row = Vec::new();
    let columns = columns(gaussians);
    for (at, column) in columns.iter().enumerate() {
        // The coefficients follow each other from column 5.
        let j = at.saturating_sub(5);
        for i in 0..gaussians.len() {
            row.clear();
            (column.write)(gaussians, i, j, &mut row);
            to.write_all(&row)?;
        }
    }
    to.write_all(&file.semantics)?;
    to.write_all(&[0; 3][..file.semantics.len().next_multiple_of(4) - file.semantics.len()])
}

fn bad(why: impl std::fmt::Display) -> Error {
    Error::invalid(format!("GLB: {why}"))
}

// The parts of a document that are read.

#[derive(Default, Deserialize)]
#[serde(default, rename_all = "camelCase")]
struct Document {
    extensions_required: Vec<String>,
    scene: usize,
    scenes: Vec<GltfScene>,
    nodes: Vec<Node>,
    meshes: Vec<Mesh>,
    buffers: Vec<Buffer>,
    buffer_views: Vec<BufferView>,
    accessors: Vec<Accessor>,
    extras: serde_json::Value,
}

#[derive(Deserialize)]
struct GltfScene {
    #[serde(default)]
    nodes: Vec<usize>,
}

#[derive(Deserialize)]
struct Node {
    mesh: Option<usize>,
    #[serde(default)]
    children: Vec<usize>,
    matrix: Option<[f64; 16]>,
    translation: Option<[f64; 3]>,
    rotation: Option<[f64; 4]>,
    scale: Option<[f64; 3]>,
}

#[derive(Deserialize)]
struct Mesh {
    #[serde(default)]
    primitives: Vec<Primitive>,
}

/// What an extension says of a primitive.
type Extension = serde_json::Value;

#[derive(Default, Deserialize)]
#[serde(default)]
struct Primitive {
    attributes: BTreeMap<String, usize>,
    extensions: BTreeMap<String, Extension>,
}

#[derive(Deserialize)]
struct Buffer {
    uri: Option<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct BufferView {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Accessor {
    buffer_view: Option<usize>,
    #[serde(default)]
    byte_offset: usize,
    component_type: u32,
    #[serde(default)]
    normalized: bool,
    count: usize,
    #[serde(rename = "type")]
    kind: String,
    sparse: Option<serde_json::Value>,
}

/// A chunk of the file, whole.
fn chunk(from: &mut dyn BufRead, kind: u32, name: &str, bytes_max: usize) -> Result<Vec<u8>> {
    let mut head = [0; 8];
    from.read_exact(&mut head)
        .map_err(|e| cut_short("GLB", e, 0, 8, &format!("bytes before {name}")))?;
    let word = |k: usize| u32::from_le_bytes([head[k], head[k + 1], head[k + 2], head[k + 3]]);
    if word(4) != kind {
        return Err(bad(format!("a chunk of type {:#010x} stands where {name} must be", word(4))));
    }
    let bytes = word(0) as usize;
    if bytes > bytes_max {
        return Err(Error::limit(format!("GLB: bytes of {name}"), bytes, bytes_max));
    }
    let mut chunk = Vec::new();
    from.take(bytes as u64).read_to_end(&mut chunk).map_err(unreadable)?;
    if chunk.len() < bytes {
        return Err(bad(format!("{name} ends after {} of {bytes} bytes", chunk.len())));
    }
    Ok(chunk)
}

fn read(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let mut head = [0; 12];
    from.read_exact(&mut head).map_err(|e| cut_short("GLB", e, 0, 12, "bytes of the header"))?;
    let version = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
    if version != 2 {
        return Err(bad(format!("version {version}; 2 is read")));
    }
    let json = chunk(from, JSON, "the JSON", JSON_BYTES_MAX)?;
    let document: Document =
        serde_json::from_slice(&json).map_err(|e| bad(format!("JSON: {e}")))?;
    let binary = chunk(from, BIN, "the binary chunk", u32::MAX as usize)?;
    let is_read = |name: &str| name == EXTENSION || SPZS.contains(&name);
    let other = document.extensions_required.iter().find(|name| !is_read(name));
    if let Some(name) = other {
        return Err(bad(format!("it needs the extension {name:?}, which is not read")));
    }
    if let Some(uri) = document.buffers.iter().find_map(|buffer| buffer.uri.as_deref()) {
        let uri = short(uri);
        return Err(bad(format!("a buffer is in the other file {uri:?}; one file is read")));
    }
    let file = Opened { document, binary, limits };
    let (raw, antialiased) = file.gaussians()?;
    Ok(SplatsRead::new(&GLB, raw, file.semantics()?)?.antialiased(antialiased))
}

/// A file whose JSON is read.
struct Opened<'a> {
    document: Document,
    binary: Vec<u8>,
    limits: &'a Limits,
}

impl Opened<'_> {
    /// All Gaussians, and whether opacity is to be compensated: where the document or any
    /// primitive says so.
    fn gaussians(&self) -> Result<(RawGaussians, bool)> {
        let nodes = &self.document.nodes;
        let scene = self.document.scenes.get(self.document.scene);
        let scene = scene.ok_or_else(|| bad(format!("no scene {}", self.document.scene)))?;
        let mut open: Vec<_> =
            scene.nodes.iter().rev().map(|&node| (node, DAffine3::IDENTITY, 0)).collect();
        let (mut raw, mut seen) = (None::<RawGaussians>, 0);
        let mut antialiased = self.document.extras["segsplat"]["antialiased"] == true;
        while let Some((at, above, depth)) = open.pop() {
            seen += 1;
            if seen > NODES_MAX || depth > DEPTH_MAX {
                return Err(bad(format!("over {NODES_MAX} nodes, or one over {DEPTH_MAX} deep")));
            }
            let node = nodes.get(at).ok_or_else(|| bad(format!("no node {at}")))?;
            let place = above * node.place();
            open.extend(node.children.iter().rev().map(|&child| (child, place, depth + 1)));
            let Some(mesh) = node.mesh else { continue };
            let mesh =
                self.document.meshes.get(mesh).ok_or_else(|| bad(format!("no mesh {mesh}")))?;
            for primitive in &mesh.primitives {
                let Some(extension) = primitive.extensions.get(EXTENSION) else { continue };
                understood(primitive, extension)?;
                let (own, is_so) = self.own(primitive, extension)?;
                antialiased |= is_so;
                self.push(own, &NodeTransform::of(place)?, &mut raw)?;
            }
        }
        let raw = raw.ok_or_else(|| bad(format!("no primitive of the scene has {EXTENSION}")))?;
        Ok((raw, antialiased))
    }

    /// The Gaussians of a primitive about its node, and whether they say that opacity is to be
    /// compensated.
    fn own(&self, primitive: &Primitive, extension: &Extension) -> Result<(RawGaussians, bool)> {
        if let Some(view) = enclosed(primitive, extension) {
            let (_, file) = self.view(view)?;
            return spz::enclosed(file, self.limits).map_err(|e| bad(e.message()));
        }
        let has = |j: usize| primitive.attributes.contains_key(&sh_name(j));
        let sh_degree = (1..=3_u8).take_while(|d| has(usize::from(*d).pow(2))).count() as u8;
        let k = (usize::from(sh_degree) + 1).pow(2);
        let of = |name: &str, width| -> Result<Vec<f32>> {
            let at = primitive.attributes.get(name);
            let at = at.ok_or_else(|| bad(format!("a primitive has no {name}")))?;
            self.numbers(*at, width, name)
        };
        let own = |name: &str, width| of(&format!("{EXTENSION}:{name}"), width);
        let positions = of("POSITION", 3)?;
        let n = positions.len() / 3;
        check_count("GLB: Gaussians", n, sh_degree, self.limits)?;
        let (rotations, scales) = (own("ROTATION", 4)?, own("SCALE", 3)?);
        let opacities = own("OPACITY", 1)?;
        let sh = (0..k).map(|j| of(&sh_name(j), 3)).collect::<Result<Vec<_>>>()?;
        let index = primitive.attributes.contains_key(INDEX).then(|| of(INDEX, 1)).transpose()?;
        let mut lengths = vec![rotations.len() / 4, scales.len() / 3, opacities.len()];
        lengths.extend(sh.iter().map(|column| column.len() / 3));
        lengths.extend(index.as_ref().map(Vec::len));
        if let Some(other) = lengths.into_iter().find(|other| *other != n) {
            return Err(bad(format!("a primitive has {n} positions and {other} of another array")));
        }
        let mut raw = begun(n, sh_degree);
        let row = |column: &[f32], i: usize| [column[3 * i], column[3 * i + 1], column[3 * i + 2]];
        for i in 0..n {
            raw.means.push(times(row(&positions, i), TURN));
            let q = &rotations[4 * i..4 * i + 4];
            raw.quats.push(times([q[3], q[0], q[1], q[2]], TURN_QUAT));
            raw.scales.push(row(&scales, i));
            for (column, sign) in sh.iter().zip(TURN_SH) {
                raw.sh.push(row(column, i).map(|c| c * sign));
            }
        }
        raw.opacities = opacities;
        // The cast saturates; an index that is none becomes the background.
        raw.semantic_index =
            index.unwrap_or_default().into_iter().map(|entry| entry as u16).collect();
        fill_rest(&mut raw);
        Ok((raw, false))
    }

    /// Adds the Gaussians of a primitive, placed as its node is.
    fn push(
        &self,
        own: RawGaussians,
        place: &NodeTransform,
        into: &mut Option<RawGaussians>,
    ) -> Result<()> {
        let sh_degree = own.sh_degree;
        if sh_degree > 0 && place.rotation.xyz().length() > 1e-6 {
            return Err(bad("a turned node has harmonics over degree 0, which are not turned"));
        }
        let raw = into.get_or_insert_with(|| RawGaussians {
            origin: turned(place.translation),
            ..begun(own.means.len(), sh_degree)
        });
        if raw.sh_degree != sh_degree {
            let other = raw.sh_degree;
            return Err(bad(format!(
                "primitives have harmonics of degree {other} and {sh_degree}"
            )));
        }
        let all = raw.means.len() + own.means.len();
        check_count("GLB: Gaussians", all, sh_degree, self.limits)?;
        let shift = place.translation - turned(raw.origin);
        for mean in own.means {
            let mean = DVec3::from_array(times(mean, TURN).map(f64::from));
            let mean = place.rotation * (mean * place.scale) + shift;
            raw.means.push(times(mean.as_vec3().to_array(), TURN));
        }
        for quat in own.quats {
            let [w, x, y, z] = times(quat, TURN_QUAT).map(f64::from);
            raw.quats.push(if place.rotation == DQuat::IDENTITY {
                quat
            } else {
                let quat = (place.rotation * DQuat::from_xyzw(x, y, z, w)).as_quat();
                times([quat.w, quat.x, quat.y, quat.z], TURN_QUAT)
            });
        }
        let scaled = |scale: [f32; 3]| scale.map(|s| (f64::from(s) * place.scale) as f32);
        raw.scales.extend(own.scales.into_iter().map(scaled));
        raw.opacities.extend(own.opacities);
        raw.sh.extend(own.sh);
        raw.semantic_index.extend(own.semantic_index);
        raw.source.extend(own.source);
        Ok(())
    }

    /// The bytes of a buffer view.
    fn view(&self, at: usize) -> Result<(&BufferView, &[u8])> {
        let view = self.document.buffer_views.get(at);
        let view = view.ok_or_else(|| bad(format!("no buffer view {at}")))?;
        let end = view.byte_offset.checked_add(view.byte_length);
        let bytes = end.and_then(|end| self.binary.get(view.byte_offset..end));
        let bytes = bytes.filter(|_| view.buffer == 0).ok_or_else(|| {
            let (offset, length) = (view.byte_offset, view.byte_length);
            let has = self.binary.len();
            bad(format!("buffer view {at}: {length} bytes from {offset} of {has}"))
        })?;
        Ok((view, bytes))
    }

    /// The numbers of an accessor of this width, rows one after the other.
    fn numbers(&self, at: usize, width: usize, name: &str) -> Result<Vec<f32>> {
        let fault = |why: String| bad(format!("{name}: {why}"));
        let accessor = self.document.accessors.get(at);
        let accessor = accessor.ok_or_else(|| fault(format!("no accessor {at}")))?;
        let kind = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1];
        if accessor.kind != kind {
            return Err(fault(format!("its type is {:?}, not {kind}", accessor.kind)));
        }
        let (size, most) = match accessor.component_type {
            5120 => (1, 127.0),
            5121 => (1, 255.0),
            5122 => (2, 32_767.0),
            U16 => (2, 65_535.0),
            FLOAT => (4, 1.0),
            other => return Err(fault(format!("component type {other} is not read"))),
        };
        if accessor.sparse.is_some() {
            return Err(fault("sparse arrays are not read".to_owned()));
        }
        check_count(&format!("GLB: {name}"), accessor.count, 0, self.limits)?;
        let view = accessor.buffer_view;
        let view = view.ok_or_else(|| fault("it has no buffer view".to_owned()))?;
        let (view, bytes) = self.view(view)?;
        let stride = view.byte_stride.unwrap_or(size * width).max(size * width);
        let last = accessor.count.saturating_sub(1);
        let end = last.checked_mul(stride).and_then(|all| all.checked_add(accessor.byte_offset));
        let fits =
            end.and_then(|end| end.checked_add(size * width)).is_some_and(|end| end <= bytes.len());
        if !fits && accessor.count > 0 {
            let has = bytes.len();
            let count = accessor.count;
            return Err(fault(format!("{count} rows do not fit into the {has} bytes of its view")));
        }
        let scale = if accessor.normalized { 1.0 / most } else { 1.0 };
        let mut numbers = Vec::with_capacity(accessor.count * width);
        for i in 0..accessor.count {
            let row = &bytes[accessor.byte_offset + i * stride..][..size * width];
            numbers.extend(row.chunks_exact(size).map(|c| match accessor.component_type {
                5120 => (f32::from(c[0] as i8) * scale).max(-1.0),
                5121 => f32::from(c[0]) * scale,
                5122 => f32::from(i16::from_le_bytes([c[0], c[1]])) * scale,
                U16 => f32::from(u16::from_le_bytes([c[0], c[1]])) * scale,
                _ => f32::from_le_bytes([c[0], c[1], c[2], c[3]]),
            }));
        }
        Ok(numbers)
    }

    fn semantics(&self) -> Result<Option<Semantics>> {
        let Some(at) = self.document.extras["segsplat"]["semantics"].as_u64() else {
            return Ok(None);
        };
        let (_, bytes) = self.view(at as usize)?;
        let read = read_semantics(bytes, &SceneId::from_bytes([0; 16]));
        read.map(|(semantics, _)| Some(semantics)).map_err(|e| bad(e.message()))
    }
}

/// The number of the buffer view with the SPZ that the primitive is.
fn enclosed(primitive: &Primitive, extension: &Extension) -> Option<usize> {
    let inner = SPZS.iter().map(|name| &extension["extensions"][name]["bufferView"]);
    let beside =
        SPZS.iter().filter_map(|name| Some(&primitive.extensions.get(*name)?["bufferView"]));
    inner.chain(beside).find_map(|view| usize::try_from(view.as_u64()?).ok())
}

/// Refuses what other kernels and colour spaces would make of the numbers.
fn understood(primitive: &Primitive, extension: &Extension) -> Result<()> {
    for (name, known) in [("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")] {
        match extension[name].as_str() {
            Some(value) if value == known => {}
            // Files with SPZ are older than these words.
            None if enclosed(primitive, extension).is_some() => {}
            other => {
                let other = short(other.unwrap_or_default());
                return Err(bad(format!("{name} is {other:?}; {known:?} is read")));
            }
        }
    }
    Ok(())
}

impl Node {
    fn place(&self) -> DAffine3 {
        if let Some(matrix) = self.matrix {
            return DAffine3::from_mat4(DMat4::from_cols_array(&matrix));
        }
        DAffine3::from_scale_rotation_translation(
            self.scale.map_or(DVec3::ONE, DVec3::from_array),
            self.rotation.map_or(DQuat::IDENTITY, DQuat::from_array),
            self.translation.map_or(DVec3::ZERO, DVec3::from_array),
        )
    }
}

/// Where a node lies: scaled alike along all axes, then turned, then moved.
struct NodeTransform {
    scale: f64,
    rotation: DQuat,
    translation: DVec3,
}

impl NodeTransform {
    fn of(affine: DAffine3) -> Result<Self> {
        let wrong = || bad("a node is scaled differently along its axes, mirrored or not finite");
        let columns = [affine.matrix3.x_axis, affine.matrix3.y_axis, affine.matrix3.z_axis];
        let [scale, b, c] = columns.map(DVec3::length);
        let same = |other: f64| (other / scale - 1.0).abs() < 1e-6;
        if !affine.is_finite() || scale <= 0.0 || !same(b) || !same(c) {
            return Err(wrong());
        }
        let turn = affine.matrix3 * (1.0 / scale);
        let square = (turn * turn.transpose() - glam::DMat3::IDENTITY).to_cols_array();
        if (turn.determinant() - 1.0).abs() > 1e-5 || square.iter().any(|v| v.abs() > 1e-5) {
            return Err(wrong());
        }
        let is_not_turned = turn.abs_diff_eq(glam::DMat3::IDENTITY, 1e-12);
        let rotation = if is_not_turned { DQuat::IDENTITY } else { DQuat::from_mat3(&turn) };
        Ok(Self { scale, rotation, translation: affine.translation })
    }
}
