//! A finished scene as one container: arrays as they are in memory, the rest as JSON.

use std::io::{self, Write};

use glam::DVec3;
use safetensors::Dtype;
use serde::{Deserialize, Serialize};

use super::{Container, ContainerArray, ContainerKind, write};
use crate::{
    error::Result,
    scene::{Backdrop, Gaussians, RawGaussians, Scene, SceneMeta, SourcePixel},
};

const LABEL: ContainerKind = ContainerKind { kind: "segsplat-scene", version: 1 };

/// What the arrays cannot say.
#[derive(Serialize, Deserialize)]
struct Header {
    origin: [f64; 3],
    sh_degree: u8,
    meta: SceneMeta,
    /// sha256 of the file of the semantics whose entries the Gaussians have; those of that file may
    /// be for other Gaussians.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    entries_of: Option<String>,
}

/// Writes a scene container and gives its sha256, hex.
///
/// # Errors
/// Those of the writer.
pub fn write_scene(to: &mut dyn Write, scene: &Scene) -> io::Result<String> {
    let gaussians = &scene.gaussians;
    let (n, k) = (gaussians.len(), gaussians.sh_count());
    let header = serde_json::to_string(&Header {
        origin: gaussians.origin().to_array(),
        sh_degree: gaussians.sh_degree(),
        meta: scene.meta.clone(),
        entries_of: Some(scene.semantics_sha256.clone()).filter(|sha256| !sha256.is_empty()),
    })?;
    let source: Vec<[u16; 3]> = gaussians.source().iter().map(|s| [s.view, s.x, s.y]).collect();
    let backdrop_shape = [Backdrop::HEIGHT, Backdrop::WIDTH, 3];
    let arrays = [
        ContainerArray::new("means", Dtype::F32, &[n, 3], gaussians.means()),
        ContainerArray::new("quats", Dtype::F32, &[n, 4], gaussians.quats()),
        ContainerArray::new("scales", Dtype::F32, &[n, 3], gaussians.scales()),
        ContainerArray::new("opacities", Dtype::F32, &[n], gaussians.opacities()),
        ContainerArray::new("sh", Dtype::F32, &[n, k, 3], gaussians.sh()),
        ContainerArray::new("semantic_index", Dtype::U16, &[n], gaussians.semantic_index()),
        ContainerArray::new("source", Dtype::U16, &[n, 3], &source),
        ContainerArray::new("backdrop", Dtype::U8, &backdrop_shape, scene.backdrop.cells()),
    ];
    write(to, &LABEL, &header, &arrays)
}

/// Reads a scene container and gives it with its sha256, hex. Its `semantics_sha256` says whose
/// entries its Gaussians have.
///
/// # Errors
/// `scene_corrupt` when any byte differs from what was written, or the version is unknown.
pub fn read_scene(file: &[u8]) -> Result<(Scene, String)> {
    let container = Container::read(file, &LABEL, "the scene file")?;
    let header: Header = container.header()?;
    let raw = RawGaussians {
        origin: DVec3::from_array(header.origin),
        means: container.rows("means", Dtype::F32)?,
        quats: container.rows("quats", Dtype::F32)?,
        scales: container.rows("scales", Dtype::F32)?,
        opacities: container.rows("opacities", Dtype::F32)?,
        sh_degree: header.sh_degree,
        sh: container.rows("sh", Dtype::F32)?,
        semantic_index: container.rows("semantic_index", Dtype::U16)?,
        source: container
            .rows::<[u16; 3]>("source", Dtype::U16)?
            .into_iter()
            .map(|[view, x, y]| SourcePixel { view, x, y })
            .collect(),
    };
    let backdrop = Backdrop::from_cells(container.rows("backdrop", Dtype::U8)?)?;
    let scene = Scene::new(header.meta, Gaussians::restore(raw)?, backdrop);
    let semantics_sha256 = header.entries_of.unwrap_or_default();
    let sha256 = container.sha256.clone();
    Ok((Scene { sha256, semantics_sha256, ..scene }, container.sha256))
}
