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
    error::{Error, Result},
    models::{
        NetworkOptions, SETUP_COMMAND,
        manifest::{GeometryManifest, ImageTextManifest, MANIFEST, MasksManifest, unavailable},
        places,
    },
};

/// Where the bundle that ships with the server lies in one of [`places::folders`].
const EMBEDDED: &str = "models/embedded";
/// Largest manifest read, bytes.
const MANIFEST_BYTES_MAX: u64 = 1 << 20;

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
    masks: Option<MasksManifest>,
    image_text: Option<ImageTextManifest>,
}

/// A file that the manifest names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BundleFile<'a> {
    /// What it is for: `geometry`, `geometry.cpu`, `masks.encoder`, `masks.decoder`,
    /// `image_text.image`, `image_text.text`, `image_text.tokenizer`.
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
        if let Some(masks) = &manifest.masks {
            masks.validate()?;
        }
        if let Some(image_text) = &manifest.image_text {
            image_text.validate()?;
        }
        Ok(Self { dir: dir.to_owned(), sha256: hex(&Sha256::digest(&text)), manifest })
    }

    /// Checks every file's sha256 again.
    ///
    /// # Errors
    /// `model_unavailable`, naming the file and both hashes.
    pub fn verify(&self) -> Result<()> {
        for BundleFile { file, sha256, .. } in self.files() {
            let found = sha256_of(&self.path(file)).map_err(|e| missing(file, e))?;
            if found != sha256.to_lowercase() {
                return Err(unavailable(format!(
                    "model bundle: {file} is not the file of {MANIFEST}: sha256 {found}, not \
                     {sha256}; restore it (`git checkout -- {EMBEDDED}`)"
                )));
            }
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
    pub fn files(&self) -> Vec<BundleFile<'_>> {
        let BundleManifest { geometry, masks, image_text, .. } = &self.manifest;
        let mut files = vec![BundleFile {
            part: "geometry",
            file: &geometry.file,
            sha256: &geometry.sha256,
            licence: &geometry.licence,
        }];
        if let Some(cpu) = &geometry.cpu {
            files.push(BundleFile {
                part: "geometry.cpu",
                file: &cpu.file,
                sha256: &cpu.sha256,
                licence: &geometry.licence,
            });
        }
        if let Some(MasksManifest { encoder, decoder, licence, .. }) = masks {
            let entry = |part, file, sha256| BundleFile { part, file, sha256, licence };
            files.push(entry("masks.encoder", &encoder.file, &encoder.sha256));
            files.push(entry("masks.decoder", &decoder.file, &decoder.sha256));
        }
        if let Some(ImageTextManifest { image, text, licence, .. }) = image_text {
            let entry = |part, file, sha256| BundleFile { part, file, sha256, licence };
            files.push(entry("image_text.image", &image.file, &image.sha256));
            files.push(entry("image_text.text", &text.file, &text.sha256));
            files.push(entry("image_text.tokenizer", &text.tokenizer, &text.tokenizer_sha256));
        }
        files
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

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

fn missing(file: &str, cause: std::io::Error) -> Error {
    unavailable(format!(
        "model bundle: {file} cannot be read ({}); the bundle is part of the repository: restore \
         it (`git checkout -- {EMBEDDED}`), run `{SETUP_COMMAND}`, or name another with --bundle",
        cause.kind()
    ))
    .caused_by(cause)
}
