//! The committed Rust of `proto/generated` is what the files of `proto` compile to.

use std::fs;

use prost::Message;

use crate::common::root;

/// `UPDATE_DOCS=1 cargo test --test it proto` writes the files after a change of the proto.
#[test]
fn generated_code_is_that_of_the_proto_files() {
    let made = tempfile::tempdir().unwrap();
    let proto = root().join("proto");
    let files = ["segsplat/v1/scene.proto", "inference/open_inference_grpc.proto"];
    let descriptors = protox::compile(files, [&proto]).unwrap();
    fs::write(made.path().join("descriptors.bin"), descriptors.encode_to_vec()).unwrap();
    let mut client = descriptors.clone();
    client.file.retain(|file| file.package() == "segsplat.v1");
    for file in &mut client.file {
        file.source_code_info = None; // the comments
    }
    fs::write(made.path().join("client.bin"), client.encode_to_vec()).unwrap();
    tonic_prost_build::configure()
        .bytes(".")
        .out_dir(made.path())
        .compile_fds(descriptors)
        .unwrap();
    let generated = |name| (name, proto.join("generated").join(name));
    let client = root().join("clients/python/src/segsplat/descriptors.bin");
    for (name, kept) in ["descriptors.bin", "segsplat.v1.rs", "inference.rs"]
        .map(generated)
        .into_iter()
        .chain([("client.bin", client)])
    {
        let new = made.path().join(name);
        if std::env::var_os("UPDATE_DOCS").is_some() {
            fs::copy(&new, &kept).unwrap();
        }
        let same = fs::read(&new).unwrap() == fs::read(&kept).unwrap_or_default();
        assert!(
            same,
            "{} differs from the files of proto: UPDATE_DOCS=1 writes it",
            kept.display()
        );
    }
}
