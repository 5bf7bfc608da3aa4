//! `segsplat query`: search by text in a scene file that has semantics.

use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

use super::{camera, engine, output::Output, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    formats::{splats::SplatFormat, table::ExportFormat},
    names::named,
    service::{
        Boxes, CameraFields, MaskFormat, QuerySpec, ScoringOptions, TextResult, ViewOptions,
        scene_splats,
    },
};

#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct Args {
    /// Scene file, or a folder with one
    scene: PathBuf,
    /// What to look for; several texts may be given
    #[arg(required = true)]
    texts: Vec<String>,
    /// File of the mask in the view (.png) or of the selected Gaussians (.ply, .spz,
    /// .glb …); with several texts, one file each
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Boxes of the parts: upright, oriented, aligned or none
    #[arg(long, default_value = "upright", value_parser = named::<Boxes>)]
    boxes: Boxes,
    #[command(flatten)]
    camera: CameraFields,
    #[command(flatten)]
    options: ViewOptions,
    #[command(flatten)]
    scoring: ScoringOptions,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let ending = args.output.as_deref().map(ending_of).transpose()?;
    let of_view = camera::spec(&args.camera)?;
    let is_mask = matches!(ending, Some(Ending::Png));
    if is_mask && of_view.is_none() {
        return Err(camera::no_camera());
    }
    let spec = QuerySpec {
        texts: args.texts.clone(),
        camera: of_view,
        options: args.options.clone(),
        boxes: args.boxes,
        mask: if is_mask { MaskFormat::Png } else { MaskFormat::Rle },
        scoring: args.scoring.clone(),
        ..QuerySpec::default()
    };
    args.output.as_deref().map_or(Ok(()), scene_file::has_folder)?;
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let service = engine::offline(config, true)?;
    let mut answer = service.query(&opened.scene, &spec)?;
    let mut text = String::new();
    for (i, found) in answer.results.iter().enumerate() {
        describe(&mut text, found);
        let Some(output) = &args.output else { continue };
        let path = numbered(output, i, answer.results.len());
        match ending {
            Some(Ending::Gaussians(format)) => {
                let chosen = service.select(&opened.scene, &found.text, &spec)?;
                let file = scene_splats(format, &opened.scene, &chosen, None)?;
                scene_file::write_splats(&path, &file)?;
            }
            _ => {
                let mask = found.view.as_ref().and_then(|view| view.mask_png.as_deref());
                scene_file::write(&path, mask.unwrap_or_default())?;
            }
        }
        let _ = writeln!(text, "  written to {}", path.display());
    }
    // The masks are in the files that were written.
    for view in answer.results.iter_mut().filter_map(|found| found.view.as_mut()) {
        view.mask_png = None;
    }
    out.answer(&text, &answer)
}

#[derive(Clone, Copy, Debug)]
enum Ending {
    Png,
    Gaussians(&'static SplatFormat),
}

fn ending_of(path: &Path) -> Result<Ending> {
    if scene_file::ending(path) == "png" {
        return Ok(Ending::Png);
    }
    scene_file::splat_format(path).map(Ending::Gaussians).ok_or_else(|| {
        let endings = ExportFormat::listed(|of| of.is_splats(), |row| row.ending);
        let path = path.display();
        Error::invalid(format!(
            "{path}: the ending must be png (for the mask) or one of {endings} (for the Gaussians)"
        ))
    })
}

/// `mask.png` of one text, `mask-2.png` of the third of several.
fn numbered(path: &Path, i: usize, count: usize) -> PathBuf {
    if count == 1 {
        return path.to_owned();
    }
    let end = scene_file::splat_format(path).map_or("png", |format| format.ending);
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let stem = &name[..name.len().saturating_sub(end.len() + 1)];
    path.with_file_name(format!("{stem}-{i}.{end}"))
}

fn describe(text: &mut String, found: &TextResult) {
    // Writing to a string does not fail.
    let best = found.scores.iter().copied().fold(0.0, f32::max);
    let of = match found.found {
        false => "not found".to_owned(),
        true => format!(
            "{} Gaussians in {} parts, {} of {} entries",
            found.gaussians,
            found.parts.len(),
            found.entries.len(),
            found.scores.len(),
        ),
    };
    let trust = match (&found.word, found.trust) {
        (Some(word), Some(trust)) => format!("trust in {word:?}: {trust}"),
        _ => "trust: no word that was measured".to_owned(),
    };
    let _ = writeln!(text, "{:?}: {of}, best score {best:.2}; {trust}", found.text);
    for part in &found.parts {
        let [x, y, z] = part.center;
        let [a, b, c] = part.size;
        let _ = writeln!(
            text,
            "  part of {} at {x:.3}, {y:.3}, {z:.3}: {a:.3} x {b:.3} x {c:.3}, score {:.2}",
            part.gaussians, part.score
        );
    }
    if let Some(view) = &found.view {
        let _ = match (view.bbox, view.peak) {
            (Some([left, top, width, height]), Some(peak)) => writeln!(
                text,
                "  in view: {} px in {width}x{height} at {left},{top}; peak {:.2} at {},{}",
                view.area, peak.relevancy, peak.x, peak.y
            ),
            _ => writeln!(text, "  not in view"),
        };
    }
    for warning in &found.warnings {
        let _ = writeln!(text, "  warning {}: {}", warning.code, warning.message);
    }
}
