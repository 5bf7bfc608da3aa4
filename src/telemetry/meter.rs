//! Every metric, registered before the first is counted: seconds, bytes, `_total`.
//!
//! Labels take few values each, all named here or in the tables of calls and errors: nothing that
//! a caller chooses becomes a label.

use std::{sync::OnceLock, time::Duration};

use metrics::{
    Unit, counter, describe_counter, describe_gauge, describe_histogram, gauge, histogram,
};
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};

pub use segsplat_core::meter::{STAGE_SECONDS, STAGES, stage};

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

/// Between two sortings of what was measured.
const UPKEEP_EVERY: Duration = Duration::from_secs(5);

/// Upper ends of the histograms' buckets, seconds: 1 ms to 10 minutes.
const BUCKETS: [f64; 16] = [
    0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 15.0, 60.0, 180.0,
    600.0,
];

/// The recorder of this process; made and filled with every metric at the first call.
///
/// # Errors
/// `internal` when another recorder was installed.
pub fn handle() -> Result<&'static PrometheusHandle> {
    static HANDLE: OnceLock<std::result::Result<PrometheusHandle, String>> = OnceLock::new();
    let handle = HANDLE.get_or_init(|| {
        let built = PrometheusBuilder::new()
            .set_buckets_for_metric(Matcher::Suffix("_seconds".to_owned()), &BUCKETS)
            .and_then(PrometheusBuilder::install_recorder)
            .map_err(|e| e.to_string());
        if let Ok(handle) = &built {
            describe();
            register();
            keep_up(handle.clone());
        }
        built
    });
    handle.as_ref().map_err(|e| Error::internal(format!("metrics cannot be kept: {e}")))
}

/// Sorts every measured time into its histogram now and then: until it is sorted it takes memory of
/// its own, and not everybody is asked for metrics. For as long as the process lives.
fn keep_up(handle: PrometheusHandle) {
    fn sort(handle: &PrometheusHandle) -> ! {
        loop {
            std::thread::sleep(UPKEEP_EVERY);
            handle.run_upkeep();
        }
    }

    if let Err(error) =
        std::thread::Builder::new().name("metrics".to_owned()).spawn(move || sort(&handle))
    {
        tracing::warn!(%error, "metrics take memory until they are asked for");
    }
}

fn describe() {
    describe_counter!(REQUESTS, "Calls answered, by door, call and code");
    describe_histogram!(REQUEST_SECONDS, Unit::Seconds, "Time to the first byte of the answer");
    describe_gauge!(INFLIGHT, "Calls let in whose answer is not sent yet");
    describe_histogram!(STAGE_SECONDS, Unit::Seconds, "Time of each stage of scenes and views");
    describe_counter!(JOBS, "Jobs ended, by kind and outcome");
    describe_gauge!(JOBS_QUEUED, "Jobs that wait");
    describe_gauge!(JOBS_RUNNING, "Jobs at work");
    describe_gauge!(RENDERS, "Renders at work or waiting");
    describe_gauge!(CACHE_BYTES, Unit::Bytes, "Bytes of scenes in memory");
    describe_counter!(UPLOADED, Unit::Bytes, "Bytes of uploads taken in");
    describe_gauge!(UPLOADS_HELD, Unit::Bytes, "Bytes of uploads held in memory now");
    describe_gauge!(READY, "1 where new work is taken");
    describe_gauge!(BUILD, "1, with the version as a label");
    describe_gauge!(RESIDENT, Unit::Bytes, "Resident memory of the process");
    describe_gauge!(OPEN_FDS, "Open file descriptors of the process");
}

/// Makes each metric known with its first value, so that none appears only after its first event.
fn register() {
    for name in [INFLIGHT, JOBS_QUEUED, JOBS_RUNNING, RENDERS, CACHE_BYTES, UPLOADS_HELD, READY] {
        gauge!(name).set(0.0);
    }
    gauge!(RESIDENT).set(0.0);
    gauge!(OPEN_FDS).set(0.0);
    gauge!(BUILD, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
    counter!(UPLOADED).absolute(0);
    for kind in ["scene", "semantics"] {
        for outcome in ["done", "failed", "cancelled", "requeued"] {
            counter!(JOBS, "kind" => kind, "outcome" => outcome).absolute(0);
        }
    }
    for stage in STAGES {
        let _ = histogram!(STAGE_SECONDS, "stage" => stage);
    }
}

/// Makes a call known before its first, as every other metric is from the start.
pub fn register_call(door: &'static str, call: &'static str) {
    counter!(REQUESTS, "door" => door, "call" => call, "code" => "ok").absolute(0);
    let _ = histogram!(REQUEST_SECONDS, "door" => door, "call" => call);
}

/// Counts an answered call; `code` is a name of the error table, or `ok`.
pub fn answered(door: &'static str, call: &'static str, code: &str, took: Duration) {
    let code = TABLE.iter().find(|row| row.name == code).map_or("ok", |row| row.name);
    counter!(REQUESTS, "door" => door, "call" => call, "code" => code).increment(1);
    histogram!(REQUEST_SECONDS, "door" => door, "call" => call).record(took.as_secs_f64());
}

/// Counts a call in (1) or out (-1).
pub fn inflight(change: f64) {
    gauge!(INFLIGHT).increment(change);
}

/// Counts an ended job.
pub fn job(kind: &'static str, outcome: &'static str) {
    counter!(JOBS, "kind" => kind, "outcome" => outcome).increment(1);
}

/// Counts bytes of an upload.
pub fn uploaded(bytes: usize) {
    counter!(UPLOADED).increment(bytes as u64);
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
/// `internal` when another recorder was installed.
pub fn text(levels: Levels) -> Result<String> {
    let handle = handle()?;
    let Levels { ready, jobs_queued, jobs_running, renders, cache_bytes, uploads_held_bytes } =
        levels;
    gauge!(READY).set(f64::from(u8::from(ready)));
    #[expect(clippy::cast_precision_loss, reason = "counts and bytes stay under 2^52")]
    for (name, level) in [
        (JOBS_QUEUED, jobs_queued as f64),
        (JOBS_RUNNING, jobs_running as f64),
        (RENDERS, renders as f64),
        (CACHE_BYTES, cache_bytes as f64),
        (UPLOADS_HELD, uploads_held_bytes as f64),
    ] {
        gauge!(name).set(level);
    }
    if let Some(bytes) = resident_bytes() {
        gauge!(RESIDENT).set(bytes);
    }
    if let Ok(open) = std::fs::read_dir("/proc/self/fd") {
        gauge!(OPEN_FDS).set(open.fold(0.0, |count, _| count + 1.0));
    }
    Ok(handle.render())
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
