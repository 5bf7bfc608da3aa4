//! Photos that a trainer does not keep: the pixels of one are there while a step learns it, so that
//! hundreds of photos take the memory of one.

use std::{fmt, sync::Arc};

use crate::{
    RenderRequest,
    error::{Error, Result},
    scene::Photo,
};

/// Where the pixels of photos are until a step needs them.
pub trait PhotoSource: fmt::Debug + Send + Sync {
    /// The pixels of the photo of this number, each time the same.
    ///
    /// # Errors
    /// `internal` where they cannot be read.
    fn photo(&self, number: usize) -> Result<Photo>;
}

/// A photo to learn from that is read for each of its steps.
#[derive(Clone, Debug)]
pub struct StreamedPhoto {
    /// Where its pixels are.
    pub source: Arc<dyn PhotoSource>,
    /// Its number there.
    pub number: usize,
    /// The view of the scene that should look like it, of the same size.
    pub request: RenderRequest,
    /// Number of its camera, as of a [`super::TrainingPhoto`].
    pub pose: usize,
}

impl StreamedPhoto {
    /// Pixels that its view has.
    pub(crate) fn pixels(&self) -> u64 {
        let lens = self.request.lens();
        u64::from(lens.width) * u64::from(lens.height)
    }

    /// Its pixels.
    ///
    /// # Errors
    /// Those of its source; `internal` for a photo of another size than its view.
    pub(crate) fn read(&self) -> Result<Photo> {
        let photo = self.source.photo(self.number)?;
        let lens = self.request.lens();
        let (has, shown) = ([photo.width, photo.height], [lens.width, lens.height]);
        match has == shown {
            true => Ok(photo),
            false => Err(Error::internal(format!("training: a photo of {has:?}, not {shown:?}"))),
        }
    }
}
