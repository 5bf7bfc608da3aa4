//! ONNX Runtime: it is found, checked by sha256 and loaded once in a process, never at build time.
//!
//! Search order: `--ort-library` / `SEGSPLAT_ORT_LIBRARY`, `ORT_DYLIB_PATH`, beside the executable,
//! `../share/segsplat`, `target/ort` of the checkout or of the working folder, the system's
//! folders. In each of them a folder `cuda` or `webgpu` comes first for that provider, and `cuda`
//! for `auto`. A library that the operator *named* is always loaded. A warning tells when its hash
//! is not pinned (a newer release). A library that was only *found* must be one of the
//! pinned builds, or the server does not start.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use ort::{
    ep::{self, ExecutionProvider, cuda::ConvAlgorithmSearch},
    session::{Session, builder::PrepackedWeights},
};
use parking_lot::Mutex;
use tracing::{info, warn};

use crate::{
    error::Result,
    models::{
        NetworkOptions, ProviderChoice, SETUP_COMMAND, bundle::sha256_of, correlate,
        manifest::unavailable, places,
    },
};

/// File name of the library.
const LIBRARY: &str = "libonnxruntime.so";
/// sha256 and name of every accepted build, as `scripts/setup` reads it too.
const PINS: &str = include_str!("../../../../third_party/onnxruntime.sha256");
/// Folders of the system, in the loader's own order.
const SYSTEM: [&str; 6] = [
    "/usr/local/lib",
    "/usr/lib/x86_64-linux-gnu",
    "/usr/lib/aarch64-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/lib",
];

/// What computes the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Provider {
    /// ONNX Runtime's own kernels.
    Cpu,
    /// CUDA.
    Cuda,
    /// WebGPU.
    Webgpu,
}

impl Provider {
    /// Name for reports and logs.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::Webgpu => "webgpu",
        }
    }
}

/// How a session computes with weights that are stored in 8 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arithmetic {
    /// In f32, which the weights become once, when the file is opened. Left in 8 bits they become
    /// f32 at each run, and no convolution is fused with what follows it: crops take twice as long.
    F32,
    /// In 8 bits all through, as the file says. Processors that lack 8-bit dot products get a form
    /// in which sums of products do not overflow; it breaks files that only store a weight so.
    EightBits,
}

/// The loaded library: one in a process.
#[derive(Debug)]
pub struct Runtime {
    environment: ort::environment::Environment,
    path: PathBuf,
    sha256: String,
    pinned: Option<&'static str>,
    /// Whether a session has told the library the domain of our operators.
    domain_known: Mutex<bool>,
}

/// The process's library. `ort` can load one only, so a second one is an error, not a surprise.
static LOADED: Mutex<Option<Arc<Runtime>>> = Mutex::new(None);

impl Runtime {
    /// Finds, checks and loads the library; the same [`Runtime`] again on later calls.
    ///
    /// # Errors
    /// `model_unavailable`: no library (names the command that gets it), one that is not pinned
    /// where it was only found, one too old, or another one is loaded already.
    pub fn load(options: &NetworkOptions) -> Result<Arc<Self>> {
        let (path, named) = locate(options)?;
        let mut loaded = LOADED.lock();
        if let Some(runtime) = &*loaded {
            if runtime.path == path {
                return Ok(Arc::clone(runtime));
            }
            return Err(unavailable(
                "ONNX Runtime: another library is loaded in this process already",
            ));
        }
        let sha256 = sha256_of(&path).map_err(|e| {
            unavailable(format!("ONNX Runtime: the library cannot be read ({})", e.kind()))
                .caused_by(e)
        })?;
        let pinned = pin_of(&sha256);
        match (pinned, named) {
            (Some(name), _) => info!(library = %path.display(), build = name, "ONNX Runtime"),
            (None, true) => warn!(
                library = %path.display(), sha256,
                "ONNX Runtime is not a pinned build; loaded because it was named"
            ),
            (None, false) => {
                return Err(unavailable(format!(
                    "ONNX Runtime: the {LIBRARY} that was found has sha256 {sha256}, which is not \
                     pinned; run `{SETUP_COMMAND}`, or name the library with \
                     SEGSPLAT_ORT_LIBRARY to use it all the same"
                )));
            }
        }
        if matches!(options.provider, ProviderChoice::Auto | ProviderChoice::Cuda) {
            preload_cuda(&path);
        }
        let environment = ort::init_from(&path)
            .map_err(|e| {
                unavailable(format!(
                    "ONNX Runtime: the library does not load; run `{SETUP_COMMAND}`"
                ))
                .caused_by(e)
            })?
            .with_name("segsplat")
            .with_telemetry(false)
            .build()
            .map_err(|e| unavailable("ONNX Runtime: the library does not start").caused_by(e))?;
        let runtime =
            Arc::new(Self { environment, path, sha256, pinned, domain_known: Mutex::new(false) });
        *loaded = Some(Arc::clone(&runtime));
        Ok(runtime)
    }

    /// The library's file.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// sha256 of the library.
    #[must_use]
    pub fn sha256(&self) -> &str {
        &self.sha256
    }

    /// Name of the pinned build, when it is one.
    #[must_use]
    pub fn build(&self) -> Option<&'static str> {
        self.pinned
    }

    /// Opens `model` on `provider`, `threads` threads an operator, spinning off. Sessions that get
    /// the same `weights` share what the CPU's kernels make of them. One that `keeps_memory` takes
    /// that of a run from the last one: faster, but it holds the largest of every shape for good.
    ///
    /// CUDA computes in f32: TF32 is off. Its convolutions are chosen by a search, which takes
    /// about a second at the first run of a shape; the heuristic's are several times slower.
    pub(super) fn session(
        &self,
        model: &Path,
        provider: Provider,
        threads: usize,
        weights: Option<&PrepackedWeights>,
        arithmetic: Arithmetic,
        keeps_memory: bool,
    ) -> ort::Result<Session> {
        let providers = match provider {
            Provider::Cpu => vec![ep::CPU::default().with_arena_allocator(keeps_memory).build()],
            Provider::Cuda => vec![
                ep::CUDA::default()
                    .with_tf32(false)
                    .with_conv_algorithm_search(ConvAlgorithmSearch::Exhaustive)
                    .build()
                    .error_on_failure(),
            ],
            Provider::Webgpu => vec![ep::WebGPU::default().build().error_on_failure()],
        };
        let mut builder = Session::builder(&self.environment)?
            .with_intra_threads(threads)?
            .with_inter_threads(1)?
            .with_intra_op_spinning(false)?
            .with_inter_op_spinning(false)?
            .with_memory_pattern(keeps_memory)?
            .with_operators(correlate::domain()?)?
            .with_execution_providers(providers)?;
        if let Some(weights) = weights {
            builder = builder.with_prepacked_weights(weights)?;
        }
        let mut builder = match arithmetic {
            Arithmetic::F32 => builder.with_quant_qdq(false)?,
            Arithmetic::EightBits => builder.with_precise_qmm()?,
        };
        // The library asks whether it knows the domain of our operators and then adds it, without
        // a lock: of two first sessions at once, one fails. So the first one is opened alone.
        let mut known = self.domain_known.lock();
        if *known {
            drop(known);
            return builder.commit_from_file(model);
        }
        let session = builder.commit_from_file(model)?;
        *known = true;
        Ok(session)
    }

    /// Providers to try for a choice, best first.
    pub(super) fn candidates(&self, choice: ProviderChoice) -> Result<Vec<Provider>> {
        let (provider, available) = match choice {
            ProviderChoice::Cpu => return Ok(vec![Provider::Cpu]),
            ProviderChoice::Auto | ProviderChoice::Cuda => {
                (Provider::Cuda, ep::CUDA::is_available())
            }
            ProviderChoice::Webgpu => (Provider::Webgpu, ep::WebGPU::is_available()),
        };
        match (choice, available.unwrap_or(false)) {
            (ProviderChoice::Auto, false) => Ok(vec![Provider::Cpu]),
            (ProviderChoice::Auto, true) => Ok(vec![provider, Provider::Cpu]),
            (_, true) => Ok(vec![provider]),
            (_, false) => Err(unavailable(format!(
                "execution provider {0}: this ONNX Runtime library was built without it; run \
                 `{SETUP_COMMAND} --provider {0}`, or use --provider auto",
                provider.name()
            ))),
        }
    }
}

/// Name of the pinned build with this hash.
fn pin_of(sha256: &str) -> Option<&'static str> {
    PINS.lines()
        .filter_map(|line| line.split_once("  "))
        .find(|(hash, _)| hash.eq_ignore_ascii_case(sha256))
        .map(|(_, name)| name.trim())
}

/// The library's path, and whether the operator named it.
fn locate(options: &NetworkOptions) -> Result<(PathBuf, bool)> {
    let from_env = || std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from);
    if let Some(path) = options.ort_library.clone().or_else(from_env) {
        let path = if path.is_dir() { path.join(LIBRARY) } else { path };
        return match path.canonicalize() {
            Ok(path) => Ok((path, true)),
            Err(e) => Err(unavailable(format!(
                "ONNX Runtime: the library named by --ort-library, SEGSPLAT_ORT_LIBRARY or \
                 ORT_DYLIB_PATH cannot be read ({}); run `{SETUP_COMMAND}` and unset it to use \
                 the pinned one",
                e.kind()
            ))
            .caused_by(e)),
        };
    }
    let target = std::env::var_os("CARGO_TARGET_DIR").map(|dir| PathBuf::from(dir).join("ort"));
    let own = places::folders();
    let folders = own
        .iter()
        .cloned()
        .chain(target)
        .chain(own.iter().map(|folder| folder.join("target/ort")))
        .chain(SYSTEM.iter().map(PathBuf::from));
    folders
        .flat_map(|folder| builds(options.provider).iter().map(move |build| folder.join(build)))
        .find_map(|folder| folder.join(LIBRARY).canonicalize().ok())
        .map(|path| (path, false))
        .ok_or_else(|| {
            unavailable(format!(
                "ONNX Runtime is missing: no {LIBRARY} beside the executable, in \
                 ../share/segsplat, in target/ort or in the system's folders; run \
                 `{SETUP_COMMAND}` (24 MB, checked by sha256)"
            ))
        })
}

/// Folders of the builds for a choice, beside or in the folder that is searched, best first.
fn builds(choice: ProviderChoice) -> &'static [&'static str] {
    match choice {
        ProviderChoice::Cpu => &[""],
        ProviderChoice::Auto | ProviderChoice::Cuda => &["cuda", ""],
        ProviderChoice::Webgpu => &["webgpu", ""],
    }
}

/// Loads CUDA's libraries that lie beside the library, so that the loader needs no path.
fn preload_cuda(library: &Path) {
    let names = ep::cuda::CUDA_DYLIBS.iter().chain(ep::cuda::CUDNN_DYLIBS);
    for name in names.copied() {
        let path = library.with_file_name(name);
        if path.is_file()
            && let Err(e) = ort::util::preload_dylib(&path)
        {
            warn!(library = name, error = %e, "a library of CUDA does not load");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;

    #[test]
    fn every_pin_is_a_hash_and_a_name() {
        let pins: Vec<_> = PINS.lines().filter(|line| !line.starts_with('#')).collect();
        assert!(!pins.is_empty(), "no pins");
        for line in pins {
            let (hash, name) = line.split_once("  ").expect("hash, two spaces, name");
            assert_eq!(hash.len(), 64, "{line}");
            assert_eq!(pin_of(hash), Some(name.trim()), "{line}");
        }
        assert_eq!(pin_of(&"0".repeat(64)), None, "an unknown hash has no pin");
    }

    #[test]
    fn a_named_library_that_is_missing_names_the_command() {
        let options = NetworkOptions {
            ort_library: Some("/nonexistent/lib.so".into()),
            ..NetworkOptions::default()
        };
        let error = locate(&options).unwrap_err();
        assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
        assert!(error.message().contains(SETUP_COMMAND), "{error}");
    }
}
