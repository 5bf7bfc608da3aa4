//! The metrics that the stages record themselves: seconds of each stage, and failed providers.

use std::sync::LazyLock;

use prometheus::{HistogramVec, IntCounterVec, register_histogram_vec, register_int_counter_vec};

use crate::scene::Stage;

/// Name of the metric: time of each stage, by `stage`.
pub const STAGE_SECONDS: &str = "segsplat_stage_seconds";

/// Stages of a view, the wait of a job for its worker, and the coarser forms of a large scene.
const OTHERS: [&str; 7] = ["wait", "queue", "load", "score", "render", "encode", "coarse"];

/// Stages of a scene, of its semantics, and of a view.
pub fn stages() -> impl Iterator<Item = &'static str> {
    let jobs = Stage::SCENE.into_iter().chain(Stage::SEMANTICS).map(Stage::name);
    jobs.chain(OTHERS)
}

/// Upper ends of the buckets of every histogram, seconds: 1 ms to 10 minutes.
pub const BUCKETS: [f64; 16] = [
    0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 15.0, 60.0, 180.0,
    600.0,
];

static SECONDS: LazyLock<HistogramVec> = LazyLock::new(|| {
    let help = "Time of each stage of scenes and views";
    let seconds = register_histogram_vec!(STAGE_SECONDS, help, &["stage"], BUCKETS.to_vec())
        .expect("the name is registered once; this is a bug");
    for stage in stages() {
        seconds.with_label_values(&[stage]);
    }
    seconds
});

/// Makes every stage known, so that none appears only after its first run.
pub fn register() {
    LazyLock::force(&SECONDS);
    LazyLock::force(&FALLBACKS);
    LazyLock::force(&RUNS);
}

/// Name of the metric: runs that the CPU answered because the provider failed, by `network`.
pub const NETWORK_FALLBACKS: &str = "segsplat_network_fallbacks_total";

/// Names of the networks.
const NETWORKS: [&str; 6] =
    ["geometry network", "mask encoder", "mask decoder", "image tower", "text tower", "features"];

/// Name of the metric: time of each run of a network, copies to and from the device included, by
/// `network`.
pub const NETWORK_SECONDS: &str = "segsplat_network_seconds";

static RUNS: LazyLock<HistogramVec> = LazyLock::new(|| {
    let help = "Time of each run of a network, copies to and from the device included";
    let seconds = register_histogram_vec!(NETWORK_SECONDS, help, &["network"], BUCKETS.to_vec())
        .expect("the name is registered once; this is a bug");
    for network in NETWORKS {
        seconds.with_label_values(&[network]);
    }
    seconds
});

static FALLBACKS: LazyLock<IntCounterVec> = LazyLock::new(|| {
    let help = "Runs of a network that the CPU answered because the provider failed";
    let fallbacks = register_int_counter_vec!(NETWORK_FALLBACKS, help, &["network"])
        .expect("the name is registered once; this is a bug");
    for network in NETWORKS {
        fallbacks.with_label_values(&[network]);
    }
    fallbacks
});

/// Counts a run of `network` that the CPU answered because its provider failed; another name is not
/// counted.
pub fn fallback(network: &str) {
    if NETWORKS.contains(&network) {
        FALLBACKS.with_label_values(&[network]).inc();
    }
}

/// Records the seconds of a run of `network`; another name is not recorded.
pub fn network(network: &str, seconds: f64) {
    if NETWORKS.contains(&network) {
        RUNS.with_label_values(&[network]).observe(seconds);
    }
}

/// Records the seconds of a stage; a name that is not in [`stages`] is not recorded.
pub fn stage(name: &str, seconds: f64) {
    if stages().any(|stage| stage == name) {
        SECONDS.with_label_values(&[name]).observe(seconds);
    }
}
