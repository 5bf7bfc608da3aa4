//! `segsplat measure`: metres, up and ground of a scene file, and lengths in it.

use std::path::PathBuf;

use serde_json::json;

use super::{engine, output::Output, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    scene::LengthUnit,
    service::{Measured, ScaleSpec, numbers},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[arg(help = scene_file::scene_help())]
    scene: PathBuf,
    /// A point of the world, X,Y,Z; more points are joined in their order
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers::<f64, 3>)]
    #[arg(allow_hyphen_values = true)]
    points: Vec<[f64; 3]>,
    /// A length that is known, metres: that between the first two points
    #[arg(long, conflicts_with = "metres_per_unit")]
    metres: Option<f64>,
    /// Metres of a unit of the world
    #[arg(long)]
    metres_per_unit: Option<f64>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let points = &*args.points;
    let ends = match (args.metres, points) {
        (None, _) => None,
        (Some(_), [a, b, ..]) => Some([*a, *b]),
        (Some(_), few) => {
            let why = format!("--metres is between two --points; {} given", few.len());
            return Err(Error::invalid(why));
        }
    };
    let (metres, metres_per_unit) = (args.metres, args.metres_per_unit);
    let spec = ScaleSpec { metres, points: ends, metres_per_unit, ..ScaleSpec::default() };
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let service = engine::offline(config, false)?;
    let (scale, measured) = service.measure(&opened.scene, spec, points)?;
    let mut says = match scale.metres_per_unit {
        Some(metres) => format!("a unit is {metres:.4} m"),
        None => "metres are not known".to_owned(),
    };
    says.push_str(match scale.ground {
        Some(_) => "; the ground was found",
        None => "; no ground was found",
    });
    if let Some(Measured { unit, length, area, heights, .. }) = &measured {
        let unit = if *unit == LengthUnit::Metre { "m" } else { "units" };
        says.push_str(&format!("; length {length:.4} {unit}"));
        if let Some(area) = area {
            says.push_str(&format!(", area {area:.4} {unit}²"));
        }
        if !heights.is_empty() {
            says.push_str(&format!(", over the ground {heights:.3?} {unit}"));
        }
    }
    out.answer(&says, &json!({ "scale": scale, "measured": measured }))
}
