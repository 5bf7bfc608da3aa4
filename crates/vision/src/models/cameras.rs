//! The network that says where photos were taken: all of them at once, in a world of its own.
//!
//! What it says is a guess: `segsplat_cameras` begins with it, and keypoints and pixels judge what
//! comes of it as they judge any other solution.

use std::sync::Arc;

use crate::{
    error::{Error, Result},
    models::{
        Bundle, CamerasManifest, NetworkOptions, Provider, Runtime,
        network::{Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted},
        resize::{planes, resize},
    },
    scene::{Camera, CameraToWorld, Intrinsics, Photo},
};

/// Its name in messages.
const CAMERAS: &str = "camera network";
/// Fewest photos of a run: one photo has no place.
const VIEWS_MIN: usize = 2;

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct CameraNetwork {
    manifest: CamerasManifest,
    network: Network,
}

impl CameraNetwork {
    /// Opens the network on the provider of the configuration; `None` where the bundle has none.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there, the file does not load, or has
    /// other tensors than the manifest.
    pub fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let Some(manifest) = bundle.cameras().cloned() else { return Ok(None) };
        let [first, second] = probe(&manifest);
        let spec = Spec {
            what: CAMERAS,
            file: &manifest.file,
            cpu_file: None,
            signature: signature(&manifest),
            memory: RunMemory::GivenBack,
            tolerance: manifest.tolerance,
            probe: &|_| Ok(vec![input(&manifest, &[&first, &second])]),
        };
        let network = Network::open(runtime, bundle, options, &spec)?;
        Ok(Some(Self { manifest, network }))
    }

    /// Looks at two and at three photos, upright and across.
    ///
    /// # Errors
    /// As [`Self::find`].
    pub(super) fn try_out(&self) -> Result<()> {
        let [first, second] = probe(&self.manifest);
        self.find(&[&first, &second])?;
        let turned = Photo { width: first.height, height: first.width, ..first };
        self.find(&[&turned, &turned, &turned]).map(drop)
    }

    /// The network itself.
    #[must_use]
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// What computes it.
    #[must_use]
    pub fn provider(&self) -> Provider {
        self.network.provider()
    }

    /// Why it is not computed where it was to be; `None` where it is.
    #[must_use]
    pub fn remark(&self) -> Option<String> {
        self.network.remark()
    }

    /// What the network says of the cameras of photos, in a world of its own. It sees photos of one
    /// shape together, that of most, and of more than [`CamerasManifest::views_max`] some that are
    /// spread evenly; of the others it says nothing.
    ///
    /// # Errors
    /// `internal` when the network fails, or answers with another shape than its manifest says or
    /// with what is no camera.
    pub fn find(&self, photos: &[&Photo]) -> Result<Vec<Option<Camera>>> {
        let mut found = vec![None; photos.len()];
        let shown = self.shown(photos);
        if shown.len() < VIEWS_MIN {
            return Ok(found);
        }
        let pictures: Vec<&Photo> = shown.iter().map(|&photo| photos[photo]).collect();
        let (input, names) = (input(&self.manifest, &pictures), self.names());
        let read = |outputs: &dyn Outputs| self.read(outputs, &pictures);
        let cameras = self.network.run_for(&[input], &names, read)?;
        for (photo, camera) in shown.into_iter().zip(cameras) {
            found[photo] = Some(camera);
        }
        Ok(found)
    }

    fn names(&self) -> [&str; 2] {
        [&self.manifest.world_to_camera, &self.manifest.intrinsics]
    }

    /// The photos that the network sees, in their order.
    fn shown(&self, photos: &[&Photo]) -> Vec<usize> {
        let shape = |photo: &usize| fitted(&self.manifest, photos[*photo]);
        let all = 0..photos.len();
        let alike =
            |photo: &usize| all.clone().filter(|other| shape(other) == shape(photo)).count();
        let Some(most) = all.clone().rev().max_by_key(alike) else { return Vec::new() };
        let own: Vec<usize> = all.clone().filter(|photo| shape(photo) == shape(&most)).collect();
        let count = own.len().min(self.manifest.views_max);
        let last = count.saturating_sub(1).max(1);
        (0..count).map(|i| own[i * (own.len() - 1) / last]).collect()
    }

    fn read(&self, outputs: &dyn Outputs, photos: &[&Photo]) -> Result<Vec<Camera>> {
        let names @ [world_to_camera, intrinsics] = self.names();
        let views = photos.len();
        let ((of, poses), (sizes, lenses)) =
            (outputs.get(world_to_camera)?, outputs.get(intrinsics)?);
        if of != [views, 3, 4] || sizes != [views, 3, 3] {
            return Err(Error::internal(format!(
                "{CAMERAS}: {names:?} are {of:?} and {sizes:?}, not [{views}, 3, 4] and [{views}, \
                 3, 3]"
            )));
        }
        let (poses, lenses) = (poses.as_chunks::<12>().0, lenses.as_chunks::<9>().0);
        let camera = |view: usize| {
            let size = fitted(&self.manifest, photos[view]);
            camera_of(&poses[view], &lenses[view], size, photos[view]).map_err(|error| {
                let why = error.message();
                Error::internal(format!("{CAMERAS}: view {view} is no camera: {why}"))
            })
        };
        (0..views).map(camera).collect()
    }
}

/// The camera of a photo by rows of world to camera, and by a lens in pixels of `size`.
fn camera_of(pose: &[f32; 12], lens: &[f32; 9], size: [u32; 2], photo: &Photo) -> Result<Camera> {
    let mut rows = [0.0; 16];
    rows.iter_mut().zip(pose).for_each(|(row, value)| *row = f64::from(*value));
    rows[15] = 1.0;
    let world_to_camera = CameraToWorld::from_row_major(&rows, "world_to_camera")?;
    let turn = world_to_camera.rotation().transpose();
    let center = -(turn * world_to_camera.center());
    let [fx, fy, cx, cy] = [0, 4, 2, 5].map(|at| f64::from(lens[at]));
    let [width, height] = size;
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height }.validated("intrinsics")?;
    Ok(Camera {
        intrinsics: intrinsics.resized(photo.width, photo.height),
        camera_to_world: CameraToWorld::from_rotation(turn, center),
    })
}

fn fitted(manifest: &CamerasManifest, photo: &Photo) -> [u32; 2] {
    manifest.fitted([photo.width, photo.height])
}

/// `[V, 3, H, W]`: photos of one shape.
fn input<'a>(manifest: &'a CamerasManifest, photos: &[&Photo]) -> Input<'a> {
    let to =
        photos.first().map_or([0; 2], |photo| fitted(manifest, photo).map(|side| side as usize));
    let picture = |photo: &&Photo| {
        let from = [photo.width, photo.height].map(|side| side as usize);
        let resized = resize(&photo.rgb, from, to, manifest.resize);
        planes(&resized, to, to, manifest.mean, manifest.std)
    };
    let pixels: Vec<f32> = photos.iter().flat_map(picture).collect();
    Input::new(&manifest.input, &[photos.len(), 3, to[1], to[0]], pixels)
}

/// Two photos that a provider is held to the CPU with.
fn probe(manifest: &CamerasManifest) -> [Photo; 2] {
    let [width, height] = [manifest.side, manifest.side / 2].map(|side| side.max(2));
    let level = |by: u32| move |i: u32| u8::try_from(i / by * 31 % 251).unwrap_or(0);
    [5, 7].map(|by| {
        let rgb = (0..width * height * 3).map(level(by)).collect();
        Photo { width, height, rgb, valid: None }
    })
}

/// Its file with its tensors.
pub(super) fn signatures(manifest: &CamerasManifest) -> Vec<Signature<'_>> {
    vec![(CAMERAS, &manifest.file, signature(manifest))]
}

fn signature<'a>(manifest: &'a CamerasManifest) -> Vec<Wanted<'a>> {
    let (cell, side) = (manifest.cell as usize, manifest.side as usize);
    let sides: Vec<usize> = (1..=side / cell).map(|cells| cells * cell).collect();
    let views: Vec<usize> = (VIEWS_MIN..=manifest.views_max).collect();
    let pictures = vec![views.clone(), vec![3], sides.clone(), sides.clone()];
    let rows = |columns: usize| vec![views.clone(), vec![3], vec![columns]];
    let maps = [&manifest.depth, &manifest.depth_confidence].into_iter().flatten();
    let map = |name: &'a String| {
        Wanted::new(Side::Output, name, vec![views.clone(), sides.clone(), sides.clone()])
    };
    let most = [manifest.views_max, 3, side, side];
    [
        Wanted::new(Side::Input, &manifest.input, pictures).at_most(&most),
        Wanted::new(Side::Output, &manifest.world_to_camera, rows(4)),
        Wanted::new(Side::Output, &manifest.intrinsics, rows(3)),
    ]
    .into_iter()
    .chain(maps.map(map))
    .collect()
}
