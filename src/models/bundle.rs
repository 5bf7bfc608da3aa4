//! A bundle: a folder with `bundle.toml` and the files it names, each checked by sha256.
//!
//! `models/README.md` documents the manifest. A bundle that differs from it is refused with what
//! differs: the file, and both hashes.

use std::{
    io::Read,
    path::{Path, PathBuf},
};

use serde::Deserialize;
use sha2::{Digest, Sha256};

use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    models::SETUP_COMMAND,
};

/// Name of the manifest in a bundle's folder.
pub(super) const MANIFEST: &str = "bundle.toml";
/// Where the bundle that ships with the server lies, under the working folder or the executable's.
const EMBEDDED: &str = "models/embedded";
/// Largest manifest read, bytes.
const MANIFEST_BYTES_MAX: u64 = 1 << 20;
/// Largest side of a bucket, pixels: `SourcePixel` counts in u16 and memory grows with the area.
const BUCKET_SIDE_MAX: u32 = 4_096;

/// A bundle whose files are those of its manifest.
#[derive(Clone, Debug)]
pub struct Bundle {
    dir: PathBuf,
    sha256: String,
    manifest: BundleManifest,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BundleManifest {
    name: String,
    version: String,
    geometry: GeometryManifest,
}

/// The rigid frame that a geometry network's outputs are in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputFrame {
    /// Each view's own camera.
    Camera,
    /// The model frame: the first camera of the set.
    Model,
}

/// How camera translations are scaled into the model frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Translation {
    /// The largest distance between two cameras of the set is 1.
    LargestBaseline,
    /// World units.
    World,
}

/// Input tensor names of a geometry network.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeometryInputs {
    /// `[V, 3, H, W]` f32.
    pub images: String,
    /// `[V, 3, 3]` f32, row 0 divided by W and row 1 by H.
    pub intrinsics: String,
    /// `[V, 4, 4]` f32, model frame.
    pub camera_to_world: String,
    /// `[V]` f32, model units.
    pub near: String,
    /// `[V]` f32, model units.
    pub far: String,
    /// `[V, K]` i64; absent for a network that chooses by itself.
    pub neighbors: Option<String>,
}

/// Output tensor names of a geometry network.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeometryOutputs {
    /// `[V, H, W, 3]` f32, model units.
    pub means: String,
    /// `[V, H, W, 3]` f32, model units.
    pub scales: String,
    /// `[V, H, W, 4]` f32, wxyz.
    pub quats: String,
    /// `[V, H, W]` f32.
    pub opacities: String,
    /// `[V, H, W, K, 3]` f32.
    pub sh: String,
    /// `[V, H, W]` f32, 0..1; absent where the network has none (1 is taken).
    pub confidence: Option<String>,
}

/// What `bundle.toml` says of the geometry network.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeometryManifest {
    /// File in the bundle's folder.
    pub file: String,
    /// Its sha256, hex.
    pub sha256: String,
    /// Licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub source: String,
    /// Working sizes, `[height, width]`.
    pub buckets: Vec<[u32; 2]>,
    /// Fewest views at once.
    pub views_min: usize,
    /// Most views at once.
    pub views_max: usize,
    /// Most source views of a view.
    pub neighbors_max: usize,
    /// Degree of the spherical harmonics.
    pub sh_degree: u8,
    /// Frame of the outputs.
    pub output_frame: OutputFrame,
    /// Scale of the model frame.
    pub translation: Translation,
    /// Subtracted from the 0..1 channels.
    pub mean: [f32; 3],
    /// Divides them after that.
    pub std: [f32; 3],
    /// Input names.
    pub inputs: GeometryInputs,
    /// Output names.
    pub outputs: GeometryOutputs,
}

impl Bundle {
    /// The bundle of the configuration, or the one found beside the executable or in the working
    /// folder.
    ///
    /// # Errors
    /// `model_unavailable` as [`Self::open`]; none found names every place looked at.
    pub fn find(config: &Config) -> Result<Self> {
        if let Some(dir) = &config.bundle {
            return Self::open(dir);
        }
        let places = search_places();
        match places.iter().find(|dir| dir.join(MANIFEST).is_file()) {
            Some(dir) => Self::open(dir),
            None => Err(unavailable(format!(
                "no model bundle: no {EMBEDDED}/{MANIFEST} beside the executable or in the \
                 working folder; name its folder with --bundle or SEGSPLAT_BUNDLE"
            ))),
        }
    }

    /// Reads the manifest of `dir` and checks every file it names.
    ///
    /// # Errors
    /// `model_unavailable` when the manifest or a file is missing, the manifest is malformed, or a
    /// file's sha256 differs.
    pub fn open(dir: &Path) -> Result<Self> {
        let path = dir.join(MANIFEST);
        let size = fs_err::metadata(&path).map_err(|e| missing(MANIFEST, e))?.len();
        if size > MANIFEST_BYTES_MAX {
            return Err(unavailable(format!(
                "model bundle: {MANIFEST} has {size} bytes, over {MANIFEST_BYTES_MAX}"
            )));
        }
        let text = fs_err::read_to_string(&path).map_err(|e| missing(MANIFEST, e))?;
        let manifest: BundleManifest = toml::from_str(&text)
            .map_err(|e| unavailable(format!("model bundle: {MANIFEST}: {e}")))?;
        manifest.geometry.validate()?;
        let bundle = Self { dir: dir.to_owned(), sha256: hex_of(text.as_bytes()), manifest };
        bundle.verify()?;
        Ok(bundle)
    }

    /// Checks every file's sha256 again.
    ///
    /// # Errors
    /// `model_unavailable`, naming the file and both hashes.
    pub fn verify(&self) -> Result<()> {
        let geometry = &self.manifest.geometry;
        let path = self.geometry_path();
        let found = sha256_of(&path).map_err(|e| missing(&geometry.file, e))?;
        if found != geometry.sha256.to_lowercase() {
            return Err(unavailable(format!(
                "model bundle: {} is not the file of {MANIFEST}: sha256 {found}, not {}; restore \
                 it (`git checkout -- {EMBEDDED}`)",
                geometry.file, geometry.sha256
            )));
        }
        Ok(())
    }

    /// Name of the bundle.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.manifest.name
    }

    /// Version of the bundle.
    #[must_use]
    pub fn version(&self) -> &str {
        &self.manifest.version
    }

    /// sha256 of the manifest, hex: it names every file's hash, so it stands for the bundle.
    #[must_use]
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// The geometry network's entry.
    #[must_use]
    pub fn geometry(&self) -> &GeometryManifest {
        &self.manifest.geometry
    }

    /// The geometry network's file.
    #[must_use]
    pub fn geometry_path(&self) -> PathBuf {
        self.dir.join(&self.manifest.geometry.file)
    }

    /// Size of the geometry network's file in bytes; 0 when it has gone.
    #[must_use]
    pub fn geometry_size_bytes(&self) -> u64 {
        fs_err::metadata(self.geometry_path()).map_or(0, |meta| meta.len())
    }
}

impl GeometryManifest {
    fn validate(&self) -> Result<()> {
        let wrong =
            |what: String| Err(unavailable(format!("model bundle: {MANIFEST}: geometry.{what}")));
        if self.file.is_empty() || Path::new(&self.file).components().count() != 1 {
            return wrong(format!("file is {:?}; it must be a plain file name", self.file));
        }
        if self.sha256.len() != 64 || !self.sha256.bytes().all(|b| b.is_ascii_hexdigit()) {
            return wrong(format!("sha256 is {:?}; it must be 64 hex digits", self.sha256));
        }
        let bad = |side: &u32| !(1..=BUCKET_SIDE_MAX).contains(side);
        if self.buckets.is_empty() || self.buckets.iter().flatten().any(bad) {
            return wrong(format!(
                "buckets is {:?}; it must hold [height, width] pairs of 1 to {BUCKET_SIDE_MAX}",
                self.buckets
            ));
        }
        if self.views_min < 1 || self.views_max < self.views_min || self.views_max < 2 {
            return wrong(format!(
                "views_min {} and views_max {} must be in order, and views_max at least 2",
                self.views_min, self.views_max
            ));
        }
        if self.neighbors_max < 1 {
            return wrong("neighbors_max is 0; it must be at least 1".to_owned());
        }
        if self.sh_degree > 3 {
            return wrong(format!("sh_degree is {}; it must be 0 to 3", self.sh_degree));
        }
        if self.std.iter().any(|v| v.is_nan() || *v <= 0.0) || self.mean.iter().any(|v| v.is_nan())
        {
            return wrong("mean must be numbers and std numbers over 0".to_owned());
        }
        Ok(())
    }
}

fn search_places() -> Vec<PathBuf> {
    let beside = std::env::current_exe().ok().and_then(|exe| Some(exe.parent()?.join(EMBEDDED)));
    beside.into_iter().chain([PathBuf::from(EMBEDDED)]).collect()
}

/// Streams a file through sha256; lower-case hex.
pub(super) fn sha256_of(path: &Path) -> std::io::Result<String> {
    let mut file = fs_err::File::open(path)?;
    let mut hasher = Sha256::new();
    let mut chunk = vec![0_u8; 1 << 16];
    loop {
        let read = file.read(&mut chunk)?;
        if read == 0 {
            break;
        }
        hasher.update(&chunk[..read]);
    }
    Ok(hex(&hasher.finalize()))
}

fn hex_of(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn unavailable(message: String) -> Error {
    Error::new(ErrorCode::ModelUnavailable, message)
}

fn missing(file: &str, cause: std::io::Error) -> Error {
    unavailable(format!(
        "model bundle: {file} cannot be read ({}); the bundle is part of the repository: restore \
         it (`git checkout -- {EMBEDDED}`), run `{SETUP_COMMAND}`, or name another with --bundle",
        cause.kind()
    ))
    .caused_by(cause)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fixture(change: impl Fn(String) -> String) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let from = Path::new("tests/fixtures/plane");
        let text = std::fs::read_to_string(from.join(MANIFEST)).unwrap();
        std::fs::write(dir.path().join(MANIFEST), change(text)).unwrap();
        std::fs::copy(from.join("plane.onnx"), dir.path().join("plane.onnx")).unwrap();
        dir
    }

    #[test]
    fn a_whole_bundle_opens() {
        let dir = fixture(|text| text);
        let bundle = Bundle::open(dir.path()).unwrap();
        assert_eq!(bundle.geometry().file, "plane.onnx", "the manifest's file");
        assert!(bundle.geometry_size_bytes() > 100, "the file has a size");
    }

    #[test]
    fn a_changed_file_is_refused_by_name_and_both_hashes() {
        let dir = fixture(|text| text);
        let path = dir.path().join("plane.onnx");
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[20] ^= 1;
        std::fs::write(&path, &bytes).unwrap();
        let error = Bundle::open(dir.path()).unwrap_err();
        assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
        let wanted = toml::from_str::<BundleManifest>(
            &std::fs::read_to_string(dir.path().join(MANIFEST)).unwrap(),
        )
        .unwrap()
        .geometry
        .sha256;
        let found = sha256_of(&path).unwrap();
        for part in ["plane.onnx", &wanted, &found] {
            assert!(error.message().contains(part), "{part} is not in: {error}");
        }
    }

    #[test]
    fn a_missing_file_and_a_missing_manifest_say_which() {
        let dir = fixture(|text| text);
        std::fs::remove_file(dir.path().join("plane.onnx")).unwrap();
        let error = Bundle::open(dir.path()).unwrap_err();
        assert!(error.message().contains("plane.onnx cannot be read"), "{error}");
        std::fs::remove_file(dir.path().join(MANIFEST)).unwrap();
        let error = Bundle::open(dir.path()).unwrap_err();
        assert!(error.message().contains("bundle.toml cannot be read"), "{error}");
    }

    #[test]
    fn a_malformed_manifest_names_the_field() {
        for (from, to, named) in [
            ("sh_degree = 0", "sh_degree = 4", "geometry.sh_degree is 4"),
            ("file = \"plane.onnx\"", "file = \"../plane.onnx\"", "plain file name"),
            ("views_max = 8", "views_max = 1", "views_max"),
            ("std = [1.0, 1.0, 1.0]", "std = [1.0, 0.0, 1.0]", "std"),
            ("[32, 32]", "[32, 0]", "buckets"),
            ("sh_degree = 0", "colour = 1\nsh_degree = 0", "unknown field"),
        ] {
            let dir = fixture(|text| {
                assert!(text.contains(from), "the fixture has no {from:?}");
                text.replace(from, to)
            });
            let error = Bundle::open(dir.path()).unwrap_err();
            assert!(error.message().contains(named), "{to}: {error}");
        }
    }
}
