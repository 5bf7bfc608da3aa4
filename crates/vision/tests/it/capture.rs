//! What the photos themselves say of a capture: on a room of known depth, and on real scenes with
//! right and with spoilt cameras.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use segsplat_core::{
    error::{ErrorCode, Result},
    limits::Limits,
    scene::{CameraToWorld, Capture, PosedPhoto, WarningCode},
};
use segsplat_vision::{
    capture, photos,
    sample::{self, Room, SampleOptions},
};

use segsplat_testing::shared_scene;

use crate::room;

fn options(photos: usize) -> SampleOptions {
    SampleOptions { photos, width: 200, height: 150, seed: 3 }
}

fn scene(name: &str) -> Option<Vec<PosedPhoto>> {
    let folder = shared_scene(name)?;
    Some(photos::read_dir(&folder, &Limits::default()).unwrap())
}

/// The generated photos of `tests/fixtures/room`.
fn generated() -> Vec<PosedPhoto> {
    photos::read_dir(&room::folder(), &Limits::default()).unwrap()
}

fn picked(photos: &[PosedPhoto], which: &[usize]) -> Vec<PosedPhoto> {
    which.iter().map(|&i| photos[i].clone()).collect()
}

fn analyse(photos: &[PosedPhoto]) -> Result<Capture> {
    capture::analyse(photos, &AtomicBool::new(false))
}

/// Depth ranges of some of the photos, measured among these alone.
fn ranges_of(photos: &[PosedPhoto], which: &[usize]) -> Vec<[f64; 2]> {
    analyse(&picked(photos, which)).unwrap().near_far
}

/// Share of the depths inside the range.
fn inside(depths: impl Iterator<Item = f64>, [near, far]: [f64; 2]) -> f64 {
    let (mut count, mut total) = (0, 0);
    for depth in depths {
        total += 1;
        count += usize::from(depth >= near && depth <= far);
    }
    count as f64 / f64::from(total)
}

#[test]
fn the_depth_range_holds_the_true_depths_and_little_else() {
    let room = Room::new(3);
    for count in [2, 5] {
        let posed = sample::photos(&options(count)).unwrap();
        let capture = analyse(&posed).unwrap();
        assert_eq!(capture.warnings, [], "a right capture");
        for (posed, &[near, far]) in posed.iter().zip(&capture.near_far) {
            let depth = room.view(&posed.camera).depth;
            let mut depths: Vec<f64> = depth.into_iter().map(f64::from).collect();
            let share = inside(depths.iter().copied(), [near, far]);
            assert!(share > 0.97, "{count} photos: {share} of the pixels in {near}..{far}");
            depths.sort_by(f64::total_cmp);
            let (nearest, farthest) = (depths[depths.len() / 100], depths[depths.len() * 99 / 100]);
            assert!(near > 0.6 * nearest, "near {near} for a scene from {nearest}");
            assert!(far < 2.0 * farthest, "far {far} for a scene to {farthest}");
            let middle = depths[depths.len() / 2];
            let ratio = capture.median_depth / middle;
            assert!((0.7..1.4).contains(&ratio), "median {} for {middle}", capture.median_depth);
        }
    }
}

#[test]
fn cameras_that_look_away_from_each_other_are_refused_and_a_single_one_is_left_out() {
    let turned = |mut photos: Vec<PosedPhoto>| {
        let last = photos.last_mut().unwrap();
        let mut m = last.camera.camera_to_world.to_row_major();
        // Half a turn about the camera's own y axis.
        for row in 0..3 {
            m[row * 4] *= -1.0;
            m[row * 4 + 2] *= -1.0;
        }
        last.camera.camera_to_world = CameraToWorld::from_row_major(&m, "turned").unwrap();
        analyse(&photos)
    };
    let posed = sample::photos(&options(5)).unwrap();
    let error = turned(picked(&posed, &[0, 1])).unwrap_err();
    assert_eq!(error.code(), ErrorCode::InvalidRequest);
    for told in [posed[0].file.as_str(), posed[1].file.as_str(), "no two photos", "apart"] {
        assert!(error.message().contains(told), "{error}");
    }
    let capture = turned(posed.clone()).unwrap();
    let unused = capture.warnings.iter().find(|w| w.code == WarningCode::PhotosUnused).unwrap();
    assert!(unused.message.contains(&posed[4].file), "{unused:?}");
}

#[test]
fn depth_follows_the_unit_of_the_cameras() {
    let posed = sample::photos(&options(2)).unwrap();
    let near_far = ranges_of(&posed, &[0, 1]);
    let scaled: Vec<PosedPhoto> = posed
        .iter()
        .map(|p| {
            let mut m = p.camera.camera_to_world.to_row_major();
            for row in 0..3 {
                m[row * 4 + 3] = m[row * 4 + 3] * 1000.0 + 5e4;
            }
            let mut p = p.clone();
            p.camera.camera_to_world = CameraToWorld::from_row_major(&m, "scaled").unwrap();
            p
        })
        .collect();
    let far_away = ranges_of(&scaled, &[0, 1]);
    for (a, b) in near_far.iter().flatten().zip(far_away.iter().flatten()) {
        assert!((b / a / 1000.0 - 1.0).abs() < 0.02, "{a} became {b}");
    }
}

#[test]
fn overlap_falls_with_distance_and_sets_follow_it() {
    let posed = sample::photos(&options(9)).unwrap();
    let capture = analyse(&posed).unwrap();
    assert!(capture.overlap[0][1] > 0.8, "{}", capture.overlap[0][1]);
    assert!(capture.overlap[0][8] < capture.overlap[0][1]);
    let sets = capture::view_sets(&capture, &posed, [2, 4], 3);
    let shared = |a: &[usize], b: &[usize]| a.iter().filter(|v| b.contains(v)).count();
    for pair in sets.windows(2) {
        let earlier = sets.iter().take_while(|s| *s != &pair[1]);
        let most = earlier.map(|s| shared(&s.views, &pair[1].views)).max();
        assert!(most >= Some(1), "a later set shares views with an earlier one: {sets:?}");
    }
    let mut seen = [0; 9];
    for set in &sets {
        assert!((2..=4).contains(&set.views.len()), "{set:?}");
        assert_eq!(set.neighbors.len(), set.views.len());
        for (at, row) in set.neighbors.iter().enumerate() {
            assert_eq!(row.len(), (set.views.len() - 1).min(3));
            assert!(row.iter().all(|&n| n != at && n < set.views.len()), "{set:?}");
        }
        set.views.iter().for_each(|&v| seen[v] += 1);
    }
    assert!(seen.iter().all(|&n| n >= 1), "every photo is used: {seen:?}");
    assert!(seen.iter().any(|&n| n >= 2), "sets overlap: {seen:?}");
    let one = capture::view_sets(&capture, &posed, [2, 16], 3);
    assert_eq!(one.len(), 1);
    assert_eq!(one[0].views.len(), 9);
    assert_eq!(one, capture::view_sets(&capture, &posed, [2, 16], 3), "deterministic");
    // A network of exactly 4 views: the last set is filled up with photos of the others.
    for fixed in [2, 4, 6] {
        let sets = capture::view_sets(&capture, &posed, [fixed; 2], 3);
        assert!(sets.iter().all(|set| set.views.len() == fixed), "{fixed} views: {sets:?}");
        let all = |i: usize| sets.iter().any(|set| set.views.contains(&i));
        assert!((0..9).all(all), "every photo is used: {sets:?}");
        for set in &sets {
            let once = |v: &usize| set.views.iter().filter(|w| w == &v).count() == 1;
            assert!(set.views.iter().all(once), "no photo twice: {set:?}");
        }
    }
}

#[test]
fn one_picture_under_several_poses_is_named() {
    let posed = sample::photos(&options(4)).unwrap();
    let copied = |copies: usize| -> Vec<PosedPhoto> {
        let mut photos = posed.clone();
        for copy in &mut photos[1..copies] {
            copy.photo = posed[0].photo.clone();
        }
        photos
    };
    let refused = analyse(&copied(4)).unwrap_err();
    assert_eq!(refused.code(), ErrorCode::InvalidRequest);
    for (i, photo) in posed.iter().enumerate() {
        let named = format!("photo {i} ({:?})", photo.file);
        assert!(refused.message().contains(&named), "{refused}");
    }
    let warnings = analyse(&copied(2)).unwrap().warnings;
    let same = warnings.iter().find(|w| w.code == WarningCode::SamePicture).expect("a warning");
    assert!(same.message.starts_with("photo 0 (") && same.message.contains("photo 1 ("));
    assert!(!same.message.contains("photo 2 ("), "{}", same.message);
    let right = analyse(&posed).unwrap().warnings;
    assert!(right.iter().all(|w| w.code != WarningCode::SamePicture), "{right:?}");
}

#[test]
fn a_cancelled_capture_ends_between_two_comparisons() {
    let posed = sample::photos(&options(24)).unwrap();
    let cancel = AtomicBool::new(false);
    let ended = std::thread::scope(|scope| {
        let analysis = scope.spawn(|| capture::analyse(&posed, &cancel));
        // The comparisons take seconds; the grey pictures of so few pixels take none.
        std::thread::sleep(Duration::from_millis(100));
        cancel.store(true, Ordering::Relaxed);
        analysis.join().unwrap()
    });
    assert_eq!(ended.unwrap_err().code(), ErrorCode::Cancelled);
}

#[test]
fn captures_without_depth_are_refused() {
    let posed = sample::photos(&options(2)).unwrap();
    let one = analyse(&posed[..1]).unwrap_err();
    assert!(one.message().contains("at least 2"), "{one}");
    let same = [posed[0].clone(), posed[0].clone()];
    let error = analyse(&same).unwrap_err();
    assert!(error.message().contains("one place"), "{error}");
    let mut blank = posed;
    blank[1].photo.rgb.fill(128);
    let error = analyse(&blank).unwrap_err();
    assert!(error.message().contains("share nothing"), "{error}");
    assert!(error.message().contains("photo 0"), "names the photos: {error}");
}

#[test]
fn invalid_pixels_are_never_matched() {
    let mut posed = sample::photos(&options(2)).unwrap();
    let want = ranges_of(&posed, &[0, 1]);
    // A frame of rubbish that moves with the photo would read as a surface at infinity.
    for p in &mut posed {
        let (w, h) = (p.photo.width as usize, p.photo.height as usize);
        let mut valid = vec![true; w * h];
        for y in 0..h {
            for x in (0..w).filter(|&x| x < 24 || y < 24 || x + 24 >= w || y + 24 >= h) {
                let i = y * w + x;
                valid[i] = false;
                // Blocks without a rhythm: a rhythm would be refused for its rivals.
                let block =
                    ((x / 4) as u32 * 73 + (y / 4) as u32 * 151).wrapping_mul(2_654_435_761);
                p.photo.rgb[3 * i..3 * i + 3].fill((block >> 24) as u8);
            }
        }
        p.photo.valid = Some(valid);
    }
    let got = ranges_of(&posed, &[0, 1]);
    for ([_, far], [_, want]) in got.iter().zip(&want) {
        assert!(far < &(1.5 * want), "far {far}, without the frame {want}");
    }
}

/// Neighbours of the real scenes, two pairs each.
const NEIGHBORS: [(&str, [[usize; 2]; 2]); 8] = [
    ("fox", [[12, 13], [47, 48]]),
    ("red_kitchen", [[0, 2], [20, 21]]),
    ("juice_box_table", [[7, 8], [12, 13]]),
    ("coke_can", [[6, 7], [12, 13]]),
    ("duck_toy", [[0, 8], [2, 12]]),
    ("computer_mouse", [[6, 8], [10, 16]]),
    ("sceaux_castle", [[2, 3], [6, 7]]),
    ("terrace", [[8, 9], [12, 13]]),
];

/// Two photos that see much of the same raise no warning.
fn raises_no_false_alarm(name: &str, all: &[PosedPhoto], pair: [usize; 2]) {
    let capture = analyse(&picked(all, &pair)).unwrap();
    assert_eq!(capture.warnings, [], "{name} {pair:?}");
    let overlap = capture.overlap[0][1].max(capture.overlap[1][0]);
    assert!(overlap > 0.4, "{name} {pair:?}: overlap {overlap}");
}

#[test]
fn neighbours_raise_no_false_alarm() {
    for first in 0..room::PHOTOS - 1 {
        raises_no_false_alarm("room", &generated(), [first, first + 1]);
    }
}

#[test]
fn real_neighbours_raise_no_false_alarm() {
    for (name, pairs) in NEIGHBORS {
        let Some(all) = scene(name) else { return };
        pairs.into_iter().for_each(|pair| raises_no_false_alarm(name, &all, pair));
    }
}

fn spoilt(photos: &[PosedPhoto], how: impl Fn(&mut PosedPhoto)) -> Vec<PosedPhoto> {
    let mut photos = photos.to_vec();
    photos.iter_mut().for_each(how);
    photos
}

fn flipped(pose: CameraToWorld) -> CameraToWorld {
    CameraToWorld::from_opengl_row_major(&pose.to_row_major(), "flipped").unwrap()
}

fn inverted(pose: CameraToWorld) -> CameraToWorld {
    CameraToWorld::from_row_major(&pose.viewmat().transpose().to_cols_array(), "inverse").unwrap()
}

fn scale_k(p: &mut PosedPhoto, focal: f64, center: f64) {
    let k = &mut p.camera.intrinsics;
    (k.fx, k.fy) = (k.fx * focal, k.fy * focal);
    (k.cx, k.cy) = (k.cx * center, k.cy * center);
}

/// Each usual mistake, made with two right photos, is named by a warning.
fn mistakes_are_named(name: &str, right: &[PosedPhoto]) {
    type Spoil = fn(&mut PosedPhoto);
    let mistakes: [(&str, WarningCode, Spoil); 6] = [
        ("axes", WarningCode::AxesSwapped, |p| {
            p.camera.camera_to_world = flipped(p.camera.camera_to_world);
        }),
        ("inverse", WarningCode::PoseInverted, |p| {
            p.camera.camera_to_world = inverted(p.camera.camera_to_world);
        }),
        ("OpenGL inverse", WarningCode::PoseInverted, |p| {
            p.camera.camera_to_world = flipped(inverted(flipped(p.camera.camera_to_world)));
        }),
        ("K of twice the size", WarningCode::IntrinsicsScale, |p| scale_k(p, 2.0, 2.0)),
        ("K of half the size", WarningCode::IntrinsicsScale, |p| scale_k(p, 0.5, 0.5)),
        ("focal length of twice the size", WarningCode::IntrinsicsScale, |p| scale_k(p, 2.0, 1.0)),
    ];
    for (what, code, spoil) in mistakes {
        let capture = analyse(&spoilt(right, spoil)).unwrap();
        let codes: Vec<WarningCode> = capture.warnings.iter().map(|w| w.code).collect();
        assert!(codes.contains(&code), "{name}, {what}: {:?}", capture.warnings);
        let message = &capture.warnings[0].message;
        assert!(message.contains(" % "), "the figures are given: {message}");
    }
}

#[test]
fn the_usual_mistakes_are_named() {
    // Nearer to each other two photos of this room do not tell a focal length.
    for pair in [[0, 2], [1, 3]] {
        mistakes_are_named("room", &picked(&generated(), &pair));
    }
}

#[test]
fn the_usual_mistakes_are_named_on_real_scenes() {
    let named = ["fox", "red_kitchen", "juice_box_table", "coke_can"];
    for (name, pairs) in NEIGHBORS.iter().filter(|(name, _)| named.contains(name)) {
        let Some(all) = scene(name) else { return };
        mistakes_are_named(name, &picked(&all, &pairs[0]));
    }
}

/// A pair whose second photo is of another place is refused.
fn stranger_is_refused(right: &[PosedPhoto], stranger: &PosedPhoto) {
    let mut pair = right.to_vec();
    pair[1].photo = stranger.photo.clone();
    pair[1].camera.intrinsics = stranger.camera.intrinsics;
    let error = analyse(&pair).unwrap_err();
    assert!(error.message().contains("share nothing"), "{error}");
}

#[test]
fn strangers_are_refused() {
    let elsewhere = sample::photos(&SampleOptions { seed: 5, ..options(2) }).unwrap();
    stranger_is_refused(&picked(&generated(), &[0, 1]), &elsewhere[0]);
}

#[test]
fn real_strangers_are_refused() {
    let (Some(fox), Some(kitchen)) = (scene("fox"), scene("red_kitchen")) else { return };
    for (i, j) in [(12, 13), (36, 35)] {
        stranger_is_refused(&picked(&fox, &[i, j]), &kitchen[j % kitchen.len()]);
    }
}

#[test]
fn ranges_hold_the_true_depths() {
    let photos = generated();
    for pair in [[0, 1], [2, 3], [4, 5]] {
        let near_far = ranges_of(&photos, &pair);
        for (i, range) in pair.into_iter().zip(near_far) {
            let depth = room::room().view(&photos[i].camera).depth;
            let share = inside(depth.into_iter().map(f64::from), range);
            assert!(share > 0.93, "photo {i} of {pair:?}: {share} in {range:?}");
        }
    }
}

#[test]
fn intrinsics_scaled_at_the_door_are_reported() {
    let mut posed = sample::photos(&options(2)).unwrap();
    posed[1].intrinsics_made_for = Some([400, 300]);
    let capture = analyse(&posed).unwrap();
    assert_eq!(capture.warnings[0].code, WarningCode::IntrinsicsScale);
    assert!((capture.warnings[0].value - 0.5).abs() < 1e-9);
    assert!(capture.warnings[0].message.contains("400x300"), "{}", capture.warnings[0].message);
}

#[test]
fn ranges_of_a_real_room_hold_what_a_depth_camera_saw() {
    let Some(folder) = shared_scene("red_kitchen") else { return };
    let posed = photos::read_dir(&folder, &Limits::default()).unwrap();
    let kinect = |i: usize| -> Vec<f64> {
        let path = folder.join(format!("depth/{i:04}.png"));
        let depth = image::open(path).unwrap().into_luma16();
        // The border is left out: the depth camera stands a few centimetres aside.
        depth
            .enumerate_pixels()
            .filter(|(x, y, d)| d.0[0] > 0 && *x > 40 && *x < 600 && *y > 40 && *y < 440)
            .map(|(_, _, d)| f64::from(d.0[0]) / 1000.0)
            .collect()
    };
    for pair in [[0, 2], [8, 9], [16, 17], [20, 21]] {
        let near_far = ranges_of(&posed, &pair);
        for (i, range) in pair.into_iter().zip(near_far) {
            let share = inside(kinect(i).into_iter(), range);
            println!("red_kitchen {pair:?}, photo {i}: {share:.4} of the pixels in {range:.2?} m");
            assert!(share > 0.93, "photo {i} of {pair:?}: {share} in {range:?}");
        }
    }
}

#[test]
fn a_set_of_fixed_size_takes_photos_that_share_nothing_where_no_others_are_left() {
    let posed = sample::photos(&options(4)).unwrap();
    let mut capture = analyse(&posed).unwrap();
    // Photos 0 and 1 overlap each other, 2 and 3 overlap nothing.
    for (i, row) in capture.overlap.iter_mut().enumerate() {
        for (j, share) in row.iter_mut().enumerate() {
            *share = f64::from(u8::from(i == j || (i < 2 && j < 2)));
        }
    }
    let views = |min| capture::view_sets(&capture, &posed, [min, 4], 3);
    assert_eq!(views(2).iter().map(|set| set.views.len()).collect::<Vec<_>>(), [2], "the pair");
    let filled = views(4);
    assert_eq!(filled.len(), 1, "{filled:?}");
    assert_eq!(filled[0].views.len(), 4, "{filled:?}");
}

#[test]
fn photos_that_are_turned_against_their_cameras_are_told() {
    for (width, height, quarters) in [(200, 150, 2), (160, 160, 1), (160, 160, 2), (160, 160, 3)] {
        let options = SampleOptions { photos: 4, width, height, seed: 3 };
        let mut posed = sample::photos(&options).unwrap();
        for posed in &mut posed {
            let rgb = std::mem::take(&mut posed.photo.rgb);
            let mut picture = image::RgbImage::from_raw(width, height, rgb).unwrap();
            for _ in 0..quarters {
                picture = image::imageops::rotate90(&picture);
            }
            posed.photo.rgb = picture.into_raw();
        }
        let warnings = analyse(&posed).unwrap().warnings;
        let turned = warnings.iter().find(|w| w.code == WarningCode::PhotosTurned);
        let degrees = format!("by {} degrees clockwise", 90 * quarters);
        let message = turned.map_or("", |w| &w.message);
        assert!(message.contains(&degrees), "{width}x{height}, {quarters}: {warnings:?}");
    }
}
