//! A scene whose photos change: photos join it, or leave it. Only sets with photos that are new go
//! through the network; what it said of all others is kept ([`Seen`]), and one scene is made of all
//! of it again.
//!
//! A scene that was refined is not made again: it would fall back behind its steps. It keeps its
//! Gaussians, and those of the new photos join where no photo before saw anything ([`version`]). So
//! does a scene that would be worse at its old photos, each judged by the others.

use rayon::prelude::*;
use segsplat_render::{
    Kinds, RenderRequest, Renderer,
    plan::{default_near, widened},
};

use super::{
    PhotoSet, Pipeline, Reconstruction, Seen, Stages, lifted, of_sets, refinement::at_side, see,
    sets::newest, united, views_of, with_reading,
};
use crate::{
    capture, center_of,
    error::{Error, Result},
    lift::{Fusion, UnionOptions},
    refine::judged_without,
    scene::{
        Camera, Gaussians, HealthReport, PosedPhoto, Scene, SceneCamera, SceneMeta, SceneOptions,
        Stage, Watch,
    },
    seen_at,
};

/// Longer side of the pictures that say what the photos of a scene saw, pixels.
const LOOK_SIDE: u32 = 160;
/// How far behind a surface, as a share of its depth, a Gaussian must be to be hidden by it.
const BEHIND: f64 = 0.05;
/// Longer side of the pictures for which Gaussians get the blur of magnification for good: that of
/// a refinement.
const LEARNT_SIDE: u32 = 640;

/// Old photos that judge whether a scene that is made again is as good: those nearest to new ones,
/// of which most decide. So one that gains or loses a lot does not outweigh the others.
const JUDGES: usize = 5;
/// Longer side of the pictures that they judge, pixels.
const JUDGED_SIDE: u32 = 320;
/// What one may lose and find it as good, dB.
const LOST_DB: f64 = 0.05;

/// What the networks make of photos some of which are new.
#[derive(Clone, Debug)]
pub struct Grown {
    /// The scene of all of them.
    pub made: Reconstruction,
    /// One set of Gaussians of the new ones alone.
    pub of_new: Gaussians,
    /// What the network said of all of them, where it can be united again.
    pub seen: Option<Seen>,
}

impl Seen {
    /// Photos that it is of.
    #[must_use]
    pub fn photos(&self) -> usize {
        self.capture.near_far.len()
    }

    /// The same of the photos of these numbers alone, ascending. What the network said of them with
    /// the help of the others stays.
    #[must_use]
    pub fn only(&self, kept: &[usize]) -> Self {
        let number = |photo: usize| kept.iter().position(|&i| i == photo);
        let mut seen = self.clone();
        seen.views.retain_mut(|view| {
            let new = number(usize::from(view.photo)).and_then(|new| u16::try_from(new).ok());
            view.photo = new.unwrap_or_default();
            new.is_some()
        });
        // Sets say which photos were used; those that say nothing new would be ever more.
        let mut is_used = vec![false; kept.len()];
        seen.sets.retain_mut(|set| {
            set.views = set.views.iter().filter_map(|&view| number(view)).collect();
            let says_more = set.views.iter().any(|&view| !is_used[view]);
            set.views.iter().for_each(|&view| is_used[view] = true);
            says_more
        });
        let capture = &mut seen.capture;
        capture.near_far = kept.iter().map(|&i| capture.near_far[i]).collect();
        let row = |&i: &usize| kept.iter().map(|&j| self.capture.overlap[i][j]).collect();
        capture.overlap = kept.iter().map(row).collect();
        seen.stages.clear();
        seen
    }
}

/// A scene of photos of which the first `before` were there already; `known` is what the network
/// said of these, where that is still known.
///
/// # Errors
/// As [`super::reconstruct`]; `invalid_request` also where none of the new photos shows anything
/// that another one shows.
pub fn make_more(
    pipeline: &Pipeline,
    photos: &PhotoSet,
    before: usize,
    known: Option<Seen>,
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<Grown> {
    let all = &photos.photos;
    let seen = match known.filter(|known| known.photos() == before) {
        Some(known) if before == all.len() => known,
        Some(known) => see_more(pipeline, all, known, options, watch)?,
        None => see(pipeline, all, options, watch)?,
    };
    let new = seen.views.iter().filter(|view| usize::from(view.photo) >= before);
    let new: Vec<_> = new.cloned().collect();
    if new.is_empty() && before < all.len() {
        return Err(Error::invalid(
            "none of the new photos shows what a photo of the scene shows; are their poses in the \
             scene's own frame?",
        ));
    }
    let fusion = Fusion::OneSet(UnionOptions::default());
    let of_new = lifted(pipeline, all, new, &seen.method, &fusion, watch)?.gaussians;
    let made = united(pipeline, all, seen.clone(), watch)?;
    Ok(Grown { made: with_reading(made, photos), of_new, seen: Some(seen) })
}

/// What the network says of photos the first of which it has seen.
fn see_more(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    known: Seen,
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<Seen> {
    let mut stages = Stages::new(watch);
    let manifest = pipeline.geometry.manifest();
    let views = views_of(manifest, options, photos.len())?;
    let before = known.photos();
    let (capture, sets) = stages.run(Stage::Capture, || {
        pipeline.on_workers(|| {
            let mut capture = capture::analyse_more(photos, &known.capture, watch.cancel)?;
            let new = capture.warnings.split_off(known.capture.warnings.len());
            capture.warnings = newest(&capture.warnings, &new);
            let most = manifest.neighbors_max;
            let sets = capture::more_view_sets(&capture, photos, before, views, most);
            Ok((capture, sets))
        })
    })?;
    let more = stages.run(Stage::Geometry, || of_sets(pipeline, photos, &capture, &sets, watch))?;
    // Photos that were there before stay as they were.
    let new = more.into_iter().filter(|view| usize::from(view.photo) >= before);
    let (views, sets) = (known.views.into_iter().chain(new), known.sets.into_iter().chain(sets));
    let (views, sets) = (views.collect(), sets.collect());
    Ok(Seen { views, capture, sets, method: known.method, stages: stages.times })
}

/// The version of the scene `served` after its photos changed, which are `photos` now: those of the
/// numbers `kept` are the first ones of `grown`, all others of `served` are gone.
///
/// # Errors
/// Those of the renderer; `internal` where they are not photos of this scene.
pub fn version(
    renderer: &dyn Renderer,
    served: &Scene,
    kept: &[usize],
    grown: &Grown,
    photos: &[PosedPhoto],
) -> Result<Reconstruction> {
    let made = &grown.made;
    let refined = served.meta.report.refinement.as_ref().is_some_and(|of| of.steps > 0);
    if !refined && (grown.of_new.is_empty() || is_as_good(renderer, served, kept, made, photos)?) {
        return Ok(made.clone());
    }
    let gaussians = renumbered(&served.gaussians, kept)?;
    let mut cameras: Vec<SceneCamera> =
        kept.iter().filter_map(|&i| served.meta.cameras.get(i)).cloned().collect();
    let meta = |cameras: Vec<SceneCamera>, report: HealthReport| SceneMeta {
        cameras,
        report,
        ..served.meta.clone()
    };
    let gaussians = match grown.of_new.is_empty() {
        true => gaussians,
        false => {
            let as_made = meta(made.cameras.clone(), made.report.clone());
            let of_scene = Scene::new(as_made, Gaussians::default(), made.backdrop.clone());
            let new = widened(&of_scene, &grown.of_new, Some(LEARNT_SIDE))?;
            let near = default_near(served.meta.report.median_depth);
            let looks = looks(renderer, &gaussians, &cameras, near)?;
            let is_new: Vec<bool> = (0..new.len())
                .into_par_iter()
                .map(|i| !looks.iter().any(|look| look.sees(&new, i)))
                .collect();
            gaussians.joined(&new.only(|i| is_new[i]))?
        }
    };
    cameras.extend(made.cameras.iter().skip(kept.len()).cloned());
    // In layers, the new photos are never in front: theirs is what the others lack.
    let mut network_focal_px = made.report.network_focal_px.clone();
    if !refined {
        let of_kept = kept.iter().filter_map(|&i| served.meta.report.network_focal_px.get(i));
        network_focal_px.fill(0.0);
        network_focal_px.iter_mut().zip(of_kept).for_each(|(new, old)| *new = *old);
    }
    let report = HealthReport {
        photos: made.report.photos,
        views_used: made.report.views_used,
        gaussians: gaussians.len() as u64,
        overlap: made.report.overlap,
        network_focal_px,
        stages: made.report.stages.clone(),
        warnings: made.report.warnings.clone(),
        ..served.meta.report.clone()
    };
    Ok(Reconstruction { gaussians, backdrop: (*served.backdrop).clone(), report, cameras })
}

/// Whether a scene that was made again of `photos` is as good as `served` at most of the photos
/// that stay and judge it, each left out of both.
fn is_as_good(
    renderer: &dyn Renderer,
    served: &Scene,
    kept: &[usize],
    made: &Reconstruction,
    photos: &[PosedPhoto],
) -> Result<bool> {
    let meta = SceneMeta {
        cameras: made.cameras.clone(),
        report: made.report.clone(),
        ..served.meta.clone()
    };
    let made = Scene::new(meta, made.gaussians.clone(), made.backdrop.clone());
    let judges = judges(photos, kept.len(), made.meta.report.median_depth);
    let mut votes = Votes::of(judges.len());
    for photo in judges {
        if let Some(decided) = votes.decided() {
            return Ok(decided);
        }
        let truth = at_side(&photos[photo], JUDGED_SIDE);
        let of = |scene: &Scene, number| judged_without(renderer, scene, number, &truth);
        if let (Some(old), Some(new)) = (of(served, kept[photo])?, of(&made, photo)?) {
            votes.count(new.psnr - old.psnr + LOST_DB >= 0.0);
        }
    }
    Ok(votes.decided().unwrap_or(votes.no == 0))
}

/// What judges say of a scene.
struct Votes {
    judges: usize,
    yes: usize,
    no: usize,
}

impl Votes {
    fn of(judges: usize) -> Self {
        Self { judges, yes: 0, no: 0 }
    }

    fn count(&mut self, yes: bool) {
        let votes = if yes { &mut self.yes } else { &mut self.no };
        *votes += 1;
    }

    /// What most say, or half that it is worse; `None` before that is sure.
    fn decided(&self) -> Option<bool> {
        match self {
            _ if 2 * self.yes > self.judges => Some(true),
            _ if self.no > 0 && 2 * self.no >= self.judges => Some(false),
            _ => None,
        }
    }
}

/// The photos of the first `before` that are nearest to one of the others, at most [`JUDGES`].
fn judges(photos: &[PosedPhoto], before: usize, depth: f64) -> Vec<usize> {
    let (old, new) = photos.split_at(before);
    let pose = |photo: &PosedPhoto| photo.camera.camera_to_world;
    let to_new = |photo: &PosedPhoto| {
        let steps = new.iter().map(|other| pose(photo).apart(&pose(other), depth));
        steps.fold(f64::INFINITY, f64::min)
    };
    let mut near: Vec<(f64, usize)> =
        old.iter().enumerate().map(|(i, photo)| (to_new(photo), i)).collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    near.into_iter().take(JUDGES).map(|(_, photo)| photo).collect()
}

/// The Gaussians of the photos `kept`, whose numbers are their places there.
fn renumbered(gaussians: &Gaussians, kept: &[usize]) -> Result<Gaussians> {
    let number = |i: usize| {
        let photo = usize::from(gaussians.source()[i].view);
        kept.iter().position(|&one| one == photo)
    };
    let mut raw = gaussians.only(|i| number(i).is_some()).into_raw();
    for source in &mut raw.source {
        let photo = usize::from(source.view);
        let new = kept.iter().position(|&one| one == photo).unwrap_or_default();
        source.view = u16::try_from(new).unwrap_or(u16::MAX);
    }
    Gaussians::restore(raw)
}

/// How far a photo of a scene sees.
struct Look {
    camera: Camera,
    /// `[H * W]` depth, and the opacity of what is there.
    depth: Vec<f32>,
    alpha: Vec<f32>,
}

impl Look {
    /// Whether the photo saw the place of Gaussian `i`: it is no farther than the surface that the
    /// photo shows there.
    fn sees(&self, gaussians: &Gaussians, i: usize) -> bool {
        let Some((seen, u, v)) = seen_at(&self.camera, center_of(gaussians, i)) else {
            return false;
        };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        let at = v as usize * self.camera.intrinsics.width as usize + u as usize;
        let surface = f64::from(self.depth[at]);
        self.alpha[at] < 0.5 || seen.z <= surface * (1.0 + BEHIND)
    }
}

/// What the photos of these cameras see of plain Gaussians.
fn looks(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    cameras: &[SceneCamera],
    near: f32,
) -> Result<Vec<Look>> {
    let kinds = Kinds { color: false, depth: true, alpha: true };
    let look = |of: &SceneCamera| {
        let lens = of.camera.intrinsics;
        let longer = lens.width.max(lens.height);
        let side = |length: u32| (length * LOOK_SIDE).div_ceil(longer).min(length).max(1);
        let intrinsics = lens.resized(side(lens.width), side(lens.height));
        let camera = Camera { intrinsics, ..of.camera };
        let frame = renderer.render(gaussians, &RenderRequest::plain(camera, kinds, near))?;
        let lacks = || Error::internal("a renderer gave no depth");
        let depth = frame.depth.ok_or_else(lacks)?;
        let alpha = frame.alpha.ok_or_else(lacks)?;
        Ok(Look { camera, depth, alpha })
    };
    cameras.iter().map(look).collect()
}

#[cfg(test)]
mod tests {
    use super::Votes;

    fn decided(judges: usize, votes: &[bool]) -> (Option<bool>, usize) {
        let mut of = Votes::of(judges);
        let asked = votes.iter().take_while(|vote| {
            let open = of.decided().is_none();
            if open {
                of.count(**vote);
            }
            open
        });
        let asked = asked.count();
        (of.decided(), asked)
    }

    #[test]
    fn most_judges_decide_and_no_more_are_asked() {
        assert_eq!(decided(5, &[true; 5]), (Some(true), 3));
        assert_eq!(decided(5, &[false, true, true, false, false]), (Some(false), 5));
        assert_eq!(decided(5, &[true, false, true, false, true]), (Some(true), 5));
        assert_eq!(decided(4, &[true, false, true, false]), (Some(false), 4), "half lose");
        assert_eq!(decided(2, &[true, true]), (Some(true), 2));
        assert_eq!(decided(1, &[false]), (Some(false), 1));
        assert_eq!(decided(3, &[true]), (None, 1), "two could not be drawn");
    }
}
