//! Everything about a bundle that does not fit, at once: its manifest, every file, the signature of
//! every network, and a run of each.

use std::{path::Path, time::Instant};

use crate::{
    error::Result,
    models::{
        Bundle, CameraNetwork, FeatureNetwork, Geometry, ImageText, MaskNetwork, MatcherNetwork,
        NetworkOptions, ProviderChoice, Runtime, TextMaskNetwork, cameras, features, geometry,
        image_text, masks, matcher,
        network::{self, Signature},
        onnx::OnnxHeader,
        text_masks,
    },
};

/// What was found of a bundle.
#[derive(Clone, Debug, Default)]
pub struct BundleCheck {
    /// Its name and version.
    pub name: String,
    /// Its files, in the manifest's order.
    pub files: Vec<CheckedFile>,
    /// The networks that were run, with seconds of opening and of all runs.
    pub ran: Vec<(&'static str, [f64; 2])>,
    /// Everything that does not fit; empty: the bundle can be served.
    pub faults: Vec<String>,
}

/// A file of a bundle.
#[derive(Clone, Debug)]
pub struct CheckedFile {
    /// As [`crate::models::BundleFile::part`].
    pub part: &'static str,
    /// Its name.
    pub file: String,
    /// Its size; 0: it is missing.
    pub bytes: u64,
    /// Version of ONNX's operators, for a network.
    pub opset: Option<u64>,
    /// Constants of 64-bit floats in a network. WebGPU opens none that has one.
    pub doubles: usize,
    /// Whether it is the file of the manifest.
    pub fits: bool,
}

/// Looks at the bundle in `dir`; its networks run on the CPU, each with a fixed input: the
/// geometry at every size with the fewest and the most views, the others alone and in a batch.
///
/// # Errors
/// `model_unavailable` when there is no manifest, it cannot be parsed, or there is no library.
pub fn check(dir: &Path, options: &NetworkOptions) -> Result<BundleCheck> {
    let (bundle, mut faults) = Bundle::parse(dir)?;
    let readable = faults.is_empty();
    let mut files = Vec::new();
    for entry in bundle.files() {
        let header = bundle.verify_file(&entry);
        let network = header.as_ref().ok().and_then(Option::as_ref);
        files.push(CheckedFile {
            part: entry.part,
            file: entry.file.to_owned(),
            bytes: bundle.size_bytes(entry.file),
            opset: network.and_then(OnnxHeader::opset),
            doubles: network.map_or(0, |header| header.doubles),
            fits: header.is_ok(),
        });
        faults.extend(header.err().map(|error| error.message().to_owned()));
    }
    let mut ran = Vec::new();
    if readable {
        let options = &NetworkOptions { provider: ProviderChoice::Cpu, jobs: 1, ..options.clone() };
        let runtime = &Runtime::load(options)?;
        // A network is opened where its file and the weights beside it are those of the manifest.
        let whole = |file: &str| {
            let part = files.iter().find(|entry| entry.file == file).map(|entry| entry.part);
            files.iter().all(|entry| Some(entry.part) != part || entry.fits)
        };
        let mut run = |name, signatures: &[Signature<'_>], work: &dyn Fn() -> Result<f64>| {
            let before = faults.len();
            for (what, file, wanted) in signatures.iter().filter(|(_, file, _)| whole(file)) {
                faults.extend(network::misfits(runtime, &bundle, options, what, file, wanted));
            }
            if faults.len() > before || !signatures.iter().all(|(_, file, _)| whole(file)) {
                return;
            }
            let begun = Instant::now();
            match work() {
                Ok(opened) => ran.push((name, [opened, begun.elapsed().as_secs_f64() - opened])),
                Err(error) => faults.push(error.message().to_owned()),
            }
        };
        let geometry = bundle.geometry();
        run("geometry", &geometry::signatures(geometry), &|| {
            timed(|| Geometry::open(runtime, &bundle, options), Geometry::try_out)
        });
        if let Some(manifest) = bundle.masks() {
            run("masks", &masks::signatures(manifest), &|| {
                timed(
                    || MaskNetwork::open(runtime, &bundle, options),
                    |of| of.as_ref().map_or(Ok(()), MaskNetwork::try_out),
                )
            });
        }
        if let Some(manifest) = bundle.image_text() {
            run("image_text", &image_text::signatures(manifest), &|| {
                timed(
                    || ImageText::open(runtime, &bundle, options),
                    |of| of.as_ref().map_or(Ok(()), ImageText::try_out),
                )
            });
        }
        if let Some(manifest) = bundle.text_masks() {
            run("text_masks", &text_masks::signatures(manifest), &|| {
                timed(
                    || TextMaskNetwork::open(runtime, &bundle, options),
                    |of| of.as_ref().map_or(Ok(()), TextMaskNetwork::try_out),
                )
            });
        }
        if let Some(manifest) = bundle.features() {
            run("features", &features::signatures(manifest), &|| {
                timed(
                    || FeatureNetwork::open(runtime, &bundle, options),
                    |of| of.as_ref().map_or(Ok(()), FeatureNetwork::try_out),
                )
            });
            if let Some(own) = bundle.matcher() {
                run("matcher", &matcher::signatures(own, manifest), &|| {
                    timed(
                        || MatcherNetwork::open(runtime, &bundle, options),
                        |of| of.as_ref().map_or(Ok(()), MatcherNetwork::try_out),
                    )
                });
            }
        }
        if let Some(manifest) = bundle.cameras() {
            run("cameras", &cameras::signatures(manifest), &|| {
                timed(
                    || CameraNetwork::open(runtime, &bundle, options),
                    |of| of.as_ref().map_or(Ok(()), CameraNetwork::try_out),
                )
            });
        }
    }
    let name = format!("{} {}", bundle.name(), bundle.version());
    Ok(BundleCheck { name, files, ran, faults })
}

/// Opens a network and tries it; seconds of the opening.
fn timed<T>(open: impl Fn() -> Result<T>, run: impl Fn(&T) -> Result<()>) -> Result<f64> {
    let begun = Instant::now();
    let network = open()?;
    let opened = begun.elapsed().as_secs_f64();
    run(&network)?;
    Ok(opened)
}
