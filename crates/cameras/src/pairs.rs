//! Which pairs of photos to match.

/// All pairs are matched up to this number of photos.
const ALL_MAX: usize = 40;
/// Neighbours in order on each side, beyond [`ALL_MAX`]. Further ones at 2, 4, 8… times as far.
const NEIGHBOURS: usize = 6;
/// Photos most alike, beyond [`ALL_MAX`].
const ALIKE: usize = 8;

/// Pairs (i < j) of `count` photos to match: all of up to 40, else neighbours in order, some
/// further ones, and for each photo those most alike by `alike` (the larger the more).
pub fn pairs_to_match(count: usize, alike: impl Fn(usize, usize) -> f32) -> Vec<[usize; 2]> {
    let mut pairs = Vec::new();
    if count <= ALL_MAX {
        for i in 0..count {
            pairs.extend((i + 1..count).map(|j| [i, j]));
        }
        return pairs;
    }
    for i in 0..count {
        pairs.extend((i + 1..count.min(i + 1 + NEIGHBOURS)).map(|j| [i, j]));
        let mut far = 2 * NEIGHBOURS;
        while i + far < count {
            pairs.push([i, i + far]);
            far *= 2;
        }
        let mut others: Vec<usize> = (0..count).filter(|&j| j != i).collect();
        others.sort_by(|&a, &b| alike(i, b).total_cmp(&alike(i, a)).then(a.cmp(&b)));
        pairs.extend(others.iter().take(ALIKE).map(|&j| [i.min(j), i.max(j)]));
    }
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}
