//! What a folder is made of: the scene, and what gives its photos and draws its views.

use crate::{error::Result, rle::Rle, scene::Scene};

/// What a folder says, beside pixels.
#[derive(Clone, Copy, Debug)]
pub struct FolderContents<'a> {
    /// The scene, with its cameras.
    pub scene: &'a Scene,
    /// The texts of the masks.
    pub texts: &'a [String],
    /// Points that it may have.
    pub points_max: usize,
}

/// The pixels of a folder. Photos have the numbers of the scene's cameras.
pub trait FolderPixels {
    /// Hands on the photos that are there, each once, in their order.
    ///
    /// # Errors
    /// Those of `put`, and `photo_unreadable`.
    fn photos(&mut self, put: &mut PutPhoto<'_>) -> Result<()>;

    /// `[H * W]` depth at the size of the photo, world units, 0 where nothing is.
    ///
    /// # Errors
    /// Where it cannot be drawn.
    fn depth(&mut self, photo: usize) -> Result<Vec<f32>>;

    /// What each text selects in a photo.
    ///
    /// # Errors
    /// Where it cannot be drawn.
    fn masks(&mut self, photo: usize) -> Result<Vec<FolderMask>>;
}

/// Takes the file of a photo.
pub type PutPhoto<'a> = dyn FnMut(usize, PhotoFile<'_>) -> Result<()> + 'a;

/// The file of a photo.
#[derive(Debug)]
pub enum PhotoFile<'a> {
    /// As it was sent.
    Sent(&'a [u8]),
    /// A PNG: the pixels of the scene are others than those that were sent.
    Png(Vec<u8>),
}

/// What a text selects in a photo.
#[derive(Clone, Debug)]
pub struct FolderMask {
    /// Its pixels.
    pub mask: Option<Rle>,
    /// How many there are.
    pub area: u64,
    /// Left, top, width and height, where there is one.
    pub bbox: Option<[u32; 4]>,
}
