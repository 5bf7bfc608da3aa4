//! A finished scene as one container: arrays as they are in memory, the rest as JSON.

use std::io::{self, Write};

use bytemuck::Pod;
use glam::DVec3;
use safetensors::Dtype;
use serde::{Deserialize, Serialize};

use super::container::{self, Array, Container, Label};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Backdrop, Gaussians, RawGaussians, Scene, SceneMeta, SourcePixel},
};

const LABEL: Label = Label { kind: "segsplat-scene", version: 1 };

/// What the arrays cannot say.
#[derive(Serialize, Deserialize)]
struct Header {
    origin: [f64; 3],
    sh_degree: u8,
    meta: SceneMeta,
}

/// Writes a scene container and gives its sha256, hex.
///
/// # Errors
/// Those of the writer.
pub fn write_scene(to: &mut dyn Write, scene: &Scene) -> io::Result<String> {
    let raw = scene.gaussians.as_raw();
    let (n, k) = (raw.means.len(), scene.gaussians.sh_count());
    let header = serde_json::to_string(&Header {
        origin: raw.origin.to_array(),
        sh_degree: raw.sh_degree,
        meta: scene.meta.clone(),
    })?;
    let source: Vec<[u16; 3]> = raw.source.iter().map(|s| [s.view, s.x, s.y]).collect();
    let array = |name: &str, dtype, shape: &[usize], bytes| Array {
        name: name.to_owned(),
        dtype,
        shape: shape.to_vec(),
        bytes,
    };
    let arrays = [
        array("means", Dtype::F32, &[n, 3], bytemuck::cast_slice(&raw.means)),
        array("quats", Dtype::F32, &[n, 4], bytemuck::cast_slice(&raw.quats)),
        array("scales", Dtype::F32, &[n, 3], bytemuck::cast_slice(&raw.scales)),
        array("opacities", Dtype::F32, &[n], bytemuck::cast_slice(&raw.opacities)),
        array("sh", Dtype::F32, &[n, k, 3], bytemuck::cast_slice(&raw.sh)),
        array("semantic_index", Dtype::U16, &[n], bytemuck::cast_slice(&raw.semantic_index)),
        array("source", Dtype::U16, &[n, 3], bytemuck::cast_slice(&source)),
        array(
            "backdrop",
            Dtype::U8,
            &[Backdrop::HEIGHT, Backdrop::WIDTH, 3],
            bytemuck::cast_slice(scene.backdrop.cells()),
        ),
    ];
    container::write(to, &LABEL, &header, &arrays)
}

/// Reads a scene container and gives it with its sha256, hex.
///
/// # Errors
/// `scene_corrupt` when any byte differs from what was written, or the version is unknown.
pub fn read_scene(file: &[u8]) -> Result<(Scene, String)> {
    let container = Container::read(file, &LABEL, "the scene file")?;
    let header: Header = serde_json::from_str(&container.meta_json).map_err(|e| {
        Error::new(ErrorCode::SceneCorrupt, format!("the scene file's metadata: {e}"))
    })?;
    let raw = RawGaussians {
        origin: DVec3::from_array(header.origin),
        means: rows(&container, "means", Dtype::F32)?,
        quats: rows(&container, "quats", Dtype::F32)?,
        scales: rows(&container, "scales", Dtype::F32)?,
        opacities: rows(&container, "opacities", Dtype::F32)?,
        sh_degree: header.sh_degree,
        sh: rows(&container, "sh", Dtype::F32)?,
        semantic_index: rows(&container, "semantic_index", Dtype::U16)?,
        source: rows::<[u16; 3]>(&container, "source", Dtype::U16)?
            .into_iter()
            .map(|[view, x, y]| SourcePixel { view, x, y })
            .collect(),
    };
    let backdrop = Backdrop::from_cells(rows(&container, "backdrop", Dtype::U8)?)?;
    let scene = Scene::new(header.meta, Gaussians::restore(raw)?, backdrop);
    Ok((scene, container.sha256))
}

/// An array as rows of `T`, copied so that alignment does not matter.
pub(super) fn rows<T: Pod>(container: &Container<'_>, name: &str, dtype: Dtype) -> Result<Vec<T>> {
    let (_, bytes) = container.array(name, dtype)?;
    if bytes.len() % size_of::<T>() != 0 {
        return Err(Error::new(
            ErrorCode::SceneCorrupt,
            format!("array {name}: {} bytes are no whole number of rows", bytes.len()),
        ));
    }
    Ok(bytemuck::pod_collect_to_vec(bytes))
}
