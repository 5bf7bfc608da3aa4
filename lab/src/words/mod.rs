//! Does an image find its name? Zero-shot classification of labelled photographs.
//!
//! Every tenth image of a set (index % 10 = 9, the rule that training leaves out) goes through the
//! bundle's image tower, every class name through its text tower, and the nearest names count.
//! `.npz` sets hold whole photographs; a `.tar` with `segments.json` holds photographs with a mask
//! for each thing, which are cut out as the product cuts them.

pub mod npz;
pub(crate) mod paste;
pub mod segments;

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
};

use serde_json::{Value, json};

use self::segments::decode;
use crate::{
    error::{Error, Result},
    limits::Limits,
    models::{Bundle, ImageText, Runtime},
    rows::{Rows, means, progress},
    scene::Crop,
    setup::Setup,
};

/// One image of this many is held out, the last of each run.
const HELD_OUT_OF: usize = 10;
/// Classes of clutter, which are no word.
const NO_CLASS: &str = "background";

/// What to evaluate.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Labelled sets: .npz of photographs, .tar of photographs with segments.json
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// What is asked of each name, {} in the name's place
    #[arg(long, default_value = "{}")]
    template: String,
    /// At most so many images of a set, evenly spread; 0: all that are held out
    #[arg(long, default_value_t = 0)]
    images: usize,
    #[command(flatten)]
    setup: Setup,
}

/// A set as embeddings, with the index of each one's name in a list of all names.
struct Set {
    name: String,
    /// Whether the images are things cut out by their mask.
    masked: bool,
    /// Indices into the list of all names, of the set's own classes.
    own: Vec<usize>,
    /// `[N * dim]` embeddings.
    rows: Vec<f32>,
    /// `[N]` name of each.
    truth: Vec<usize>,
}

/// Names of all sets, each once.
#[derive(Default)]
struct Names {
    list: Vec<String>,
    at: HashMap<String, usize>,
}

impl Names {
    /// Index of a class's plain name; `None` where it is no class.
    fn add(&mut self, stored: &str) -> Option<usize> {
        let name = plain(stored);
        if name.is_empty() || name.starts_with(NO_CLASS) {
            return None;
        }
        let next = self.list.len();
        let at = *self.at.entry(name.clone()).or_insert(next);
        if at == next {
            self.list.push(name);
        }
        Some(at)
    }
}

/// The first synonym of a class name, in small letters, with spaces between its words.
fn plain(stored: &str) -> String {
    let first = stored.split(',').next().unwrap_or_default().to_lowercase();
    let first = first.trim_end_matches("-merged").trim_end_matches("-other");
    let first = first.trim_end_matches("-stuff");
    first.split(['_', '-', ' ']).filter(|w| !w.is_empty()).collect::<Vec<_>>().join(" ")
}

/// Makes a row for each set, and one of means; the error is the share of images that miss their
/// name. `own` are hits among the set's own names, `all` among the names of all sets.
///
/// # Errors
/// `invalid_request` for files that are no labelled sets, `model_unavailable` where the bundle has
/// no image-text pair.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if !args.template.contains("{}") {
        return Err(Error::invalid(format!("template {:?} has no {{}}", args.template)));
    }
    let options = args.setup.networks(1);
    let bundle = Bundle::find(&options)?;
    let towers = ImageText::open(&Runtime::load(&options)?, &bundle, &options)?
        .ok_or_else(|| Error::invalid("the bundle has no image-text pair"))?;
    let mut names = Names::default();
    let mut sets = Vec::new();
    for path in &args.files {
        let set = embed(path, &towers, &mut names, args.images)?;
        progress(&format!("{}: {} images", set.name, set.truth.len()));
        sets.push(set);
    }
    let texts: Vec<String> = names.list.iter().map(|n| args.template.replace("{}", n)).collect();
    let found = towers.embed_texts(&texts)?;
    let dim = towers.manifest().dim;
    let all: Vec<usize> = (0..texts.len()).collect();
    let measure = |set: &Set| {
        json!({
            "set": set.name,
            "masked": set.masked,
            "images": set.truth.len(),
            "own": hits(set, dim, &set.own, |n| &found[n].row),
            "all": hits(set, dim, &all, |n| &found[n].row),
        })
    };
    let mut measured: Vec<Value> = sets.iter().map(measure).collect();
    let mut mean = means(&measured);
    mean["set"] = json!("**mean of sets**");
    mean["images"] = json!(sets.iter().map(|set| set.truth.len()).sum::<usize>());
    measured.push(mean);
    for mut row in measured {
        row["bundle"] = json!(format!("{} {}", bundle.name(), bundle.version()));
        let missed = 1.0 - row["all"]["top1"].as_f64().unwrap_or(f64::NAN);
        rows.push(json!({ "missed": missed }), row)?;
    }
    Ok(())
}

/// Every `n`-th so that at most `max` of `count` remain; 1 where 0 asks for all.
fn stride(count: usize, max: usize) -> usize {
    if max == 0 { 1 } else { count.div_ceil(max).max(1) }
}

/// Embeds what is held out of a set.
fn embed(path: &Path, towers: &ImageText, names: &mut Names, images_max: usize) -> Result<Set> {
    let bytes_max = Limits::default().archive_unpacked_bytes_max;
    let image = &towers.manifest().image;
    let margin = f64::from(image.crop_margin);
    // Crops with the index of their name.
    let mut things: Vec<(Crop, usize)> = Vec::new();
    let npz = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("npz"));
    let (name, mut own): (_, Vec<usize>) = if npz {
        let set = npz::Labelled::open(path, bytes_max)?;
        let own: Vec<Option<usize>> = set.names.iter().map(|n| names.add(n)).collect();
        let class = |i: usize| Some((i, own[set.labels[i]]?));
        let held: Vec<(usize, usize)> = held_out(set.labels.len()).filter_map(class).collect();
        for &(i, class) in held.iter().step_by(stride(held.len(), images_max)) {
            let photo = decode(set.image(i), &format!("{} image {i}", set.set))?;
            things.push((square(&photo), class));
        }
        (set.set, own.into_iter().flatten().collect())
    } else {
        let set = segments::Segmented::open(path, bytes_max)?;
        let own = set.class_names().into_iter().filter_map(|class| names.add(class)).collect();
        let mut cut = Vec::new();
        for i in held_out(set.images.len()) {
            cut.extend(set.images[i].cut(margin, image.crop_shape)?);
        }
        let every = stride(cut.len(), images_max);
        let named = |(crop, class): (Crop, String)| Some((crop, names.add(&class)?));
        things.extend(cut.into_iter().step_by(every).filter_map(named));
        (set.set, own)
    };
    own.sort_unstable();
    own.dedup();
    let (crops, truth): (Vec<Crop>, Vec<usize>) = things.into_iter().unzip();
    Ok(Set { name, masked: !npz, own, rows: towers.embed_images(&crops)?, truth })
}

/// Indices that training leaves out, of `count` in a file's order.
fn held_out(count: usize) -> impl Iterator<Item = usize> {
    (0..count).filter(|i| i % HELD_OUT_OF == HELD_OUT_OF - 1)
}

/// A whole photo in the middle of a black square.
fn square(photo: &image::RgbImage) -> Crop {
    let (width, height) = photo.dimensions();
    let side = width.max(height);
    let mut whole = image::RgbImage::new(side, side);
    let middle = |n: u32| i64::from((side - n) / 2);
    image::imageops::replace(&mut whole, photo, middle(width), middle(height));
    Crop { width: side, height: side, rgb: whole.into_raw() }
}

/// How many `names` there are, and the shares of images whose name is the nearest of them (`top1`)
/// or among the five nearest (`top5`); of equally near names the right one comes last.
fn hits<'a>(
    set: &Set,
    dim: usize,
    names: &[usize],
    row_of: impl Fn(usize) -> &'a Vec<f32>,
) -> Value {
    let (mut first, mut five) = (0_u32, 0_u32);
    for (image, truth) in set.rows.chunks_exact(dim.max(1)).zip(&set.truth) {
        let score = |n: usize| -> f32 { image.iter().zip(row_of(n)).map(|(a, b)| a * b).sum() };
        let own = score(*truth);
        let before = names.iter().filter(|n| *n != truth && score(**n) >= own).count();
        first += u32::from(before == 0);
        five += u32::from(before < 5);
    }
    let share = |n: u32| f64::from(n) / set.truth.len().max(1) as f64;
    json!({ "names": names.len(), "top1": share(first), "top5": share(five) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_said_plainly_and_clutter_is_none() {
        let mut names = Names::default();
        assert_eq!(names.add("goldfish, Carassius auratus"), Some(0));
        assert_eq!(names.add("car_side"), Some(1));
        assert_eq!(names.add("Goldfish"), Some(0));
        assert_eq!(names.add("wall-other-merged"), Some(2));
        assert_eq!(names.add("BACKGROUND_Google"), None);
        assert_eq!(names.list, ["goldfish", "car side", "wall"]);
    }

    #[test]
    fn the_last_of_every_ten_is_held_out() {
        assert_eq!(held_out(31).collect::<Vec<_>>(), [9, 19, 29]);
        assert_eq!((stride(30, 0), stride(30, 10), stride(31, 10), stride(5, 10)), (1, 3, 4, 1));
    }

    #[test]
    fn hits_count_first_and_first_five_and_a_tie_is_no_hit() {
        let rows: Vec<Vec<f32>> = (0..8).map(|n| vec![1.0, n as f32 / 8.0]).collect();
        let set = Set {
            name: String::new(),
            masked: false,
            own: vec![],
            rows: vec![0.0, 1.0, 0.0, 1.0, 1.0, 0.0],
            truth: vec![7, 3, 0],
        };
        let all: Vec<usize> = (0..8).collect();
        let found = hits(&set, 2, &all, |n| &rows[n]);
        // The best name first; the fifth best among five; all alike: nothing.
        assert_eq!(found, json!({ "names": 8, "top1": 1.0 / 3.0, "top5": 2.0 / 3.0 }));
    }

    #[test]
    fn a_wide_photo_stands_in_the_middle_of_its_square() {
        let crop = square(&image::RgbImage::from_pixel(4, 2, image::Rgb([9; 3])));
        assert_eq!([crop.width, crop.height], [4; 2]);
        let rows: Vec<u8> = crop.rgb.chunks(12).map(|row| row[0]).collect();
        assert_eq!(rows, [0, 9, 9, 0]);
    }
}
