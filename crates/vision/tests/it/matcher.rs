//! The network that matches keypoints, as it ships, on rendered photos whose depths and cameras are
//! known.

use std::sync::LazyLock;

use segsplat_core::scene::{Camera, Photo};
use segsplat_testing::{opened, root};
use segsplat_vision::{
    models::{Bundle, FeatureNetwork, MatcherNetwork, PhotoFeatures, Runtime, SureMatch},
    sample::{self, Room, SampleOptions, TrueView},
};

use crate::network_options;

const SIZE: [u32; 2] = [480, 360];
/// How far a match may be from the true place, pixels.
const NEAR_PX: f64 = 3.0;
/// Scores from which on a match is sure, and which shares of all and of the sure ones must be near.
const SURE: f32 = 0.5;
const RIGHT: f64 = 0.75;
const RIGHT_OF_SURE: f64 = 0.9;

struct Networks {
    features: FeatureNetwork,
    matcher: MatcherNetwork,
}

/// `None` without ONNX Runtime.
fn networks() -> Option<Networks> {
    let options = network_options();
    let runtime = opened(Runtime::load(&options))?;
    let bundle = Bundle::open(&root().join("models/embedded")).unwrap();
    let features = FeatureNetwork::open(&runtime, &bundle, &options).unwrap();
    let matcher = MatcherNetwork::open(&runtime, &bundle, &options).unwrap();
    Some(Networks { features: features.unwrap(), matcher: matcher.unwrap() })
}

/// Two photos of a room, 23 degrees apart, and one of another room: drawn once.
fn views() -> &'static [(Camera, TrueView); 3] {
    static VIEWS: LazyLock<[(Camera, TrueView); 3]> = LazyLock::new(|| {
        [(1, -0.2), (1, 0.2), (40, 0.0)].map(|(seed, arc)| {
            let options = SampleOptions { photos: 2, width: SIZE[0], height: SIZE[1], seed };
            let camera = sample::camera_at(&options, arc).unwrap();
            (camera, Room::new(seed).view(&camera))
        })
    });
    &VIEWS
}

fn found(networks: &Networks) -> [PhotoFeatures; 3] {
    [0, 1, 2].map(|i| networks.features.find(&views()[i].1.photo).unwrap())
}

/// Where the second photo shows what the first one has at `at`.
fn shown_at([x, y]: [f32; 2]) -> Option<[f64; 2]> {
    let [(camera, view), (other, _), _] = views();
    let depth = view.depth[y as usize * SIZE[0] as usize + x as usize];
    let point = camera.intrinsics.unproject(f64::from(x), f64::from(y), f64::from(depth));
    let world = camera.camera_to_world.matrix().transform_point3(point);
    let there = other.camera_to_world.viewmat().transform_point3(world);
    let (x, y) = other.intrinsics.project(there);
    (there.z > 0.0).then_some([x, y])
}

/// The share of matches that are near the true place.
fn right(matches: &[SureMatch], [first, second]: [&PhotoFeatures; 2]) -> f64 {
    let near = |([i, j], _): &&SureMatch| {
        let Some([x, y]) = shown_at(first.keypoints[*i as usize]) else { return false };
        let [px, py] = second.keypoints[*j as usize].map(f64::from);
        (px - x).hypot(py - y) <= NEAR_PX
    };
    matches.iter().filter(near).count() as f64 / matches.len().max(1) as f64
}

/// The first `count` keypoints.
fn first(of: &PhotoFeatures, count: usize) -> PhotoFeatures {
    PhotoFeatures {
        keypoints: of.keypoints[..count].to_vec(),
        descriptors: of.descriptors[..count * of.dim].to_vec(),
        dim: of.dim,
    }
}

#[test]
fn matches_are_where_the_other_photo_shows_the_same() {
    let Some(networks) = networks() else { return };
    let [a, b, other] = found(&networks);
    let matches = networks.matcher.matched([&a, &b], [SIZE; 2], usize::MAX).unwrap();
    let share = right(&matches, [&a, &b]);
    let sure: Vec<SureMatch> =
        matches.iter().copied().filter(|(_, score)| *score >= SURE).collect();
    let sure_share = right(&sure, [&a, &b]);
    println!("{} matches, {share:.3} right; {} sure, {sure_share:.3}", matches.len(), sure.len());
    assert!(sure.len() >= 300, "{} matches", sure.len());
    assert!(share >= RIGHT && sure_share >= RIGHT_OF_SURE, "{share} {sure_share}");
    assert!(matches.windows(2).all(|two| two[0].0[0] < two[1].0[0]), "in the first one's order");
    assert!(matches.iter().all(|(_, score)| (0.0..=1.0).contains(score)), "scores");
    let mut taken: Vec<u32> = matches.iter().map(|([_, j], _)| *j).collect();
    taken.sort_unstable();
    assert!(taken.windows(2).all(|two| two[0] != two[1]), "a keypoint twice");
    // Another room.
    let strangers = networks.matcher.matched([&a, &other], [SIZE; 2], usize::MAX).unwrap();
    println!("{} of another room", strangers.len());
    assert!(strangers.len() * 5 < matches.len(), "{} of another room", strangers.len());
}

#[test]
fn a_photo_of_any_size_is_matched_by_its_own() {
    let Some(networks) = networks() else { return };
    let [a, b, _] = found(&networks);
    let matched = |b: &PhotoFeatures, size: [u32; 2]| {
        networks.matcher.matched([&a, b], [SIZE, size], 1_024).unwrap()
    };
    // The same picture, twice as large: what the network sees is the same.
    let mut large = b.clone();
    large.keypoints.iter_mut().flatten().for_each(|v| *v *= 2.0);
    let (same, large) = (matched(&b, SIZE), matched(&large, SIZE.map(|v| 2 * v)));
    assert_eq!(same, large, "by shares of the photo");
    // Keypoints far outside of the size that is told are not where the network was trained.
    let wrong = matched(&b, SIZE.map(|v| v / 4));
    println!("{} by the right size, {} by a quarter of it", same.len(), wrong.len());
    assert!(wrong.len() * 2 < same.len(), "{} of {}", wrong.len(), same.len());
}

#[test]
fn no_keypoint_and_one_are_no_error_and_the_count_bounds_both_photos() {
    let Some(networks) = networks() else { return };
    let [a, b, _] = found(&networks);
    let none = PhotoFeatures { dim: a.dim, ..PhotoFeatures::default() };
    let matched = |photos, count| networks.matcher.matched(photos, [SIZE; 2], count).unwrap();
    for photos in [[&none, &none], [&none, &b], [&a, &none]] {
        assert_eq!(matched(photos, usize::MAX), []);
    }
    assert_eq!(matched([&a, &b], 0), [], "none are looked at");
    let one = first(&b, 1);
    assert!(matched([&a, &one], usize::MAX).len() <= 1);
    assert!(matched([&one, &one], usize::MAX).iter().all(|(pair, _)| *pair == [0, 0]));
    let most = 300;
    let some = matched([&a, &b], most);
    assert!(!some.is_empty());
    assert!(some.iter().flat_map(|(pair, _)| pair).all(|i| (*i as usize) < most), "{some:?}");
    let cut = matched([&first(&a, most), &first(&b, most)], usize::MAX);
    assert_eq!(some, cut, "the others are not looked at");
}

#[test]
fn more_keypoints_than_the_bundle_allows_are_cut() {
    let Some(networks) = networks() else { return };
    let [a, b, _] = found(&networks);
    let bundle = Bundle::open(&root().join("models/embedded")).unwrap();
    let most = bundle.matcher().unwrap().count;
    // Each keypoint again, beside itself, until there are too many.
    let mut many = a.clone();
    while many.keypoints.len() <= most {
        many.keypoints.extend(a.keypoints.iter().map(|[x, y]| [x + 0.5, *y]));
        many.descriptors.extend_from_slice(&a.descriptors);
    }
    let matches = networks.matcher.matched([&many, &b], [SIZE; 2], usize::MAX).unwrap();
    assert!(matches.iter().all(|([i, _], _)| (*i as usize) < most), "over {most}");
    // A plain photo has hardly any keypoint; whatever it has is matched without an error.
    let [width, height] = SIZE;
    let rgb = vec![128; (width * height * 3) as usize];
    let plain = networks.features.find(&Photo { width, height, rgb, valid: None }).unwrap();
    let matches = networks.matcher.matched([&plain, &b], [SIZE; 2], usize::MAX).unwrap();
    assert!(matches.len() <= plain.keypoints.len());
}
