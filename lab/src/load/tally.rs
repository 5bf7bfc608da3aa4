//! Counts and times of many answers.

use std::{collections::BTreeMap, time::Duration};

use serde_json::{Value, json};

use crate::rows::median;

/// What one caller, or all together, got.
#[derive(Debug, Default)]
pub(super) struct Tally {
    ms: Vec<f64>,
    bytes: Vec<f64>,
    /// Faults and how often they came.
    failed: BTreeMap<String, u64>,
    /// Milliseconds of each stage that `Server-Timing` names.
    stages: BTreeMap<String, Vec<f64>>,
}

impl Tally {
    /// Counts an answer of so many bytes with the values of its `Server-Timing` headers.
    pub(super) fn answered<'a>(
        &mut self,
        took: Duration,
        bytes: usize,
        timing: impl Iterator<Item = &'a str>,
    ) {
        self.ms.push(took.as_secs_f64() * 1e3);
        self.bytes.push(bytes as f64);
        for (stage, ms) in timing.flat_map(stages) {
            match self.stages.get_mut(stage) {
                Some(all) => all.push(ms),
                None => drop(self.stages.insert(stage.to_owned(), vec![ms])),
            }
        }
    }

    /// Counts a fault.
    pub(super) fn failed(&mut self, why: String) {
        *self.failed.entry(why).or_default() += 1;
    }

    /// Answers without a fault.
    pub(super) fn count(&self) -> usize {
        self.ms.len()
    }

    /// Share of the calls that failed.
    pub(super) fn failed_share(&self) -> f64 {
        let failed: u64 = self.failed.values().sum();
        failed as f64 / (failed as f64 + self.ms.len() as f64).max(1.0)
    }

    /// Adds what another caller got.
    pub(super) fn add(&mut self, other: Self) {
        self.ms.extend(other.ms);
        self.bytes.extend(other.bytes);
        for (why, count) in other.failed {
            *self.failed.entry(why).or_default() += count;
        }
        for (stage, all) in other.stages {
            self.stages.entry(stage).or_default().extend(all);
        }
    }

    /// Quantiles of the times, sizes, faults and medians of the stages.
    pub(super) fn row(&self) -> Value {
        let mut ms = self.ms.clone();
        ms.sort_by(f64::total_cmp);
        let stages: BTreeMap<&str, f64> =
            self.stages.iter().map(|(stage, all)| (stage.as_str(), median(all.clone()))).collect();
        json!({
            "answers": ms.len(),
            "p50_ms": quantile(&ms, 0.5),
            "p95_ms": quantile(&ms, 0.95),
            "p99_ms": quantile(&ms, 0.99),
            "max_ms": ms.last(),
            "bytes": median(self.bytes.clone()),
            "failed": self.failed,
            "stages_ms": stages,
        })
    }
}

/// The value that so large a share of the sorted values does not exceed; none of none.
fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(rank.max(1) - 1).copied()
}

/// The stages and times of a `Server-Timing` value: `render;dur=1.2, encode;dur=0.3`.
fn stages(value: &str) -> impl Iterator<Item = (&str, f64)> {
    value.split(',').filter_map(|metric| {
        let (stage, ms) = metric.trim().split_once(";dur=")?;
        Some((stage, ms.parse().ok()?))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_faults_and_stages_are_counted() {
        let mut all = Tally::default();
        for caller in 0..4_u64 {
            let mut one = Tally::default();
            for ms in 1..=25 {
                let timing = ["render;dur=2.5, encode;dur=1", "total;dur=4, odd"];
                one.answered(Duration::from_millis(4 * ms - caller), 10, timing.into_iter());
            }
            one.failed("503 overloaded".to_owned());
            all.add(one);
        }
        let row = all.row();
        assert_eq!((all.count(), all.failed_share()), (100, 4.0 / 104.0));
        assert_eq!(
            (&row["p50_ms"], &row["p95_ms"], &row["p99_ms"], &row["max_ms"]),
            (&json!(50.0), &json!(95.0), &json!(99.0), &json!(100.0))
        );
        assert_eq!(row["stages_ms"], json!({ "render": 2.5, "encode": 1.0, "total": 4.0 }));
        assert_eq!(row["failed"], json!({ "503 overloaded": 4 }));
        assert_eq!(Tally::default().row()["p50_ms"], Value::Null);
    }
}
