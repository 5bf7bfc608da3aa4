//! What the test files share: where things are, and how a test says that it was skipped.
#![allow(dead_code, reason = "not every build of the tests uses every helper")]

pub(crate) mod cluster;
pub(crate) mod cpu_server;
pub(crate) mod doors;
pub(crate) mod faults;
pub(crate) mod meaning;
pub(crate) mod process;
pub(crate) mod server;

#[allow(unused_imports, reason = "as above")]
pub(crate) use segsplat_testing::{
    compare, opened, root, scenes, shared_data, shared_scene, skipped, strict,
};

/// A client whose TLS has its cryptography.
pub(crate) fn client_builder() -> reqwest::ClientBuilder {
    segsplat::crypto::install();
    reqwest::Client::builder()
}

/// As [`client_builder`] with nothing else set.
pub(crate) fn client() -> reqwest::Client {
    client_builder().build().expect("a client")
}
