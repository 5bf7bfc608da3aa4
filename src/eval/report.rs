//! What an evaluation found, as JSON and as a table.

use std::fmt;

use serde::Serialize;

use crate::scene::{DropCount, StageTime, Warning};

/// One triple.
#[derive(Clone, Debug, Serialize)]
pub struct TripleReport {
    /// Files of the inputs.
    pub inputs: Vec<String>,
    /// File of the target.
    pub target: String,
    /// Distance between the first two inputs, world units.
    pub baseline: f64,
    /// PSNR of the rendered target, dB.
    pub psnr: f64,
    /// SSIM of the rendered target.
    pub ssim: f64,
    /// PSNR of the hindsight warp, dB.
    pub warp_psnr: f64,
    /// Gaussians of the scene.
    pub gaussians: u64,
    /// Gaussians dropped, by reason.
    pub dropped: Vec<DropCount>,
    /// Overlap of the inputs, 0..1.
    pub overlap: f64,
    /// Depths searched, world units.
    pub depth_range: [f64; 2],
    /// What looked wrong with the inputs.
    pub warnings: Vec<Warning>,
    /// Time of each stage.
    pub stages: Vec<StageTime>,
    /// Time of all stages, milliseconds.
    pub total_ms: f64,
}

/// One scene: means over its triples.
#[derive(Clone, Debug, Serialize)]
pub struct SceneReport {
    /// Folder name.
    pub scene: String,
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean PSNR of the hindsight warp, dB.
    pub warp_psnr: f64,
    /// Mean time of the geometry stage, milliseconds.
    pub geometry_ms: f64,
    /// Mean time of all stages, milliseconds.
    pub total_ms: f64,
    /// The triples.
    pub triples: Vec<TripleReport>,
}

/// All scenes.
#[derive(Clone, Debug, Serialize)]
pub struct EvalReport {
    /// Photos put in.
    pub photos: usize,
    /// Execution provider of the network.
    pub execution_provider: String,
    /// Renderer of the targets.
    pub renderer: String,
    /// Mean over scenes of their PSNR, dB.
    pub psnr: f64,
    /// Mean over scenes of their SSIM.
    pub ssim: f64,
    /// Mean over scenes of their hindsight warp, dB.
    pub warp_psnr: f64,
    /// Largest resident memory of the process so far, MiB; 0 where the system does not tell.
    pub peak_rss_mib: f64,
    /// The scenes.
    pub scenes: Vec<SceneReport>,
}

fn mean<T>(items: &[T], of: impl Fn(&T) -> f64) -> f64 {
    if items.is_empty() { f64::NAN } else { items.iter().map(of).sum::<f64>() / items.len() as f64 }
}

impl SceneReport {
    pub(super) fn new(scene: String, triples: Vec<TripleReport>) -> Self {
        let geometry = |t: &TripleReport| -> f64 {
            t.stages.iter().filter(|s| s.stage == "geometry").map(|s| s.ms).sum()
        };
        Self {
            scene,
            psnr: mean(&triples, |t| t.psnr),
            ssim: mean(&triples, |t| t.ssim),
            warp_psnr: mean(&triples, |t| t.warp_psnr),
            geometry_ms: mean(&triples, geometry),
            total_ms: mean(&triples, |t| t.total_ms),
            triples,
        }
    }
}

impl EvalReport {
    pub(super) fn new(
        scenes: Vec<SceneReport>,
        photos: usize,
        provider: &str,
        renderer: &str,
    ) -> Self {
        let filled: Vec<&SceneReport> = scenes.iter().filter(|s| !s.triples.is_empty()).collect();
        Self {
            photos,
            execution_provider: provider.to_owned(),
            renderer: renderer.to_owned(),
            psnr: mean(&filled, |s| s.psnr),
            ssim: mean(&filled, |s| s.ssim),
            warp_psnr: mean(&filled, |s| s.warp_psnr),
            peak_rss_mib: peak_rss_mib(),
            scenes,
        }
    }

    /// The heading of the table that [`SceneReport`]s print.
    #[must_use]
    pub fn heading() -> String {
        format!(
            "{:<18} {:>7} {:>9} {:>7} {:>9} {:>9} {:>12} {:>9}",
            "scene", "triples", "PSNR dB", "SSIM", "warp dB", "gain dB", "geometry ms", "total ms"
        )
    }
}

impl fmt::Display for SceneReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:<18} {:>7} {:>9.2} {:>7.3} {:>9.2} {:>9.2} {:>12.0} {:>9.0}",
            self.scene,
            self.triples.len(),
            self.psnr,
            self.ssim,
            self.warp_psnr,
            self.psnr - self.warp_psnr,
            self.geometry_ms,
            self.total_ms
        )
    }
}

impl fmt::Display for EvalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let triples: usize = self.scenes.iter().map(|s| s.triples.len()).sum();
        writeln!(
            f,
            "{:<18} {:>7} {:>9.2} {:>7.3} {:>9.2} {:>9.2}",
            "mean of scenes",
            triples,
            self.psnr,
            self.ssim,
            self.warp_psnr,
            self.psnr - self.warp_psnr
        )?;
        write!(
            f,
            "{} photos in; geometry on {}, rendered by {}; peak memory {:.0} MiB",
            self.photos, self.execution_provider, self.renderer, self.peak_rss_mib
        )
    }
}

/// Peak resident memory of this process, from Linux's own count.
fn peak_rss_mib() -> f64 {
    let status = fs_err::read_to_string("/proc/self/status").unwrap_or_default();
    status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .and_then(|rest| rest.trim().trim_end_matches("kB").trim().parse::<f64>().ok())
        .map_or(0.0, |kib| kib / 1024.0)
}
