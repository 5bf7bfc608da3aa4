//! Does an image find its name? Zero-shot classification of labelled photographs.
//!
//! Every tenth image of a set (index % 10 = 9, the rule that training leaves out) goes through the
//! bundle's image tower, every class name through its text tower, and the nearest names count.
//! `.npz` sets hold whole photographs; a `.tar` with `segments.json` holds photographs with a mask
//! for each thing, which are cut out as the product cuts them.

mod npz;
mod segments;

use std::{
    collections::HashMap,
    fmt,
    path::{Path, PathBuf},
};

use image::ImageReader;
use serde::Serialize;
use serde_json::json;

use crate::{
    error::{Error, Result},
    limits::Limits,
    models::{Bundle, ImageText, Runtime},
    rows::{Rows, mean, progress},
    scene::Crop,
    setup::Setup,
};

/// One image of this many is held out, the last of each run.
const HELD_OUT_OF: usize = 10;
/// Crops that are decoded before the tower sees them.
const BATCH: usize = 64;
/// Classes of clutter, which are no word.
const NO_CLASS: &str = "background";

/// What to evaluate.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
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

/// How often the right name came first, or among the first five.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
struct Hits {
    /// Names to choose from.
    names: usize,
    /// Share of images whose name came first.
    top1: f64,
    /// Share of images whose name came among the first five.
    top5: f64,
}

/// One set.
#[derive(Clone, Debug, Serialize)]
struct Measured {
    set: String,
    bundle: String,
    /// Whether the images are things cut out by their mask.
    masked: bool,
    images: usize,
    /// Among the set's own names.
    own: Hits,
    /// Among the names of all sets.
    all: Hits,
}

/// A set as crops to be embedded, with the index of each one's name in a list of all names.
struct Set {
    name: String,
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
/// name.
///
/// # Errors
/// `invalid_request` for files that are no labelled sets, `model_unavailable` where the bundle has
/// no image-text pair.
pub fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if !args.template.contains("{}") {
        return Err(Error::invalid(format!("template {:?} has no {{}}", args.template)));
    }
    let options = args.setup.networks(1);
    let bundle = Bundle::find(&options)?;
    let towers = ImageText::open(&*Runtime::load(&options)?, &bundle, &options)?
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
    let measure = |set: &Set| Measured {
        set: set.name.clone(),
        bundle: format!("{} {}", bundle.name(), bundle.version()),
        masked: set.masked,
        images: set.truth.len(),
        own: hits(set, dim, &set.own, |n| &found[n].row),
        all: hits(set, dim, &all, |n| &found[n].row),
    };
    let mut measured: Vec<Measured> = sets.iter().map(measure).collect();
    let over = |of: fn(&Measured) -> Hits| Hits {
        names: all.len(),
        top1: mean(measured.iter().map(|m| of(m).top1)),
        top5: mean(measured.iter().map(|m| of(m).top5)),
    };
    let images = measured.iter().map(|m| m.images).sum();
    let (own, among_all) = (over(|m| m.own), over(|m| m.all));
    if let Some(first) = measured.first().cloned() {
        let set = "mean of sets".to_owned();
        measured.push(Measured { set, masked: false, images, own, all: among_all, ..first });
    }
    for measured in &measured {
        rows.push(json!({ "missed": 1.0 - measured.all.top1 }), measured)?;
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
    let margin = f64::from(towers.manifest().image.crop_margin);
    let (mut rows, mut truth) = (Vec::new(), Vec::new());
    let mut waiting: Vec<Crop> = Vec::new();
    let mut flush = |waiting: &mut Vec<Crop>| -> Result<()> {
        rows.extend(towers.embed_images(waiting)?);
        waiting.clear();
        Ok(())
    };
    let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
    let (name, own) = if ending == "npz" {
        let set = npz::Labelled::open(path, bytes_max)?;
        let own: Vec<Option<usize>> = set.names.iter().map(|n| names.add(n)).collect();
        let is_class = |i: &usize| own[set.labels[*i]].is_some();
        let held: Vec<usize> = held_out(set.labels.len()).filter(is_class).collect();
        for &i in held.iter().step_by(stride(held.len(), images_max)) {
            let Some(class) = own[set.labels[i]] else { continue };
            let photo = decode(set.image(i), &format!("{} image {i}", set.set))?;
            waiting.push(square(&photo));
            truth.push(class);
            if waiting.len() == BATCH {
                flush(&mut waiting)?;
            }
        }
        (set.set, own.into_iter().flatten().collect())
    } else {
        let mut own = Vec::new();
        let set = segments::Segmented::open(path, bytes_max)?;
        for class in set.class_names() {
            own.extend(names.add(class));
        }
        let held: Vec<usize> = held_out(set.images.len()).collect();
        let mut things = Vec::new();
        for i in held {
            things.extend(set.images[i].cut(margin)?);
        }
        let every = stride(things.len(), images_max);
        for (crop, class) in things.into_iter().step_by(every) {
            let Some(class) = names.add(&class) else { continue };
            waiting.push(crop);
            truth.push(class);
            if waiting.len() == BATCH {
                flush(&mut waiting)?;
            }
        }
        (set.set, own)
    };
    flush(&mut waiting)?;
    let mut own: Vec<usize> = own;
    own.sort_unstable();
    own.dedup();
    Ok(Set { name, masked: ending != "npz", own, rows, truth })
}

/// Indices that training leaves out, of `count` in a file's order.
fn held_out(count: usize) -> impl Iterator<Item = usize> {
    (0..count).filter(|i| i % HELD_OUT_OF == HELD_OUT_OF - 1)
}

/// The pixels of an image file.
fn decode(bytes: &[u8], what: &str) -> Result<image::RgbImage> {
    let fault = |e: &dyn fmt::Display| Error::invalid(format!("{what}: {e}"));
    let reader = ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format();
    Ok(reader.map_err(|e| fault(&e))?.decode().map_err(|e| fault(&e))?.into_rgb8())
}

/// A whole photo in the middle of a black square.
fn square(photo: &image::RgbImage) -> Crop {
    let (width, height) = photo.dimensions();
    let side = width.max(height);
    let mut whole = image::RgbImage::new(side, side);
    let middle = |n: u32| i64::from((side - n) / 2);
    image::imageops::replace(&mut whole, photo, middle(width), middle(height));
    Crop { side, rgb: whole.into_raw() }
}

/// Shares of images whose name is the nearest, or among the five nearest, of `names`; of equally
/// near names the right one comes last.
fn hits<'a>(
    set: &Set,
    dim: usize,
    names: &[usize],
    row_of: impl Fn(usize) -> &'a Vec<f32>,
) -> Hits {
    let (mut first, mut five) = (0_u32, 0_u32);
    for (image, truth) in set.rows.chunks_exact(dim.max(1)).zip(&set.truth) {
        let score = |n: usize| -> f32 { image.iter().zip(row_of(n)).map(|(a, b)| a * b).sum() };
        let own = score(*truth);
        let before = names.iter().filter(|n| *n != truth && score(**n) >= own).count();
        first += u32::from(before == 0);
        five += u32::from(before < 5);
    }
    let share = |n: u32| f64::from(n) / set.truth.len().max(1) as f64;
    Hits { names: names.len(), top1: share(first), top5: share(five) }
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
        assert_eq!(found, Hits { names: 8, top1: 1.0 / 3.0, top5: 2.0 / 3.0 });
    }

    #[test]
    fn a_wide_photo_stands_in_the_middle_of_its_square() {
        let crop = square(&image::RgbImage::from_pixel(4, 2, image::Rgb([9; 3])));
        assert_eq!(crop.side, 4);
        let rows: Vec<u8> = crop.rgb.chunks(12).map(|row| row[0]).collect();
        assert_eq!(rows, [0, 9, 9, 0]);
    }
}
