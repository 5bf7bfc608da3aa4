//! photos: under construction.

pub use crate::scene::{Upload, UploadCameras as Cameras, UploadFile};
