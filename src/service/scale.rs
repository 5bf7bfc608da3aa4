//! How large a scene is: metres, up and the ground, and lengths, areas and heights in it.
//!
//! A scene is never made larger or smaller: its units stay those of its cameras, so views, edits
//! and files are what they were. What a unit is in metres is kept beside it, where somebody said
//! it, and else is what the capture says ([`LengthUnit`]).

use std::{sync::Arc, time::Duration};

use glam::DVec3;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{
    offline::OfflineService,
    request::{Boxes, QuerySpec},
    shared::Service,
    tasks::blocking,
    texts,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    names::display_names,
    scene::{Gaussians, Ground, LengthUnit, Scene, SceneCamera, SceneId},
};

/// Metres a unit that are accepted.
const METRES_PER_UNIT: [f64; 2] = [1e-6, 1e6];

/// Where the metres of a scene come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ScaleSource {
    /// They are not known.
    #[default]
    None,
    /// The program that took the photos measures in metres.
    Capture,
    /// A call gave them.
    Given,
}

/// A side of the upright box of a thing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum BoxSide {
    /// Along up.
    #[default]
    Height,
    /// The longer one of the other two.
    Width,
    /// The shorter one of them.
    Depth,
    /// The longest of all three.
    Longest,
}

display_names!(ScaleSource, BoxSide);

/// A thing whose size is known.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ScaleThing {
    /// The text that finds it.
    pub text: String,
    /// Which of the parts that the text finds, counted from 0 in a query's order.
    #[serde(default)]
    pub part: u32,
    /// Which side of the part's upright box.
    #[serde(default)]
    pub side: BoxSide,
}

/// How large a scene is: `metres` with either `points` or `thing`, or `metres_per_unit`. Nothing:
/// as the capture says it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ScaleSpec {
    /// A length, metres.
    pub metres: Option<f64>,
    /// It is that between these two points of the world.
    pub points: Option<[[f64; 3]; 2]>,
    /// It is that of a side of this thing.
    pub thing: Option<ScaleThing>,
    /// Metres of a unit of the world.
    pub metres_per_unit: Option<f64>,
}

/// What is known of how large a scene is and how it stands.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
pub struct SceneScale {
    /// Metres of a unit of the world, where they are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metres_per_unit: Option<f64>,
    /// Where they come from.
    pub source: ScaleSource,
    /// Up, a unit vector of the world: the ground's, else as the photos tell it.
    pub up: [f64; 3],
    /// The ground, where one was found in the scene as it was made.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ground: Option<Ground>,
}

/// Lengths between points of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct Measured {
    /// Unit of the lengths; areas are in its square. Where metres are not known: that of the world.
    pub unit: LengthUnit,
    /// From the first point to the last, by way of all others.
    pub length: f64,
    /// From each point to the next one.
    pub legs: Vec<f64>,
    /// Area of the polygon of the points, in the plane that it fills most of; of three points and
    /// more.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area: Option<f64>,
    /// Of each point over the ground; none where no ground was found.
    pub heights: Vec<f64>,
}

/// What is kept of a scale that a call gave.
#[derive(Serialize, Deserialize)]
struct Kept {
    metres_per_unit: f64,
}

impl SceneScale {
    /// Of a scene as it was made, whose metres a unit a call gave or not.
    fn of(scene: &Scene, given: Option<f64>) -> Self {
        let report = &scene.meta.report;
        let up = SceneCamera::level_up(&scene.meta.cameras);
        let ground = scene.ground();
        let (metres_per_unit, source) = match (given, report.cameras.unit) {
            (Some(given), _) => (Some(given), ScaleSource::Given),
            (None, LengthUnit::Metre) => (Some(1.0), ScaleSource::Capture),
            (None, LengthUnit::Unknown) => (None, ScaleSource::None),
        };
        let up = ground.map_or(up.to_array(), |ground| ground.normal);
        Self { metres_per_unit, source, up, ground }
    }

    /// Lengths, area and heights of points.
    fn measure(&self, points: &[[f64; 3]]) -> Measured {
        let places: Vec<DVec3> = points.iter().copied().map(DVec3::from).collect();
        let (unit, metres) = match self.metres_per_unit {
            Some(metres) => (LengthUnit::Metre, metres),
            None => (LengthUnit::Unknown, 1.0),
        };
        let legs: Vec<f64> =
            places.windows(2).map(|ends| metres * ends[0].distance(ends[1])).collect();
        // Half the sum of the cross products around the polygon (Newell).
        let around = places.iter().zip(places.iter().cycle().skip(1));
        let first = places.first().copied().unwrap_or_default();
        let cross: DVec3 = around.map(|(a, b)| (*a - first).cross(*b - first)).sum();
        let area = (places.len() >= 3).then(|| metres * metres * 0.5 * cross.length());
        let height = |ground: Ground| places.iter().map(|at| metres * ground.height(*at)).collect();
        let heights = self.ground.map(height).unwrap_or_default();
        Measured { unit, length: legs.iter().sum(), legs, area, heights }
    }
}

/// Metres a unit of the scene where `length` units are so many metres.
fn per_unit(metres: f64, length: f64) -> Result<f64> {
    let [least, most] = METRES_PER_UNIT;
    let found = metres / length;
    if (least..=most).contains(&found) {
        return Ok(found);
    }
    let found = format!("metres_per_unit is {found} ({metres} metres, {length} units)");
    Err(Error::invalid(format!("{found}; it must be {least} to {most}")))
}

/// Refuses points that are nowhere.
fn check_points(points: &[[f64; 3]]) -> Result<()> {
    let most = f64::from(Gaussians::COORDINATE_MAX);
    for (i, point) in points.iter().enumerate() {
        if !point.iter().all(|v| v.abs() <= most) {
            let what = format!("points[{i}] is {point:?}");
            return Err(Error::invalid(format!("{what}; its numbers must be -{most} to {most}")));
        }
    }
    Ok(())
}

fn check_measured(points: &[[f64; 3]], limits: &Limits) -> Result<()> {
    texts::check_count("points", points.len(), limits.parts_max)?;
    check_points(points)
}

/// The length in the scene that a call says the metres of.
enum Length {
    Of(f64),
    Thing(ScaleThing),
}

impl ScaleSpec {
    /// Metres with what they are of, or metres a unit; `None`: nothing is said.
    fn said(self) -> Result<Option<(f64, Length)>> {
        let Self { metres, points, thing, metres_per_unit } = self;
        let one = "give metres with points or with thing, or metres_per_unit alone";
        match (metres, points, thing, metres_per_unit) {
            (None, None, None, None) => Ok(None),
            (None, None, None, Some(metres)) => Ok(Some((metres, Length::Of(1.0)))),
            (Some(metres), Some(ends), None, None) => {
                check_points(&ends)?;
                let [a, b] = ends.map(DVec3::from);
                Ok(Some((metres, Length::Of(a.distance(b)))))
            }
            (Some(metres), None, Some(thing), None) => Ok(Some((metres, Length::Thing(thing)))),
            _ => Err(Error::invalid(format!("scale: {one}"))),
        }
    }
}

impl Service {
    /// How large a scene is and how it stands.
    ///
    /// # Errors
    /// As [`Service::export`].
    pub async fn scale(&self, id: &SceneId) -> Result<SceneScale> {
        let (inner, access) = (Arc::clone(&self.inner), self.scene(id).await?.unedited()?);
        blocking(move || {
            let kept = inner.store.scale(access.id())?;
            let kept = kept.map(|json| serde_json::from_str::<Kept>(&json)).transpose();
            let kept =
                kept.map_err(|e| Error::internal("the scale cannot be read").caused_by(e))?;
            let scene = inner.load(&access)?;
            Ok(SceneScale::of(&scene, kept.map(|kept| kept.metres_per_unit)))
        })
        .await?
    }

    /// Says how large a scene is, in place of what was said before. A thing needs semantics and
    /// waits for them: at most `wait`, or as long as a text would. Nothing of the scene changes
    /// but lengths in metres.
    ///
    /// # Errors
    /// `invalid_request`; else as [`Service::query`].
    pub async fn set_scale(
        &self,
        id: &SceneId,
        spec: ScaleSpec,
        wait: Option<Duration>,
    ) -> Result<SceneScale> {
        let access = self.scene(id).await?.unedited()?;
        let given = match spec.said()? {
            None => None,
            Some((metres, of)) => {
                let length = match of {
                    Length::Of(length) => length,
                    Length::Thing(thing) => self.side_of(id, thing, wait).await?,
                };
                Some(per_unit(metres, length)?)
            }
        };
        let inner = Arc::clone(&self.inner);
        blocking(move || {
            let kept =
                given.map(|metres_per_unit| serde_json::to_string(&Kept { metres_per_unit }));
            let kept = kept.transpose();
            let kept = kept.map_err(|e| Error::internal("the scale has no JSON").caused_by(e))?;
            inner.store.put_scale(access.id(), kept)?;
            Ok(SceneScale::of(&*inner.load(&access)?, given))
        })
        .await?
    }

    /// Lengths, area and heights of points of a scene.
    ///
    /// # Errors
    /// `invalid_request`, `limit_exceeded`; else as [`Service::scale`].
    pub async fn measure(&self, id: &SceneId, points: Vec<[f64; 3]>) -> Result<Measured> {
        check_measured(&points, &self.limits())?;
        Ok(self.scale(id).await?.measure(&points))
    }

    /// Length of a side of a thing, world units.
    async fn side_of(
        &self,
        id: &SceneId,
        thing: ScaleThing,
        wait: Option<Duration>,
    ) -> Result<f64> {
        let ScaleThing { text, part, side } = thing;
        let texts = vec![text];
        let spec = QuerySpec { texts, boxes: Boxes::Upright, wait, ..QuerySpec::default() };
        let answer = self.query(id, spec).await?;
        let parts = answer.results.into_iter().next().map_or(Vec::new(), |result| result.parts);
        let Some(found) = parts.get(part as usize) else {
            let has = format!("the text has {} parts", parts.len());
            return Err(Error::invalid(format!("thing.part is {part}; {has}, counted from 0")));
        };
        // Up is the last axis.
        let [a, b, height] = found.size;
        Ok(match side {
            BoxSide::Height => height,
            BoxSide::Width => a.max(b),
            BoxSide::Depth => a.min(b),
            BoxSide::Longest => a.max(b).max(height),
        })
    }
}

impl OfflineService {
    /// As [`Service::measure`] and [`Service::scale`], of a scene that nothing is kept beside.
    ///
    /// # Errors
    /// As there.
    pub fn measure(
        &self,
        scene: &Scene,
        spec: ScaleSpec,
        points: &[[f64; 3]],
    ) -> Result<(SceneScale, Option<Measured>)> {
        let given = match spec.said()? {
            None => None,
            Some((metres, Length::Of(length))) => Some(per_unit(metres, length)?),
            Some(_) => return Err(Error::invalid("a file is measured by points alone")),
        };
        let scale = SceneScale::of(scene, given);
        if points.is_empty() {
            return Ok((scale, None));
        }
        check_measured(points, &self.limits)?;
        let measured = scale.measure(points);
        Ok((scale, Some(measured)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_areas_and_heights_have_the_unit_that_is_known() {
        let ground = Ground { normal: [0.0, -1.0, 0.0], point: [9.0, 1.0, 9.0], share: 0.2 };
        let scale = |metres_per_unit| SceneScale {
            metres_per_unit,
            source: ScaleSource::None,
            up: ground.normal,
            ground: Some(ground),
        };
        // An L of three squares, on the ground and over it.
        let l = [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]];
        let l = l.map(|[x, z]| [f64::from(x), 0.0, f64::from(z)]);
        let found = scale(None).measure(&l);
        assert_eq!((found.unit, found.length, found.area), (LengthUnit::Unknown, 6.0, Some(3.0)));
        assert_eq!(found.heights, [1.0; 6]);
        let found = scale(Some(0.5)).measure(&l);
        assert_eq!((found.unit, found.length, found.area), (LengthUnit::Metre, 3.0, Some(0.75)));
        assert_eq!(
            (&*found.legs, &*found.heights),
            (&[1.0, 0.5, 0.5, 0.5, 0.5][..], &[0.5; 6][..])
        );
        let two = scale(Some(2.0)).measure(&l[..2]);
        assert_eq!((two.length, two.area), (4.0, None));
        let one = SceneScale { ground: None, ..scale(None) }.measure(&l[..1]);
        assert_eq!((one.length, one.area, one.heights.len()), (0.0, None, 0));
    }

    #[test]
    fn a_scale_is_said_in_one_way() {
        let (ends, thing) = ([[0.0; 3], [3.0, 0.0, 4.0]], ScaleThing::default());
        let length = |spec: ScaleSpec| match spec.said() {
            Ok(Some((metres, Length::Of(length)))) => Some(metres / length),
            _ => None,
        };
        let points = Some(ends);
        let said = ScaleSpec { metres: Some(10.0), points, ..ScaleSpec::default() };
        assert_eq!(length(said.clone()), Some(2.0));
        let alone = ScaleSpec { metres_per_unit: Some(0.3), ..ScaleSpec::default() };
        assert_eq!(length(alone.clone()), Some(0.3));
        assert!(ScaleSpec::default().said().unwrap().is_none());
        for wrong in [
            ScaleSpec { metres: None, ..said.clone() },
            ScaleSpec { points: None, ..said.clone() },
            ScaleSpec { thing: Some(thing), ..said.clone() },
            ScaleSpec { metres: Some(1.0), ..alone },
            ScaleSpec { points: Some([[f64::NAN; 3], [0.0; 3]]), ..said },
        ] {
            assert!(wrong.clone().said().is_err(), "{wrong:?}");
        }
        for wrong in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e7] {
            assert!(per_unit(wrong, 1.0).is_err(), "{wrong}");
        }
    }
}
