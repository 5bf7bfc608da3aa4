//! Which links of the view graph turn the photos consistently: rotations of all photos by the
//! strongest links, averaged robustly, and what each link is off from them.

use nalgebra::Matrix3;

use crate::{
    pose::{angle_deg, project},
    survey::Link,
};

/// Links that are off by more are left out, degrees.
const OFF_MAX_DEG: f64 = 12.0;
/// Rounds of averaging.
const ROUNDS: usize = 40;

/// Links that agree with rotations of all photos: those of the spanning trees of the strongest
/// links, averaged so that the sum of angles is least (weighted by strength).
pub(crate) fn consistent(photos: usize, links: &[Link]) -> Vec<Link> {
    let mut turns = along_strongest(photos, links);
    for _ in 0..ROUNDS {
        for photo in 0..photos {
            let mut sum = Matrix3::zeros();
            for link in links {
                let [a, b] = link.photos;
                let (by_link, off) = match photo {
                    p if p == a => (link.geometry.pose.r.transpose() * turns[b], off(link, &turns)),
                    p if p == b => (link.geometry.pose.r * turns[a], off(link, &turns)),
                    _ => continue,
                };
                sum += by_link * (link.strength() / off.max(1.0));
            }
            if let Some(turn) = project(&sum) {
                turns[photo] = turn;
            }
        }
    }
    links.iter().filter(|link| off(link, &turns) <= OFF_MAX_DEG).cloned().collect()
}

/// Angle between a link's turn and that of the photos, degrees.
fn off(link: &Link, turns: &[Matrix3<f64>]) -> f64 {
    let [a, b] = link.photos.map(|photo| turns[photo]);
    angle_deg(&(link.geometry.pose.r * a * b.transpose()))
}

/// Rotations (world to camera) along the spanning trees of the strongest links.
fn along_strongest(photos: usize, links: &[Link]) -> Vec<Matrix3<f64>> {
    let mut order: Vec<&Link> = links.iter().collect();
    order.sort_by(|a, b| b.strength().total_cmp(&a.strength()).then(a.pair.cmp(&b.pair)));
    let mut tree: Vec<usize> = (0..photos).collect();
    let mut turns = vec![Matrix3::identity(); photos];
    for link in order {
        let [a, b] = link.photos;
        let (of_a, of_b) = (tree[a], tree[b]);
        if of_a == of_b {
            continue;
        }
        // Turns the second tree so that this link fits.
        let change = turns[b].transpose() * link.geometry.pose.r * turns[a];
        for photo in 0..photos {
            if tree[photo] == of_b {
                turns[photo] *= change;
                tree[photo] = of_a;
            }
        }
    }
    turns
}
