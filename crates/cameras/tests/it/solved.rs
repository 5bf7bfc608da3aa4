//! Solutions against the truth.

use std::sync::atomic::AtomicBool;

use glam::{DMat3, DVec3};
use segsplat_cameras::{
    CONFIDENCE_MIN, Grey, PairMatches, PhotoKeypoints, Placing, Solution, SolveOptions, solve,
};
use segsplat_core::error::{ErrorCode, Result};

use crate::generated::{Draw, Plan, SIZE, Truth, arc, cloud, off, photos, room};

fn solved(photos: &[PhotoKeypoints], pairs: &[PairMatches]) -> Result<Solution> {
    solve(photos, pairs, &[], &SolveOptions::default(), &AtomicBool::new(false), &|_| ())
}

fn plan() -> Plan {
    Plan {
        points: cloud(600, 1.0, 11),
        cameras: arc(8, 90.0, 4.0),
        focal: 560.0,
        k1: 0.0,
        noise: 0.0,
        wrong: 0.0,
        seed: 5,
    }
}

#[test]
fn exact_keypoints_give_exact_cameras() {
    for (points, cameras) in
        [(cloud(600, 1.0, 11), arc(8, 90.0, 4.0)), (room(900, 2.0, 12), arc(8, 40.0, 1.2))]
    {
        let plan = Plan { points, cameras, k1: -0.08, ..plan() };
        let (photos, pairs) = photos(&plan);
        let solution = solved(&photos, &pairs).expect("a solution");
        let off = off(&solution, &plan);
        assert_eq!(off.placed, 8);
        // The lens is thought to be plainer than this one.
        assert!(off.degrees < 0.05, "{} degrees", off.degrees);
        assert!(off.center < 2e-3, "centre {}", off.center);
        assert!((off.focal - 1.0).abs() < 0.015, "focal {}", off.focal);
        assert!(solution.confidence > 0.8, "{:?}", solution.evidence);
    }
}

#[test]
fn noise_and_wrong_matches_are_borne() {
    for wrong in [0.0, 0.3, 0.5, 0.7] {
        let plan = Plan { noise: 0.5, wrong, k1: 0.05, ..plan() };
        let (photos, pairs) = photos(&plan);
        let solution = solved(&photos, &pairs).expect("a solution");
        let off = off(&solution, &plan);
        assert_eq!(off.placed, 8, "{wrong}");
        assert!(off.degrees < 0.5, "{wrong}: {} degrees", off.degrees);
        assert!(off.center < 0.02, "{wrong}: centre {}", off.center);
        assert!((off.focal - 1.0).abs() < 0.02, "{wrong}: focal {}", off.focal);
        // Where most matches are wrong the cameras are right, but it cannot be known.
        let known = solution.confidence > CONFIDENCE_MIN;
        assert_eq!(known, wrong <= 0.5, "{wrong}: {:?}", solution.evidence);
    }
}

#[test]
fn focal_lengths_are_found_without_exif_and_with_a_wrong_one() {
    for focal in [380.0, 560.0, 900.0] {
        for exif in [None, Some(1.04)] {
            let plan = Plan { focal, noise: 0.3, wrong: 0.2, cameras: arc(8, 90.0, 4.0), ..plan() };
            let (mut photos, pairs) = photos(&plan);
            for photo in &mut photos {
                photo.focal = exif.map(|factor| factor * focal);
            }
            let off = off(&solved(&photos, &pairs).expect("a solution"), &plan);
            assert!((off.focal - 1.0).abs() < 0.02, "{focal} {exif:?}: {}", off.focal);
        }
    }
}

#[test]
fn a_focal_length_of_exif_that_is_far_off_does_not_hold_the_cameras() {
    for exif in [0.8, 1.25] {
        let plan = Plan { noise: 0.5, cameras: arc(4, 30.0, 4.0), ..plan() };
        let (mut photos, pairs) = photos(&plan);
        photos.iter_mut().for_each(|photo| photo.focal = Some(exif * plan.focal));
        let solution = solved(&photos, &pairs).expect("a solution");
        let off = off(&solution, &plan);
        assert!((off.focal - 1.0).abs() < 0.03, "{exif}: {}", off.focal);
        let is_said = |warning: &String| warning.contains("from that of EXIF");
        assert!(solution.warnings.iter().any(is_said), "{exif}: {:?}", solution.warnings);
    }
}

#[test]
fn photos_around_a_thing_are_all_placed_with_a_focal_length_that_is_half_as_long_again() {
    for wrong in [0.3, 0.5, 0.6] {
        let cameras = arc(12, 330.0, 4.0);
        let plan = Plan { noise: 0.5, wrong, cameras, ..plan() };
        let (mut photos, mut pairs) = photos(&plan);
        photos.iter_mut().for_each(|photo| photo.focal = Some(1.5 * plan.focal));
        // Others show another side.
        for pair in pairs.iter_mut().filter(|pair| pair.photos[1] - pair.photos[0] > 2) {
            pair.pairs.clear();
        }
        let off = off(&solved(&photos, &pairs).expect("a solution"), &plan);
        assert_eq!(off.placed, 12, "{wrong}");
        assert!((off.focal - 1.0).abs() < 0.03, "{wrong}: {}", off.focal);
    }
}

#[test]
fn a_photo_of_another_place_is_left_out_and_named() {
    let plan = Plan { noise: 0.5, wrong: 0.2, ..plan() };
    let (mut photos, mut pairs) = photos(&plan);
    let mut draw = Draw(99);
    let [width, height] = SIZE.map(f64::from);
    photos[3].keypoints = (0..600)
        .map(|_| [draw.between(0.0, width) as f32, draw.between(0.0, height) as f32])
        .collect();
    for pair in pairs.iter_mut().filter(|pair| pair.photos.contains(&3)) {
        pair.pairs.truncate(150);
        for (k, ends) in pair.pairs.iter_mut().enumerate() {
            ends[usize::from(pair.photos[1] == 3)] = k as u32;
        }
    }
    let solution = solved(&photos, &pairs).expect("a solution");
    let off = off(&solution, &plan);
    assert_eq!(off.placed, 7);
    assert!(off.degrees < 0.5, "{} degrees", off.degrees);
    assert!(matches!(&solution.photos[3], Placing::LeftOut(why) if !why.is_empty()));
    assert!(solution.warnings.iter().any(|w| w.contains("photo 3")), "{:?}", solution.warnings);
}

#[test]
fn a_photo_that_few_points_hold_is_left_out_and_the_others_are_trusted() {
    let plan = Plan { noise: 0.5, ..plan() };
    let (photos, mut pairs) = photos(&plan);
    pairs.iter_mut().filter(|pair| pair.photos[1] == 7).for_each(|pair| pair.pairs.truncate(18));
    let solution = solved(&photos, &pairs).expect("a solution");
    let off = off(&solution, &plan);
    assert_eq!(off.placed, 7);
    assert!(off.degrees < 0.5, "{} degrees", off.degrees);
    assert!(solution.confidence > 0.8, "{:?}", solution.evidence);
    let Placing::LeftOut(why) = &solution.photos[7] else { panic!("photo 7 has a camera") };
    assert!(why.starts_with("only 18 of its points"), "{why}");
}

#[test]
fn a_photo_whose_turn_its_points_leave_open_is_left_out_and_named() {
    // Photo 7 shows things of a hand's width alone, which a step aside moves as a turn does.
    for (reach, placed) in [(0.06, 7), (0.6, 8)] {
        let mut points = plan().points;
        points.extend(cloud(120, reach, 12));
        let plan = Plan { points, noise: 0.5, ..plan() };
        let (photos, mut pairs) = photos(&plan);
        for pair in pairs.iter_mut().filter(|pair| pair.photos[1] == 7) {
            let first = pair.pairs.len() - 120;
            pair.pairs.drain(..first);
        }
        let solution = solved(&photos, &pairs).expect("a solution");
        let off = off(&solution, &plan);
        assert_eq!(off.placed, placed, "{reach}: {} degrees", off.degrees);
        assert!(off.degrees < 0.5, "{reach}: {} degrees", off.degrees);
        assert!(solution.confidence > 0.8, "{reach}: {:?}", solution.evidence);
        if let Placing::LeftOut(why) = &solution.photos[7] {
            assert!(why.contains("open by degrees"), "{why}");
        }
    }
}

#[test]
fn photos_of_two_places_that_one_picture_joins_are_not_taken_for_one_place() {
    // Six photos of one place and four of another; both have the same picture on the wall.
    const FIRST: usize = 6;
    for (in_picture, placed) in [(0.45, FIRST), (0.8, 10)] {
        let plan = Plan { noise: 0.5, cameras: arc(10, 90.0, 4.0), ..plan() };
        let (photos, mut pairs) = photos(&plan);
        for pair in
            pairs.iter_mut().filter(|pair| pair.photos[0] < FIRST && pair.photos[1] >= FIRST)
        {
            assert_eq!(pair.pairs.len(), plan.points.len(), "all are in each photo");
            let picture = (in_picture * pair.pairs.len() as f64) as usize;
            let (others, count) = (&mut pair.pairs[picture..], plan.points.len() as u32);
            others.iter_mut().rev().zip(picture as u32..count).for_each(|(of, k)| of[1] = k);
        }
        let solution = solved(&photos, &pairs).expect("a solution");
        let off = off(&solution, &plan);
        assert_eq!(off.placed, placed, "{in_picture}: {:?}", solution.evidence);
        assert!(off.degrees < 0.5, "{in_picture}: {} degrees", off.degrees);
        assert!(solution.confidence > CONFIDENCE_MIN, "{in_picture}: {:?}", solution.evidence);
        for (photo, placing) in solution.photos.iter().enumerate() {
            let is_named = matches!(placing, Placing::LeftOut(why) if why.contains("contradict"));
            assert_eq!(is_named, photo >= placed, "{in_picture}: photo {photo} {placing:?}");
        }
    }
}

#[test]
fn a_camera_that_only_turns_gives_no_cameras() {
    let turned = |i: usize| Truth {
        turn: DMat3::from_rotation_y(0.08 * i as f64) * DMat3::from_rotation_x(0.03 * i as f64),
        center: DVec3::ZERO,
    };
    let points = cloud(3000, 6.0, 21).into_iter().filter(|p| p.length() > 2.0).collect();
    let plan = Plan { points, cameras: (0..6).map(turned).collect(), noise: 0.5, ..plan() };
    let (photos, pairs) = photos(&plan);
    let solution = solved(&photos, &pairs).expect("an answer");
    assert!(solution.confidence < CONFIDENCE_MIN, "{:?}", solution.evidence);
}

#[test]
fn photos_from_nearly_one_place_are_solved_by_what_is_far() {
    // No two rays to a point meet at one degree.
    let at = |i: usize| DVec3::new(0.016 * i as f64, 0.0, -4.0);
    let cameras = (0..5).map(|i| Truth::looking_at(at(i), DVec3::ZERO)).collect();
    let plan = Plan { noise: 0.1, cameras, ..plan() };
    let (mut photos, pairs) = photos(&plan);
    for photo in &mut photos {
        photo.focal = Some(plan.focal);
    }
    let off = off(&solved(&photos, &pairs).expect("an answer"), &plan);
    assert_eq!(off.placed, 5);
    assert!(off.degrees < 0.5, "{} degrees", off.degrees);
}

#[test]
fn matches_that_two_photos_alone_leave_out_are_gathered() {
    let plan = Plan { noise: 1.0, wrong: 0.3, ..plan() };
    let (photos, pairs) = photos(&plan);
    let solution = solved(&photos, &pairs).expect("a solution");
    let sights: usize = solution.points.iter().map(|point| point.track.len()).sum();
    let all: usize = photos.iter().map(|photo| photo.keypoints.len()).sum();
    assert!(20 * sights > 16 * all, "{sights} of {all} keypoints have a point");
}

#[test]
fn a_plane_is_solved_where_the_focal_length_is_known() {
    let tilt = DMat3::from_rotation_x(0.9);
    let flat = |p: DVec3| tilt * DVec3::new(p.x * 1.5, p.y * 1.5, 0.0);
    let points: Vec<DVec3> = cloud(600, 1.0, 31).into_iter().map(flat).collect();
    let plan = Plan { points, noise: 0.3, wrong: 0.2, cameras: arc(8, 60.0, 4.0), ..plan() };
    let (mut photos, pairs) = photos(&plan);
    for photo in &mut photos {
        photo.focal = Some(plan.focal);
    }
    let solution = solved(&photos, &pairs).expect("an answer");
    let off = off(&solution, &plan);
    assert_eq!(off.placed, 8);
    assert!(off.degrees < 1.0, "{} degrees", off.degrees);
}

#[test]
fn two_photos_are_trusted_where_the_focal_length_is_known() {
    let plan = Plan { noise: 0.5, wrong: 0.2, cameras: arc(2, 15.0, 4.0), ..plan() };
    let (mut photos, pairs) = photos(&plan);
    let unknown = solved(&photos, &pairs).expect("an answer");
    assert!(unknown.confidence < CONFIDENCE_MIN, "{:?}", unknown.evidence);
    for photo in &mut photos {
        photo.focal = Some(plan.focal);
    }
    let known = solved(&photos, &pairs).expect("an answer");
    let off = off(&known, &plan);
    assert!(off.placed == 2 && off.degrees < 1.0, "{} degrees", off.degrees);
    assert!(known.confidence > CONFIDENCE_MIN, "{:?}", known.evidence);
}

#[test]
fn a_small_distant_thing_inside_out_is_doubted() {
    // Through a long lens both depths fit: the right one and its mirror image.
    let plan = Plan {
        points: cloud(150, 0.15, 41),
        cameras: arc(4, 12.0, 20.0),
        focal: 12_000.0,
        noise: 1.2,
        ..plan()
    };
    let (photos, pairs) = photos(&plan);
    let solution = solved(&photos, &pairs).expect("an answer");
    assert!(solution.confidence < CONFIDENCE_MIN, "{:?}", solution.evidence);
}

#[test]
fn a_can_with_the_same_label_on_both_sides_is_solved_or_doubted() {
    let mut draw = Draw(51);
    let labels: Vec<(f64, f64)> =
        (0..500).map(|_| (draw.between(0.0, 180.0), draw.between(-1.0, 1.0))).collect();
    let on_can = |degrees: f64, height: f64| {
        let angle = degrees.to_radians();
        DVec3::new(angle.sin(), height, -angle.cos())
    };
    // Each point and its twin on the other side.
    let points = labels.iter().flat_map(|&(d, h)| [on_can(d, h), on_can(d + 180.0, h)]).collect();
    let ring =
        |i: usize| Truth::looking_at(on_can(30.0 * i as f64, 0.0) * 5.0 - DVec3::Y, DVec3::ZERO);
    let plan = Plan { points, cameras: (0..12).map(ring).collect(), noise: 0.5, ..plan() };
    for twins in [false, true] {
        let (photos, pairs) = photos_of_a_can(&plan, twins);
        let solution = solved(&photos, &pairs).expect("an answer");
        let off = off(&solution, &plan);
        let right = off.placed == 12 && off.degrees < 1.0;
        assert!(right || twins, "{} of 12, {} degrees", off.placed, off.degrees);
        let evidence = solution.evidence;
        assert!(right || solution.confidence < CONFIDENCE_MIN, "{} {evidence:?}", off.degrees);
    }
}

/// Keypoints on the near side of a can; with `twins`, photos of opposite sides match by the label.
fn photos_of_a_can(plan: &Plan, twins: bool) -> (Vec<PhotoKeypoints>, Vec<PairMatches>) {
    let faces = |camera: &Truth, p: &DVec3| {
        let out = DVec3::new(p.x, 0.0, p.z);
        out.dot(camera.center - *p) > 0.35 * (camera.center - *p).length()
    };
    let mut photos = Vec::new();
    let mut ids: Vec<Vec<usize>> = Vec::new();
    for camera in &plan.cameras {
        let near: Vec<usize> =
            (0..plan.points.len()).filter(|&i| faces(camera, &plan.points[i])).collect();
        let points = near.iter().map(|&i| plan.points[i]).collect();
        let one = Plan { points, cameras: vec![*camera], ..*plan };
        photos.extend(crate::generated::photos(&one).0);
        assert_eq!(photos[photos.len() - 1].keypoints.len(), near.len(), "all are in the photo");
        ids.push(near);
    }
    let mut pairs = Vec::new();
    for a in 0..photos.len() {
        for b in a + 1..photos.len() {
            let place = |id: usize| ids[b].binary_search(&id).ok().map(|k| k as u32);
            let partner = |id: usize| place(id).or_else(|| place(id ^ 1).filter(|_| twins));
            let matched = ids[a].iter().enumerate();
            let matched = matched.filter_map(|(k, &id)| Some([k as u32, partner(id)?]));
            pairs.push(PairMatches {
                photos: [a, b],
                pairs: matched.collect(),
                scores: Vec::new(),
            });
        }
    }
    (photos, pairs)
}

#[test]
fn the_same_seed_gives_the_same_cameras_on_any_number_of_threads() {
    let plan = Plan { noise: 0.5, wrong: 0.4, ..plan() };
    let (photos, pairs) = photos(&plan);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        let solution = pool.install(|| solved(&photos, &pairs).expect("a solution"));
        format!("{solution:?}")
    };
    let one = with(1);
    assert!(one == with(4), "the number of threads changes the cameras");
    assert!(one == with(1), "a second run changes the cameras");
}

#[test]
fn any_input_is_an_answer_or_an_error_that_names_it() {
    let cancel = AtomicBool::new(true);
    let (photos_of, pairs) = photos(&plan());
    let stopped = solve(&photos_of, &pairs, &[], &SolveOptions::default(), &cancel, &|_| ());
    assert_eq!(stopped.expect_err("cancelled").code(), ErrorCode::Cancelled);

    let few = SolveOptions { photos_max: 4, ..SolveOptions::default() };
    let over = solve(&photos_of, &pairs, &[], &few, &AtomicBool::new(false), &|_| ());
    let over = over.expect_err("too many photos");
    assert_eq!(over.code(), ErrorCode::LimitExceeded);
    assert!(over.message().contains('8') && over.message().contains('4'), "{over}");

    let never = AtomicBool::new(false);
    let other = vec![Grey::new(8, 6, &[90; 144]); photos_of.len()];
    let other = solve(&photos_of, &pairs, &other, &SolveOptions::default(), &never, &|_| ());
    let other = other.map(|_| ()).expect_err("photos of another size");
    assert!(other.message().contains("greys") && other.message().contains('8'), "{other}");

    let refused = |change: &dyn Fn(&mut Vec<PhotoKeypoints>, &mut Vec<PairMatches>), what: &str| {
        let (mut photos, mut pairs) = (photos_of.clone(), pairs.clone());
        change(&mut photos, &mut pairs);
        let error = solved(&photos, &pairs).expect_err(what);
        assert_eq!(error.code(), ErrorCode::InvalidRequest);
        assert!(error.message().contains(what), "{error} does not say {what}");
    };
    refused(&|p, _| p[2].keypoints[0][1] = f32::NAN, "photo 2");
    refused(&|p, _| p[1].focal = Some(-3.0), "-3");
    refused(&|p, _| p[1].size = [0, 4], "0x4");
    refused(&|_, m| m[0].pairs[0] = [4_000_000, 0], "4000000");
    refused(&|_, m| m[0].photos = [7, 7], "7 and 7");
    refused(&|_, m| m[0].photos = [7, 8], "7 and 8");
    refused(&|_, m| m.push(m[0].clone()), "twice");
    refused(&|_, m| m[0].scores = vec![0.5], "1 scores");

    // Degenerate inputs are answered.
    for same in [0.0_f32, 320.0, 1e30] {
        let photo = PhotoKeypoints {
            size: SIZE,
            keypoints: vec![[same, same]; 100],
            ..PhotoKeypoints::default()
        };
        let pair = PairMatches {
            photos: [0, 1],
            pairs: (0..100).map(|i| [i, i]).collect(),
            scores: Vec::new(),
        };
        let solution = solved(&[photo.clone(), photo], &[pair]).expect("an answer");
        assert!(solution.confidence < CONFIDENCE_MIN);
    }
    assert!(solved(&[], &[]).expect("an answer").photos.is_empty());
}

#[test]
fn a_walk_of_many_photos_is_solved() {
    let cameras: Vec<Truth> = (0..48)
        .map(|i| {
            let angle = f64::from(i) / 48.0 * std::f64::consts::TAU;
            let center = DVec3::new(angle.sin(), 0.1 * (3.0 * angle).sin(), -angle.cos()) * 1.5;
            Truth::looking_at(center, DVec3::Y * 0.2 - center)
        })
        .collect();
    let plan = Plan { points: room(3000, 3.0, 61), cameras, noise: 0.5, wrong: 0.2, ..plan() };
    let (photos, pairs) = photos(&plan);
    let solution = solved(&photos, &pairs).expect("a solution");
    let off = off(&solution, &plan);
    assert_eq!(off.placed, 48);
    assert!(off.degrees < 1.0, "{} degrees", off.degrees);
    assert!(solution.confidence > CONFIDENCE_MIN, "{:?}", solution.evidence);
}

#[test]
fn the_world_has_size_one_and_stands_upright() {
    let plan = plan();
    let (photos, pairs) = photos(&plan);
    let solution = solved(&photos, &pairs).expect("a solution");
    let mut from_origin: Vec<f64> =
        solution.points.iter().map(|p| DVec3::from_array(p.position).length()).collect();
    from_origin.sort_by(f64::total_cmp);
    assert!((from_origin[from_origin.len() / 2] - 0.5).abs() < 0.02);
    let down: DVec3 = solution
        .photos
        .iter()
        .filter_map(|placing| match placing {
            Placing::Placed(placed) => Some(placed.camera.camera_to_world.rotation().y_axis),
            Placing::LeftOut(_) => None,
        })
        .sum();
    assert!(down.normalize().y > 0.999, "{down}");
}
