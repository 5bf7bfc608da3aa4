//! Standard 3DGS PLY, out and in, with `semantic_index` as one more attribute.
//!
//! Per vertex: `x y z nx ny nz f_dc_0..2 f_rest_0..3(K-1) opacity scale_0..2 rot_0..3`, all
//! little-endian f32, then `ushort semantic_index`. Scales are natural logarithms, opacity is a
//! logit, `rot` is wxyz, `f_rest` is channel-major: all red coefficients, then green, then blue.
//! After the last vertex comes the container of the semantics, where they are made: the bank, the
//! rows of the masks, the index maps. A comment says how many bytes it has. Readers of PLY stop at
//! the last vertex.
//!
//! The compressed PLY of `PlayCanvas` and `SuperSplat` is read here too: see `packed_ply`.
//!
//! Positions are world coordinates. Where the step of f32 is too coarse for the scene, `x y z` are
//! `double`, and a comment says so.
//!
//! The mode of the renderer is a comment: `SplatRenderMode: mip` is written, `antialiased 1` is
//! read too. Files of nearly Gaussians are read: colours as `red green blue` instead of harmonics,
//! one or two scales instead of three, and what is missing as viewers have it (opacity 1, scales of
//! 0.01, not turned).

mod read;
mod write;

pub use self::read::{COMPRESSED_PLY, PLY};
