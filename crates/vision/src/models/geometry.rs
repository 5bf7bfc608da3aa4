//! The geometry network: it fits the photos, makes the model frame, runs a session and returns to
//! world units.

use std::sync::Arc;

use ort::{session::SessionInputValue, value::TensorRef};

use crate::{
    error::{Error, Result},
    models::{
        Bundle, GeometryManifest, ModelFrame, NetworkOptions, OutputFrame, Provider, Runtime,
        bucket_for, fit, fit::FittedPhoto, pool::Pool,
    },
    scene::{CameraToWorld, Intrinsics, PosedPhoto, ViewGaussians},
};

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
    _runtime: Arc<Runtime>,
}

impl Geometry {
    /// Opens one session a concurrent job on the provider of the configuration.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there, or the model does not load.
    pub fn open(runtime: Arc<Runtime>, bundle: &Bundle, options: &NetworkOptions) -> Result<Self> {
        let manifest = bundle.geometry().clone();
        let (pool, provider) =
            Pool::open(&runtime, bundle, options, "geometry network", &manifest.file)?;
        Ok(Self { manifest, pool, provider, _runtime: runtime })
    }

    /// What the manifest says of the network.
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
        let neighbors_each = input.neighbors[0].len();
        let names = &self.manifest.inputs;
        let mut inputs: Vec<(&str, SessionInputValue<'_>)> = vec![
            (&names.images, tensor(([count, 3, h, w], &prepared.images))?),
            (&names.intrinsics, tensor(([count, 3, 3], &prepared.intrinsics))?),
            (&names.camera_to_world, tensor(([count, 4, 4], &prepared.poses))?),
            (&names.near, tensor(([count], &prepared.near))?),
            (&names.far, tensor(([count], &prepared.far))?),
        ];
        if let Some(name) = &names.neighbors {
            let view = TensorRef::from_array_view((
                [count, neighbors_each],
                prepared.neighbors.as_slice(),
            ))
            .map_err(fault("input"))?;
            inputs.push((name, view.into()));
        }
        let mut session = self.pool.take();
        let outputs = session.run(inputs).map_err(fault("run"))?;
        let names = &self.manifest.outputs;
        let get = |name: &str, shape: &[usize]| -> Result<&[f32]> {
            let value = outputs
                .get(name)
                .ok_or_else(|| Error::internal(format!("geometry network: no output {name:?}")))?;
            let (found, data) = value.try_extract_tensor::<f32>().map_err(fault("output"))?;
            let matches = found.len() == shape.len()
                && found.iter().zip(shape).all(|(&a, &b)| usize::try_from(a) == Ok(b));
            if !matches {
                return Err(Error::internal(format!(
                    "geometry network: output {name:?} is {found:?}, not {shape:?}"
                )));
            }
            Ok(data)
        };
        let sh_count = (usize::from(self.manifest.sh_degree) + 1).pow(2);
        let arrays = Arrays {
            means: get(&names.means, &[count, h, w, 3])?,
            scales: get(&names.scales, &[count, h, w, 3])?,
            quats: get(&names.quats, &[count, h, w, 4])?,
            opacities: get(&names.opacities, &[count, h, w])?,
            sh: get(&names.sh, &[count, h, w, sh_count, 3])?,
            confidence: match &names.confidence {
                Some(name) => Some(get(name, &[count, h, w])?),
                None => None,
            },
        };
        Ok(self.to_views(input, prepared, &arrays))
    }

    fn to_views(
        &self,
        input: &GeometryInput<'_>,
        prepared: Prepared,
        arrays: &Arrays<'_>,
    ) -> Vec<ViewGaussians> {
        let pixels = (prepared.bucket[0] * prepared.bucket[1]) as usize;
        #[expect(clippy::cast_possible_truncation, reason = "network outputs are f32")]
        let unit = prepared.frame.unit() as f32;
        let sh_count = arrays.sh.len() / (arrays.opacities.len() * 3).max(1);
        let scaled = |data: &[f32], v: usize| -> Vec<[f32; 3]> {
            chunks::<3>(&data[v * pixels * 3..(v + 1) * pixels * 3])
                .map(|row| row.map(|x| x * unit))
                .collect()
        };
        let views = input.views.iter().zip(prepared.fitted).enumerate();
        views
            .map(|(v, (&photo, fitted))| ViewGaussians {
                photo: u16::try_from(photo).unwrap_or(u16::MAX),
                camera: fitted.camera,
                frame_to_world: match self.manifest.output_frame {
                    OutputFrame::Camera => fitted.camera.camera_to_world,
                    OutputFrame::Model => prepared.frame.pose(),
                },
                near_far: input.near_far[photo],
                means: scaled(arrays.means, v),
                scales: scaled(arrays.scales, v),
                quats: chunks(&arrays.quats[v * pixels * 4..(v + 1) * pixels * 4]).collect(),
                opacities: arrays.opacities[v * pixels..(v + 1) * pixels].to_vec(),
                sh_degree: self.manifest.sh_degree,
                sh: chunks(&arrays.sh[v * pixels * sh_count * 3..(v + 1) * pixels * sh_count * 3])
                    .collect(),
                confidence: match arrays.confidence {
                    Some(all) => all[v * pixels..(v + 1) * pixels].to_vec(),
                    None => vec![1.0; pixels],
                },
                valid: fitted.valid,
            })
            .collect()
    }

    fn prepare(&self, input: &GeometryInput<'_>) -> Result<Prepared> {
        let (count, manifest) = (input.views.len(), &self.manifest);
        if count < manifest.views_min || count > manifest.views_max {
            return Err(Error::internal(format!(
                "geometry network: {count} views, outside {} to {}",
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
                "geometry network: neighbours {:?} do not fit {count} views",
                input.neighbors
            )));
        }
        if input.views.iter().any(|&v| v >= input.photos.len() || v >= input.near_far.len()) {
            return Err(Error::internal(format!(
                "geometry network: views {:?} of {} photos",
                input.views,
                input.photos.len()
            )));
        }
        let lenses: Vec<Intrinsics> =
            input.views.iter().map(|&v| input.photos[v].camera.intrinsics).collect();
        let bucket = bucket_for(&lenses, &manifest.buckets)
            .ok_or_else(|| Error::internal("geometry network: no buckets"))?;
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

struct Arrays<'a> {
    means: &'a [f32],
    scales: &'a [f32],
    quats: &'a [f32],
    opacities: &'a [f32],
    sh: &'a [f32],
    confidence: Option<&'a [f32]>,
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

fn chunks<const N: usize>(data: &[f32]) -> impl Iterator<Item = [f32; N]> + '_ {
    data.chunks_exact(N).map(|row| {
        let mut out = [0.0; N];
        out.copy_from_slice(row);
        out
    })
}

fn tensor<'a, const N: usize>(
    (shape, data): ([usize; N], &'a [f32]),
) -> Result<SessionInputValue<'a>> {
    Ok(TensorRef::from_array_view((shape, data)).map_err(fault("input"))?.into())
}

fn fault(what: &'static str) -> impl Fn(ort::Error) -> Error {
    move |e| Error::internal(format!("geometry network: {what} failed")).caused_by(e)
}
