//! Files of other programs, and our own: what reads one stands beside what writes it. No threads
//! of its own, no network, no clock; of disks only a capture's folder is read.
//!
//! | module | what |
//! |---|---|
//! | [`table`] | all formats that scenes are exported in |
//! | [`splats`] | Gaussians: PLY, compressed PLY, SPZ, SOG, GLB, `.splat`, in and out |
//! | [`captures`] | photos and cameras of any layout, in: which photo has which lens and pose |
//! | [`folders`] | a scene as a zip of a folder, out: COLMAP, nerfstudio, COCO, `LabelMe` |
//! | [`container`] | our own files: a scene, its semantics |
//! | [`packed`] | a scene as the page draws it |
//! | [`npy`], [`npz`], [`rle`] | arrays of `NumPy`, masks of COCO |

pub mod captures;
mod colmap;
pub mod container;
pub mod folders;
pub mod npy;
pub mod npz;
pub mod packed;
pub mod rle;
pub mod splats;
pub mod table;

use segsplat_core::{error, limits, names, scene};
