//! The outlines of a mask as polygons that give it back to the pixel.
//!
//! A polygon goes along the edges of pixels, once around each part of pixels that touch by a side.
//! A hole is reached by a seam: a way of no width through the row at the hole's left, there and
//! back. Right and lower edges lie [`INSET`] inside of the pixel, so that a coordinate without its
//! fraction is the pixel's: programs that draw the polygon with its border, as `LabelMe` does,
//! find the same pixels as programs that ask which centres of pixels lie inside.

use std::collections::HashMap;

/// Pixels by which right and lower edges are moved in.
const INSET: f64 = 0.01;

/// Corners, x and y in pixels; the centre of the first pixel is (0.5, 0.5).
pub(super) type Polygon = Vec<[f64; 2]>;

/// A side of a pixel. Along it the pixel is at the right hand: the upper side is walked to the
/// right, the right one down, the lower one to the left, the left one up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Edge {
    x: usize,
    y: usize,
    side: Side,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Side {
    Upper,
    Right,
    Lower,
    Left,
}

struct Mask<'a> {
    on: &'a [bool],
    width: usize,
    height: usize,
}

impl Mask<'_> {
    /// Whether a pixel is on; outside of the picture none is.
    fn at(&self, x: usize, y: usize) -> bool {
        x < self.width && y < self.height && self.on[y * self.width + x]
    }

    /// The edge after this one. Pixels that touch by a corner alone are apart.
    fn next(&self, Edge { x, y, side }: Edge) -> Edge {
        // Beyond the end of the edge: the pixel ahead, and the one ahead at the left hand. Left of
        // 0 lies a number beyond the width.
        let (left, up) = (x.wrapping_sub(1), y.wrapping_sub(1));
        let (ahead, aside, turn_right, turn_left) = match side {
            Side::Upper => ((x + 1, y), (x + 1, up), Side::Right, Side::Left),
            Side::Right => ((x, y + 1), (x + 1, y + 1), Side::Lower, Side::Upper),
            Side::Lower => ((left, y), (left, y + 1), Side::Left, Side::Right),
            Side::Left => ((x, up), (left, up), Side::Upper, Side::Lower),
        };
        let edge = |(x, y), side| Edge { x, y, side };
        match (self.at(ahead.0, ahead.1), self.at(aside.0, aside.1)) {
            (false, _) => edge((x, y), turn_right),
            (true, false) => edge(ahead, side),
            (true, true) => edge(aside, turn_left),
        }
    }
}

/// A closed way along edges.
struct Way {
    start: Edge,
    /// Its edge farthest left that has its pixel at the left.
    leftmost: Edge,
    is_hole: bool,
}

/// The polygons of a mask, `[height * width]` row-major.
pub(super) fn polygons(on: &[bool], width: usize, height: usize) -> Vec<Polygon> {
    let mask = Mask { on, width, height };
    let ways = ways(&mask);
    let mut seams: HashMap<Edge, Edge> = HashMap::new();
    for hole in ways.iter().filter(|way| way.is_hole) {
        let right = hole.leftmost;
        let run = (0..=right.x).rev().take_while(|x| mask.at(*x, right.y));
        let left = Edge { x: run.last().unwrap_or(right.x), side: Side::Left, ..right };
        seams.insert(left, right);
        seams.insert(right, left);
    }
    let outer = ways.iter().filter(|way| !way.is_hole);
    outer.map(|way| polygon(&mask, &seams, way.start)).collect()
}

/// All ways around parts and holes.
fn ways(mask: &Mask<'_>) -> Vec<Way> {
    let mut seen = vec![false; mask.on.len()];
    let mut ways = Vec::new();
    for (y, x) in (0..mask.height).flat_map(|y| (0..mask.width).map(move |x| (y, x))) {
        let is_edge = mask.at(x, y) && !mask.at(x.wrapping_sub(1), y);
        if !is_edge || seen[y * mask.width + x] {
            continue;
        }
        let start = Edge { x, y, side: Side::Left };
        let (mut edge, mut leftmost, mut area) = (start, None::<Edge>, 0_i64);
        loop {
            match edge.side {
                Side::Left => {
                    seen[edge.y * mask.width + edge.x] = true;
                    area -= edge.x as i64;
                }
                Side::Right => {
                    area += edge.x as i64 + 1;
                    if leftmost.is_none_or(|least| edge.x < least.x) {
                        leftmost = Some(edge);
                    }
                }
                Side::Upper | Side::Lower => {}
            }
            edge = mask.next(edge);
            if edge == start {
                break;
            }
        }
        ways.push(Way { start, leftmost: leftmost.unwrap_or(start), is_hole: area < 0 });
    }
    ways
}

/// The way around a part and, by the seams, around its holes.
fn polygon(mask: &Mask<'_>, seams: &HashMap<Edge, Edge>, start: Edge) -> Polygon {
    let (mut corners, mut edge) = (Polygon::new(), start);
    loop {
        if let Some(&other) = seams.get(&edge) {
            let row = edge.y as f64 + 0.5;
            corners.extend([[along(edge), row], [along(other), row]]);
            edge = other;
        }
        let next = mask.next(edge);
        match (edge.side, next.side) {
            (a, b) if a == b => {}
            (Side::Left | Side::Right, _) => corners.push([along(edge), along(next)]),
            _ => corners.push([along(next), along(edge)]),
        }
        edge = next;
        if edge == start {
            return corners;
        }
    }
}

/// The x of an upright edge, the y of a level one.
fn along(edge: Edge) -> f64 {
    match edge.side {
        Side::Left => edge.x as f64,
        Side::Right => edge.x as f64 + 1.0 - INSET,
        Side::Upper => edge.y as f64,
        Side::Lower => edge.y as f64 + 1.0 - INSET,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether the centre of each pixel lies inside of an odd number of ways.
    fn filled(polygons: &[Polygon], width: usize, height: usize) -> Vec<bool> {
        let inside = |x: f64, y: f64| {
            let crossed = |polygon: &Polygon| {
                let ends = polygon.iter().zip(polygon.iter().cycle().skip(1));
                // Seams lie in the rows of centres: what is asked is a little above.
                let y = y - 0.25;
                ends.filter(|(a, b)| (a[1] > y) != (b[1] > y) && a[0] > x).count()
            };
            polygons.iter().map(crossed).sum::<usize>() % 2 == 1
        };
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x as f64, y as f64)));
        pixels.map(|(x, y)| inside(x + 0.5, y + 0.5)).collect()
    }

    fn mask(rows: &[&str]) -> (Vec<bool>, usize, usize) {
        let on = rows.iter().flat_map(|row| row.chars().map(|c| c == '#')).collect();
        (on, rows[0].len(), rows.len())
    }

    #[test]
    fn a_pixel_is_a_square_and_a_hole_has_a_seam() {
        let (on, width, height) = mask(&["...", ".#."]);
        assert_eq!(
            polygons(&on, width, height),
            [[[1.0, 1.0], [1.99, 1.0], [1.99, 1.99], [1.0, 1.99]]]
        );
        let (on, width, height) = mask(&["###", "#.#", "###"]);
        let [ring] = &polygons(&on, width, height)[..] else { panic!("one part") };
        assert_eq!(ring.len(), 4 + 4 + 4, "two squares and a seam, there and back");
        assert!(ring.contains(&[0.0, 1.5]) && ring.contains(&[0.99, 1.5]), "{ring:?}");
    }

    #[test]
    fn polygons_give_the_mask_back() {
        let (mut state, mut holes) = (1_u64, 0);
        for case in 0..400 {
            let (width, height) = (1 + case % 13, 1 + case % 11);
            let dense = 20 + case as u64 % 70;
            let on: Vec<bool> = (0..width * height)
                .map(|_| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    (state >> 33) % 100 < dense
                })
                .collect();
            let found = polygons(&on, width, height);
            assert_eq!(filled(&found, width, height), on, "case {case}: {found:?}");
            let ways = ways(&Mask { on: &on, width, height });
            assert_eq!(found.len(), ways.iter().filter(|way| !way.is_hole).count());
            holes += ways.len() - found.len();
        }
        assert!(holes > 100, "only {holes} holes");
        assert!(polygons(&[false; 6], 3, 2).is_empty());
        assert!(polygons(&[], 0, 0).is_empty());
    }
}
