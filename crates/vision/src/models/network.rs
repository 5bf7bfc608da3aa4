//! A network as its adapters run it: on one execution provider, with the CPU behind it.
//!
//! A provider other than the CPU is held to the CPU's answer when the network opens. One that
//! differs, or that does not open, is refused. A run that fails later is answered by the CPU.

use std::{
    borrow::Cow,
    fmt::Debug,
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::Instant,
};

use half::f16;
use ort::{
    session::{
        OutputSelector, RunOptions, Session, SessionInputValue, SessionOutputs,
        builder::PrepackedWeights,
    },
    value::{Outlet, Shape, Tensor, TensorElementType, TensorRef, ValueType},
};
use parking_lot::{Condvar, Mutex};
use tracing::{info, warn};

use crate::{
    error::{Error, Result},
    meter,
    models::{
        Bundle, NetworkOptions, Provider, ProviderChoice, Runtime,
        manifest::unavailable,
        runtime::Arithmetic,
        tensors::{self, NetworkTensors, Numbers, TensorData, TensorKind, TensorSpec},
    },
};

/// Failed runs in a row after which a provider is not asked again.
const FAILURES_MAX: u32 = 3;
/// A network of more bytes has one session on the CPU, which runs for one job at a time.
const SHARED_BYTES: u64 = 256 << 20;
/// Threads for which a job has a session of its own on the CPU.
const THREADS_A_SESSION: usize = 4;
/// Sessions of a small network on CUDA. One NVIDIA H200, 16 callers, two photos each: 6.3 scenes a
/// second with one session, 14.8 with three.
const CUDA_SESSIONS: usize = 3;

/// Numbers of a tensor.
#[derive(Clone, Debug)]
pub(super) enum Data<'a> {
    F32(Cow<'a, [f32]>),
    I64(Cow<'a, [i64]>),
}

impl<'a> From<&'a [f32]> for Data<'a> {
    fn from(data: &'a [f32]) -> Self {
        Self::F32(Cow::Borrowed(data))
    }
}

impl<'a> From<&'a [i64]> for Data<'a> {
    fn from(data: &'a [i64]) -> Self {
        Self::I64(Cow::Borrowed(data))
    }
}

impl<'a> From<Cow<'a, [f32]>> for Data<'a> {
    fn from(data: Cow<'a, [f32]>) -> Self {
        Self::F32(data)
    }
}

impl From<Vec<f32>> for Data<'_> {
    fn from(data: Vec<f32>) -> Self {
        Self::F32(Cow::Owned(data))
    }
}

impl From<Vec<i64>> for Data<'_> {
    fn from(data: Vec<i64>) -> Self {
        Self::I64(Cow::Owned(data))
    }
}

/// A tensor that goes in.
#[derive(Clone, Debug)]
pub(super) struct Input<'a> {
    name: &'a str,
    shape: Vec<usize>,
    data: Data<'a>,
}

impl<'a> Input<'a> {
    pub(super) fn new(name: &'a str, shape: &[usize], data: impl Into<Data<'a>>) -> Self {
        Self { name, shape: shape.to_vec(), data: data.into() }
    }

    /// A tensor of a caller; `None` where no network takes its kind.
    fn of(tensor: &'a tensors::Tensor) -> Option<Self> {
        let data = match &tensor.data {
            TensorData::F32(data) => data.as_slice().into(),
            TensorData::I64(data) => data.as_slice().into(),
            TensorData::U8(_) => return None,
        };
        Some(Self { name: &tensor.name, shape: tensor.shape.clone(), data })
    }

    /// For a session; `half` where its file takes f16.
    fn value(&self, half: bool) -> ort::Result<SessionInputValue<'_>> {
        let shape = self.shape.clone();
        Ok(match &self.data {
            Data::F32(data) if half => {
                let data: Vec<f16> = data.iter().map(|v| f16::from_f32(*v)).collect();
                Tensor::from_array((shape, data))?.into()
            }
            Data::F32(data) => TensorRef::from_array_view((shape, &**data))?.into(),
            Data::I64(data) => TensorRef::from_array_view((shape, &**data))?.into(),
        })
    }
}

/// What a run gave.
pub(super) trait Outputs {
    /// Shape and numbers of an output; those of an f16 are widened.
    fn get(&self, name: &str) -> Result<(Vec<usize>, Cow<'_, [f32]>)>;

    /// Shape and bytes of an output of u8.
    fn bytes(&self, name: &str) -> Result<(Vec<usize>, &[u8])>;
}

impl Outputs for SessionOutputs<'_> {
    fn get(&self, name: &str) -> Result<(Vec<usize>, Cow<'_, [f32]>)> {
        let value = SessionOutputs::get(self, name).ok_or_else(|| lacking(name))?;
        if let Ok((shape, data)) = value.try_extract_tensor::<f16>() {
            return Ok((sizes(shape), data.iter().map(|v| v.to_f32()).collect()));
        }
        let (shape, data) = value
            .try_extract_tensor::<f32>()
            .map_err(|e| Error::internal(format!("output {name:?} is not of f32")).caused_by(e))?;
        Ok((sizes(shape), data.into()))
    }

    fn bytes(&self, name: &str) -> Result<(Vec<usize>, &[u8])> {
        let value = SessionOutputs::get(self, name).ok_or_else(|| lacking(name))?;
        let (shape, data) = value
            .try_extract_tensor::<u8>()
            .map_err(|e| Error::internal(format!("output {name:?} is not of u8")).caused_by(e))?;
        Ok((sizes(shape), data))
    }
}

fn lacking(name: &str) -> Error {
    Error::internal(format!("no output {name:?}"))
}

fn sizes(shape: &Shape) -> Vec<usize> {
    shape.iter().map(|&n| usize::try_from(n).unwrap_or(0)).collect()
}

/// Takes the outputs of a run.
type Read<'a> = dyn FnMut(&dyn Outputs) -> Result<()> + 'a;

/// Why a run gave nothing.
#[derive(Debug)]
pub(super) enum Failure {
    /// The provider failed.
    Run(Box<dyn std::error::Error + Send + Sync>),
    /// The outputs are not what their reader expects.
    Read(Error),
}

/// Something that runs: a session, or the stand-in of a test.
pub(super) trait Runner: Debug + Send {
    /// Gives the outputs of these names, or all where there is none.
    fn run(
        &mut self,
        inputs: &[Input<'_>],
        only: &[&str],
        read: &mut Read<'_>,
    ) -> std::result::Result<(), Failure>;
}

impl Runner for Session {
    fn run(
        &mut self,
        inputs: &[Input<'_>],
        only: &[&str],
        read: &mut Read<'_>,
    ) -> std::result::Result<(), Failure> {
        let failed = |e: ort::Error| Failure::Run(Box::new(e));
        let values: Vec<(&str, SessionInputValue<'_>)> = inputs
            .iter()
            .map(|input| {
                let taken = self.inputs().iter().find(|taken| taken.name() == input.name);
                let kind = taken.and_then(|taken| taken.dtype().tensor_type());
                Ok((input.name, input.value(kind == Some(TensorElementType::Float16))?))
            })
            .collect::<ort::Result<_>>()
            .map_err(failed)?;
        let mut names = OutputSelector::no_default();
        if only.is_empty() {
            names = OutputSelector::default();
        }
        for name in only {
            names = names.with(*name);
        }
        let options = RunOptions::new().map_err(failed)?.with_outputs(names);
        let outputs = self.run_with_options(values, &options).map_err(failed)?;
        read(&outputs).map_err(Failure::Read)
    }
}

/// Held while anything is opened, run or closed on WebGPU.
static ON_WEBGPU: Mutex<()> = Mutex::new(());

/// A session on WebGPU. Its provider ends the process where two sessions run at once, of whatever
/// networks (ONNX Runtime 1.31, issues 27592 and 32561 there), so all of them take turns.
#[derive(Debug)]
struct InTurn(Option<Box<dyn Runner>>);

impl Runner for InTurn {
    fn run(
        &mut self,
        inputs: &[Input<'_>],
        only: &[&str],
        read: &mut Read<'_>,
    ) -> std::result::Result<(), Failure> {
        let _turn = ON_WEBGPU.lock();
        self.0.as_mut().map_or(Ok(()), |runner| runner.run(inputs, only, read))
    }
}

impl Drop for InTurn {
    fn drop(&mut self) {
        let _turn = ON_WEBGPU.lock();
        drop(self.0.take());
    }
}

/// Sizes of the inputs of a run.
type Shapes = Vec<Vec<usize>>;

/// A session, and the shapes of its last run.
#[derive(Debug)]
struct Kept {
    runner: Box<dyn Runner>,
    shapes: Shapes,
}

/// Sessions of one network, lent one at a time.
#[derive(Debug)]
struct Pool {
    /// The one that came back last is last.
    idle: Mutex<Vec<Kept>>,
    returned: Condvar,
}

impl Pool {
    fn new(runners: Vec<Box<dyn Runner>>) -> Self {
        let kept = |runner| Kept { runner, shapes: Shapes::new() };
        let idle = Mutex::new(runners.into_iter().map(kept).collect());
        Self { idle, returned: Condvar::new() }
    }

    /// Runs on an idle session, and waits for one. One whose last run had the same shapes goes
    /// first, for a device looks for its fastest kernels again wherever they change (1 to 2 s of an
    /// image tower on CUDA); else the one that is idle for longest.
    fn run(
        &self,
        inputs: &[Input<'_>],
        only: &[&str],
        read: &mut Read<'_>,
    ) -> std::result::Result<(), Failure> {
        let shapes: Shapes = inputs.iter().map(|input| input.shape.clone()).collect();
        let mut idle = self.idle.lock();
        while idle.is_empty() {
            self.returned.wait(&mut idle);
        }
        let same = idle.iter().position(|kept| kept.shapes == shapes);
        let kept = idle.remove(same.unwrap_or(0));
        drop(idle);
        let mut lent = Lent { pool: self, kept: Some(Kept { shapes, ..kept }) };
        lent.kept.as_mut().map_or(Ok(()), |kept| kept.runner.run(inputs, only, read))
    }

    /// Runs on every session, one after the other; for a pool that is not in use yet.
    fn run_each(
        &self,
        inputs: &[Input<'_>],
        only: &[&str],
        read: &mut Read<'_>,
    ) -> std::result::Result<(), Failure> {
        self.idle.lock().iter_mut().try_for_each(|kept| kept.runner.run(inputs, only, read))
    }
}

/// A borrowed session; goes back when dropped.
struct Lent<'a> {
    pool: &'a Pool,
    kept: Option<Kept>,
}

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        self.pool.idle.lock().extend(self.kept.take());
        self.pool.returned.notify_one();
    }
}

/// A tensor of a file.
#[derive(Clone, Debug)]
pub(super) struct FileTensor {
    name: String,
    /// -1 where it is free; empty where the file says nothing.
    pub(super) shape: Vec<i64>,
    /// Names of the dimensions; empty where they have none.
    symbols: Vec<String>,
    kind: TensorElementType,
}

impl FileTensor {
    fn of(outlet: &Outlet) -> Self {
        let (shape, symbols, kind) = match outlet.dtype() {
            ValueType::Tensor { ty, shape, dimension_symbols } => {
                (shape.to_vec(), dimension_symbols.to_vec(), *ty)
            }
            _ => (Vec::new(), Vec::new(), TensorElementType::Undefined),
        };
        Self { name: outlet.name().to_owned(), shape, symbols, kind }
    }

    /// Whole numbers, not f32 or f16.
    pub(super) fn whole(&self) -> bool {
        self.kind == TensorElementType::Int64
    }

    /// With what callers must keep to; `None` where its kind is none of ours.
    fn spec(&self, wanted: &Wanted<'_>) -> Option<TensorSpec> {
        let kind = match self.kind {
            TensorElementType::Float32 | TensorElementType::Float16 => TensorKind::F32,
            TensorElementType::Int64 => TensorKind::I64,
            TensorElementType::Uint8 => TensorKind::U8,
            _ => return None,
        };
        let used = |axis: usize| {
            let mut sizes = wanted.shape.as_ref()?.get(axis)?.clone();
            sizes.sort_unstable();
            sizes.dedup();
            Some(sizes)
        };
        let sizes = |(axis, size): (usize, &i64)| match fixed(*size) {
            Some(size) => vec![size],
            None => used(axis).unwrap_or_default(),
        };
        Some(TensorSpec {
            name: self.name.clone(),
            kind,
            sizes: self.shape.iter().enumerate().map(sizes).collect(),
            shape: self.shape.clone(),
            symbols: self.symbols.clone(),
            most: wanted.most.clone(),
            numbers: wanted.numbers,
        })
    }
}

/// The inputs and outputs of a file.
#[derive(Clone, Debug, Default)]
pub(super) struct FileSignature {
    inputs: Vec<FileTensor>,
    outputs: Vec<FileTensor>,
}

impl FileSignature {
    fn of(session: &Session) -> Self {
        let all = |outlets: &[Outlet]| outlets.iter().map(FileTensor::of).collect();
        Self { inputs: all(session.inputs()), outputs: all(session.outputs()) }
    }

    /// The input of this name; `None` where the file has none.
    pub(super) fn get(&self, name: &str) -> Option<&FileTensor> {
        self.inputs.iter().find(|taken| taken.name == name)
    }

    /// The tensors with what callers must keep to.
    fn tensors(&self, wanted: &[Wanted<'_>]) -> NetworkTensors {
        let specs = |of: &[FileTensor], sides: [Side; 2]| -> Vec<TensorSpec> {
            let wanted = |name: &str| {
                wanted.iter().find(|want| want.name == name && sides.contains(&want.side))
            };
            of.iter().filter_map(|taken| taken.spec(wanted(&taken.name)?)).collect()
        };
        NetworkTensors {
            inputs: specs(&self.inputs, [Side::Input, Side::MayTake]),
            outputs: specs(&self.outputs, [Side::Output, Side::MayGive]),
        }
    }

    /// What the file has otherwise than the manifest says, all of it.
    fn misfits(&self, wanted: &[Wanted<'_>]) -> Vec<String> {
        let mut faults: Vec<String> = wanted.iter().filter_map(|want| want.misfit(self)).collect();
        let known = |taken: &&FileTensor| wanted.iter().any(|want| want.name == taken.name);
        faults.extend(
            self.inputs
                .iter()
                .filter(|taken| !known(taken))
                .map(|taken| format!("takes {:?}, which nothing gives it", taken.name)),
        );
        faults
    }
}

/// Which side of a network a tensor is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Side {
    Input,
    /// An input that a file may lack.
    MayTake,
    Output,
    /// An output that a file may lack; it is not compared.
    MayGive,
}

/// A network's file, and the tensors that it must have.
pub(super) type Signature<'a> = (&'static str, &'a str, Vec<Wanted<'a>>);

/// A tensor that a network must have.
#[derive(Clone, Debug)]
pub(super) struct Wanted<'a> {
    pub(super) side: Side,
    pub(super) name: &'a str,
    /// Whole numbers (i64); `None`: either kind.
    pub(super) whole: Option<bool>,
    /// For each dimension every size that is used, where an empty list is any; `None`: any shape.
    pub(super) shape: Option<Vec<Vec<usize>>>,
    /// For each dimension the largest size that a caller may send.
    pub(super) most: Vec<usize>,
    /// The numbers that a caller may send.
    pub(super) numbers: Numbers,
}

impl<'a> Wanted<'a> {
    /// A tensor of f32 (or f16).
    pub(super) fn new(side: Side, name: &'a str, shape: Vec<Vec<usize>>) -> Self {
        Self { shape: Some(shape), ..Self::unshaped(side, name) }
    }

    /// The same of any shape.
    pub(super) fn unshaped(side: Side, name: &'a str) -> Self {
        let (most, numbers) = (Vec::new(), Numbers::Any);
        Self { side, name, whole: Some(false), shape: None, most, numbers }
    }

    /// The same with the largest sizes that a caller may send.
    pub(super) fn at_most(self, most: &[usize]) -> Self {
        Self { most: most.to_vec(), ..self }
    }

    /// The same with the numbers that a caller may send.
    pub(super) fn of(self, numbers: Numbers) -> Self {
        Self { numbers, ..self }
    }

    fn misfit(&self, file: &FileSignature) -> Option<String> {
        let (word, all) = match self.side {
            Side::Input | Side::MayTake => ("input", &file.inputs),
            Side::Output | Side::MayGive => ("output", &file.outputs),
        };
        let name = self.name;
        let Some(found) = all.iter().find(|taken| taken.name == name) else {
            let needed = !matches!(self.side, Side::MayTake | Side::MayGive);
            return needed.then(|| format!("has no {word} {name:?}"));
        };
        let real = matches!(found.kind, TensorElementType::Float32 | TensorElementType::Float16)
            || (self.side == Side::MayGive && found.kind == TensorElementType::Uint8);
        let kind_fits = match self.whole {
            Some(true) => found.whole(),
            Some(false) => real,
            None => real || found.whole(),
        };
        // A file that fixes a size takes no other.
        let fits = |(have, want): (&i64, &Vec<usize>)| {
            fixed(*have).is_none_or(|have| want.iter().all(|size| *size == have))
        };
        let output = matches!(self.side, Side::Output | Side::MayGive);
        let unknown = found.shape.is_empty() && output;
        let shape = self.shape.as_ref().filter(|_| !unknown);
        let shape_fits = shape.is_none_or(|shape| {
            found.shape.len() == shape.len() && found.shape.iter().zip(shape).all(fits)
        });
        if kind_fits && shape_fits {
            return None;
        }
        let size = |sizes: &Vec<usize>| match (sizes.iter().min(), sizes.iter().max()) {
            (Some(first), Some(last)) if first == last => first.to_string(),
            (Some(first), Some(last)) => format!("{first}..{last}"),
            _ => "any".to_owned(),
        };
        let shape: Vec<String> = self.shape.iter().flatten().map(size).collect();
        let kind = if self.whole == Some(true) { "i64" } else { "f32" };
        Some(format!(
            "{word} {name:?} is {} {:?}, not {kind} [{}]",
            found.kind,
            found.shape,
            shape.join(", ")
        ))
    }
}

/// A dimension of a file; `None` where the file leaves it free.
pub(super) fn fixed(dimension: i64) -> Option<usize> {
    usize::try_from(dimension).ok().filter(|&n| n > 0)
}

/// What becomes of the memory of a run of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RunMemory {
    /// It is kept for the next one: shapes are few and runs are short.
    Kept,
    /// A device keeps it. On the CPU it goes back: a run is long beside the time to get it anew.
    KeptOnDevices,
    /// It goes back: shapes are many and large.
    GivenBack,
}

impl RunMemory {
    fn is_kept_on(self, provider: Provider) -> bool {
        match self {
            Self::Kept => true,
            Self::KeptOnDevices => provider != Provider::Cpu,
            Self::GivenBack => false,
        }
    }
}

/// Which network, and how a provider is held to the CPU.
pub(super) struct Spec<'a> {
    /// Its name in messages.
    pub(super) what: &'static str,
    /// File of the bundle.
    pub(super) file: &'a str,
    /// The file that the CPU runs, where it is another one.
    pub(super) cpu_file: Option<&'a str>,
    /// The tensors that it must have; its outputs are compared.
    pub(super) signature: Vec<Wanted<'a>>,
    /// What becomes of the memory of a run.
    pub(super) memory: RunMemory,
    /// The largest relative difference of an output to the CPU's, root of mean squares.
    pub(super) tolerance: f64,
    /// The fixed input of the comparison.
    pub(super) probe: &'a dyn Fn(&FileSignature) -> Result<Vec<Input<'a>>>,
}

/// Opens sessions of one network.
#[derive(Clone)]
struct Opener {
    runtime: Arc<Runtime>,
    options: NetworkOptions,
    file: PathBuf,
    /// The CPU's own file, in 8 bits.
    cpu_file: Option<PathBuf>,
    /// One session, whatever the number of jobs.
    shared: bool,
    /// [`Spec::memory`].
    memory: RunMemory,
}

impl Opener {
    /// A session a job on the CPU, or one that all jobs wait for where the network is large or the
    /// threads are few. On CUDA [`CUDA_SESSIONS`] of a small network: its kernels are many and
    /// short, so that one job's run leaves the device idle. Else one session on a device.
    fn open(&self, provider: Provider) -> ort::Result<(Pool, FileSignature)> {
        let (count, threads) = match provider {
            Provider::Cpu if self.shared => (1, self.options.threads),
            Provider::Cpu => shares(self.options.threads, self.options.jobs),
            Provider::Cuda if self.memory.is_kept_on(provider) => {
                (CUDA_SESSIONS, self.options.threads)
            }
            Provider::Cuda | Provider::Webgpu => (1, self.options.threads),
        };
        let own = self.cpu_file.as_ref().filter(|_| provider == Provider::Cpu);
        let file = own.unwrap_or(&self.file);
        let arithmetic = match (provider, own) {
            (Provider::Cpu, Some(_)) => Arithmetic::EightBits,
            _ => Arithmetic::F32,
        };
        let weights = PrepackedWeights::new();
        let session = |_| {
            let weights = Some(&weights);
            let keeps_memory = self.memory.is_kept_on(provider);
            self.runtime.session(file, provider, threads, weights, arithmetic, keeps_memory)
        };
        let turn = (provider == Provider::Webgpu).then(|| ON_WEBGPU.lock());
        let sessions: Vec<Session> = (0..count).map(session).collect::<ort::Result<_>>()?;
        drop(turn);
        let file = sessions.first().map(FileSignature::of).unwrap_or_default();
        let runner = |session| match provider {
            Provider::Webgpu => Box::new(InTurn(Some(Box::new(session)))) as Box<dyn Runner>,
            Provider::Cpu | Provider::Cuda => Box::new(session),
        };
        Ok((Pool::new(sessions.into_iter().map(runner).collect()), file))
    }

    /// The CPU's own answer in f32 from the file that devices run.
    fn reference(&self) -> ort::Result<Pool> {
        let threads = self.options.threads;
        let session = self.runtime.session(
            &self.file,
            Provider::Cpu,
            threads,
            None,
            Arithmetic::F32,
            false,
        )?;
        Ok(Pool::new(vec![Box::new(session)]))
    }
}

/// What opens the sessions of the CPU when a provider fails.
type OpenCpu = Box<dyn Fn() -> Result<Pool> + Send + Sync>;

/// A network, ready to run from any thread.
pub struct Network {
    what: &'static str,
    file: FileSignature,
    tensors: NetworkTensors,
    pool: Pool,
    provider: Provider,
    /// Failed runs in a row.
    failures: AtomicU32,
    cpu: Mutex<Option<Arc<Pool>>>,
    open_cpu: OpenCpu,
    /// Why a better provider was refused.
    refused: Option<String>,
}

impl Debug for Network {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let provider = self.provider();
        f.debug_struct("Network").field("what", &self.what).field("provider", &provider).finish()
    }
}

impl Network {
    /// Opens a file of the bundle on the first provider of the choice that takes it and gives the
    /// CPU's answer.
    ///
    /// # Errors
    /// `model_unavailable`, naming network and provider, and the difference where that is it.
    pub(super) fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
        spec: &Spec<'_>,
    ) -> Result<Self> {
        let what = spec.what;
        let opener = Opener {
            runtime: Arc::clone(runtime),
            options: options.clone(),
            file: bundle.path(spec.file),
            cpu_file: spec.cpu_file.map(|file| bundle.path(file)),
            shared: bundle.network_bytes(spec.file) > SHARED_BYTES,
            memory: spec.memory,
        };
        let mut refused = None;
        for provider in runtime.candidates(options.provider)? {
            let name = provider.name();
            let opened = opener.open(provider).map_err(|e| {
                unavailable(format!("{what}: {name} does not open {}", spec.file)).caused_by(e)
            });
            let checked = opened.and_then(|(pool, file)| {
                let misfits = file.misfits(&spec.signature);
                let tensors = file.tensors(&spec.signature);
                if !misfits.is_empty() {
                    let (file, all) = (spec.file, misfits.join("; and "));
                    return Err(unavailable(format!("{what}: {file} {all}")));
                }
                if provider != Provider::Cpu {
                    let reference = opener.reference().map_err(|e| {
                        unavailable(format!("{what}: cpu does not open {}", spec.file)).caused_by(e)
                    })?;
                    let probe = (spec.probe)(&file)?;
                    let off = check(spec, name, &pool, &reference, &probe)?;
                    info!(network = what, provider = name, off, "held to the CPU's answer");
                }
                Ok((pool, file, tensors))
            });
            match checked {
                Ok((pool, file, tensors)) => {
                    info!(network = what, provider = name, "open");
                    let open_cpu = move || {
                        let opened = opener.open(Provider::Cpu).map(|(pool, _)| pool);
                        opened.map_err(|e| {
                            unavailable(format!("{what}: cpu does not open it")).caused_by(e)
                        })
                    };
                    return Ok(Self {
                        tensors,
                        refused: refused.map(|e: Error| e.message().to_owned()),
                        ..Self::of(what, provider, pool, file, Box::new(open_cpu))
                    });
                }
                Err(error) => {
                    warn!(network = what, provider = name, %error, "refused");
                    if options.provider != ProviderChoice::Auto || provider == Provider::Cpu {
                        return Err(error);
                    }
                    refused = Some(error);
                }
            }
        }
        Err(refused.unwrap_or_else(|| unavailable(format!("{what}: no provider"))))
    }

    fn of(
        what: &'static str,
        provider: Provider,
        pool: Pool,
        file: FileSignature,
        open_cpu: OpenCpu,
    ) -> Self {
        Self {
            what,
            file,
            tensors: NetworkTensors::default(),
            pool,
            provider,
            failures: AtomicU32::new(0),
            cpu: Mutex::default(),
            open_cpu,
            refused: None,
        }
    }

    /// The tensors of its file.
    pub(super) fn signature(&self) -> &FileSignature {
        &self.file
    }

    /// Its tensors, for [`Self::infer`].
    #[must_use]
    pub fn tensors(&self) -> &NetworkTensors {
        &self.tensors
    }

    /// Runs the network on tensors of a caller from outside and gives the outputs of these names,
    /// or all where there is none. Waits for an idle session as every run does. A run that fails
    /// is the caller's fault: the provider is asked again by others.
    ///
    /// # Errors
    /// `invalid_request` where a tensor is not one that the network takes, or they do not fit each
    /// other; `internal` where an output has another kind than the file says.
    pub fn infer(
        &self,
        given: &[tensors::Tensor],
        only: &[String],
    ) -> Result<Vec<tensors::Tensor>> {
        self.tensors.check(given)?;
        let outputs = self.tensors.chosen(only)?;
        let names: Vec<&str> = outputs.iter().map(|output| &*output.name).collect();
        let inputs: Vec<Input<'_>> = given.iter().filter_map(Input::of).collect();
        let mut found = Vec::with_capacity(outputs.len());
        let mut read = |of: &dyn Outputs| {
            for TensorSpec { name, kind, .. } in &outputs {
                let (shape, data) = match kind {
                    TensorKind::U8 => {
                        let (shape, data) = of.bytes(name)?;
                        (shape, TensorData::U8(data.to_vec()))
                    }
                    TensorKind::F32 | TensorKind::I64 => {
                        let (shape, data) = of.get(name)?;
                        (shape, TensorData::F32(data.into_owned()))
                    }
                };
                found.push(tensors::Tensor { name: name.clone(), shape, data });
            }
            Ok(())
        };
        let begun = Instant::now();
        let ran = match self.lost() {
            false => self.pool.run(&inputs, &names, &mut read),
            true => self.cpu()?.run(&inputs, &names, &mut read),
        };
        meter::network(self.what, begun.elapsed().as_secs_f64());
        match ran {
            Ok(()) => Ok(found),
            Err(Failure::Read(error)) => Err(error),
            Err(Failure::Run(e)) => {
                let why = format!("{}: it does not run with these inputs", self.what);
                Err(Error::invalid(why).caused_by(e))
            }
        }
    }

    /// What computes it now.
    pub(super) fn provider(&self) -> Provider {
        if self.lost() { Provider::Cpu } else { self.provider }
    }

    /// Why it is not computed where it was to be; `None` where it is.
    pub(super) fn remark(&self) -> Option<String> {
        let lost = || format!("{}: {} was lost", self.what, self.provider.name());
        self.refused.clone().or_else(|| self.lost().then(lost))
    }

    fn lost(&self) -> bool {
        self.failures.load(Ordering::Relaxed) >= FAILURES_MAX
    }

    /// Runs the network and gives its outputs to `read`. Where the provider fails, the CPU answers.
    ///
    /// # Errors
    /// Those of `read`; `internal` when the CPU fails too.
    pub(super) fn run<T>(
        &self,
        inputs: &[Input<'_>],
        read: impl FnOnce(&dyn Outputs) -> Result<T>,
    ) -> Result<T> {
        self.run_for(inputs, &[], read)
    }

    /// The same, with the outputs of these names only: no other comes back from a device.
    ///
    /// # Errors
    /// Those of [`Self::run`].
    pub(super) fn run_for<T>(
        &self,
        inputs: &[Input<'_>],
        only: &[&str],
        read: impl FnOnce(&dyn Outputs) -> Result<T>,
    ) -> Result<T> {
        let (mut read, mut answer) = (Some(read), None);
        let mut once = |outputs: &dyn Outputs| {
            answer = read.take().map(|read| read(outputs)).transpose()?;
            Ok(())
        };
        let begun = Instant::now();
        self.run_dyn(inputs, only, &mut once)?;
        meter::network(self.what, begun.elapsed().as_secs_f64());
        answer.ok_or_else(|| Error::internal(format!("{}: no answer", self.what)))
    }

    fn run_dyn(&self, inputs: &[Input<'_>], only: &[&str], read: &mut Read<'_>) -> Result<()> {
        let what = self.what;
        let failed = |e| Error::internal(format!("{what}: run failed")).caused_by(e);
        if !self.lost() {
            match self.pool.run(inputs, only, read) {
                Ok(()) => {
                    self.failures.store(0, Ordering::Relaxed);
                    return Ok(());
                }
                Err(Failure::Read(error)) => return Err(error),
                Err(Failure::Run(e)) if self.provider == Provider::Cpu => return Err(failed(e)),
                Err(Failure::Run(e)) => {
                    let failures = self.failures.fetch_add(1, Ordering::Relaxed) + 1;
                    let from = self.provider.name();
                    warn!(network = what, from, failures, error = %e, "failed; the CPU answers");
                }
            }
        }
        meter::fallback(what);
        self.cpu()?.run(inputs, only, read).map_err(|failure| match failure {
            Failure::Run(e) => failed(e),
            Failure::Read(error) => error,
        })
    }

    /// Sessions of the CPU, for a provider that fails.
    fn cpu(&self) -> Result<Arc<Pool>> {
        let mut kept = self.cpu.lock();
        Ok(match &*kept {
            Some(cpu) => Arc::clone(cpu),
            None => Arc::clone(kept.insert(Arc::new((self.open_cpu)()?))),
        })
    }
}

/// What a network's file has otherwise than its manifest says; or why the CPU does not open it.
pub(super) fn misfits(
    runtime: &Runtime,
    bundle: &Bundle,
    options: &NetworkOptions,
    what: &str,
    file: &str,
    wanted: &[Wanted<'_>],
) -> Vec<String> {
    let path = bundle.path(file);
    match runtime.session(&path, Provider::Cpu, options.threads, None, Arithmetic::F32, false) {
        Ok(session) => FileSignature::of(&session)
            .misfits(wanted)
            .into_iter()
            .map(|fault| format!("{what}: {file} {fault}"))
            .collect(),
        Err(e) => vec![format!("{what}: cpu does not open {file}: {e}")],
    }
}

/// Holds a provider to the reference on one input: the largest relative difference of an output,
/// root of mean squares.
///
/// # Errors
/// `model_unavailable` when a run fails or the difference is over the tolerance.
fn check(
    spec: &Spec<'_>,
    provider: &str,
    pool: &Pool,
    reference: &Pool,
    probe: &[Input<'_>],
) -> Result<f64> {
    let what = spec.what;
    let compared = spec.signature.iter().filter(|wanted| wanted.side == Side::Output);
    let compared: Vec<&str> = compared.map(|wanted| wanted.name).collect();
    let answers = |pool: &Pool, name: &str| {
        let mut answers: Vec<Vec<f32>> = Vec::new();
        let mut read = |outputs: &dyn Outputs| {
            for output in &compared {
                answers.push(outputs.get(output)?.1.into_owned());
            }
            Ok(())
        };
        // Every session: a device looks for its fastest kernels at the first run of each.
        match pool.run_each(probe, &compared, &mut read) {
            Ok(()) => Ok(answers),
            Err(Failure::Read(error)) => Err(error),
            Err(Failure::Run(e)) => {
                Err(unavailable(format!("{what}: {name} does not run")).caused_by(e))
            }
        }
    };
    let (found, wanted) = (answers(pool, provider)?, answers(reference, "cpu")?);
    // The answers of one session come after those of another.
    let differences = found.iter().zip(wanted.iter().cycle()).map(|(a, b)| difference(a, b));
    let off = differences.fold(0.0, f64::max);
    if off <= spec.tolerance {
        return Ok(off);
    }
    Err(unavailable(format!(
        "{what}: {provider} differs from the CPU by {off:.1e} of its answer, over {:.0e}; it is \
         refused",
        spec.tolerance
    )))
}

/// Root of the mean squared difference as a share of that of `wanted`; infinite where a number or
/// their count is no match.
fn difference(found: &[f32], wanted: &[f32]) -> f64 {
    let squares = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let pairs = found.iter().zip(wanted);
    let off = squares(&mut pairs.map(|(a, b)| f64::from(*a) - f64::from(*b)));
    let all = squares(&mut wanted.iter().map(|v| f64::from(*v)));
    let share = (off / all.max(f64::MIN_POSITIVE)).sqrt();
    if found.len() == wanted.len() && share.is_finite() { share } else { f64::INFINITY }
}

/// Sessions, and threads of an operator in each, together at most `threads`. Each job has a session
/// of its own where it has [`THREADS_A_SESSION`]: on fewer, runs side by side take the memory of
/// both and end no sooner.
fn shares(threads: usize, jobs: usize) -> (usize, usize) {
    let sessions = jobs.clamp(1, (threads / THREADS_A_SESSION).max(1));
    (sessions, (threads / sessions).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;

    /// Gives its one number, or fails.
    #[derive(Debug)]
    struct Fake(Option<f32>);

    struct One([f32; 1]);

    impl Outputs for One {
        fn get(&self, _: &str) -> Result<(Vec<usize>, Cow<'_, [f32]>)> {
            Ok((vec![1], self.0.as_slice().into()))
        }

        fn bytes(&self, name: &str) -> Result<(Vec<usize>, &[u8])> {
            Err(lacking(name))
        }
    }

    impl Runner for Fake {
        fn run(
            &mut self,
            _: &[Input<'_>],
            _: &[&str],
            read: &mut Read<'_>,
        ) -> std::result::Result<(), Failure> {
            match self.0 {
                Some(value) => read(&One([value])).map_err(Failure::Read),
                None => Err(Failure::Run("CUDA error 700".into())),
            }
        }
    }

    fn pool(fakes: impl IntoIterator<Item = Option<f32>>) -> Pool {
        let boxed = |fake| Box::new(Fake(fake)) as Box<dyn Runner>;
        Pool::new(fakes.into_iter().map(boxed).collect())
    }

    /// One number of each session, and the CPU's.
    fn held(found: &[f32], wanted: f32) -> Result<f64> {
        let spec = Spec {
            what: "fake network",
            file: "fake.onnx",
            cpu_file: None,
            signature: vec![Wanted::new(Side::Output, "answer", vec![vec![1]])],
            memory: RunMemory::Kept,
            tolerance: 1e-2,
            probe: &|_| Ok(Vec::new()),
        };
        let sessions = pool(found.iter().map(|found| Some(*found)));
        check(&spec, "cuda", &sessions, &pool([Some(wanted)]), &[])
    }

    #[test]
    fn sessions_on_webgpu_run_one_at_a_time() {
        let (running, most) = (AtomicU32::new(0), AtomicU32::new(0));
        std::thread::scope(|threads| {
            for _ in 0..4 {
                threads.spawn(|| {
                    let mut session = InTurn(Some(Box::new(Fake(Some(1.0)))));
                    let mut read = |_: &dyn Outputs| {
                        most.fetch_max(
                            running.fetch_add(1, Ordering::SeqCst) + 1,
                            Ordering::SeqCst,
                        );
                        std::thread::sleep(std::time::Duration::from_millis(20));
                        running.fetch_sub(1, Ordering::SeqCst);
                        Ok(())
                    };
                    session.run(&[], &[], &mut read).unwrap();
                });
            }
        });
        assert_eq!(most.into_inner(), 1);
    }

    /// Counts runs whose shapes are others than those of its run before.
    #[derive(Debug)]
    struct Searching(Option<usize>, Arc<AtomicU32>);

    impl Runner for Searching {
        fn run(
            &mut self,
            inputs: &[Input<'_>],
            _: &[&str],
            _: &mut Read<'_>,
        ) -> std::result::Result<(), Failure> {
            let size = inputs.first().map(|input| input.shape[0]);
            if std::mem::replace(&mut self.0, size) != size {
                self.1.fetch_add(1, Ordering::SeqCst);
            }
            Ok(())
        }
    }

    #[test]
    fn runs_of_other_shapes_have_other_sessions() {
        let searches = Arc::new(AtomicU32::new(0));
        let session = || Box::new(Searching(None, Arc::clone(&searches))) as Box<dyn Runner>;
        let pool = Pool::new(vec![session(), session(), session()]);
        for size in [1, 16].repeat(5).into_iter().chain([4, 1, 16, 4]) {
            let input = Input::new("images", &[size], vec![0.0_f32; size]);
            pool.run(&[input], &[], &mut |_| Ok(())).unwrap();
        }
        assert_eq!(searches.load(Ordering::SeqCst), 3, "one for each shape");
    }

    #[test]
    fn a_provider_that_differs_is_refused_by_name_with_the_figure() {
        assert!(held(&[1.005, 0.995], 1.0).is_ok(), "within the tolerance");
        for wrong in [1.02, -1.0, f32::NAN, f32::INFINITY] {
            assert!(held(&[wrong], 1.0).is_err(), "{wrong}");
            let error = held(&[1.0, wrong], 1.0).unwrap_err();
            assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
            let message = error.message();
            assert!(message.contains("fake network: cuda differs from the CPU by"), "{message}");
        }
        assert!(held(&[1.02], 1.0).unwrap_err().message().contains("2.0e-2"), "names the figure");
    }

    #[test]
    fn the_cpu_answers_for_a_provider_that_is_gone() {
        let gone = |fake: Option<f32>| {
            let cpu = || Ok(pool([Some(7.0)]));
            let file = FileSignature::default();
            Network::of("fake network", Provider::Cuda, pool([fake]), file, Box::new(cpu))
        };
        let answer =
            |network: &Network| network.run(&[], |outputs| Ok(outputs.get("answer")?.1[0]));
        let well = gone(Some(3.0));
        assert_eq!(answer(&well).unwrap(), 3.0, "the provider answers while it is there");
        assert_eq!(well.remark(), None);
        let network = gone(None);
        for run in 1..=5 {
            assert_eq!(answer(&network).unwrap(), 7.0, "run {run}");
            let lost = run >= FAILURES_MAX;
            let wanted = if lost { Provider::Cpu } else { Provider::Cuda };
            assert_eq!(network.provider(), wanted, "run {run}");
            assert_eq!(network.remark().is_some(), lost, "run {run}");
        }
    }

    #[test]
    fn a_failure_of_the_cpu_is_an_error() {
        let none = || Ok(pool([]));
        let file = FileSignature::default();
        let network =
            Network::of("fake network", Provider::Cpu, pool([None]), file, Box::new(none));
        let error = network.run(&[], |_| Ok(())).unwrap_err();
        assert_eq!(error.code(), ErrorCode::Internal, "{error}");
        assert_eq!(network.provider(), Provider::Cpu);
    }

    #[test]
    fn threads_are_never_oversubscribed() {
        for threads in 1..20 {
            for jobs in 1..20 {
                let (sessions, each) = shares(threads, jobs);
                assert!(sessions * each <= threads, "{threads} threads, {jobs} jobs");
                assert!(sessions >= 1 && each >= 1, "{threads} threads, {jobs} jobs");
            }
        }
        assert_eq!(shares(2, 1), (1, 2), "one job gets all threads");
        assert_eq!(shares(2, 2), (1, 2), "few threads are not parted");
        assert_eq!(shares(8, 2), (2, 4), "two jobs share");
    }
}
