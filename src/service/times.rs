//! Where the time of a view or a query goes: each stage as a metric, as a span, and in the answer.

use std::time::Instant;

use crate::telemetry::meter;

/// Milliseconds of the stages of a view, or of a query.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ViewTimes {
    /// Waiting for a place among the views that are drawn, and for a thread.
    pub queue_ms: f64,
    /// The scene, and its semantics where a text needs them, into memory. Next to nothing where
    /// they are there.
    pub load_ms: f64,
    /// Scores of the bank for a text, and of the pixels where they are not drawn; none for kinds
    /// without a text.
    pub score_ms: Option<f64>,
    /// Drawing, with the waiting for other views on the same device.
    pub render_ms: f64,
    /// Encoding; for a query the parts in space too.
    pub encode_ms: f64,
}

impl ViewTimes {
    /// Names and milliseconds, in order.
    pub fn stages(&self) -> impl Iterator<Item = (&'static str, f64)> + use<> {
        let Self { queue_ms, load_ms, score_ms, render_ms, encode_ms } = *self;
        [
            ("queue", Some(queue_ms)),
            ("load", Some(load_ms)),
            ("score", score_ms),
            ("render", Some(render_ms)),
            ("encode", Some(encode_ms)),
        ]
        .into_iter()
        .filter_map(|(stage, ms)| Some((stage, ms?)))
    }
}

/// Milliseconds since `begun`.
pub(super) fn ms(begun: Instant) -> f64 {
    begun.elapsed().as_secs_f64() * 1e3
}

/// Does the work of a stage; what it gives, and its milliseconds.
pub(super) fn staged<T>(stage: &'static str, work: impl FnOnce() -> T) -> (T, f64) {
    let _span = tracing::info_span!("stage", stage).entered();
    let begun = Instant::now();
    let done = work();
    let ms = ms(begun);
    meter::stage(stage, ms / 1e3);
    (done, ms)
}
