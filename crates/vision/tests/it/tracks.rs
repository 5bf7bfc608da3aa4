//! Masks of different photos that lie on the same Gaussians share a row.

use segsplat_core::scene::{Gaussians, IndexMap, MaskInfo, PhotoMasks};
use segsplat_vision::semantics::{Views, tracks};

use crate::votes::{cameras, wall};

/// The masks of a photo of the wall of `votes`: from these columns on, of 20. A mask lies on those
/// before it.
fn masks(from: &[u32]) -> PhotoMasks {
    let number = |x: u32| from.iter().filter(|from| x >= **from).count() as u16;
    let index = (0..20 * 20).map(|i| number(i % 20)).collect();
    let map = IndexMap { width: 20, height: 20, index };
    PhotoMasks { map, masks: vec![MaskInfo::default(); from.len()], wholes: Vec::new() }
}

/// The rows of all masks, which are counted photo by photo.
fn rows(gaussians: &Gaussians, masks: &[PhotoMasks]) -> Vec<Vec<usize>> {
    let of = |(photo, of): (usize, &PhotoMasks)| (0..of.masks.len()).map(move |k| [photo, k]);
    let all: Vec<[usize; 2]> = masks.iter().enumerate().flat_map(of).collect();
    let cameras = cameras(masks.len());
    let tracks = tracks(&Views::new(gaussians, &cameras), &cameras, masks, &all);
    tracks.rows().to_vec()
}

#[test]
fn masks_of_one_thing_are_one_row_through_all_photos() {
    // The wall's place X is column 10 + 2 (X - v) of photo v. Thing B begins at X = 0, A is left
    // of it.
    let photos = [masks(&[0, 10]), masks(&[0, 8]), masks(&[0, 6])];
    assert_eq!(rows(&wall(3, |_| 10.0), &photos), [[1, 3, 5], [0, 2, 4]], "B is larger");
}

#[test]
fn two_masks_of_one_photo_are_never_one_row() {
    // Photo 1 has the thing as a whole, photo 0 in two parts: the larger one takes it.
    let photos = [masks(&[4, 14]), masks(&[2])];
    assert_eq!(rows(&wall(2, |_| 10.0), &photos), [vec![0, 2], vec![1]]);
}

#[test]
fn a_mask_that_lies_on_a_small_part_of_another_stays_alone() {
    let photos = [masks(&[0]), masks(&[14])];
    assert_eq!(rows(&wall(2, |_| 10.0), &photos), [[0], [1]]);
}

#[test]
fn photos_that_show_none_of_each_other_share_no_row() {
    // Photo 1 shows a screen in front of the wall.
    let gaussians = wall(2, |source| if source.view == 1 { 5.0 } else { 10.0 });
    assert_eq!(rows(&gaussians, &[masks(&[0]), masks(&[0])]).len(), 2);
}

#[test]
fn masks_without_an_embedding_have_no_row_and_those_on_no_gaussian_come_last() {
    let cameras = cameras(3);
    // The scene has no Gaussian of photo 2, which stands aside, and none that it shows.
    let photos = [masks(&[0, 12]), masks(&[0, 10]), masks(&[0])];
    let gaussians = wall(2, |_| 10.0);
    let far: Vec<_> = cameras
        .iter()
        .enumerate()
        .map(|(v, camera)| {
            let mut camera = camera.clone();
            if v == 2 {
                camera.network = None;
            }
            camera
        })
        .collect();
    let of = [[0, 1], [1, 0], [1, 1], [2, 0]];
    let tracks = tracks(&Views::new(&gaussians, &far), &far, &photos, &of);
    assert_eq!(tracks.rows(), [vec![0, 2], vec![1], vec![3]]);
    assert_eq!(tracks.on_gaussians(), 2);
    assert_eq!(tracks.entries(4), [1, 2, 1, 3]);
}
