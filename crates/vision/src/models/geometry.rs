//! The geometry network: it fits the photos, makes the model frame, runs a session and returns to
//! world units.

use ort::session::SessionInputValue;

use crate::{
    error::{Error, Result},
    models::{
        Bundle, GeometryManifest, ModelFrame, NetworkOptions, OutputFrame, Provider, Runtime,
        bucket_for, fit,
        fit::FittedPhoto,
        pool::{Pool, fault, output, tensor},
    },
    scene::{CameraToWorld, Intrinsics, PosedPhoto, ViewGaussians},
};

/// Name of the network in messages.
const WHAT: &str = "geometry network";

/// One set of photos for the network.
#[derive(Clone, Copy, Debug)]
pub struct GeometryInput<'a> {
    /// All photos of the scene.
    pub photos: &'a [PosedPhoto],
    /// Indices of this set's photos, the first view first.
    pub views: &'a [usize],
    /// `[nearest, farthest]` depth of each *photo of the scene*, world units.
    pub near_far: &'a [[f64; 2]],
    /// Row v: positions in `views` of the source views of view v.
    pub neighbors: &'a [Vec<usize>],
}

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct Geometry {
    manifest: GeometryManifest,
    pool: Pool,
    provider: Provider,
}

impl Geometry {
    /// Opens one session a concurrent job on the provider of the configuration.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there, or the model does not load.
    pub fn open(runtime: &Runtime, bundle: &Bundle, options: &NetworkOptions) -> Result<Self> {
        let manifest = bundle.geometry().clone();
        let (pool, provider) = Pool::open(runtime, bundle, options, WHAT, &manifest.file)?;
        Ok(Self { manifest, pool, provider })
    }

    /// The network's section of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &GeometryManifest {
        &self.manifest
    }

    /// What computes it.
    #[must_use]
    pub fn provider(&self) -> Provider {
        self.provider
    }

    /// A Gaussian for each pixel of each view of the set, in world units.
    ///
    /// # Errors
    /// `invalid_request` when all cameras stand at one place; `internal` when the set does not fit
    /// the network, or the network fails or answers with other shapes than its manifest says.
    pub fn run(&self, input: &GeometryInput<'_>) -> Result<Vec<ViewGaussians>> {
        let prepared = self.prepare(input)?;
        let [height, width] = prepared.bucket;
        let count = input.views.len();
        let (h, w) = (height as usize, width as usize);
        let names = &self.manifest.inputs;
        let mut inputs: Vec<(&str, SessionInputValue<'_>)> = vec![
            (&names.images, tensor(WHAT, &[count, 3, h, w], &prepared.images)?),
            (&names.intrinsics, tensor(WHAT, &[count, 3, 3], &prepared.intrinsics)?),
            (&names.camera_to_world, tensor(WHAT, &[count, 4, 4], &prepared.poses)?),
            (&names.near, tensor(WHAT, &[count], &prepared.near)?),
            (&names.far, tensor(WHAT, &[count], &prepared.far)?),
        ];
        if let Some(name) = &names.neighbors {
            let shape = [count, input.neighbors[0].len()];
            inputs.push((name, tensor(WHAT, &shape, &prepared.neighbors)?));
        }
        let mut session = self.pool.take();
        let outputs = session.run(inputs).map_err(fault(WHAT, "run"))?;
        let names = &self.manifest.outputs;
        let get = |name: &str, tail: &[usize]| -> Result<&[f32]> {
            let wanted = [&[count, h, w], tail].concat();
            let (found, data) = output(WHAT, &outputs, name)?;
            if found != wanted {
                return Err(Error::internal(format!(
                    "{WHAT}: output {name:?} is {found:?}, not {wanted:?}"
                )));
            }
            Ok(data)
        };
        let sh_count = (usize::from(self.manifest.sh_degree) + 1).pow(2);
        let (means, scales) = (get(&names.means, &[3])?, get(&names.scales, &[3])?);
        let (quats, opacities) = (get(&names.quats, &[4])?, get(&names.opacities, &[])?);
        let sh = get(&names.sh, &[sh_count, 3])?;
        let confidence = names.confidence.as_ref().map(|name| get(name, &[])).transpose()?;

        let pixels = h * w;
        let unit = narrow(prepared.frame.unit());
        let views = input.views.iter().zip(prepared.fitted).enumerate();
        let view = |(v, (&photo, fitted)): (usize, (&usize, FittedPhoto))| {
            let part = |data, each| part_of(data, v, pixels * each);
            let scaled = |data| chunks(part(data, 3)).map(|row| row.map(|x| x * unit)).collect();
            ViewGaussians {
                photo: u16::try_from(photo).unwrap_or(u16::MAX),
                camera: fitted.camera,
                frame_to_world: match self.manifest.output_frame {
                    OutputFrame::Camera => fitted.camera.camera_to_world,
                    OutputFrame::Model => prepared.frame.pose(),
                },
                near_far: input.near_far[photo],
                means: scaled(means),
                scales: scaled(scales),
                quats: chunks(part(quats, 4)).collect(),
                opacities: part(opacities, 1).to_vec(),
                sh_degree: self.manifest.sh_degree,
                sh: chunks(part(sh, sh_count * 3)).collect(),
                confidence: confidence
                    .map_or_else(|| vec![1.0; pixels], |all| part(all, 1).to_vec()),
                valid: fitted.valid,
            }
        };
        Ok(views.map(view).collect())
    }

    fn prepare(&self, input: &GeometryInput<'_>) -> Result<Prepared> {
        let (count, manifest) = (input.views.len(), &self.manifest);
        if count < manifest.views_min || count > manifest.views_max {
            return Err(Error::internal(format!(
                "{WHAT}: {count} views, outside {} to {}",
                manifest.views_min, manifest.views_max
            )));
        }
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
            .map(|&v| fit(&input.photos[v].photo, &input.photos[v].camera, bucket))
            .collect();
        let cameras: Vec<CameraToWorld> =
            fitted.iter().map(|view| view.camera.camera_to_world).collect();
        let frame = ModelFrame::new(&cameras, manifest.translation)?;
        let ranges = || input.views.iter().map(|&v| input.near_far[v]);
        Ok(Prepared {
            images: images(&fitted, manifest),
            intrinsics: fitted
                .iter()
                .flat_map(|view| normalised(&view.camera.intrinsics))
                .collect(),
            poses: cameras
                .iter()
                .flat_map(|c| frame.camera(c).transpose().to_cols_array().map(narrow))
                .collect(),
            near: ranges().map(|[near, _]| narrow(near / frame.unit())).collect(),
            far: ranges().map(|[_, far]| narrow((far / frame.unit()).min(1e6))).collect(),
            neighbors: input
                .neighbors
                .iter()
                .flatten()
                .map(|&n| i64::try_from(n).unwrap_or_default())
                .collect(),
            fitted,
            frame,
            bucket,
        })
    }
}

struct Prepared {
    bucket: [u32; 2],
    frame: ModelFrame,
    fitted: Vec<FittedPhoto>,
    images: Vec<f32>,
    intrinsics: Vec<f32>,
    poses: Vec<f32>,
    near: Vec<f32>,
    far: Vec<f32>,
    neighbors: Vec<i64>,
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
