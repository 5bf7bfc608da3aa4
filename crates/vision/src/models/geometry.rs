//! The geometry network: it fits the photos, makes the model frame, runs a session and returns to
//! world units.

use std::{borrow::Cow, collections::BTreeSet, ops::RangeInclusive, sync::Arc};

use crate::{
    error::{Error, Result},
    models::{
        Bundle, GeometryManifest, GeometryWeights, ModelFrame, NetworkOptions, OutputFrame,
        Provider, Runtime, bucket_for, fit,
        fit::FittedPhoto,
        network::{Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted},
        tensors::Numbers,
    },
    scene::{CameraToWorld, Intrinsics, PosedPhoto, ViewGaussians},
};

/// Name of the network in messages.
const WHAT: &str = "geometry network";
/// Largest difference of a provider to the CPU: rounding moves the depth of a few pixels that have
/// two equally good matches. A provider that computes one convolution wrong is off by 0.1 and more.
const TOLERANCE: f64 = 1e-2;
/// Focal length of the fixed input, widths of the picture.
const FOCAL: f64 = 1.1;
/// Numbers of views that a device is made ready for.
const WARM_VIEWS: [usize; 3] = [2, 4, 8];

/// One set of photos for the network.
#[derive(Clone, Copy, Debug)]
pub struct GeometryInput<'a> {
    /// All photos of the scene.
    pub photos: &'a [PosedPhoto],
    /// Indices of this set's photos, the first view first.
    pub views: &'a [usize],
    /// `[nearest, farthest]` depth of each *photo of the scene*, world units.
    pub near_far: &'a [[f64; 2]],
    /// Median depth of all photos, world units.
    pub median_depth: f64,
    /// Row v: positions in `views` of the source views of view v.
    pub neighbors: &'a [Vec<usize>],
}

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct Geometry {
    manifest: GeometryManifest,
    /// By the views of a set; together they are all that the manifest allows.
    networks: Vec<ByViews>,
}

/// A network with the weights for sets of so many views.
#[derive(Debug)]
struct ByViews {
    part: &'static str,
    views: RangeInclusive<usize>,
    network: Network,
}

impl Geometry {
    /// Opens it on the provider of the configuration. On a device its answer was held to the CPU's
    /// when this returns.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there or differs from the CPU, or the
    /// model does not load.
    pub fn open(runtime: &Arc<Runtime>, bundle: &Bundle, options: &NetworkOptions) -> Result<Self> {
        let manifest = bundle.geometry();
        let open = |weights: GeometryWeights<'_>| {
            let probe = Tensors::probe(manifest, manifest.buckets[0], *weights.views.start());
            let spec = Spec {
                what: WHAT,
                file: weights.file,
                cpu_file: weights.cpu_file,
                signature: signature(manifest, *weights.views.start()),
                memory: RunMemory::GivenBack,
                tolerance: TOLERANCE,
                probe: &|_| Ok(probe.inputs(manifest)),
            };
            let network = Network::open(runtime, bundle, options, &spec)?;
            Ok(ByViews { part: weights.part, views: weights.views, network })
        };
        let networks = manifest.weights().into_iter().map(open).collect::<Result<_>>()?;
        Ok(Self { networks, manifest: manifest.clone() })
    }

    /// The network for sets of so many views.
    fn network_for(&self, views: usize) -> Result<&Network> {
        let found = self.networks.iter().find(|network| network.views.contains(&views));
        found.map(|found| &found.network).ok_or_else(|| {
            let GeometryManifest { views_min, views_max, .. } = self.manifest;
            Error::internal(format!("{WHAT}: {views} views, outside {views_min} to {views_max}"))
        })
    }

    /// Runs every size with the usual numbers of views, where a device computes it: the first run
    /// of a shape takes a second there.
    ///
    /// # Errors
    /// As [`Self::run`].
    pub fn warm(&self) -> Result<()> {
        if self.provider() == Provider::Cpu {
            return Ok(());
        }
        let manifest = &self.manifest;
        for views in WARM_VIEWS {
            let Ok(network) = self.network_for(views) else { continue };
            for &bucket in &manifest.buckets {
                let probe = Tensors::probe(manifest, bucket, views);
                network.run(&probe.inputs(manifest), |_| Ok(()))?;
            }
        }
        Ok(())
    }

    /// Runs every size with the fewest and with the most views of each network, and looks at all
    /// numbers.
    ///
    /// # Errors
    /// `internal` when a run fails, or an output has another shape than the manifest says or holds
    /// a number that is not finite.
    pub(super) fn try_out(&self) -> Result<()> {
        let manifest = &self.manifest;
        for ByViews { views, network, .. } in &self.networks {
            for views in BTreeSet::from([*views.start(), *views.end()]) {
                for &bucket in &manifest.buckets {
                    let probe = Tensors::probe(manifest, bucket, views);
                    network.run(&probe.inputs(manifest), |outputs| {
                        Answer::read(manifest, bucket, views, outputs)?.finite()
                    })?;
                }
            }
        }
        Ok(())
    }

    /// The network's section of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &GeometryManifest {
        &self.manifest
    }

    /// The network of this part of the bundle; `None` where it has none.
    #[must_use]
    pub fn network(&self, part: &str) -> Option<&Network> {
        self.networks.iter().find(|found| found.part == part).map(|found| &found.network)
    }

    /// What computes it: the CPU where any of its networks is computed there.
    #[must_use]
    pub fn provider(&self) -> Provider {
        let mut providers = self.networks.iter().map(|found| found.network.provider());
        let first = providers.next().unwrap_or(Provider::Cpu);
        if providers.all(|provider| provider == first) { first } else { Provider::Cpu }
    }

    /// Why it is not computed where it was to be; `None` where it is.
    #[must_use]
    pub fn remark(&self) -> Option<String> {
        self.networks.iter().find_map(|found| found.network.remark())
    }

    /// A Gaussian for each pixel of each view of the set, in world units.
    ///
    /// # Errors
    /// `invalid_request` when all cameras stand at one place; `internal` when the set does not fit
    /// the network, or the network fails or answers with other shapes than its manifest says.
    pub fn run(&self, input: &GeometryInput<'_>) -> Result<Vec<ViewGaussians>> {
        let network = self.network_for(input.views.len())?;
        let prepared = self.prepare(input)?;
        let inputs = prepared.tensors.inputs(&self.manifest);
        network.run(&inputs, |outputs| self.views(input, &prepared, outputs))
    }

    /// The outputs of a run, view by view.
    fn views(
        &self,
        input: &GeometryInput<'_>,
        prepared: &Prepared,
        outputs: &dyn Outputs,
    ) -> Result<Vec<ViewGaussians>> {
        let [h, w] = prepared.tensors.bucket.map(|side| side as usize);
        let bucket = prepared.tensors.bucket;
        let answer = Answer::read(&self.manifest, bucket, input.views.len(), outputs)?;
        let sh_count = sh_count(&self.manifest);
        let pixels = h * w;
        let unit = narrow(prepared.frame.unit());
        let view = |(v, (&photo, fitted)): (usize, (&usize, &FittedPhoto))| {
            let part = |data, each| part_of(data, v, pixels * each);
            let scaled = |data| chunks(part(data, 3)).map(|row| row.map(|x| x * unit)).collect();
            ViewGaussians {
                photo: u16::try_from(photo).unwrap_or(u16::MAX),
                camera: fitted.camera,
                frame_to_world: match self.manifest.output_frame {
                    OutputFrame::Camera => fitted.camera.camera_to_world,
                    OutputFrame::Model => prepared.frame.pose(),
                },
                near_far: prepared.near_far(v),
                means: scaled(&answer.means),
                scales: scaled(&answer.scales),
                quats: chunks(part(&answer.quats, 4)).collect(),
                opacities: part(&answer.opacities, 1).to_vec(),
                sh_degree: self.manifest.sh_degree,
                sh: chunks(part(&answer.sh, sh_count * 3)).collect(),
                confidence: answer
                    .confidence
                    .as_ref()
                    .map_or_else(|| vec![1.0; pixels], |all| part(all, 1).to_vec()),
                valid: fitted.valid.clone(),
            }
        };
        Ok(input.views.iter().zip(&prepared.fitted).enumerate().map(view).collect())
    }

    fn prepare(&self, input: &GeometryInput<'_>) -> Result<Prepared> {
        let (count, manifest) = (input.views.len(), &self.manifest);
        let each = input.neighbors.first().map_or(0, Vec::len);
        let fits = |row: &Vec<usize>| row.len() == each && row.iter().all(|&n| n < count);
        if input.neighbors.len() != count
            || each == 0
            || each > manifest.neighbors_max
            || !input.neighbors.iter().all(fits)
        {
            return Err(Error::internal(format!(
                "{WHAT}: neighbours {:?} do not fit {count} views",
                input.neighbors
            )));
        }
        if input.views.iter().any(|&v| v >= input.photos.len() || v >= input.near_far.len()) {
            return Err(Error::internal(format!(
                "{WHAT}: views {:?} of {} photos",
                input.views,
                input.photos.len()
            )));
        }
        let lenses: Vec<Intrinsics> =
            input.views.iter().map(|&v| input.photos[v].camera.intrinsics).collect();
        let bucket = bucket_for(&lenses, &manifest.buckets)
            .ok_or_else(|| Error::internal(format!("{WHAT}: no buckets")))?;
        let fitted: Vec<FittedPhoto> = input
            .views
            .iter()
            .map(|&v| fit(&input.photos[v].photo, &input.photos[v].camera, bucket, manifest.resize))
            .collect();
        let cameras: Vec<CameraToWorld> =
            fitted.iter().map(|view| view.camera.camera_to_world).collect();
        let measured = || input.views.iter().map(|&v| input.near_far[v]);
        let nearest = measured().map(|[near, _]| near).fold(f64::INFINITY, f64::min);
        let frame = ModelFrame::new(&cameras, manifest.translation, nearest, input.median_depth)?;
        let ranges = || {
            measured().map(|range| {
                manifest.near_far.unwrap_or(range.map(|depth| (depth / frame.unit()).min(1e6)))
            })
        };
        let tensors = Tensors {
            bucket,
            images: images(&fitted, manifest),
            intrinsics: fitted
                .iter()
                .flat_map(|view| normalised(&view.camera.intrinsics))
                .collect(),
            poses: cameras
                .iter()
                .flat_map(|c| frame.camera(c).transpose().to_cols_array().map(narrow))
                .collect(),
            near: ranges().map(|[near, _]| narrow(near)).collect(),
            far: ranges().map(|[_, far]| narrow(far)).collect(),
            neighbors: input
                .neighbors
                .iter()
                .flatten()
                .map(|&n| i64::try_from(n).unwrap_or_default())
                .collect(),
        };
        Ok(Prepared { frame, fitted, tensors })
    }
}

struct Prepared {
    frame: ModelFrame,
    fitted: Vec<FittedPhoto>,
    tensors: Tensors,
}

impl Prepared {
    /// Nearest and farthest depth that the network looked at in view `v`, world units.
    fn near_far(&self, v: usize) -> [f64; 2] {
        [self.tensors.near[v], self.tensors.far[v]]
            .map(|depth| f64::from(depth) * self.frame.unit())
    }
}

/// What the network gave, with the shapes of the manifest.
struct Answer<'a> {
    means: Cow<'a, [f32]>,
    scales: Cow<'a, [f32]>,
    quats: Cow<'a, [f32]>,
    opacities: Cow<'a, [f32]>,
    sh: Cow<'a, [f32]>,
    confidence: Option<Cow<'a, [f32]>>,
}

impl<'a> Answer<'a> {
    fn read(
        manifest: &GeometryManifest,
        bucket: [u32; 2],
        views: usize,
        outputs: &'a dyn Outputs,
    ) -> Result<Self> {
        let [h, w] = bucket.map(|side| side as usize);
        let get = |name: &str, tail: &[usize]| -> Result<Cow<'a, [f32]>> {
            let wanted = [&[views, h, w], tail].concat();
            let (found, data) = outputs.get(name)?;
            if found != wanted {
                return Err(Error::internal(format!(
                    "{WHAT}: output {name:?} is {found:?}, not {wanted:?}"
                )));
            }
            Ok(data)
        };
        let names = &manifest.outputs;
        Ok(Self {
            means: get(&names.means, &[3])?,
            scales: get(&names.scales, &[3])?,
            quats: get(&names.quats, &[4])?,
            opacities: get(&names.opacities, &[])?,
            sh: get(&names.sh, &[sh_count(manifest), 3])?,
            confidence: names.confidence.as_ref().map(|name| get(name, &[])).transpose()?,
        })
    }

    fn finite(&self) -> Result<()> {
        let all = [&self.means, &self.scales, &self.quats, &self.opacities, &self.sh];
        if all.into_iter().chain(&self.confidence).all(|data| data.iter().all(|v| v.is_finite())) {
            return Ok(());
        }
        Err(Error::internal(format!("{WHAT}: an output holds a number that is not finite")))
    }
}

/// Harmonics of a Gaussian.
fn sh_count(manifest: &GeometryManifest) -> usize {
    (usize::from(manifest.sh_degree) + 1).pow(2)
}

/// Each file with its tensors.
pub(super) fn signatures(manifest: &GeometryManifest) -> Vec<Signature<'_>> {
    let mut all = Vec::new();
    for GeometryWeights { file, cpu_file, views, .. } in manifest.weights() {
        let files = [Some(file), cpu_file].into_iter().flatten();
        all.extend(files.map(|file| (WHAT, file, signature(manifest, *views.start()))));
    }
    all
}

/// The tensors of the manifest, for so many views and more: a caller of the network itself may give
/// one with weights for few views as many as the manifest allows.
fn signature(manifest: &GeometryManifest, least: usize) -> Vec<Wanted<'_>> {
    let (inputs, outputs) = (&manifest.inputs, &manifest.outputs);
    let views: Vec<usize> = (least..=manifest.views_max).collect();
    let side = |axis: usize| manifest.buckets.iter().map(|b| b[axis] as usize).collect::<Vec<_>>();
    let of = |side, name, tail: &[&[usize]]| {
        let shape = [&[&*views], tail].concat().into_iter().map(<[usize]>::to_vec).collect();
        Wanted::new(side, name, shape)
    };
    let (h, w) = (&*side(0), &*side(1));
    let pixel = |name, tail: &[usize]| {
        let tail: Vec<&[usize]> = tail.iter().map(std::slice::from_ref).collect();
        of(Side::Output, name, &[&[h, w], &*tail].concat())
    };
    let mut all = vec![
        of(Side::Input, &*inputs.images, &[&[3], h, w]),
        of(Side::Input, &inputs.intrinsics, &[&[3], &[3]]),
        of(Side::Input, &inputs.camera_to_world, &[&[4], &[4]]),
        of(Side::Input, &inputs.near, &[]),
        of(Side::Input, &inputs.far, &[]),
        pixel(&*outputs.means, &[3]),
        pixel(&outputs.scales, &[3]),
        pixel(&outputs.quats, &[4]),
        pixel(&outputs.opacities, &[]),
        pixel(&outputs.sh, &[sh_count(manifest), 3]),
    ];
    if let Some(name) = &inputs.neighbors {
        let each = of(Side::Input, name, &[&[]]).at_most(&[0, manifest.neighbors_max]);
        all.push(Wanted { whole: Some(true), ..each.of(Numbers::OwnRows) });
    }
    all.extend(outputs.confidence.iter().map(|name| pixel(name, &[])));
    all
}

/// What the network takes for one set of views.
struct Tensors {
    bucket: [u32; 2],
    images: Vec<f32>,
    intrinsics: Vec<f32>,
    poses: Vec<f32>,
    near: Vec<f32>,
    far: Vec<f32>,
    neighbors: Vec<i64>,
}

impl Tensors {
    /// A fixed input of the network's own size: a textured plane before cameras side by side.
    fn probe(manifest: &GeometryManifest, bucket: [u32; 2], views: usize) -> Self {
        let [h, w] = bucket.map(f64::from);
        let place = |v: usize| v as f64 / (views - 1).max(1) as f64;
        // On the plane z = 5, in model units.
        let texture = |x: f64, y: f64, c: f64| {
            let (u, v) = (5.0 * (x / w - 0.5) / FOCAL, 5.0 * (y - 0.5 * h) / (FOCAL * w));
            let waves = (7.0 * u + 3.0 * v + c).sin() + (23.0 * u - 17.0 * v).sin();
            narrow(0.5 + 0.2 * waves + 0.1 * (31.0 * u * v + 2.0 * c).cos())
        };
        let mut images = Vec::new();
        for v in 0..views {
            let shift = place(v) * FOCAL * w / 5.0;
            for (c, (mean, std)) in manifest.mean.iter().zip(manifest.std).enumerate() {
                let (height, width) = (bucket[0], bucket[1]);
                let places = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
                images.extend(places.map(|(x, y)| {
                    (texture(f64::from(x) + shift, f64::from(y), c as f64) - mean) / std
                }));
            }
        }
        let (fx, fy) = (narrow(FOCAL), narrow(FOCAL * w / h));
        let pose = |v: usize| {
            let x = narrow(place(v));
            [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        };
        let each = (views - 1).min(manifest.neighbors_max);
        let other = |v: usize, n: usize| i64::try_from((v + 1 + n) % views).unwrap_or_default();
        Self {
            bucket,
            images,
            intrinsics: [fx, 0.0, 0.5, 0.0, fy, 0.5, 0.0, 0.0, 1.0].repeat(views),
            poses: (0..views).flat_map(pose).collect(),
            near: vec![3.0; views],
            far: vec![15.0; views],
            neighbors: (0..views).flat_map(|v| (0..each).map(move |n| other(v, n))).collect(),
        }
    }

    fn inputs<'a>(&'a self, manifest: &'a GeometryManifest) -> Vec<Input<'a>> {
        let (count, names) = (self.near.len(), &manifest.inputs);
        let [h, w] = self.bucket.map(|side| side as usize);
        let mut inputs = vec![
            Input::new(&names.images, &[count, 3, h, w], &*self.images),
            Input::new(&names.intrinsics, &[count, 3, 3], &*self.intrinsics),
            Input::new(&names.camera_to_world, &[count, 4, 4], &*self.poses),
            Input::new(&names.near, &[count], &*self.near),
            Input::new(&names.far, &[count], &*self.far),
        ];
        if let Some(name) = &names.neighbors {
            let each = self.neighbors.len() / count.max(1);
            inputs.push(Input::new(name, &[count, each], &*self.neighbors));
        }
        inputs
    }
}

/// `[V, 3, H, W]`, normalised as the manifest says.
fn images(fitted: &[FittedPhoto], manifest: &GeometryManifest) -> Vec<f32> {
    let mut images = Vec::with_capacity(fitted.iter().map(|view| view.rgb.len()).sum());
    for view in fitted {
        for (c, (mean, std)) in manifest.mean.iter().zip(manifest.std).enumerate() {
            images.extend(view.rgb.iter().skip(c).step_by(3).map(|v| (v - mean) / std));
        }
    }
    images
}

/// K with row 0 divided by the width and row 1 by the height.
fn normalised(lens: &Intrinsics) -> [f32; 9] {
    let (w, h) = (f64::from(lens.width), f64::from(lens.height));
    let (fx, cx) = (narrow(lens.fx / w), narrow(lens.cx / w));
    let (fy, cy) = (narrow(lens.fy / h), narrow(lens.cy / h));
    [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
}

#[expect(clippy::cast_possible_truncation, reason = "networks take f32")]
fn narrow(value: f64) -> f32 {
    value as f32
}

/// The numbers of view `v`, of which each has `count`.
fn part_of(data: &[f32], v: usize, count: usize) -> &[f32] {
    &data[v * count..(v + 1) * count]
}

fn chunks<const N: usize>(data: &[f32]) -> impl Iterator<Item = [f32; N]> + '_ {
    data.as_chunks::<N>().0.iter().copied()
}
