//! Hashes over canonical bytes: two uploads, or two requests, are the same where these are equal.
//!
//! Nothing here reads the `Debug` text of a type: renaming a field must not change a kept hash.

use std::collections::BTreeMap;

use serde_json::Value;
use sha2::{Digest, Sha256};

use crate::{
    names::hex,
    scene::{Density, PhotoHash, Provenance, SceneOptions, SemanticsMode},
};

/// sha256 over files and options, hex: what an idempotency key stands for.
pub fn request_sha256(files: &[PhotoHash], options: &SceneOptions) -> String {
    sha256_of_files(files, &canonical(options))
}

/// What a scene is made of: photos and cameras in their order, options, and the networks by the
/// sha256 of their bundle (hex; empty where none is used), with the hash over all of it.
pub fn provenance(files: Vec<PhotoHash>, options: &SceneOptions, networks: &str) -> Provenance {
    let program_version = env!("CARGO_PKG_VERSION").to_owned();
    let rest = format!("{} {networks} {program_version}", canonical(options));
    Provenance {
        content_sha256: sha256_of_files(&files, &rest),
        files,
        bundle_sha256: networks.to_owned(),
        options: options.clone(),
        program_version,
    }
}

/// Whether a kept hash is that of this request, also where an earlier program wrote it.
pub(crate) fn is_of_request(kept: &str, files: &[PhotoHash], options: &SceneOptions) -> bool {
    kept == request_sha256(files, options)
        || kept == sha256_of_files(files, &before_canonical(options))
}

fn sha256_of_files(files: &[PhotoHash], rest: &str) -> String {
    let mut hash = Sha256::new();
    for file in files {
        // The length of the name first, so that no two lists of files read the same.
        hash.update((file.file.len() as u64).to_le_bytes());
        hash.update(&file.file);
        hash.update(&file.sha256);
    }
    hash.update(rest);
    hex(&hash.finalize())
}

/// The options and the fields of the method that differ from the defaults, as JSON sorted by name:
/// an option that a later program adds changes no hash of a request that does not use it.
fn canonical(options: &SceneOptions) -> String {
    let fields = |options: &SceneOptions| {
        let values = [serde_json::to_value(options), serde_json::to_value(options.method())];
        let objects = values.into_iter().filter_map(|value| match value {
            Ok(Value::Object(fields)) => Some(fields),
            _ => None,
        });
        objects.flatten().collect::<BTreeMap<String, Value>>()
    };
    let default = fields(&SceneOptions::default());
    let mut set = fields(options);
    set.retain(|name, value| default.get(name) != Some(value));
    Value::Object(set.into_iter().collect()).to_string()
}

/// The text that was hashed for the options before [`canonical`] was. An option that no such
/// program had is left out.
fn before_canonical(options: &SceneOptions) -> String {
    let SceneOptions { max_views, semantics, density, .. } = options;
    let semantics = match semantics {
        SemanticsMode::Lazy => "Lazy",
        SemanticsMode::Eager => "Eager",
        SemanticsMode::Off => "Off",
    };
    let density = match density.unwrap_or_default() {
        Density::Thinned => "Thinned",
        Density::Full => "Full",
    };
    let max_views = max_views.map_or("None".to_owned(), |views| format!("Some({views})"));
    format!("SceneOptions {{ max_views: {max_views}, semantics: {semantics}, density: {density} }}")
}
