//! The points of a folder: centres of the Gaussians that cover most.

use glam::DVec3;

use crate::{
    packed::largest_first,
    scene::{SH_C0, Scene},
};

/// A point of a scene.
pub(crate) struct FolderPoint {
    /// World frame of the capture.
    pub(crate) at: DVec3,
    /// sRGB.
    pub(crate) color: [u8; 3],
    /// The photo whose pixel it is; none in a scene without photos.
    pub(crate) photo: Option<usize>,
}

/// At most `max` points, those that cover most first: opacity times the product of the two larger
/// scales.
pub(crate) fn points(scene: &Scene, max: usize) -> Vec<FolderPoint> {
    let (gaussians, meta) = (&scene.gaussians, &scene.meta);
    let of_photos = meta.report.file_format.is_none();
    let point = |i: usize| {
        let photo = usize::from(gaussians.source()[i].view);
        FolderPoint {
            at: gaussians.origin() + DVec3::from_array(gaussians.means()[i].map(f64::from)),
            color: gaussians.sh()[i * gaussians.sh_count()]
                .map(|c| (255.0 * (SH_C0 * c + 0.5).clamp(0.0, 1.0)).round() as u8),
            photo: (of_photos && photo < meta.cameras.len()).then_some(photo),
        }
    };
    largest_first(gaussians).into_iter().take(max).map(point).collect()
}
