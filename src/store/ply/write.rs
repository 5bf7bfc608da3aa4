//! Gaussians as a PLY, part by part, so that no whole file is in memory.

use crate::{
    error::{Error, Result},
    scene::{Gaussians, SceneId, Semantics},
    store::write_semantics,
};

/// The comment that says how many bytes of semantics follow the vertices.
pub(super) const SEMANTICS: &str = "segsplat_semantics_bytes";
/// Gaussians of a part.
const PART: usize = 16_384;
/// Opacity 1 has no finite logit; this one reads back as 1 within f32's step.
const OPACITY_MAX: f64 = 1.0 - 5e-8;

/// What a PLY holds: Gaussians, and after them the container of their semantics.
#[derive(Debug)]
pub struct PlyFile {
    gaussians: Gaussians,
    semantics: Vec<u8>,
}

impl PlyFile {
    /// Gaussians with their semantics, where there are some.
    ///
    /// # Errors
    /// `internal` when the semantics cannot be packed.
    pub fn new(gaussians: Gaussians, semantics: Option<&Semantics>) -> Result<Self> {
        let mut packed = Vec::new();
        if let Some(semantics) = semantics {
            write_semantics(&mut packed, &SceneId::from_bytes([0; 16]), semantics)
                .map_err(|e| Error::internal("the semantics cannot be packed").caused_by(e))?;
        }
        Ok(Self { gaussians, semantics: packed })
    }

    /// Size of the whole file.
    pub fn size_bytes(&self) -> u64 {
        let vertices = self.gaussians.len() * vertex_bytes(&self.gaussians);
        (header(self).len() + vertices + self.semantics.len()) as u64
    }
}

/// Iterates over the parts of the file: the header, vertices, semantics.
#[derive(Debug)]
pub struct PlyWriter<'a> {
    file: &'a PlyFile,
    /// Next Gaussian; `None` before the header.
    next: Option<usize>,
}

impl<'a> PlyWriter<'a> {
    /// A writer at the start of the file.
    pub fn new(file: &'a PlyFile) -> Self {
        Self { file, next: None }
    }
}

impl Iterator for PlyWriter<'_> {
    type Item = Vec<u8>;

    fn next(&mut self) -> Option<Vec<u8>> {
        let Some(from) = self.next else {
            self.next = Some(0);
            return Some(header(self.file).into_bytes());
        };
        let gaussians = &self.file.gaussians;
        if from == gaussians.len() {
            self.next = Some(usize::MAX);
            return Some(self.file.semantics.clone()).filter(|packed| !packed.is_empty());
        }
        if from > gaussians.len() {
            return None;
        }
        let to = (from + PART).min(gaussians.len());
        self.next = Some(to);
        let mut part = Vec::with_capacity((to - from) * vertex_bytes(gaussians));
        for i in from..to {
            vertex(gaussians, i, &mut part);
        }
        Some(part)
    }
}

fn vertex_bytes(gaussians: &Gaussians) -> usize {
    4 * (3 + 3 + 3 * gaussians.sh_count() + 1 + 3 + 4) + 2
}

fn header(file: &PlyFile) -> String {
    let gaussians = &file.gaussians;
    let after = match file.semantics.len() {
        0 => String::new(),
        bytes => format!("comment {SEMANTICS} {bytes}\n"),
    };
    let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz"].map(str::to_owned).to_vec();
    names.extend((0..3).map(|c| format!("f_dc_{c}")));
    names.extend((0..3 * (gaussians.sh_count() - 1)).map(|i| format!("f_rest_{i}")));
    names.push("opacity".to_owned());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    let floats: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    format!(
        "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: default\n{after}\
         element vertex {}\n{floats}property ushort semantic_index\nend_header\n",
        gaussians.len()
    )
}

fn vertex(gaussians: &Gaussians, i: usize, to: &mut Vec<u8>) {
    let raw = gaussians.as_raw();
    let k = gaussians.sh_count();
    let sh = &raw.sh[i * k..(i + 1) * k];
    let mut put = |value: f64| to.extend_from_slice(&(value as f32).to_le_bytes());
    for (mean, origin) in raw.means[i].iter().zip(raw.origin.to_array()) {
        put(f64::from(*mean) + origin);
    }
    (0..3).for_each(|_normal| put(0.0));
    sh[0].iter().for_each(|&value| put(f64::from(value)));
    for channel in 0..3 {
        sh[1..].iter().for_each(|row| put(f64::from(row[channel])));
    }
    let opacity = f64::from(raw.opacities[i]).min(OPACITY_MAX);
    put((opacity / (1.0 - opacity)).ln());
    raw.scales[i].iter().for_each(|&scale| put(f64::from(scale).ln()));
    raw.quats[i].iter().for_each(|&value| put(f64::from(value)));
    to.extend_from_slice(&raw.semantic_index[i].to_le_bytes());
}
