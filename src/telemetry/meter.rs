//! Every metric, registered before the first is counted: seconds, bytes, `_total`.
//!
//! Labels take few values each, all named here or in the tables of calls and errors: nothing that
//! a caller chooses becomes a label.

use std::{sync::LazyLock, time::Duration};

use prometheus::{
    Gauge, HistogramVec, IntCounter, IntCounterVec, TextEncoder, register_gauge,
    register_gauge_vec, register_histogram_vec, register_int_counter, register_int_counter_vec,
};

pub use segsplat_core::meter::{STAGE_SECONDS, stage, stages};

use crate::error::{Error, Result, TABLE};

/// Calls answered, by `door` (http, grpc), `call` and `code` (ok or a code of the error table).
pub const REQUESTS: &str = "segsplat_requests_total";
/// Time to the first byte of the answer, by `door` and `call`.
pub const REQUEST_SECONDS: &str = "segsplat_request_seconds";
/// Calls let in whose answer is not sent yet.
pub const INFLIGHT: &str = "segsplat_requests_inflight";
/// Jobs ended, by `kind` (scene, semantics) and `outcome` (done, failed, cancelled, requeued).
pub const JOBS: &str = "segsplat_jobs_total";
/// Jobs that wait.
pub const JOBS_QUEUED: &str = "segsplat_jobs_queued";
/// Jobs at work.
pub const JOBS_RUNNING: &str = "segsplat_jobs_running";
/// Renders at work or waiting.
pub const RENDERS: &str = "segsplat_renders_inside";
/// Bytes of scenes in memory.
pub const CACHE_BYTES: &str = "segsplat_scene_cache_bytes";
/// Bytes of uploads taken in.
pub const UPLOADED: &str = "segsplat_upload_bytes_total";
/// Bytes of uploads held in memory now.
pub const UPLOADS_HELD: &str = "segsplat_uploads_held_bytes";
/// 1 where new work is taken.
pub const READY: &str = "segsplat_ready";
/// 1, with the version as a label.
pub const BUILD: &str = "segsplat_build_info";
/// Resident memory of the process.
pub const RESIDENT: &str = "process_resident_memory_bytes";
/// Open file descriptors of the process.
pub const OPEN_FDS: &str = "process_open_fds";

/// Every metric of the process.
struct Metrics {
    requests: IntCounterVec,
    request_seconds: HistogramVec,
    inflight: Gauge,
    jobs: IntCounterVec,
    jobs_queued: Gauge,
    jobs_running: Gauge,
    renders: Gauge,
    cache_bytes: Gauge,
    uploaded: IntCounter,
    uploads_held: Gauge,
    ready: Gauge,
    resident: Gauge,
    open_fds: Gauge,
}

impl Metrics {
    /// Registers every metric and gives each its first value, so that none appears only after its
    /// first event.
    fn register() -> prometheus::Result<Self> {
        segsplat_core::meter::register();
        let buckets = segsplat_core::meter::BUCKETS.to_vec();
        register_gauge_vec!(BUILD, "1, with the version as a label", &["version"])?
            .with_label_values(&[env!("CARGO_PKG_VERSION")])
            .set(1.0);
        let jobs = register_int_counter_vec!(
            JOBS,
            "Jobs ended, by kind and outcome",
            &["kind", "outcome"]
        )?;
        for kind in ["scene", "semantics"] {
            for outcome in ["done", "failed", "cancelled", "requeued"] {
                jobs.with_label_values(&[kind, outcome]);
            }
        }
        Ok(Self {
            requests: register_int_counter_vec!(
                REQUESTS,
                "Calls answered, by door, call and code",
                &["door", "call", "code"]
            )?,
            request_seconds: register_histogram_vec!(
                REQUEST_SECONDS,
                "Time to the first byte of the answer",
                &["door", "call"],
                buckets
            )?,
            inflight: register_gauge!(INFLIGHT, "Calls let in whose answer is not sent yet")?,
            jobs,
            jobs_queued: register_gauge!(JOBS_QUEUED, "Jobs that wait")?,
            jobs_running: register_gauge!(JOBS_RUNNING, "Jobs at work")?,
            renders: register_gauge!(RENDERS, "Renders at work or waiting")?,
            cache_bytes: register_gauge!(CACHE_BYTES, "Bytes of scenes in memory")?,
            uploaded: register_int_counter!(UPLOADED, "Bytes of uploads taken in")?,
            uploads_held: register_gauge!(UPLOADS_HELD, "Bytes of uploads held in memory now")?,
            ready: register_gauge!(READY, "1 where new work is taken")?,
            resident: register_gauge!(RESIDENT, "Resident memory of the process")?,
            open_fds: register_gauge!(OPEN_FDS, "Open file descriptors of the process")?,
        })
    }
}

static METRICS: LazyLock<Metrics> =
    LazyLock::new(|| Metrics::register().expect("each name is registered once; this is a bug"));

/// Makes a call known before its first, as every other metric is from the start.
pub fn register_call(door: &'static str, call: &'static str) {
    METRICS.requests.with_label_values(&[door, call, "ok"]);
    METRICS.request_seconds.with_label_values(&[door, call]);
}

/// Counts an answered call; `code` is a name of the error table, or `ok`.
pub fn answered(door: &'static str, call: &'static str, code: &str, took: Duration) {
    let code = TABLE.iter().find(|row| row.name == code).map_or("ok", |row| row.name);
    METRICS.requests.with_label_values(&[door, call, code]).inc();
    METRICS.request_seconds.with_label_values(&[door, call]).observe(took.as_secs_f64());
}

/// Counts a call in (1) or out (-1).
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

/// What is looked up when somebody asks for the metrics.
#[derive(Clone, Copy, Debug, Default)]
pub struct Levels {
    /// Whether new work is taken.
    pub ready: bool,
    /// Jobs that wait.
    pub jobs_queued: usize,
    /// Jobs at work.
    pub jobs_running: usize,
    /// Renders at work or waiting.
    pub renders: usize,
    /// Bytes of scenes in memory.
    pub cache_bytes: u64,
    /// Bytes of uploads held in memory.
    pub uploads_held_bytes: usize,
}

/// All metrics as Prometheus reads them.
///
/// # Errors
/// `internal` when they cannot be written as text.
pub fn text(levels: Levels) -> Result<String> {
    let Levels { ready, jobs_queued, jobs_running, renders, cache_bytes, uploads_held_bytes } =
        levels;
    METRICS.ready.set(f64::from(u8::from(ready)));
    #[expect(clippy::cast_precision_loss, reason = "counts and bytes stay under 2^52")]
    for (gauge, level) in [
        (&METRICS.jobs_queued, jobs_queued as f64),
        (&METRICS.jobs_running, jobs_running as f64),
        (&METRICS.renders, renders as f64),
        (&METRICS.cache_bytes, cache_bytes as f64),
        (&METRICS.uploads_held, uploads_held_bytes as f64),
    ] {
        gauge.set(level);
    }
    if let Some(bytes) = resident_bytes() {
        METRICS.resident.set(bytes);
    }
    if let Ok(open) = std::fs::read_dir("/proc/self/fd") {
        METRICS.open_fds.set(open.fold(0.0, |count, _| count + 1.0));
    }
    TextEncoder::new()
        .encode_to_string(&prometheus::gather())
        .map_err(|e| Error::internal("the metrics cannot be written").caused_by(e))
}

/// `VmRSS` of this process, where the system tells.
fn resident_bytes() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_metric_is_there_before_anything_happened() {
        let text = text(Levels { cache_bytes: 7, ..Levels::default() }).unwrap();
        for name in [
            INFLIGHT,
            STAGE_SECONDS,
            JOBS,
            JOBS_QUEUED,
            JOBS_RUNNING,
            RENDERS,
            CACHE_BYTES,
            UPLOADED,
            UPLOADS_HELD,
            READY,
            BUILD,
            RESIDENT,
            OPEN_FDS,
        ] {
            assert!(text.contains(&format!("# TYPE {name} ")), "{name} is not in\n{text}");
        }
        assert!(text.contains("segsplat_scene_cache_bytes 7"), "{text}");
        let done = "segsplat_jobs_total{kind=\"scene\",outcome=\"done\"}";
        assert!(text.contains(done), "{text}");
    }
}
