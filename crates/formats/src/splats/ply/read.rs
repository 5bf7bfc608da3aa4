//! A 3DGS PLY as Gaussians: attributes in any order and of any scalar type, strangers skipped.

use std::io::{BufRead, Read};

use glam::DVec3;

use crate::{
    container::read_semantics,
    error::{Error, Result, short},
    limits::Limits,
    scene::{RawGaussians, SH_C0, SceneId, Semantics, SourcePixel},
};

use super::{
    super::{
        OCTETS, SplatFormat, SplatsRead, begun, check_count, cut_short,
        packed_ply::{self, BOUNDS, PACKED, PackedLayout},
        some_near,
    },
    write::{SEMANTICS, size_bytes, write},
};

/// 3DGS PLY.
pub static PLY: SplatFormat = SplatFormat {
    name: "ply",
    ending: "ply",
    media_type: OCTETS,
    semantics: true,
    begins: b"ply",
    read,
    check: |_| Ok(()),
    size_bytes: |file| Some(size_bytes(file)),
    write,
};

/// The compressed PLY of `PlayCanvas` and `SuperSplat`.
pub static COMPRESSED_PLY: SplatFormat = SplatFormat {
    name: "compressed_ply",
    ending: "compressed.ply",
    media_type: OCTETS,
    semantics: false,
    begins: b"ply",
    read,
    check: some_near,
    size_bytes: |file| Some(packed_ply::size_bytes(file)),
    write: packed_ply::write,
};

/// Longest header, bytes.
const HEADER_BYTES_MAX: u64 = 1 << 20;
/// Most attributes of a vertex: 62 are standard.
const ATTRIBUTES_MAX: usize = 256;
/// Most bytes of semantics after the vertices, an eighth of what a scene may have.
const SEMANTICS_BYTES_MAX: u64 = 1 << 30;
/// The element that a compressed PLY begins with, and the one that may end it.
const CHUNK: &str = "chunk";
const SH: &str = "sh";

/// Reads a file, with the semantics after its vertices if there are some.
fn read(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let header = Header::read(from)?;
    let vertices = header.vertices()?;
    let check = |degree| check_count("PLY: Gaussians", vertices.count, degree, limits);
    check(0)?;
    if header.elements[0].name == CHUNK {
        let layout = header.packed()?;
        check(layout.sh_degree)?;
        let read = SplatsRead::new(&COMPRESSED_PLY, packed_ply::read(from, &layout)?, None)?;
        return Ok(read.antialiased(header.antialiased));
    }
    let layout = Layout::of(vertices)?;
    check(layout.sh_degree)?;
    let (mut raw, mut placed) = (begun(vertices.count, layout.sh_degree), false);
    let mut vertex = vec![0; vertices.stride()];
    for i in 0..vertices.count {
        from.read_exact(&mut vertex)
            .map_err(|cause| cut_short("PLY", cause, i, vertices.count, "Gaussians"))?;
        layout.push(&header, vertices, &vertex, &mut raw, &mut placed);
    }
    let semantics = header.semantics.map(|bytes| semantics_after(from, bytes)).transpose()?;
    Ok(SplatsRead::new(&PLY, raw, semantics)?.antialiased(header.antialiased))
}

/// The container of `bytes` bytes that follows the vertices.
fn semantics_after(from: &mut dyn Read, bytes: u64) -> Result<Semantics> {
    if bytes > SEMANTICS_BYTES_MAX {
        return Err(Error::limit("PLY: bytes of semantics", bytes, SEMANTICS_BYTES_MAX));
    }
    let mut file = Vec::new();
    let read = from.take(bytes).read_to_end(&mut file);
    read.map_err(|cause| Error::unavailable("read the PLY", cause))?;
    if (file.len() as u64) < bytes {
        return Err(bad(format!("the semantics end after {} of {bytes} bytes", file.len())));
    }
    let read = read_semantics(&file, &SceneId::from_bytes([0; 16]));
    read.map(|(semantics, _)| semantics).map_err(|e| bad(e.message()))
}

fn bad(why: impl std::fmt::Display) -> Error {
    Error::invalid(format!("PLY: {why}"))
}

/// A type of numbers; integers with their size in bytes.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Scalar {
    Signed(usize),
    Unsigned(usize),
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::Signed(1),
            "uchar" | "uint8" => Self::Unsigned(1),
            "short" | "int16" => Self::Signed(2),
            "ushort" | "uint16" => Self::Unsigned(2),
            "int" | "int32" => Self::Signed(4),
            "uint" | "uint32" => Self::Unsigned(4),
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::Signed(size) | Self::Unsigned(size) => size,
            Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The number that stands for 1 where a whole range is 0..1.
    fn most(self) -> f64 {
        match self {
            Self::Unsigned(size) => 256_f64.powi(size as i32) - 1.0,
            Self::Signed(size) => 256_f64.powi(size as i32) / 2.0 - 1.0,
            Self::F32 | Self::F64 => 1.0,
        }
    }

    /// The value at the start of `bytes`, which hold at least [`Self::size`].
    fn value(self, bytes: &[u8], big_endian: bool) -> f64 {
        let (mut word, size) = ([0; 8], self.size());
        word[..size].copy_from_slice(&bytes[..size]);
        if big_endian {
            word[..size].reverse();
        }
        let bits = u64::from_le_bytes(word);
        match self {
            Self::Unsigned(_) => bits as f64,
            Self::Signed(size) => {
                let unused = 64 - 8 * size;
                ((bits as i64) << unused >> unused) as f64
            }
            Self::F32 => f64::from(f32::from_bits(bits as u32)),
            Self::F64 => f64::from_bits(bits),
        }
    }
}

struct Attribute {
    name: String,
    scalar: Scalar,
    offset: usize,
}

/// Rows of one kind.
struct Element {
    name: String,
    count: usize,
    attributes: Vec<Attribute>,
}

struct Header {
    big_endian: bool,
    /// Those that are read: the vertices, with chunks before and harmonics after where it is
    /// compressed.
    elements: Vec<Element>,
    /// Bytes of semantics after the vertices.
    semantics: Option<u64>,
    /// Whether a comment says that the renderer compensates opacity.
    antialiased: bool,
}

/// What a comment says of that renderer: `SplatRenderMode: mip` (Brush, splat-transform) or
/// `antialiased 1` (Postshot).
fn mode(comment: &str) -> Option<bool> {
    let words = comment.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
    let words: Vec<String> = words.map(str::to_ascii_lowercase).collect();
    match [words.first()?, words.get(1)?].map(String::as_str) {
        _ if words.len() > 2 => None,
        ["splatrendermode", mode] => Some(mode == "mip"),
        ["antialiased", is] => Some(matches!(is, "1" | "true")),
        _ => None,
    }
}

impl Header {
    fn read(mut from: &mut dyn BufRead) -> Result<Self> {
        let mut from = Read::take(&mut from, HEADER_BYTES_MAX);
        let mut line = |what: &str| -> Result<String> {
            let mut line = Vec::new();
            from.read_until(b'\n', &mut line)
                .map_err(|cause| Error::unavailable("read the PLY", cause))?;
            if line.last() != Some(&b'\n') {
                return Err(bad(format!(
                    "{what} is missing in the first {HEADER_BYTES_MAX} bytes"
                )));
            }
            // A comment may be in any encoding.
            Ok(String::from_utf8_lossy(&line).trim_end().to_owned())
        };
        if line("the line `ply`")? != "ply" {
            return Err(bad("the file does not begin with the line `ply`"));
        }
        let (mut big_endian, mut semantics, mut antialiased) = (None, None, false);
        let mut elements: Vec<Element> = Vec::new();
        let mut is_read = false;
        loop {
            let line = line("`end_header`")?;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["end_header"] => break,
                ["comment", name, bytes] if name == SEMANTICS => {
                    semantics =
                        Some(bytes.parse().map_err(|e| {
                            bad(format!("bytes of semantics {:?}: {e}", short(bytes)))
                        })?);
                }
                ["comment" | "obj_info", ..] => {
                    let (_, comment) =
                        line.trim_start().split_once([' ', '\t']).unwrap_or_default();
                    antialiased = mode(comment).unwrap_or(antialiased);
                }
                [] => {}
                ["format", "binary_little_endian", "1.0"] => big_endian = Some(false),
                ["format", "binary_big_endian", "1.0"] => big_endian = Some(true),
                ["format", ..] => {
                    return Err(bad(format!("`{}`; only binary is read", short(&line))));
                }
                ["element", name, number] => {
                    let names: Vec<&str> = elements.iter().map(|e| e.name.as_str()).collect();
                    is_read = match (&names[..], name) {
                        ([] | [CHUNK], "vertex") | ([], CHUNK) | ([CHUNK, "vertex"], SH) => true,
                        ([] | [CHUNK], _) => {
                            return Err(bad(format!(
                                "`{}` stands before the vertices",
                                short(&line)
                            )));
                        }
                        // What follows the vertices is not read.
                        _ => false,
                    };
                    if is_read {
                        let what = if name == "vertex" { "vertices" } else { name };
                        let count = number.parse().map_err(|e| {
                            bad(format!("number of {what} {:?}: {e}", short(number)))
                        })?;
                        elements.push(Element {
                            name: name.to_owned(),
                            count,
                            attributes: Vec::new(),
                        });
                    }
                }
                ["property", ..] if !is_read => {}
                ["property", scalar, name] => match elements.last_mut() {
                    Some(element) => push_attribute(&mut element.attributes, scalar, name)?,
                    None => return Err(bad("a property stands before the first element")),
                },
                _ if line.contains(char::REPLACEMENT_CHARACTER) => {
                    return Err(bad("the header is not text"));
                }
                _ => return Err(bad(format!("header line {:?} is not known", short(&line)))),
            }
        }
        let big_endian = big_endian.ok_or_else(|| bad("the header has no `format`"))?;
        Ok(Self { big_endian, elements, semantics, antialiased })
    }

    fn vertices(&self) -> Result<&Element> {
        let vertices = self.elements.iter().find(|element| element.name == "vertex");
        vertices.ok_or_else(|| bad("the header has no `element vertex`"))
    }

    /// Where the numbers of a compressed PLY are. Chunks are read first, vertices second.
    fn packed(&self) -> Result<PackedLayout> {
        let [chunks, vertices, sh @ ..] = &self.elements[..] else {
            return Err(bad("the header has no `element vertex`"));
        };
        let count = vertices.count;
        if self.big_endian {
            return Err(bad("a compressed PLY is little-endian"));
        }
        if chunks.count != count.div_ceil(packed_ply::CHUNK) {
            let each = packed_ply::CHUNK;
            let chunks = chunks.count;
            return Err(bad(format!("{chunks} chunks for {count} vertices; {each} go into one")));
        }
        let colors = chunks.find("min_r").is_some();
        let bounds = BOUNDS.iter().take(if colors { 18 } else { 12 });
        let bounds = bounds.map(|name| chunks.offset(name, Scalar::F32)).collect::<Result<_>>()?;
        let mut packed = [0; 4];
        for (at, name) in packed.iter_mut().zip(PACKED) {
            *at = vertices.offset(name, Scalar::Unsigned(4))?;
        }
        let (sh_degree, of_sh) = match sh {
            [] => (0, 0),
            [sh, ..] if sh.count != count => {
                let rows = sh.count;
                return Err(bad(format!("{rows} rows of harmonics for {count} vertices")));
            }
            [sh, ..] => (sh.packed_degree()?, sh.stride()),
        };
        let strides = [chunks.stride(), vertices.stride(), of_sh];
        Ok(PackedLayout { count, sh_degree, strides, bounds, packed })
    }
}

impl Element {
    fn stride(&self) -> usize {
        self.attributes.last().map_or(0, |last| last.offset + last.scalar.size())
    }

    fn find(&self, name: &str) -> Option<usize> {
        self.attributes.iter().position(|attribute| attribute.name == name)
    }

    fn require<const N: usize>(&self, names: [&str; N]) -> Result<[usize; N]> {
        let mut found = [0; N];
        for (slot, name) in found.iter_mut().zip(names) {
            *slot = self.find(name).ok_or_else(|| bad(format!("the vertices have no `{name}`")))?;
        }
        Ok(found)
    }

    /// Where the attribute is in a row; it must be of this type.
    fn offset(&self, name: &str, scalar: Scalar) -> Result<usize> {
        let element = &self.name;
        let at = self.find(name);
        let at = at.ok_or_else(|| bad(format!("element {element} has no `{name}`")))?;
        let attribute = &self.attributes[at];
        if attribute.scalar != scalar {
            let is = attribute.scalar;
            return Err(bad(format!("`{name}` of {element} is {is:?}, not {scalar:?}")));
        }
        Ok(attribute.offset)
    }

    /// The degree of harmonics of one byte each, `f_rest_0` to the last.
    fn packed_degree(&self) -> Result<u8> {
        let right = self.attributes.iter().enumerate().all(|(i, attribute)| {
            attribute.name == format!("f_rest_{i}") && attribute.scalar == Scalar::Unsigned(1)
        });
        match (self.attributes.len(), right) {
            (9, true) => Ok(1),
            (24, true) => Ok(2),
            (45, true) => Ok(3),
            (count, _) => Err(bad(format!(
                "{count} attributes of harmonics; 9, 24 or 45 uchar from `f_rest_0` are read"
            ))),
        }
    }
}

fn push_attribute(attributes: &mut Vec<Attribute>, scalar: &str, name: &str) -> Result<()> {
    let scalar = Scalar::parse(scalar).ok_or_else(|| {
        bad(format!("type {:?} of {:?} is not known", short(scalar), short(name)))
    })?;
    if attributes.iter().any(|attribute| attribute.name == name) {
        return Err(bad(format!("the vertices have {:?} twice", short(name))));
    }
    if attributes.len() == ATTRIBUTES_MAX {
        return Err(Error::limit("PLY: attributes of a vertex", "one more", ATTRIBUTES_MAX));
    }
    let offset = attributes.last().map_or(0, |last| last.offset + last.scalar.size());
    attributes.push(Attribute { name: name.to_owned(), scalar, offset });
    Ok(())
}

/// Names of colours that are no harmonics.
const LEVELS: [[&str; 3]; 3] =
    [["red", "green", "blue"], ["diffuse_red", "diffuse_green", "diffuse_blue"], ["r", "g", "b"]];
/// Scale of Gaussians without one, world units, as viewers of the web have it.
const SCALE: f32 = 0.01;

/// A number of a vertex.
#[derive(Clone, Copy)]
enum Number {
    /// As it is.
    Plain(usize),
    /// A level: the whole range of an integer is 0..1.
    Level(usize),
}

/// Which attribute is what.
struct Layout {
    position: [usize; 3],
    color: [Number; 3],
    rest: Vec<usize>,
    /// A logit, or a level; where there is none it is 1.
    opacity: Option<Number>,
    /// One for all axes; of two axes, of a flat Gaussian; or of three. None: [`SCALE`].
    scale: Vec<usize>,
    rotation: Option<[usize; 4]>,
    semantic_index: Option<usize>,
    sh_degree: u8,
}

impl Layout {
    fn of(vertices: &Element) -> Result<Self> {
        let rest: Vec<usize> = (0..).map_while(|i| vertices.find(&format!("f_rest_{i}"))).collect();
        let sh_degree = match rest.len() {
            0 => 0,
            9 => 1,
            24 => 2,
            45 => 3,
            other => {
                return Err(bad(format!("{other} `f_rest_` attributes; 0, 9, 24 or 45 are read")));
            }
        };
        Ok(Self {
            position: vertices.require(["x", "y", "z"])?,
            color: Self::color(vertices)?,
            rest,
            opacity: (vertices.find("opacity").map(Number::Plain))
                .or_else(|| vertices.find("alpha").map(Number::Level)),
            scale: Self::scale(vertices)?,
            rotation: (vertices.find("rot_0"))
                .map(|_| vertices.require(["rot_0", "rot_1", "rot_2", "rot_3"]))
                .transpose()?,
            semantic_index: vertices.find("semantic_index"),
            sh_degree,
        })
    }

    fn color(vertices: &Element) -> Result<[Number; 3]> {
        let levels = LEVELS.into_iter().find(|names| vertices.find(names[0]).is_some());
        match levels.filter(|_| vertices.find("f_dc_0").is_none()) {
            Some(names) => Ok(vertices.require(names)?.map(Number::Level)),
            None => Ok(vertices.require(["f_dc_0", "f_dc_1", "f_dc_2"])?.map(Number::Plain)),
        }
    }

    fn scale(vertices: &Element) -> Result<Vec<usize>> {
        let has = |name: &str| vertices.find(name).is_some();
        Ok(match [has("scale_0"), has("scale_1"), has("scale_2")] {
            [false, false, false] => Vec::new(),
            [_, false, false] => vertices.require(["scale_0"])?.to_vec(),
            [.., false] => vertices.require(["scale_0", "scale_1"])?.to_vec(),
            _ => vertices.require(["scale_0", "scale_1", "scale_2"])?.to_vec(),
        })
    }

    /// Adds a vertex; `placed` is whether a vertex before it had a place.
    fn push(
        &self,
        header: &Header,
        vertices: &Element,
        vertex: &[u8],
        raw: &mut RawGaussians,
        placed: &mut bool,
    ) {
        let attributes = &vertices.attributes;
        let value = |attribute: usize| {
            let Attribute { scalar, offset, .. } = attributes[attribute];
            scalar.value(&vertex[offset..], header.big_endian)
        };
        let narrow = |attribute| value(attribute) as f32;
        let position = DVec3::from_array(self.position.map(value));
        let wide = self.position.iter().any(|&i| attributes[i].scalar == Scalar::F64);
        if wide && !*placed && position.is_finite() {
            // f64 positions are kept near the first one, where f32 is fine enough.
            (raw.origin, *placed) = (position, true);
        }
        raw.means.push((position - raw.origin).as_vec3().to_array());
        let level = |i: usize| value(i) / attributes[i].scalar.most();
        raw.quats.push(self.rotation.map_or([1.0, 0.0, 0.0, 0.0], |rotation| rotation.map(narrow)));
        let scale = |i: usize| value(i).exp() as f32;
        raw.scales.push(match self.scale[..] {
            [x, y, z] => [x, y, z].map(scale),
            [x, y] => [scale(x), scale(y), 0.0],
            [all] => [scale(all); 3],
            _ => [SCALE; 3],
        });
        raw.opacities.push(match self.opacity {
            Some(Number::Plain(i)) => (1.0 / (1.0 + (-value(i)).exp())) as f32,
            Some(Number::Level(i)) => level(i) as f32,
            None => 1.0,
        });
        raw.sh.push(self.color.map(|number| match number {
            Number::Plain(i) => narrow(i),
            Number::Level(i) => ((level(i) - 0.5) / f64::from(SH_C0)) as f32,
        }));
        let each = self.rest.len() / 3;
        for coefficient in 0..each {
            raw.sh.push([0, 1, 2].map(|channel| narrow(self.rest[channel * each + coefficient])));
        }
        // The cast saturates; an index that is none becomes the background.
        let index = self.semantic_index.map_or(0, |i| value(i) as u16);
        raw.semantic_index.push(index);
        raw.source.push(SourcePixel::default());
    }
}
