//! Places of Gaussians in halves of halves, each cut across the longest side of its box.

use glam::Vec3;

/// Fewest places that a thread sorts by itself.
const SPLIT_MIN: usize = 1 << 14;

/// A centre with its number, for the sort.
#[derive(Clone, Copy)]
pub(crate) struct Place {
    pub(crate) at: [f32; 3],
    pub(crate) id: u32,
}

/// Least and largest coordinates.
pub(crate) fn corners(places: &[Place]) -> [[f32; 3]; 2] {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for place in places {
        let at = Vec3::from(place.at);
        (low, high) = (low.min(at), high.max(at));
    }
    [low.to_array(), high.to_array()]
}

/// Orders places so that blocks of `size` of them are close together, and neighbouring blocks
/// mostly are.
pub(crate) fn split(places: &mut [Place], size: usize) {
    if places.len() <= size {
        return places.sort_unstable_by_key(|place| place.id);
    }
    let [low, high] = corners(places);
    let side = |axis: &usize| high[*axis] - low[*axis];
    let axis = (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0);
    // Both parts but the last end with a whole block.
    let middle = places.len().div_ceil(size) / 2 * size;
    places.select_nth_unstable_by(middle, |a, b| {
        a.at[axis].total_cmp(&b.at[axis]).then(a.id.cmp(&b.id))
    });
    let large = places.len() > SPLIT_MIN;
    let (near, far) = places.split_at_mut(middle);
    if large {
        rayon::join(|| split(near, size), || split(far, size));
    } else {
        split(near, size);
        split(far, size);
    }
}
