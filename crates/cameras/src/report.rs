//! What is said of a solution in words.

use crate::{
    grow::Grown,
    joints::weakest_min,
    judge::{
        CHAIN_LINKS, CHAIN_PLACED, EXPLAINED_MIN, LOOPS_MIN, MIRRORED_MAX, MISSING_MAX, RIVAL_MAX,
    },
    solution::{CONFIDENCE_MIN, Evidence, Placing},
    survey::Survey,
};

/// Matches under which a pair of photos says nothing.
const MATCHES_FEW: usize = 30;
/// Focal lengths further than this from what EXIF says are told, as a share.
const EXIF_OFF: f64 = 0.08;

/// Photos that were taken out of a solution.
#[derive(Default)]
pub(crate) struct Dropped {
    /// Those that only weak pairs join with the others.
    pub(crate) weak: Vec<usize>,
    /// Those that few points hold, and how many.
    pub(crate) few: Vec<(usize, usize)>,
    /// Those whose turn is not known.
    pub(crate) loose: Vec<usize>,
}

/// Why a photo has no camera.
pub(crate) fn why_left_out(survey: &Survey, photo: usize, dropped: &Dropped) -> String {
    let keypoints = survey.views[photo].pixels.len();
    let own = survey.pairs.iter().filter(|pair| pair.photos.contains(&photo));
    let most = own.map(|pair| pair.matches.len()).max().unwrap_or(0);
    let held = dropped.few.iter().find(|(few, _)| *few == photo);
    if let Some((_, points)) = held {
        format!("only {points} of its points are seen by two other photos: its camera is not sure")
    } else if dropped.loose.contains(&photo) {
        "what it shows leaves its camera open by degrees: it may be far from the other photos, or \
         show few things that are near"
            .to_owned()
    } else if dropped.weak.contains(&photo) {
        "its matches with the other photos contradict each other: it may show another place, or \
         another side of a thing that looks alike"
            .to_owned()
    } else if keypoints < MATCHES_FEW {
        format!("only {keypoints} keypoints were found in it: it may be blurred or plain")
    } else if most < MATCHES_FEW {
        format!("at most {most} of its keypoints match another photo")
    } else {
        "too few of its matches agree with the photos whose cameras were found".to_owned()
    }
}

/// What a person should know.
pub(crate) fn warnings(
    survey: &Survey,
    grown: &Grown,
    placings: &[Placing],
    evidence: &Evidence,
    confidence: f64,
) -> Vec<String> {
    let mut said = Vec::new();
    for (photo, placing) in placings.iter().enumerate() {
        if let Placing::LeftOut(why) = placing {
            said.push(format!("photo {photo} was left out: {why}"));
        }
    }
    for (view, pose) in survey.views.iter().zip(&grown.poses) {
        let (lens, prior) = (grown.lenses[view.lens], survey.priors[view.lens]);
        let off = lens.focal / prior.focal - 1.0;
        if pose.is_some() && prior.known && off.abs() > EXIF_OFF {
            said.push(format!(
                "the focal length that fits the photos is {:.0} % off from that of EXIF",
                100.0 * off
            ));
            break;
        }
    }
    if confidence < CONFIDENCE_MIN {
        said.push(doubt(evidence).to_owned());
    }
    said
}

/// The strongest reason for a low confidence.
fn doubt(evidence: &Evidence) -> &'static str {
    if evidence.placed <= 2 {
        "only two photos could be placed: nothing confirms their cameras"
    } else if evidence.rival > RIVAL_MAX {
        "two different solutions fit the photos equally well"
    } else if evidence.mirrored > MIRRORED_MAX {
        "the scene fits the photos inside out as well: take photos from nearer or wider apart"
    } else if evidence.weakest < weakest_min(evidence.placed, evidence.links)
        || evidence.explained < EXPLAINED_MIN
    {
        "many matches contradict the cameras: the photos may show different sides of a thing that \
         looks alike"
    } else if evidence.loops < LOOPS_MIN {
        "the pairs of photos contradict each other around most loops"
    } else if evidence.placed >= CHAIN_PLACED
        && (evidence.links as f64) < CHAIN_LINKS * (evidence.placed - 1) as f64
    {
        "most photos match only their neighbours: errors add up along the row, take more photos"
    } else if evidence.missing > MISSING_MAX {
        "photos that should show the same things by the cameras do not look alike"
    } else {
        "the cameras are held by few points"
    }
}
