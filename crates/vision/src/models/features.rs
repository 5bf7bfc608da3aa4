//! The feature network: a photo to keypoints that are found again in other photos, with a
//! descriptor of each.

use std::sync::Arc;

use crate::{
    error::{Error, Result},
    models::{
        Bundle, FeaturesManifest, NetworkOptions, ProviderChoice, Runtime,
        network::{Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted},
        resize::{planes, resize},
    },
    scene::Photo,
};

/// Its name in messages.
const FEATURES: &str = "features";
/// Largest difference of a provider to the CPU.
const TOLERANCE: f64 = 2e-3;

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct FeatureNetwork {
    manifest: FeaturesManifest,
    network: Network,
}

/// What the network finds in a photo, the best first.
#[derive(Clone, Debug, Default)]
pub struct PhotoFeatures {
    /// `[N]` places, pixels of the photo; the centre of the top left pixel is (0.5, 0.5).
    pub keypoints: Vec<[f32; 2]>,
    /// `[N * dim]` descriptors, each of length 1.
    pub descriptors: Vec<f32>,
    /// Numbers of a descriptor.
    pub dim: usize,
}

impl FeatureNetwork {
    /// Opens the network; `None` where the bundle has none. It always runs on the CPU: how many
    /// keypoints it gives is no size that a device could prepare for, and a photo takes it some
    /// tens of milliseconds.
    ///
    /// # Errors
    /// `model_unavailable` when the file does not load, or has other tensors than the manifest.
    pub fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let Some(manifest) = bundle.features().cloned() else { return Ok(None) };
        let options = NetworkOptions { provider: ProviderChoice::Cpu, ..options.clone() };
        let spec = Spec {
            what: FEATURES,
            file: &manifest.file,
            cpu_file: None,
            signature: signature(&manifest),
            memory: RunMemory::GivenBack,
            tolerance: TOLERANCE,
            probe: &|_| Ok(Vec::new()),
        };
        let network = Network::open(runtime, bundle, &options, &spec)?;
        Ok(Some(Self { manifest: manifest.clone(), network }))
    }

    /// Looks at two photos of different shapes.
    ///
    /// # Errors
    /// `internal` when a run fails, or an output has another shape than the manifest says or holds
    /// a number that is not finite.
    pub(super) fn try_out(&self) -> Result<()> {
        for [width, height] in [[96_u32, 64], [64, 128]] {
            let level = |i: u32| u8::try_from(i * i % 251).unwrap_or(0);
            let rgb = (0..width * height * 3).map(level).collect();
            self.find(&Photo { width, height, rgb, valid: None })?;
        }
        Ok(())
    }

    /// The section of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &FeaturesManifest {
        &self.manifest
    }

    /// The network itself.
    #[must_use]
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// The keypoints of a photo that lie on valid pixels.
    ///
    /// # Errors
    /// `internal` when the network fails, or answers with another shape than its manifest says or
    /// with a number that is not finite.
    pub fn find(&self, photo: &Photo) -> Result<PhotoFeatures> {
        let manifest = &self.manifest;
        let size = [photo.width, photo.height];
        let placed = manifest.fitted(size);
        let [from, to] = [size, placed].map(|sides| sides.map(|side| side as usize));
        let resized = resize(&photo.rgb, from, to, manifest.resize);
        let pixels = planes(&resized, to, to, manifest.mean, manifest.std);
        let input = Input::new(&manifest.input, &[1, 3, to[1], to[0]], pixels);
        let found = self.network.run(&[input], |outputs| self.read(outputs))?;
        let scale = [0, 1].map(|axis| size[axis] as f32 / placed[axis] as f32);
        Ok(on_valid(found, scale, photo))
    }

    fn read(&self, outputs: &dyn Outputs) -> Result<PhotoFeatures> {
        let FeaturesManifest { keypoints, descriptors, dim, count, .. } = &self.manifest;
        let (shape, places) = outputs.get(keypoints)?;
        let (rows, numbers) = outputs.get(descriptors)?;
        let n = shape.first().copied().unwrap_or(0);
        if shape != [n, 2] || rows != [n, *dim] || n > *count {
            return Err(Error::internal(format!(
                "{FEATURES}: {keypoints:?} is {shape:?} and {descriptors:?} {rows:?}, not [N, 2] \
                 and [N, {dim}] with N at most {count}"
            )));
        }
        if !places.iter().chain(numbers.iter()).all(|v| v.is_finite()) {
            return Err(Error::internal(format!("{FEATURES}: a number is not finite")));
        }
        let keypoints = places.as_chunks::<2>().0.to_vec();
        Ok(PhotoFeatures { keypoints, descriptors: numbers.into_owned(), dim: *dim })
    }
}

/// Features at the size of the photo, without those that its mask leaves out.
fn on_valid(found: PhotoFeatures, scale: [f32; 2], photo: &Photo) -> PhotoFeatures {
    let PhotoFeatures { keypoints, descriptors, dim } = found;
    let mut kept = PhotoFeatures { dim, ..PhotoFeatures::default() };
    for (at, row) in keypoints.iter().zip(descriptors.chunks_exact(dim)) {
        let at = [at[0] * scale[0], at[1] * scale[1]];
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in a photo")]
        let [x, y] = [at[0].max(0.0) as u32, at[1].max(0.0) as u32];
        if x >= photo.width || y >= photo.height {
            continue;
        }
        let pixel = y as usize * photo.width as usize + x as usize;
        if photo.valid.as_ref().is_none_or(|valid| valid[pixel]) {
            kept.keypoints.push(at);
            kept.descriptors.extend(row);
        }
    }
    kept
}

/// Its file with its tensors.
pub(super) fn signatures(manifest: &FeaturesManifest) -> Vec<Signature<'_>> {
    vec![(FEATURES, &manifest.file, signature(manifest))]
}

fn signature(manifest: &FeaturesManifest) -> Vec<Wanted<'_>> {
    let FeaturesManifest { input, keypoints, scores, descriptors, .. } = manifest;
    let cell = manifest.cell as usize;
    let sides: Vec<usize> = (1..=manifest.side as usize / cell).map(|cells| cells * cell).collect();
    let pictures = vec![vec![1], vec![3], sides.clone(), sides];
    let side = manifest.side as usize;
    vec![
        Wanted::new(Side::Input, input, pictures).at_most(&[1, 3, side, side]),
        Wanted::new(Side::Output, keypoints, vec![vec![], vec![2]]),
        Wanted::new(Side::Output, scores, vec![vec![]]),
        Wanted::new(Side::Output, descriptors, vec![vec![], vec![manifest.dim]]),
    ]
}
