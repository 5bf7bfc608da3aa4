//! Edits as callers send them, and their checks.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::{
    error::{Error, Result},
    limits::Limits,
    names::{display_names, shown},
    scene::{EditAction, Gaussians, Place, Placement, Preset, ScoringMethod},
    service::{
        request::{CameraFields, CameraSpec, PickSpec, ScoringOptions, ViewOptions},
        texts,
    },
};

/// Least and largest scale of a move or a copy.
const SCALE_RANGE: [f64; 2] = [1e-3, 1e3];
/// Largest number of a place, a size or a translation, world units.
const LENGTH_MAX: f64 = Gaussians::COORDINATE_MAX as f64;
/// How far axes of a box may be from unit axes at right angles, and a rotation from length 1.
const UNIT_TOLERANCE: f64 = 1e-3;

/// What an edit does with the Gaussians that it takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum EditOp {
    /// They go.
    Delete,
    /// All others go.
    Keep,
    /// They go elsewhere.
    Move,
    /// They stay, and a copy of them is elsewhere. It has their labels.
    Copy,
    /// Their colour becomes another one.
    Recolor,
}

display_names!(EditOp);

/// A box in the world. The boxes of a query's parts have these fields too.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EditBox {
    /// Middle, world units.
    pub center: [f64; 3],
    /// Full lengths along the axes, world units.
    pub size: [f64; 3],
    /// Unit axes at right angles, one a row; those of the world by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<[[f64; 3]; 3]>,
}

/// A ball in the world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EditSphere {
    /// Middle, world units.
    pub center: [f64; 3],
    /// Radius, world units.
    pub radius: f64,
}

/// A pixel of a view, as a pick takes it: the connected part of the thing that is seen there.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EditPick {
    /// Camera of the view.
    pub camera: CameraFields,
    /// Across, pixels of the picture.
    pub x: f64,
    /// Down, pixels of the picture.
    pub y: f64,
    /// Width of the picture, pixels; as a view has it by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub width: Option<u32>,
    /// Height of the picture, pixels; as a view has it by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height: Option<u32>,
}

/// Which Gaussians an edit takes: one of `text`, `box`, `sphere`, `point`, `pick` and `floaters`.
/// It looks at the scene as the edits before it leave it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EditSelection {
    /// What a text selects, as a query does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// Of what the text selects these parts alone, counted from 0 in a query's order.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parts: Option<Vec<u32>>,
    /// Relevancy from which the text selects, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cut: Option<f64>,
    /// What has its centre in a box.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub r#box: Option<EditBox>,
    /// What has its centre in a ball.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sphere: Option<EditSphere>,
    /// The thing at a point of the world, as a pick gives it: the connected part of the nearest
    /// Gaussian with a label. Nothing where that does not reach the point.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub point: Option<[f64; 3]>,
    /// What is seen at a pixel.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pick: Option<EditPick>,
    /// What no photo confirms and two or more see through, of the scene as it was made.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub floaters: bool,
}

/// One edit of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = Edit)]
pub struct EditSpec {
    /// What it does.
    pub op: EditOp,
    /// To what.
    pub select: EditSelection,
    /// Of `move` and `copy`: how far, world units; 0 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub translation: Option<[f64; 3]>,
    /// Of `move` and `copy`: a unit quaternion, wxyz; none by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation: Option<[f64; 4]>,
    /// Of `move` and `copy`: how many times as large, 0.001 to 1000; 1 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scale: Option<f64>,
    /// Of `move` and `copy`: the point that rotation and scale leave where it is; the mean centre
    /// of what is taken by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub center: Option<[f64; 3]>,
    /// Of `recolor`: red, green and blue, 0 to 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub color: Option<[f32; 3]>,
    /// Of `recolor`: 0 (no change) to 1 (this colour alone); 1 by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub amount: Option<f32>,
}

/// The edits of a scene and what they come to.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct SceneEdits {
    /// The list, as it can be sent again.
    pub edits: Vec<EditSpec>,
    /// Gaussians of the served version that each edit took.
    pub counts: Vec<u64>,
    /// Gaussians of the scene after all of them.
    pub gaussians: u64,
    /// Share of what the photos showed that has nothing any more, 0 to 1: where no photo saw what
    /// is behind a thing that is gone.
    pub uncovered: f64,
}

/// A selection that is checked.
#[derive(Clone, Debug)]
pub(super) enum Asked {
    Text { text: String, parts: Option<Vec<u32>>, scoring: ScoringOptions },
    Place(Place),
    Point(DVec3),
    Pick(Box<PickSpec>),
    Floaters,
}

impl EditSpec {
    /// Whether it needs the scene's semantics.
    pub(super) fn needs_semantics(&self) -> bool {
        let EditSelection { text, point, pick, .. } = &self.select;
        text.is_some() || point.is_some() || pick.is_some()
    }

    /// What it does; `at` names it: `edits[3]`.
    pub(super) fn action(&self, at: &str) -> Result<EditAction> {
        let places = self.op == EditOp::Move || self.op == EditOp::Copy;
        let given = [
            ("translation", self.translation.is_some(), places),
            ("rotation", self.rotation.is_some(), places),
            ("scale", self.scale.is_some(), places),
            ("center", self.center.is_some(), places),
            ("color", self.color.is_some(), self.op == EditOp::Recolor),
            ("amount", self.amount.is_some(), self.op == EditOp::Recolor),
        ];
        if let Some((name, ..)) = given.into_iter().find(|(_, given, taken)| *given && !taken) {
            return Err(Error::invalid(format!("{at}: {} takes no {name}", self.op)));
        }
        Ok(match self.op {
            EditOp::Delete => EditAction::Delete,
            EditOp::Keep => EditAction::Keep,
            EditOp::Move => EditAction::Move(self.placement(at)?),
            EditOp::Copy => EditAction::Copy(self.placement(at)?),
            EditOp::Recolor => {
                let Some(color) = self.color else {
                    return Err(Error::invalid(format!("{at}: recolor needs color")));
                };
                let amount = self.amount.unwrap_or(1.0);
                let share = |name: &str, v: f32| {
                    in_range(&format!("{at}.{name}"), f64::from(v), [0.0, 1.0])
                };
                color.iter().try_for_each(|channel| share("color", *channel))?;
                share("amount", amount)?;
                EditAction::Recolor { color, amount }
            }
        })
    }

    fn placement(&self, at: &str) -> Result<Placement> {
        let of = Placement::default();
        let placement = Placement {
            translation: self.translation.unwrap_or(of.translation),
            rotation: self.rotation.unwrap_or(of.rotation),
            scale: self.scale.unwrap_or(of.scale),
            center: self.center,
        };
        lengths(&format!("{at}.translation"), &placement.translation)?;
        lengths(&format!("{at}.center"), placement.center.as_ref().map_or(&[][..], |c| c))?;
        in_range(&format!("{at}.scale"), placement.scale, SCALE_RANGE)?;
        let norm = placement.rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        if (norm - 1.0).abs() > UNIT_TOLERANCE {
            let norm = shown(norm);
            let must = "it must be a quaternion w x y z of length 1";
            return Err(Error::invalid(format!("{at}.rotation has the length {norm}; {must}")));
        }
        Ok(placement)
    }

    /// What it takes; `at` names it.
    pub(super) fn asked(&self, at: &str, limits: &Limits) -> Result<Asked> {
        let EditSelection { text, parts, cut, r#box, sphere, point, pick, floaters } = &self.select;
        let at = &format!("{at}.select");
        let given = [
            ("text", text.is_some()),
            ("box", r#box.is_some()),
            ("sphere", sphere.is_some()),
            ("point", point.is_some()),
            ("pick", pick.is_some()),
            ("floaters", *floaters),
        ];
        let named: Vec<_> = given.iter().filter(|(_, is)| *is).map(|(name, _)| *name).collect();
        if named.len() != 1 {
            let has = if named.is_empty() { "none".to_owned() } else { named.join(" and ") };
            let must = "it must have one of text, box, sphere, point, pick and floaters";
            return Err(Error::invalid(format!("{at} has {has}; {must}")));
        }
        for (name, is) in [("parts", parts.is_some()), ("cut", cut.is_some())] {
            if is && text.is_none() {
                return Err(Error::invalid(format!("{at}: {name} goes with text")));
            }
        }
        if let Some(text) = text {
            let text = texts::checked(text, &format!("{at}.text"), limits)?;
            let max = limits.parts_max;
            let numbers = parts.iter().flatten();
            if let Some(part) = numbers.copied().find(|part| *part as usize >= max) {
                let must = format!("it must be 0 to {}", max - 1);
                return Err(Error::invalid(format!("{at}.parts has {part}; {must}")));
            }
            let scoring = ScoringOptions { cut: *cut, ..ScoringOptions::default() };
            let canon = ScoringMethod::CANON.map(str::to_owned).to_vec();
            let of = ScoringMethod::of(Preset::Paper, canon, 1.0, 0.0, 0.0, 1.0);
            let named = |e: Error| Error::invalid(format!("{at}: {}", e.message()));
            scoring.change(of).check().map_err(named)?;
            return Ok(Asked::Text { text, parts: parts.clone(), scoring });
        }
        if let Some(of) = r#box {
            return of.place(&format!("{at}.box")).map(Asked::Place);
        }
        if let Some(EditSphere { center, radius }) = *sphere {
            lengths(&format!("{at}.sphere.center"), &center)?;
            in_range(&format!("{at}.sphere.radius"), radius, [0.0, LENGTH_MAX])?;
            return Ok(Asked::Place(Place::Sphere { center, radius }));
        }
        if let Some(point) = *point {
            lengths(&format!("{at}.point"), &point)?;
            return Ok(Asked::Point(DVec3::from(point)));
        }
        if *floaters {
            return Ok(Asked::Floaters);
        }
        let pick = pick.as_ref().ok_or_else(|| Error::internal("a selection without a kind"))?;
        let named = |e: Error| Error::invalid(format!("{at}.pick.camera: {}", e.message()));
        let camera = CameraSpec::try_from(pick.camera.clone()).map_err(named)?;
        let (width, height) = (pick.width, pick.height);
        Ok(Asked::Pick(Box::new(PickSpec {
            camera,
            x: pick.x,
            y: pick.y,
            options: ViewOptions { width, height, ..ViewOptions::default() },
            labels: Vec::new(),
            scoring: ScoringOptions::default(),
            wait: None,
        })))
    }
}

impl EditBox {
    fn place(&self, at: &str) -> Result<Place> {
        let (center, size) = (self.center, self.size);
        lengths(&format!("{at}.center"), &center)?;
        for length in size {
            in_range(&format!("{at}.size"), length, [0.0, LENGTH_MAX])?;
        }
        let axes = self.axes.unwrap_or(DMat3::IDENTITY.to_cols_array_2d());
        let [x, y, z] = axes.map(DVec3::from);
        let products = [x.length() - 1.0, y.length() - 1.0, z.length() - 1.0];
        let products = products.into_iter().chain([x.dot(y), y.dot(z), z.dot(x)]);
        if let Some(off) = products.map(f64::abs).find(|off| *off > UNIT_TOLERANCE) {
            let must = format!("they must be unit axes at right angles within {UNIT_TOLERANCE}");
            return Err(Error::invalid(format!("{at}.axes are off by {}; {must}", shown(off))));
        }
        Ok(Place::Box { center, size, axes })
    }
}

fn in_range(name: &str, value: f64, [least, most]: [f64; 2]) -> Result<()> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    let (least, most) = (shown(least), shown(most));
    Err(Error::invalid(format!("{name} is {}; it must be {least} to {most}", shown(value))))
}

fn lengths(name: &str, values: &[f64]) -> Result<()> {
    values.iter().try_for_each(|value| in_range(name, *value, [-LENGTH_MAX, LENGTH_MAX]))
}
