//! A finished scene: its Gaussians, its sources and its report.

use std::sync::{Arc, OnceLock};

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        Backdrop, Gaussians, Ground, HealthReport, SceneCamera, SceneId, SceneOptions, Semantics,
        ground,
    },
};

/// A photo of the upload and its hash.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PhotoHash {
    /// File name as uploaded.
    pub file: String,
    /// sha256 of the file, hex.
    pub sha256: String,
}

/// The sources of a scene: all that is needed to make it again.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Files of the upload: photos, or the archive, and the camera description.
    pub files: Vec<PhotoHash>,
    /// sha256 of the model bundle's manifest, hex; empty where no network was used.
    pub bundle_sha256: String,
    /// Options of the call.
    pub options: SceneOptions,
    /// sha256 over all of these, hex: two scenes with the same one are the same.
    #[serde(default)]
    pub content_sha256: String,
    /// Version of the program.
    pub program_version: String,
}

/// Everything of a scene but its Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneMeta {
    /// Id.
    pub id: SceneId,
    /// Time of the create call, milliseconds since 1970.
    pub created_ms: u64,
    /// Input cameras, in the order of the upload.
    pub cameras: Vec<SceneCamera>,
    /// Health report.
    pub report: HealthReport,
    /// Sources.
    pub provenance: Provenance,
}

/// A finished scene.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Cameras, report, provenance.
    pub meta: SceneMeta,
    /// The Gaussians.
    pub gaussians: Gaussians,
    /// The photos' colours by direction, behind everything.
    pub backdrop: Arc<Backdrop>,
    /// Its semantics, once they are ready; the Gaussians then have its entries.
    pub semantics: Option<Arc<Semantics>>,
    /// sha256 of the file that it is kept in, hex; empty where it is in none.
    pub sha256: String,
    /// sha256 of the file of its semantics, hex; empty where they are in none.
    pub semantics_sha256: String,
    /// sha256 of the list of edits that its Gaussians have behind them, hex; empty where none.
    pub edits_sha256: String,
    /// What [`Self::ground`] found.
    pub found_ground: OnceLock<Option<Ground>>,
}

impl Scene {
    /// A scene without semantics.
    pub fn new(meta: SceneMeta, gaussians: Gaussians, backdrop: Backdrop) -> Self {
        Self {
            meta,
            gaussians,
            backdrop: Arc::new(backdrop),
            semantics: None,
            sha256: String::new(),
            semantics_sha256: String::new(),
            edits_sha256: String::new(),
            found_ground: OnceLock::new(),
        }
    }

    /// The ground of the scene as it was made: searched once, and kept through edits.
    #[must_use]
    pub fn ground(&self) -> Option<Ground> {
        *self.found_ground.get_or_init(|| {
            let up = SceneCamera::level_up(&self.meta.cameras);
            ground(&self.gaussians, up, self.meta.report.median_depth)
        })
    }

    /// Bytes held by its arrays.
    pub fn size_bytes(&self) -> u64 {
        let semantics = self.semantics.as_ref().map_or(0, |semantics| {
            let photos: usize = semantics.photos.iter().map(|map| map.index.len()).sum();
            4 * semantics.bank.rows.len()
                + 2 * (semantics.index.len() + photos)
                + 12 * semantics.masks.len()
        });
        self.gaussians.size_bytes() + semantics as u64
    }

    /// The same scene with other Gaussians, which have entries of its bank, after the edits of
    /// this hash.
    #[must_use]
    pub fn after_edits(&self, gaussians: Gaussians, edits_sha256: String) -> Self {
        let semantics = self.semantics.as_ref().map(|semantics| {
            let index = gaussians.semantic_index().to_vec();
            Arc::new(Semantics { index, ..(**semantics).clone() })
        });
        let _ = self.ground();
        Self { gaussians, semantics, edits_sha256, ..self.clone() }
    }

    /// The same scene; its Gaussians have the entries of `semantics`.
    ///
    /// # Errors
    /// `scene_corrupt` when the semantics are those of a scene with other Gaussians, or name
    /// entries that their bank does not have.
    pub fn with_semantics(&self, semantics: Arc<Semantics>) -> Result<Self> {
        let (count, entries) = (semantics.index.len(), semantics.bank.len());
        let most = semantics.index.iter().copied().max().unwrap_or(0);
        if count != self.gaussians.len() || usize::from(most) > entries {
            return Err(Error::new(
                ErrorCode::SceneCorrupt,
                format!(
                    "semantics of {count} Gaussians and {entries} entries, highest index {most}; \
                     the scene has {} Gaussians",
                    self.gaussians.len()
                ),
            ));
        }
        Ok(Self {
            gaussians: self.gaussians.with_semantic_index(semantics.index.clone())?,
            semantics: Some(semantics),
            ..self.clone()
        })
    }
}
