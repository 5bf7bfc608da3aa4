//! Gaussians as a PLY.

use std::io::{self, Write};

use super::super::{SplatFile, places::Coarse, world};

/// The comment that says how many bytes of semantics follow the vertices.
pub(super) const SEMANTICS: &str = "segsplat_semantics_bytes";
/// Opacity 1 has no finite logit; this one reads back as 1 within f32's step.
const OPACITY_MAX: f64 = 1.0 - 5e-8;

pub(super) fn size_bytes(file: &SplatFile) -> u64 {
    let vertices = file.gaussians.len() * vertex_bytes(file);
    (header(file).len() + vertices + file.semantics.len()) as u64
}

pub(super) fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    to.write_all(header(file).as_bytes())?;
    let mut row = Vec::new();
    for i in 0..file.gaussians.len() {
        row.clear();
        vertex(file, i, &mut row);
        to.write_all(&row)?;
    }
    to.write_all(&file.semantics)
}

fn vertex_bytes(file: &SplatFile) -> usize {
    let of_position = if file.coarse.is_some() { 8 } else { 4 };
    3 * of_position + 4 * (3 + 3 * file.gaussians.sh_count() + 1 + 3 + 4) + 2
}

fn header(file: &SplatFile) -> String {
    let gaussians = &file.gaussians;
    let after = match file.semantics.len() {
        0 => String::new(),
        bytes => format!("comment {SEMANTICS} {bytes}\n"),
    };
    let (position, why) = file.coarse.map_or(("float", String::new()), |Coarse { step, bound }| {
        let why = format!("step {step} of float positions is over {bound}: they are double");
        ("double", format!("comment {why}\n"))
    });
    let mode = if file.antialiased { "mip" } else { "default" };
    let places: String = ["x", "y", "z"].map(|k| format!("property {position} {k}\n")).concat();
    let mut names: Vec<String> = ["nx", "ny", "nz"].map(str::to_owned).to_vec();
    names.extend((0..3).map(|c| format!("f_dc_{c}")));
    names.extend((0..3 * (gaussians.sh_count() - 1)).map(|i| format!("f_rest_{i}")));
    names.push("opacity".to_owned());
    names.extend((0..3).map(|i| format!("scale_{i}")));
    names.extend((0..4).map(|i| format!("rot_{i}")));
    let floats: String = names.iter().map(|name| format!("property float {name}\n")).collect();
    format!(
        "ply\nformat binary_little_endian 1.0\ncomment SplatRenderMode: {mode}\n{why}{after}\
         element vertex {}\n{places}{floats}property ushort semantic_index\nend_header\n",
        gaussians.len()
    )
}

fn vertex(file: &SplatFile, i: usize, to: &mut Vec<u8>) {
    let gaussians = &file.gaussians;
    for value in world(gaussians, i).to_array() {
        match file.coarse {
            Some(_) => to.extend_from_slice(&value.to_le_bytes()),
            None => to.extend_from_slice(&(value as f32).to_le_bytes()),
        }
    }
    let k = gaussians.sh_count();
    let sh = &gaussians.sh()[i * k..(i + 1) * k];
    let mut put = |value: f64| to.extend_from_slice(&(value as f32).to_le_bytes());
    (0..3).for_each(|_normal| put(0.0));
    sh[0].iter().for_each(|&value| put(f64::from(value)));
    for channel in 0..3 {
        sh[1..].iter().for_each(|row| put(f64::from(row[channel])));
    }
    let opacity = f64::from(gaussians.opacities()[i]).min(OPACITY_MAX);
    put((opacity / (1.0 - opacity)).ln());
    gaussians.scales()[i].iter().for_each(|&scale| put(f64::from(scale).ln()));
    gaussians.quats()[i].iter().for_each(|&value| put(f64::from(value)));
    to.extend_from_slice(&gaussians.semantic_index()[i].to_le_bytes());
}
