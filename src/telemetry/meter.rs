//! Every metric of the process. All are registered before the first event.
//!
//! Labels take few values, all named here or in the tables of calls and errors: a caller cannot
//! make new ones. The label `door` is `http` or `grpc`.

use std::{sync::LazyLock, time::Duration};

use prometheus::{
    Gauge, HistogramVec, IntCounter, IntCounterVec, TextEncoder, register_gauge,
    register_gauge_vec, register_histogram_vec, register_int_counter, register_int_counter_vec,
};

pub use segsplat_core::meter::{stage, stages};

use crate::error::{Error, Result, TABLE};

struct Metrics {
    requests: IntCounterVec,
    request_seconds: HistogramVec,
    inflight: Gauge,
    jobs: IntCounterVec,
    jobs_queued: Gauge,
    jobs_running: Gauge,
    renders: Gauge,
    cache_bytes: Gauge,
    photos_bytes: Gauge,
    uploaded: IntCounter,
    uploads_held: Gauge,
    ready: Gauge,
    resident: Gauge,
    open_fds: Gauge,
}

impl Metrics {
    /// Registers every metric and gives each its first value.
    fn register() -> prometheus::Result<Self> {
        segsplat_core::meter::register();
        register_gauge_vec!("segsplat_build_info", "1, with the version as a label", &["version"])?
            .with_label_values(&[env!("CARGO_PKG_VERSION")])
            .set(1.0);
        let jobs = register_int_counter_vec!(
            "segsplat_jobs_total",
            "Jobs ended, by kind and outcome",
            &["kind", "outcome"]
        )?;
        let gauge = |name: &str, help: &str| register_gauge!(name, help);
        Ok(Self {
            requests: register_int_counter_vec!(
                "segsplat_requests_total",
                "Calls answered, by door (http, grpc), call and code of the error table or ok",
                &["door", "call", "code"]
            )?,
            request_seconds: register_histogram_vec!(
                "segsplat_request_seconds",
                "Time to the first byte of the answer, by door and call",
                &["door", "call"],
                segsplat_core::meter::BUCKETS.to_vec()
            )?,
            inflight: gauge("segsplat_requests_inflight", "Calls whose answer is not sent yet")?,
            jobs,
            jobs_queued: gauge("segsplat_jobs_queued", "Jobs that wait")?,
            jobs_running: gauge("segsplat_jobs_running", "Jobs at work")?,
            renders: gauge("segsplat_renders_inside", "Renders at work or waiting")?,
            cache_bytes: gauge("segsplat_scene_cache_bytes", "Bytes of scenes in memory")?,
            photos_bytes: gauge("segsplat_photos_bytes", "Bytes of photos in memory for jobs")?,
            uploaded: register_int_counter!(
                "segsplat_upload_bytes_total",
                "Bytes of uploads received"
            )?,
            uploads_held: gauge("segsplat_uploads_held_bytes", "Bytes of uploads in memory now")?,
            ready: gauge("segsplat_ready", "1 where the server takes new work")?,
            resident: gauge("process_resident_memory_bytes", "Resident memory of the process")?,
            open_fds: gauge("process_open_fds", "Open file descriptors of the process")?,
        })
    }
}

static METRICS: LazyLock<Metrics> =
    LazyLock::new(|| Metrics::register().expect("each name is registered once; this is a bug"));

/// Registers a call before its first answer.
pub fn register_call(transport: &'static str, call: &'static str) {
    METRICS.requests.with_label_values(&[transport, call, "ok"]);
    METRICS.request_seconds.with_label_values(&[transport, call]);
}

/// Registers kinds of jobs before the first of them ends.
pub fn register_jobs(kinds: impl Iterator<Item = &'static str>) {
    for kind in kinds {
        for outcome in ["done", "failed", "cancelled", "requeued"] {
            METRICS.jobs.with_label_values(&[kind, outcome]);
        }
    }
}

/// Counts an answered call; `code` is a name of the error table, or `ok`.
pub fn answered(transport: &'static str, call: &'static str, code: &str, took: Duration) {
    let code = TABLE.iter().find(|row| row.name == code).map_or("ok", |row| row.name);
    METRICS.requests.with_label_values(&[transport, call, code]).inc();
    METRICS.request_seconds.with_label_values(&[transport, call]).observe(took.as_secs_f64());
}

/// Counts a call as open (1) or ended (-1).
pub fn inflight(change: f64) {
    METRICS.inflight.add(change);
}

/// Counts an ended job.
pub fn job(kind: &'static str, outcome: &'static str) {
    METRICS.jobs.with_label_values(&[kind, outcome]).inc();
}

/// Counts bytes of an upload.
pub fn uploaded(bytes: usize) {
    METRICS.uploaded.inc_by(bytes as u64);
}

/// Values that are read when somebody asks for the metrics.
#[derive(Clone, Copy, Debug, Default)]
pub struct Readings {
    /// Whether the server takes new work.
    pub ready: bool,
    /// Jobs that wait.
    pub jobs_queued: usize,
    /// Jobs at work.
    pub jobs_running: usize,
    /// Renders at work or waiting.
    pub renders: usize,
    /// Bytes of scenes in memory.
    pub cache_bytes: u64,
    /// Bytes of photos in memory, for jobs and for first texts.
    pub photos_bytes: u64,
    /// Bytes of uploads in memory.
    pub uploads_held_bytes: usize,
}

/// All metrics in the text format of Prometheus.
///
/// # Errors
/// `internal` when they cannot be written as text.
pub fn text(levels: Readings) -> Result<String> {
    METRICS.ready.set(f64::from(u8::from(levels.ready)));
    METRICS.jobs_queued.set(levels.jobs_queued as f64);
    METRICS.jobs_running.set(levels.jobs_running as f64);
    METRICS.renders.set(levels.renders as f64);
    METRICS.cache_bytes.set(levels.cache_bytes as f64);
    METRICS.photos_bytes.set(levels.photos_bytes as f64);
    METRICS.uploads_held.set(levels.uploads_held_bytes as f64);
    if let Some(bytes) = resident_bytes() {
        METRICS.resident.set(bytes);
    }
    if let Ok(open) = std::fs::read_dir("/proc/self/fd") {
        METRICS.open_fds.set(open.count() as f64);
    }
    TextEncoder::new()
        .encode_to_string(&prometheus::gather())
        .map_err(|e| Error::internal("the metrics cannot be written").caused_by(e))
}

/// `VmRSS` of this process, where the system has it.
fn resident_bytes() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024.0)
}
