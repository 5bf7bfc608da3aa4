//! A bundle: a folder with `bundle.toml` and the files it names, each checked by sha256.
//!
//! `models/README.md` documents the manifest. A bundle that differs from it is refused with what
//! differs: the file, and both hashes.

use std::{
    io::Read,
    ops::RangeInclusive,
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use serde::{Deserialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};

use crate::{
    error::{Error, Result},
    models::{
        NetworkOptions, SETUP_COMMAND,
        manifest::{
            CamerasManifest, Faults, FeaturesManifest, Files, GeometryManifest, ImageTextManifest,
            MANIFEST, MasksManifest, MatcherManifest, TextMasksManifest, is_plain, unavailable,
        },
        onnx::OnnxHeader,
        places,
    },
    names::hex,
};

/// Where the bundle that ships with the server lies in one of [`places::folders`].
const EMBEDDED: &str = "models/embedded";
/// Largest manifest read, bytes.
const MANIFEST_BYTES_MAX: u64 = 1 << 20;
/// Largest file of a bundle, bytes: eight times Segment Anything's ViT-H.
const FILE_BYTES_MAX: u64 = 20 << 30;
/// Versions of ONNX's operators that the pinned ONNX Runtime takes.
const OPSETS: RangeInclusive<u64> = 7..=26;
/// Ending of a network's file.
const NETWORK: &str = ".onnx";

/// A bundle whose files are those of its manifest.
#[derive(Clone, Debug)]
pub struct Bundle {
    dir: PathBuf,
    sha256: String,
    manifest: BundleManifest,
    /// The file of measured words, once it was asked for.
    words: Arc<OnceLock<Vec<u8>>>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BundleManifest {
    name: String,
    version: String,
    geometry: GeometryManifest,
    masks: Option<MasksManifest>,
    image_text: Option<ImageTextManifest>,
    text_masks: Option<TextMasksManifest>,
    features: Option<FeaturesManifest>,
    matcher: Option<MatcherManifest>,
    cameras: Option<CamerasManifest>,
}

/// A file that the manifest names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BundleFile<'a> {
    /// What it is for: `geometry`, `geometry.cpu`, `geometry.many`, `geometry.many.cpu`,
    /// `masks.encoder`, `masks.decoder`, `image_text.image`, `image_text.text`,
    /// `image_text.tokenizer`, `image_text.words`, `text_masks.image`, `text_masks.find`,
    /// `text_masks.tokenizer`, `features`, `matcher`, `cameras`. A file of weights beside another
    /// has that one's name.
    pub part: &'static str,
    /// Name in the bundle's folder.
    pub file: &'a str,
    /// sha256 of the manifest, hex.
    pub sha256: &'a str,
    /// Licence of the weights.
    pub licence: &'a str,
}

impl Bundle {
    /// The bundle of the configuration, or the one found beside the executable or in the working
    /// folder.
    ///
    /// # Errors
    /// `model_unavailable` as [`Self::open`]; none found names every place looked at.
    pub fn find(options: &NetworkOptions) -> Result<Self> {
        Self::named(options)?.verified()
    }

    /// As [`Self::find`], with no file looked at but the manifest: [`Self::verify`] is still due.
    ///
    /// # Errors
    /// `model_unavailable` when none is found or the manifest is malformed.
    pub fn named(options: &NetworkOptions) -> Result<Self> {
        if let Some(dir) = &options.bundle {
            return Self::read(dir);
        }
        let mut found = places::folders().into_iter().map(|folder| folder.join(EMBEDDED));
        match found.find(|dir| dir.join(MANIFEST).is_file()) {
            Some(dir) => Self::read(&dir),
            None => Err(unavailable(format!(
                "no model bundle: no {EMBEDDED}/{MANIFEST} beside the executable, in \
                 ../share/segsplat, in the checkout that it was built in or in the working folder; \
                 name its folder with --bundle or SEGSPLAT_BUNDLE"
            ))),
        }
    }

    /// Reads the manifest of `dir` and checks every file it names.
    ///
    /// # Errors
    /// `model_unavailable` when the manifest or a file is missing, the manifest is malformed, or a
    /// file's sha256 differs.
    pub fn open(dir: &Path) -> Result<Self> {
        Self::read(dir)?.verified()
    }

    fn verified(self) -> Result<Self> {
        self.verify()?;
        Ok(self)
    }

    fn read(dir: &Path) -> Result<Self> {
        let (bundle, faults) = Self::parse(dir)?;
        if faults.is_empty() {
            return Ok(bundle);
        }
        Err(unavailable(format!("model bundle: {MANIFEST}: {}", faults.join("; and "))))
    }

    /// The manifest, and what in it is out of range.
    pub(super) fn parse(dir: &Path) -> Result<(Self, Vec<String>)> {
        let path = dir.join(MANIFEST);
        let missing = |e| missing(dir, MANIFEST, e);
        let size = fs_err::metadata(&path).map_err(missing)?.len();
        if size > MANIFEST_BYTES_MAX {
            return Err(unavailable(format!(
                "model bundle: {MANIFEST} has {size} bytes, over {MANIFEST_BYTES_MAX}"
            )));
        }
        let text = fs_err::read_to_string(&path).map_err(missing)?;
        let manifest: BundleManifest = toml::from_str(&text)
            .map_err(|e| unavailable(format!("model bundle: {MANIFEST}: {e}")))?;
        let mut faults = Faults::default();
        manifest.geometry.validate(&mut faults);
        if let Some(masks) = &manifest.masks {
            masks.validate(&mut faults);
        }
        if let Some(image_text) = &manifest.image_text {
            image_text.validate(&mut faults);
        }
        if let Some(text_masks) = &manifest.text_masks {
            text_masks.validate(&mut faults);
        }
        if let Some(features) = &manifest.features {
            features.validate(&mut faults);
        }
        if let Some(matcher) = &manifest.matcher {
            matcher.validate(manifest.features.is_some(), &mut faults);
        }
        if let Some(cameras) = &manifest.cameras {
            cameras.validate(manifest.features.is_some(), &mut faults);
        }
        let sha256 = hex(&Sha256::digest(&text));
        let bundle = Self { dir: dir.to_owned(), sha256, manifest, words: Arc::default() };
        Ok((bundle, faults.0))
    }

    /// Checks every file's sha256 again.
    ///
    /// # Errors
    /// `model_unavailable`, naming the file and both hashes.
    pub fn verify(&self) -> Result<()> {
        self.files().iter().try_for_each(|file| self.verify_file(file).map(|_| ()))
    }

    /// Checks the sha256 of a file of [`Self::files`]. A network may keep weights only in files
    /// that the manifest names, since only those were checked.
    pub(super) fn verify_file(&self, file: &BundleFile<'_>) -> Result<Option<OnnxHeader>> {
        let BundleFile { file, sha256, .. } = file;
        let path = self.path(file);
        if !is_plain(file) {
            return Err(unavailable(format!("model bundle: {file:?} is no plain file name")));
        }
        let missing = |e| missing(&self.dir, file, e);
        let size = fs_err::metadata(&path).map_err(missing)?.len();
        if size > FILE_BYTES_MAX {
            return Err(unavailable(format!(
                "model bundle: {file} has {size} bytes, over {FILE_BYTES_MAX}"
            )));
        }
        let found = sha256_of(&path).map_err(missing)?;
        if found != sha256.to_lowercase() {
            return Err(unavailable(format!(
                "model bundle: {file} is not the file of {MANIFEST}: sha256 {found}, not \
                 {sha256}; {}",
                remedy(&self.dir)
            )));
        }
        if !file.ends_with(NETWORK) {
            return Ok(None);
        }
        let header = OnnxHeader::read(&path).map_err(|e| {
            unavailable(format!("model bundle: {file} is no ONNX file: {e}")).caused_by(e)
        })?;
        if header.opset().is_some_and(|opset| !OPSETS.contains(&opset)) {
            let (first, last) = (OPSETS.start(), OPSETS.end());
            return Err(unavailable(format!(
                "model bundle: {file} has opset {}; it must be {first} to {last}",
                header.opset().unwrap_or_default()
            )));
        }
        let named = self.files();
        match header.external.iter().find(|data| named.iter().all(|entry| entry.file != **data)) {
            None => Ok(Some(header)),
            Some(data) => Err(unavailable(format!(
                "model bundle: {file} keeps weights in {data:?}, which {MANIFEST} does not name; \
                 give its `data` and `data_sha256`"
            ))),
        }
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

    /// The mask network's entry; `None`: the bundle has no semantics.
    #[must_use]
    pub fn masks(&self) -> Option<&MasksManifest> {
        self.manifest.masks.as_ref()
    }

    /// The entry of image and text tower; `None`: the bundle has no semantics.
    #[must_use]
    pub fn image_text(&self) -> Option<&ImageTextManifest> {
        self.manifest.image_text.as_ref()
    }

    /// The entry of the network that masks what a text says; `None`: texts are compared with masks.
    #[must_use]
    pub fn text_masks(&self) -> Option<&TextMasksManifest> {
        self.manifest.text_masks.as_ref()
    }

    /// The feature network's entry; `None`: it takes no photos without cameras.
    #[must_use]
    pub fn features(&self) -> Option<&FeaturesManifest> {
        self.manifest.features.as_ref()
    }

    /// The entry of the network that matches keypoints; `None`: they match by their descriptors
    /// alone.
    #[must_use]
    pub fn matcher(&self) -> Option<&MatcherManifest> {
        self.manifest.matcher.as_ref()
    }

    /// The entry of the network that says where photos were taken; `None`: keypoints alone say it.
    #[must_use]
    pub fn cameras(&self) -> Option<&CamerasManifest> {
        self.manifest.cameras.as_ref()
    }

    /// What it lacks for semantics; `None` where nothing.
    #[must_use]
    pub fn lacks_semantics(&self) -> Option<&'static str> {
        match (self.masks(), self.image_text()) {
            (Some(_), Some(_)) => None,
            (None, Some(_)) => Some("no mask network"),
            (Some(_), None) => Some("no image and text towers"),
            (None, None) => Some("no semantic networks"),
        }
    }

    /// Every file that the manifest names, itself left out.
    #[must_use]
    pub fn files<'a>(&'a self) -> Vec<BundleFile<'a>> {
        let BundleManifest { geometry, masks, image_text, text_masks, .. } = &self.manifest;
        let BundleManifest { features, matcher, cameras, .. } = &self.manifest;
        let mut files = Vec::new();
        let mut network = |part, licence: &'a str, ([file, sha256], data): Files<'a>| {
            files.push(BundleFile { part, file, sha256, licence });
            if let [Some(file), Some(sha256)] = data {
                files.push(BundleFile { part, file, sha256, licence });
            }
        };
        let g = geometry;
        network("geometry", &g.licence, g.files());
        if let Some(cpu) = &g.cpu {
            network("geometry.cpu", &g.licence, cpu.files());
        }
        if let Some(many) = &g.many {
            network("geometry.many", &g.licence, ([&many.file, &many.sha256], [&None, &None]));
            if let Some(cpu) = &many.cpu {
                network("geometry.many.cpu", &g.licence, cpu.files());
            }
        }
        if let Some(MasksManifest { encoder: e, decoder: d, licence, .. }) = masks {
            network("masks.encoder", licence, e.files());
            network("masks.decoder", licence, d.files());
        }
        if let Some(image_text) = image_text {
            let ImageTextManifest { image: i, text: t, licence, .. } = image_text;
            network("image_text.image", licence, i.files());
            network("image_text.text", licence, t.files());
            let tokenizer = [&t.tokenizer, &t.tokenizer_sha256];
            network("image_text.tokenizer", licence, (tokenizer, [&None, &None]));
            if let Some(words) = &image_text.words {
                network("image_text.words", licence, words.files());
            }
        }
        if let Some(TextMasksManifest { image: i, find: f, licence, .. }) = text_masks {
            network("text_masks.image", licence, i.files());
            network("text_masks.find", licence, f.files());
            let tokenizer = [&f.tokenizer, &f.tokenizer_sha256];
            network("text_masks.tokenizer", licence, (tokenizer, [&None, &None]));
        }
        if let Some(f) = features {
            network("features", &f.licence, f.files());
        }
        if let Some(m) = matcher {
            network("matcher", &m.licence, m.files());
        }
        if let Some(c) = cameras {
            network("cameras", &c.licence, c.files());
        }
        files
    }

    /// The words that were measured, as rows of any fields; none where the bundle names no such
    /// file. It is read once.
    ///
    /// # Errors
    /// `model_unavailable` when the file cannot be read or lacks a field.
    pub fn words<T: DeserializeOwned>(&self) -> Result<Vec<T>> {
        let Some(named) = self.image_text().and_then(|towers| towers.words.as_ref()) else {
            return Ok(Vec::new());
        };
        let refused = |why: String| unavailable(format!("model bundle: {}: {why}", named.file));
        let bytes = match self.words.get() {
            Some(bytes) => bytes,
            None => {
                let read = fs_err::read(self.path(&named.file));
                let read = read.map_err(|e| refused(e.kind().to_string()))?;
                self.words.get_or_init(|| read)
            }
        };
        serde_json::from_slice(bytes).map_err(|e| refused(e.to_string()))
    }

    /// Bytes of a network: its file and the weights beside it.
    pub(super) fn network_bytes(&self, file: &str) -> u64 {
        let files = self.files();
        let part = files.iter().find(|entry| entry.file == file).map(|entry| entry.part);
        let own = files.iter().filter(|entry| Some(entry.part) == part);
        own.map(|entry| self.size_bytes(entry.file)).sum()
    }

    /// Where a file of [`Self::files`] lies.
    #[must_use]
    pub fn path(&self, file: &str) -> PathBuf {
        self.dir.join(file)
    }

    /// Size in bytes of a file of [`Self::files`]; 0 when it has gone.
    #[must_use]
    pub fn size_bytes(&self, file: &str) -> u64 {
        fs_err::metadata(self.path(file)).map_or(0, |meta| meta.len())
    }
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

fn missing(dir: &Path, file: &str, cause: std::io::Error) -> Error {
    let (kind, remedy) = (cause.kind(), remedy(dir));
    unavailable(format!("model bundle: {file} cannot be read ({kind}); {remedy}")).caused_by(cause)
}

/// What to do about a file of the bundle in `dir` that is not there or is another.
fn remedy(dir: &Path) -> String {
    if dir.ends_with(EMBEDDED) {
        format!(
            "the bundle is part of the repository: restore it (`git checkout -- {EMBEDDED}`), run \
             `{SETUP_COMMAND}`, or name another with --bundle"
        )
    } else {
        format!("put the right file in {}, or name another bundle with --bundle", dir.display())
    }
}
