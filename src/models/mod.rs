//! The networks: a bundle with its manifest, ONNX Runtime, a pool of sessions, one adapter each.
//!
//! In: photos with cameras, depth ranges and neighbours. Out: [`ViewGaussians`]. A network is
//! known only by its `bundle.toml`: names, sizes, normalisation and frames all come from there.
//! The only module that knows `ort`.
//!
//! [`ViewGaussians`]: crate::scene::ViewGaussians

mod bundle;
mod fit;
mod frame;
mod geometry;
mod pool;
mod runtime;

pub use bundle::{Bundle, GeometryManifest, OutputFrame, Translation};
pub use fit::{FittedPhoto, bucket_for, fit};
pub use frame::ModelFrame;
pub use geometry::{Geometry, GeometryInput};
pub use runtime::{Provider, Runtime, SETUP_COMMAND};
