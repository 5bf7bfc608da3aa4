//! Tracks: keypoints of several photos that are the same point of the scene.

/// Photo and keypoint.
pub(crate) type Sighting = (u32, u32);

/// Joins matched keypoints, the most trusted matches first. A match that would put two keypoints of
/// one photo into a track is left out. Tracks and their keypoints are in order of photos.
pub(crate) fn join(
    keypoints: &[usize],
    matches: impl Iterator<Item = [Sighting; 2]>,
) -> Vec<Vec<Sighting>> {
    let mut first = Vec::with_capacity(keypoints.len());
    let mut total = 0;
    for count in keypoints {
        first.push(total);
        total += count;
    }
    let node = |(photo, keypoint): Sighting| first[photo as usize] + keypoint as usize;
    let mut of = vec![usize::MAX; total];
    let mut tracks: Vec<Vec<Sighting>> = Vec::new();
    for [a, b] in matches {
        let (in_a, in_b) = (of[node(a)], of[node(b)]);
        match (in_a, in_b) {
            (usize::MAX, usize::MAX) => {
                (of[node(a)], of[node(b)]) = (tracks.len(), tracks.len());
                tracks.push(vec![a, b]);
            }
            (track, usize::MAX) if tracks[track].iter().all(|s| s.0 != b.0) => {
                of[node(b)] = track;
                tracks[track].push(b);
            }
            (usize::MAX, track) if tracks[track].iter().all(|s| s.0 != a.0) => {
                of[node(a)] = track;
                tracks[track].push(a);
            }
            (usize::MAX, _) | (_, usize::MAX) => {}
            (one, other) if one != other => {
                let disjoint = tracks[one].iter().all(|s| tracks[other].iter().all(|o| o.0 != s.0));
                if disjoint {
                    let moved = std::mem::take(&mut tracks[other]);
                    for sighting in &moved {
                        of[node(*sighting)] = one;
                    }
                    tracks[one].extend(moved);
                }
            }
            _ => {}
        }
    }
    tracks.retain(|track| track.len() >= 2);
    for track in &mut tracks {
        track.sort_unstable();
    }
    tracks.sort_unstable();
    tracks
}

#[cfg(test)]
mod tests {
    use super::join;

    #[test]
    fn a_match_that_contradicts_a_trusted_one_is_left_out() {
        let matches = [
            [(0, 1), (1, 1)],
            [(1, 1), (2, 0)],
            [(0, 0), (2, 1)],
            // Would join keypoints 0 and 1 of photo 0.
            [(1, 1), (2, 1)],
        ];
        let tracks = join(&[2, 2, 2], matches.into_iter());
        assert_eq!(tracks, vec![vec![(0, 0), (2, 1)], vec![(0, 1), (1, 1), (2, 0)]]);
    }
}
