//! Compiles `proto/` with protox (no protoc needed) and keeps the descriptors for reflection.

use std::{env, error::Error, fs, path::PathBuf};

use prost::Message;

fn main() -> Result<(), Box<dyn Error>> {
    println!("cargo:rerun-if-changed=proto");
    let descriptors = protox::compile(["segsplat/v1/scene.proto"], ["proto"])?;
    let path = PathBuf::from(env::var("OUT_DIR")?).join("segsplat_descriptor.bin");
    fs::write(path, descriptors.encode_to_vec())?;
    tonic_prost_build::configure().bytes(".segsplat.v1").compile_fds(descriptors)?;
    Ok(())
}
