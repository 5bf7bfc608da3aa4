//! The networks: a bundle with its manifest, ONNX Runtime, sessions, one adapter for each network.
//!
//! [`Geometry`]: photos with cameras, depth ranges and neighbours to [`ViewGaussians`].
//! [`MaskNetwork`]: a photo and points in it to masks. [`ImageText`]: crops and texts to embeddings
//! of one space. [`TextMaskNetwork`]: a photo and a text to masks. [`FeatureNetwork`]: a photo to
//! keypoints and descriptors. [`MatcherNetwork`]: those of two photos to matches.
//! [`CameraNetwork`]: photos to a guess of their cameras. A network is known only by its
//! `bundle.toml`: names, sizes, normalisation and frames all come from there. The only module that
//! knows `ort`.
//!
//! [`ViewGaussians`]: crate::scene::ViewGaussians

mod bundle;
mod cameras;
mod check;
mod correlate;
mod features;
mod fit;
mod frame;
mod geometry;
mod image_text;
mod manifest;
mod masks;
mod matcher;
mod network;
mod onnx;
mod options;
mod places;
mod resize;
mod runtime;
mod tensors;
mod text_masks;

pub use bundle::{Bundle, BundleFile};
pub use cameras::CameraNetwork;
pub use check::{BundleCheck, CheckedFile, check};
pub use features::{FeatureNetwork, PhotoFeatures};
pub use fit::{FittedPhoto, bucket_for, fit};
pub use frame::ModelFrame;
pub use geometry::{Geometry, GeometryInput};
pub use image_text::{ImageText, PreparedCrops};
pub use manifest::{
    CamerasManifest, DenseManifest, FeaturesManifest, GeometryManifest, GeometryWeights,
    ImageTextManifest, ImageTowerManifest, MaskAdapter, MaskDecoderManifest, MaskEncoderManifest,
    MasksManifest, MatcherManifest, OutputFrame, PlainFile, TextMasksFindManifest,
    TextMasksImageManifest, TextMasksManifest, TextTowerManifest, Translation,
};
pub use masks::{MaskNetwork, PhotoEmbedding};
pub use matcher::{MatcherNetwork, SureMatch};
pub use network::Network;
pub use options::{NetworkOptions, ProviderChoice, SETUP_COMMAND};
pub use resize::ResizeFilter;
pub use runtime::{Provider, Runtime};
pub use tensors::{NetworkTensors, Tensor, TensorData, TensorKind, TensorSpec};
pub use text_masks::{EncodedPhoto, TextMaskNetwork};
