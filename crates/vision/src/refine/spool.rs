//! Photos on disk, decoded and at the size at which they are learnt: what the steps stream of
//! hundreds of photos.

use std::{
    fs::File,
    io::{Read, Seek, SeekFrom, Write},
    path::Path,
    sync::Arc,
};

use parking_lot::Mutex;
use segsplat_render::train::PhotoSource;

use super::half::halved;
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Camera, Photo, PosedPhoto},
};

/// Photos on disk and where they were taken from. The file goes with the last who has it.
#[derive(Debug)]
pub struct PhotoSpool {
    files: Vec<String>,
    cameras: Vec<Camera>,
    /// Where each begins, whether some of its pixels are not valid, and where the last one ends.
    places: Vec<(u64, bool)>,
    end: u64,
    /// RGB of each photo, `[H * W * 3]`, then a byte a pixel where some are not valid.
    file: Mutex<File>,
}

impl PhotoSpool {
    /// An empty one, whose file is in this folder, or where the system keeps such files.
    ///
    /// # Errors
    /// `store_unavailable` where no file can be made.
    pub fn new(dir: Option<&Path>) -> Result<Self> {
        let made = dir.map_or_else(tempfile::tempfile, tempfile::tempfile_in);
        let file = Mutex::new(made.map_err(|e| unavailable("photos cannot be kept").caused_by(e))?);
        let (files, cameras, places) = (Vec::new(), Vec::new(), Vec::new());
        Ok(Self { files, cameras, places, end: 0, file })
    }

    /// Puts a photo behind the others.
    ///
    /// # Errors
    /// `store_unavailable` where the disk has no room.
    pub fn push(&mut self, posed: &PosedPhoto) -> Result<()> {
        let PosedPhoto { file: name, photo, camera, .. } = posed;
        let valid = photo.valid.as_ref();
        let valid: Option<Vec<u8>> = valid.map(|all| all.iter().map(|&v| v.into()).collect());
        let file = self.file.get_mut();
        let put = file.seek(SeekFrom::Start(self.end)).and_then(|_| {
            file.write_all(&photo.rgb)?;
            let valid = valid.as_deref().unwrap_or_default();
            file.write_all(valid)
        });
        put.map_err(|e| unavailable("a photo cannot be kept").caused_by(e))?;
        self.files.push(name.clone());
        self.cameras.push(*camera);
        self.places.push((self.end, valid.is_some()));
        self.end += (photo.rgb.len() + valid.map_or(0, |valid| valid.len())) as u64;
        Ok(())
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.cameras.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// Their cameras, of the size that they have here.
    #[must_use]
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// A photo with its camera.
    ///
    /// # Errors
    /// As [`PhotoSource::photo`].
    pub fn posed(&self, number: usize) -> Result<PosedPhoto> {
        let (photo, camera) = (self.photo(number)?, self.cameras[number]);
        let file = self.files[number].clone();
        Ok(PosedPhoto { file, photo, camera, intrinsics_made_for: None })
    }
}

/// Photos on disk, and which of them are learnt.
#[derive(Clone, Debug)]
pub struct MorePhotos {
    /// All.
    pub spool: Arc<PhotoSpool>,
    /// Numbers of those that are learnt, ascending.
    pub numbers: Vec<usize>,
}

impl MorePhotos {
    /// All of them are learnt; none where there are none.
    #[must_use]
    pub fn of(spool: PhotoSpool) -> Option<Self> {
        let (numbers, spool) = ((0..spool.len()).collect(), Arc::new(spool));
        (!spool.is_empty()).then_some(Self { spool, numbers })
    }

    /// Files of those that are not learnt.
    pub fn left_out(&self) -> impl Iterator<Item = &str> {
        let files = self.spool.files.iter().enumerate();
        files.filter(|(i, _)| !self.numbers.contains(i)).map(|(_, file)| &**file)
    }

    /// Cameras of those that are learnt.
    pub(super) fn cameras(&self) -> impl Iterator<Item = &Camera> {
        self.numbers.iter().map(|&number| &self.spool.cameras[number])
    }
}

impl PhotoSource for PhotoSpool {
    fn photo(&self, number: usize) -> Result<Photo> {
        let place = self.cameras.get(number).zip(self.places.get(number));
        let absent = || Error::internal(format!("there is no photo {number} on disk"));
        let (camera, &(at, has_invalid)) = place.ok_or_else(absent)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let pixels = width as usize * height as usize;
        let mut rgb = vec![0; 3 * pixels];
        let mut valid = vec![0; if has_invalid { pixels } else { 0 }];
        let mut file = self.file.lock();
        let read = file.seek(SeekFrom::Start(at)).and_then(|_| {
            file.read_exact(&mut rgb)?;
            file.read_exact(&mut valid)
        });
        read.map_err(|e| unavailable("a photo cannot be read again").caused_by(e))?;
        let valid = has_invalid.then(|| valid.iter().map(|&v| v != 0).collect());
        Ok(Photo { width, height, rgb, valid })
    }
}

/// The photos of a spool at half their size.
#[derive(Debug)]
pub(super) struct Halved(pub(super) Arc<PhotoSpool>);

impl PhotoSource for Halved {
    fn photo(&self, number: usize) -> Result<Photo> {
        Ok(halved(&self.0.photo(number)?))
    }
}

fn unavailable(what: &str) -> Error {
    Error::new(ErrorCode::StoreUnavailable, format!("{what} on disk while they are learnt"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{CameraToWorld, Intrinsics};

    #[test]
    fn photos_come_back_as_they_were_put_in_any_order() {
        let pose = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let photo = |width: u32, height: u32, first: u8, holes: bool| {
            let pixels = (width * height) as usize;
            let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width, height };
            let rgb = (0..3 * pixels).map(|i| first.wrapping_add(i as u8)).collect();
            let valid = holes.then(|| (0..pixels).map(|i| i % 5 != 1).collect());
            let camera = Camera { intrinsics, camera_to_world };
            let photo = Photo { width, height, rgb, valid };
            PosedPhoto { file: String::new(), photo, camera, intrinsics_made_for: None }
        };
        let all = [photo(5, 3, 7, false), photo(4, 4, 90, true), photo(2, 7, 1, false)];
        let folder = tempfile::tempdir().unwrap();
        let mut spool = PhotoSpool::new(Some(folder.path())).unwrap();
        all.iter().for_each(|posed| spool.push(posed).unwrap());
        assert_eq!((spool.len(), spool.is_empty()), (3, false));
        for i in [2, 0, 1, 1, 2] {
            let (got, put) = (spool.photo(i).unwrap(), &all[i].photo);
            assert_eq!((got.width, got.height), (put.width, put.height));
            assert_eq!((got.rgb, &got.valid), (put.rgb.clone(), &put.valid), "photo {i}");
        }
        assert!(spool.photo(3).is_err());
        let half = Halved(Arc::new(spool)).photo(1).unwrap();
        assert_eq!((half.width, half.valid), (2, Some(vec![false, false, true, false])));
        assert_eq!(folder.path().read_dir().unwrap().count(), 0, "nobody else sees the file");
    }
}
