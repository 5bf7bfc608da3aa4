//! The network that matches the keypoints of two photos: it looks at all of them together, so that
//! it finds pairs whose descriptors alone are not each other's most similar.

use std::sync::Arc;

use crate::{
    error::{Error, Result},
    models::{
        Bundle, FeaturesManifest, MatcherManifest, NetworkOptions, PhotoFeatures, ProviderChoice,
        Runtime,
        network::{Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted},
    },
};

/// Its name in messages.
const MATCHER: &str = "matcher";
/// Largest difference of a provider to the CPU.
const TOLERANCE: f64 = 2e-3;

/// Two keypoints that match: their places among those of their photos, and how sure that is, 0..1.
pub type SureMatch = ([u32; 2], f32);

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct MatcherNetwork {
    manifest: MatcherManifest,
    network: Network,
    dim: usize,
}

impl MatcherNetwork {
    /// Opens the network; `None` where the bundle has none. It always runs on the CPU, as the
    /// feature network does: the number of keypoints is free.
    ///
    /// # Errors
    /// `model_unavailable` when the file does not load, or has other tensors than the manifest.
    pub fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let (Some(manifest), Some(features)) = (bundle.matcher().cloned(), bundle.features())
        else {
            return Ok(None);
        };
        let options = NetworkOptions { provider: ProviderChoice::Cpu, ..options.clone() };
        let spec = Spec {
            what: MATCHER,
            file: &manifest.file,
            cpu_file: None,
            signature: signature(&manifest, features),
            memory: RunMemory::GivenBack,
            tolerance: TOLERANCE,
            probe: &|_| Ok(Vec::new()),
        };
        let network = Network::open(runtime, bundle, &options, &spec)?;
        Ok(Some(Self { manifest, network, dim: features.dim }))
    }

    /// Matches photos with two numbers of keypoints.
    ///
    /// # Errors
    /// As [`Self::matched`].
    pub(super) fn try_out(&self) -> Result<()> {
        let found = |count: usize| {
            let place = |i: usize| [(i * 37 % 64) as f32, (i * 11 % 48) as f32];
            let length = (self.dim as f32).sqrt();
            let numbers = 0..count * self.dim;
            PhotoFeatures {
                keypoints: (0..count).map(place).collect(),
                descriptors: numbers.map(|i| [1.0, -1.0][i * i % 7 % 2] / length).collect(),
                dim: self.dim,
            }
        };
        let size = [64, 48];
        self.matched([&found(9), &found(5)], [size, size], usize::MAX)?;
        self.matched([&found(3), &found(8)], [size, size], usize::MAX).map(drop)
    }

    /// The keypoints of two photos of `sizes` (width and height, pixels) that show the same, in the
    /// order of the first photo's keypoints. Only the first `count` keypoints of a photo are looked
    /// at, at most [`MatcherManifest::count`]: the time grows with its square.
    ///
    /// # Errors
    /// `internal` when the network fails, or answers with another shape than its manifest says or
    /// with a number that is no place.
    pub fn matched(
        &self,
        photos: [&PhotoFeatures; 2],
        sizes: [[u32; 2]; 2],
        count: usize,
    ) -> Result<Vec<SureMatch>> {
        let most = self.manifest.count.min(count);
        let counts = photos.map(|photo| photo.keypoints.len().min(most));
        if counts.contains(&0) {
            return Ok(Vec::new());
        }
        let placed: [Vec<f32>; 2] =
            [0, 1].map(|side| from_middle(&photos[side].keypoints[..counts[side]], sizes[side]));
        let mut inputs = Vec::with_capacity(4);
        for (side, (photo, placed)) in photos.iter().zip(&placed).enumerate() {
            let (keypoints, descriptors) =
                (&self.manifest.keypoints[side], &self.manifest.descriptors[side]);
            let (count, dim) = (counts[side], self.dim);
            inputs.push(Input::new(keypoints, &[count, 2], &**placed));
            let numbers = &photo.descriptors[..count * dim];
            inputs.push(Input::new(descriptors, &[count, dim], numbers));
        }
        self.network.run(&inputs, |outputs| self.read(outputs, counts))
    }

    fn read(&self, outputs: &dyn Outputs, counts: [usize; 2]) -> Result<Vec<SureMatch>> {
        let MatcherManifest { matches, scores, score_min, .. } = &self.manifest;
        let (of, places) = outputs.get(matches)?;
        let (sure, similar) = outputs.get(scores)?;
        let [first, second] = counts;
        let is_place = |place: &f32| (-1.0..second as f32).contains(place) && place.fract() == 0.0;
        if of != [first] || sure != [first] || !places.iter().all(is_place) {
            return Err(Error::internal(format!(
                "{MATCHER}: {matches:?} is {of:?} and {scores:?} {sure:?}, not [{first}] with \
                 places of -1 to {}",
                second - 1
            )));
        }
        let pairs = (0_u32..).zip(places.iter().zip(similar.iter()));
        let sure = pairs.filter(|(_, (place, score))| **place >= 0.0 && *score > score_min);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a place")]
        let pair = |(i, (place, score)): (u32, (&f32, &f32))| ([i, *place as u32], *score);
        Ok(sure.map(pair).collect())
    }
}

/// Keypoints from the middle of a photo, in halves of its longer side.
fn from_middle(keypoints: &[[f32; 2]], [width, height]: [u32; 2]) -> Vec<f32> {
    let (middle, half) =
        ([width as f32 / 2.0, height as f32 / 2.0], width.max(height) as f32 / 2.0);
    keypoints.iter().flat_map(|at| [0, 1].map(|axis| (at[axis] - middle[axis]) / half)).collect()
}

/// Its file with its tensors.
pub(super) fn signatures<'a>(
    manifest: &'a MatcherManifest,
    features: &FeaturesManifest,
) -> Vec<Signature<'a>> {
    vec![(MATCHER, &manifest.file, signature(manifest, features))]
}

fn signature<'a>(manifest: &'a MatcherManifest, features: &FeaturesManifest) -> Vec<Wanted<'a>> {
    let MatcherManifest { keypoints, descriptors, matches, scores, .. } = manifest;
    let input = |name: &'a String, numbers: usize| {
        Wanted::new(Side::Input, name, vec![vec![], vec![numbers]])
    };
    let inputs = keypoints.iter().map(|name| input(name, 2));
    let inputs = inputs.chain(descriptors.iter().map(|name| input(name, features.dim)));
    let output = |name| Wanted::new(Side::Output, name, vec![vec![]]);
    inputs.chain([output(matches), output(scores)]).collect()
}
