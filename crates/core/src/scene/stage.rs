//! The stages of a job, in order: the one list behind progress, reports and metrics.

use std::{
    fmt,
    sync::atomic::{AtomicBool, Ordering},
};

use crate::error::{Error, ErrorCode, Result};

/// A stage of making a scene, of making its semantics, or of refining it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// The upload is read: undistorted photos with cameras, or the Gaussians of a file.
    Photos,
    /// The cameras of photos that came without.
    Cameras,
    /// Depth ranges, overlap and diagnosis from the photos themselves.
    Capture,
    /// The geometry network.
    Geometry,
    /// One scene out of what the network says of each photo.
    Lift,
    /// The scene goes to the store.
    Store,
    /// The mask network, photo by photo.
    Masks,
    /// The image tower on a crop of each mask.
    Embed,
    /// K-Means over the embeddings.
    Bank,
    /// An index for each Gaussian.
    Assign,
    /// Gradient steps of a finished scene.
    Refine,
}

impl Stage {
    /// Stages of a scene, in order.
    pub const SCENE: [Self; 6] =
        [Self::Photos, Self::Cameras, Self::Capture, Self::Geometry, Self::Lift, Self::Store];

    /// Stages of the semantics of a scene, in order.
    pub const SEMANTICS: [Self; 4] = [Self::Masks, Self::Embed, Self::Bank, Self::Assign];

    /// Name in events, reports and metrics.
    pub const fn name(self) -> &'static str {
        self.row().0
    }

    /// Share of the whole job that is done when `fraction` of this stage is, both 0..1.
    pub fn overall(self, fraction: f32) -> f32 {
        let (_, [from, to]) = self.row();
        from + (to - from) * fraction.clamp(0.0, 1.0)
    }

    /// Name, and where the stage begins and ends in its job. Most time goes to the networks.
    const fn row(self) -> (&'static str, [f32; 2]) {
        match self {
            Self::Photos => ("photos", [0.0, 0.1]),
            Self::Cameras => ("cameras", [0.1, 0.25]),
            Self::Capture => ("capture", [0.25, 0.3]),
            Self::Geometry => ("geometry", [0.3, 0.9]),
            Self::Lift => ("lift", [0.9, 0.97]),
            Self::Store => ("store", [0.97, 1.0]),
            Self::Masks => ("masks", [0.0, 0.6]),
            Self::Embed => ("embed", [0.6, 0.95]),
            Self::Bank => ("bank", [0.95, 0.98]),
            Self::Assign => ("assign", [0.98, 1.0]),
            Self::Refine => ("refine", [0.0, 1.0]),
        }
    }
}

/// How a job tells where it is, and learns that it is to stop.
#[derive(Clone, Copy)]
pub struct Watch<'a> {
    /// Gets each stage with the share of that stage that is done, 0..1.
    pub progress: &'a (dyn Fn(Stage, f32) + Sync),
    /// Turns true when the job is to stop.
    pub cancel: &'a AtomicBool,
}

impl fmt::Debug for Watch<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watch").field("cancel", self.cancel).finish_non_exhaustive()
    }
}

/// Ends work that is to stop; loops of stages ask it at each step.
///
/// # Errors
/// `cancelled`.
pub fn unless_cancelled(cancel: &AtomicBool) -> Result<()> {
    if cancel.load(Ordering::Relaxed) {
        return Err(Error::new(ErrorCode::Cancelled, "the job was cancelled"));
    }
    Ok(())
}
