//! Photos of a video, by the program `ffmpeg` where it is there: sharp frames, spread over the
//! motion of the camera.
//!
//! The video is decoded twice: small and grey to look at all frames, then the chosen ones as JPEGs.

use std::{
    io::{ErrorKind, Read},
    path::Path,
    process::{Child, Command, Stdio},
};

use crate::{
    error::{Error, Result},
    scene::{Upload, UploadFile},
};

/// Endings of the names of videos.
const ENDINGS: [&str; 8] = ["mp4", "mov", "m4v", "webm", "mkv", "avi", "mpg", "3gp"];
/// Frames a second that are looked at.
const RATE: usize = 10;
/// Width and height at which they are looked at, pixels; the shape is not kept.
const LOOKED: [usize; 2] = [320, 240];
/// Side of the squares whose means are compared from frame to frame, pixels.
const SQUARE: usize = 16;
/// Frames that are looked at, at most: half an hour.
const FRAMES_MAX: usize = 30 * 60 * RATE;
/// Frames that are chosen for each second, at least and at most.
const CHOSEN_A_SECOND: usize = 2;
const CHOSEN_MIN: usize = 16;
const CHOSEN_MAX: usize = 64;
/// Longest side of a photo, pixels: a scene keeps no larger ones.
const SIDE_MAX: u32 = 2_048;
/// Motion that a frame has at least, grey levels: one of a camera that stands still counts too.
const MOTION_MIN: f64 = 0.05;
/// Without the program.
const REMEDY: &str = "install ffmpeg (apt install ffmpeg, brew install ffmpeg), or make photos of \
                      the video elsewhere and give their folder";

/// What is seen of a small frame.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Look {
    /// Mean square of the second derivatives: the larger, the sharper.
    sharpness: f64,
    /// How much the means of squares differ from those of the frame before, grey levels.
    motion: f64,
}

/// Whether a file of this name is a video.
pub(super) fn is_video(path: &Path) -> bool {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    path.is_file() && ENDINGS.contains(&&*ending)
}

/// Frames of a video as photos, named by their times.
///
/// # Errors
/// `invalid_request` where the program is missing or does not read the file, or the video is too
/// long.
pub(super) fn photos(path: &Path) -> Result<Upload> {
    let looks = looked_at(path)?;
    let count = (looks.len() * CHOSEN_A_SECOND / RATE).clamp(CHOSEN_MIN, CHOSEN_MAX);
    let chosen = chosen(&looks, count);
    let frames = jpegs(path, &chosen)?;
    if frames.len() != chosen.len() {
        let (got, wanted) = (frames.len(), chosen.len());
        return Err(fault(path, &format!("ffmpeg gave {got} of {wanted} frames")));
    }
    let file = |(place, bytes): (&usize, Vec<u8>)| {
        let seconds = *place as f64 / RATE as f64;
        UploadFile { name: format!("{seconds:08.2}s.jpg"), bytes }
    };
    let photos = chosen.iter().zip(frames).map(file).collect();
    Ok(Upload { photos, ..Upload::default() })
}

/// Looks at the frames of a video.
fn looked_at(path: &Path) -> Result<Vec<Look>> {
    let [width, height] = LOOKED;
    let filter = format!("fps={RATE},scale={width}:{height},format=gray");
    let mut ffmpeg = ffmpeg(path, &filter, &["-f", "rawvideo"])?;
    let mut frame = vec![0; width * height];
    let mut before: Option<Vec<f64>> = None;
    let mut looks = Vec::new();
    let mut pixels = ffmpeg.stdout.take();
    while let Some(Ok(())) = pixels.as_mut().map(|from| from.read_exact(&mut frame)) {
        let squares = squares(&frame);
        let motion = before.map_or(0.0, |before| difference(&before, &squares));
        looks.push(Look { sharpness: sharpness(&frame), motion });
        before = Some(squares);
        if looks.len() > FRAMES_MAX {
            // Nothing is read any more, which ends the program.
            break;
        }
    }
    drop(pixels);
    if looks.len() > FRAMES_MAX {
        let _ = ffmpeg.wait();
        let minutes = FRAMES_MAX / RATE / 60;
        return Err(fault(path, &format!("the video is longer than {minutes} minutes; cut it")));
    }
    ended(path, ffmpeg)?;
    if looks.is_empty() { Err(fault(path, "ffmpeg finds no frame in it")) } else { Ok(looks) }
}

/// The frames at these places, in order, as JPEGs.
fn jpegs(path: &Path, chosen: &[usize]) -> Result<Vec<Vec<u8>>> {
    let each: Vec<String> = chosen.iter().map(|place| format!(r"eq(n\,{place})")).collect();
    // Numbered anew, so that no frame is repeated to fill a gap.
    let filter = format!(
        "fps={RATE},select={},setpts=N/{RATE}/TB,scale=w='min({SIDE_MAX},iw)':\
         h='min({SIDE_MAX},ih)':force_original_aspect_ratio=decrease",
        each.join("+")
    );
    let rate = RATE.to_string();
    let kind = ["-r", &rate, "-pix_fmt", "yuvj420p", "-q:v", "2", "-c:v", "mjpeg"];
    let mut ffmpeg = ffmpeg(path, &filter, &[&kind[..], &["-f", "image2pipe"]].concat())?;
    let mut bytes = Vec::new();
    let read = ffmpeg.stdout.take().map_or(Ok(0), |mut from| from.read_to_end(&mut bytes));
    read.map_err(|e| fault(path, "ffmpeg cannot be read").caused_by(e))?;
    ended(path, ffmpeg)?;
    Ok(split(&bytes))
}

/// Starts the program, which writes frames into a pipe.
fn ffmpeg(path: &Path, filter: &str, kind: &[&str]) -> Result<Child> {
    let mut command = Command::new("ffmpeg");
    command.args(["-nostdin", "-v", "error", "-i"]).arg(path);
    command.args(["-an", "-sn", "-vf", filter]).args(kind).arg("-");
    // What it says of the file goes to the caller as it is.
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn();
    child.map_err(|e| match e.kind() {
        ErrorKind::NotFound => {
            fault(path, &format!("it is a video, and there is no ffmpeg; {REMEDY}"))
        }
        _ => fault(path, "ffmpeg does not start").caused_by(e),
    })
}

/// Waits for the program, which has written all.
fn ended(path: &Path, mut ffmpeg: Child) -> Result<()> {
    match ffmpeg.wait() {
        Ok(status) if status.success() => Ok(()),
        Ok(_) => Err(fault(path, "ffmpeg does not read it")),
        Err(e) => Err(fault(path, "ffmpeg cannot be waited for").caused_by(e)),
    }
}

fn fault(path: &Path, what: &str) -> Error {
    Error::invalid(format!("{}: {what}", path.display()))
}

/// Places of `count` frames at most: the motion is cut into equal parts, and the sharpest frame of
/// each is taken.
fn chosen(looks: &[Look], count: usize) -> Vec<usize> {
    let motion = |look: &Look| look.motion.max(MOTION_MIN);
    let total: f64 = looks.iter().map(motion).sum();
    let mut chosen: Vec<usize> = Vec::new();
    let (mut moved, mut part) = (0.0, 0);
    for (place, look) in looks.iter().enumerate() {
        // The middle of the frame's own motion says in which part it is.
        let here = (moved + 0.5 * motion(look)) / total * count as f64;
        moved += motion(look);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part")]
        let own = here as usize;
        match chosen.last_mut() {
            Some(last) if own == part => {
                if look.sharpness > looks[*last].sharpness {
                    *last = place;
                }
            }
            _ => chosen.push(place),
        }
        part = own;
    }
    chosen
}

/// Mean square of the differences of a pixel to the mean of its four neighbours.
fn sharpness(frame: &[u8]) -> f64 {
    let [width, height] = LOOKED;
    let at = |x: usize, y: usize| f64::from(frame[y * width + x]);
    let mut sum = 0.0;
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let around = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1);
            sum += (at(x, y) - 0.25 * around).powi(2);
        }
    }
    sum / ((width - 2) * (height - 2)) as f64
}

/// Means of squares of [`SQUARE`] pixels less the mean of all: other light is no motion.
fn squares(frame: &[u8]) -> Vec<f64> {
    let [width, height] = LOOKED;
    let mut means = vec![0.0; (width / SQUARE) * (height / SQUARE)];
    for (place, level) in frame.iter().enumerate() {
        let (x, y) = (place % width / SQUARE, place / width / SQUARE);
        means[y * (width / SQUARE) + x] += f64::from(*level) / (SQUARE * SQUARE) as f64;
    }
    let mean = means.iter().sum::<f64>() / means.len() as f64;
    means.iter().map(|level| level - mean).collect()
}

fn difference(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f64>() / a.len() as f64
}

/// JPEGs that follow each other. Inside of one its end marker does not occur.
fn split(bytes: &[u8]) -> Vec<Vec<u8>> {
    let ends = bytes.windows(2).enumerate().filter(|(_, two)| *two == [0xFF, 0xD9]);
    let mut first = 0;
    let each = ends.map(|(end, _)| {
        let jpeg = bytes[first..end + 2].to_vec();
        first = end + 2;
        jpeg
    });
    each.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn look(sharpness: f64, motion: f64) -> Look {
        Look { sharpness, motion }
    }

    #[test]
    fn sharp_frames_are_chosen_over_the_motion() {
        // Ten seconds that stand still, then two that move: most frames are of the motion.
        let still = std::iter::repeat_n(look(1.0, 0.0), 100);
        let moving = (0..20).map(|i| look(if i % 2 == 0 { 3.0 } else { 2.0 }, 2.0));
        let looks: Vec<Look> = still.chain(moving).collect();
        let places = chosen(&looks, 9);
        assert_eq!(places.len(), 9);
        assert!(places.windows(2).all(|two| two[0] < two[1]), "{places:?}");
        let moved = &places[1..];
        assert!(moved.iter().all(|place| *place >= 100), "{places:?}");
        assert!(moved.iter().all(|place| looks[*place].sharpness > 2.5), "{places:?}");
        // Fewer frames than asked for: each once.
        assert_eq!(chosen(&looks[..5], 16), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn blur_is_less_sharp_and_light_is_no_motion() {
        let [width, height] = LOOKED;
        let board = |size: usize| -> Vec<u8> {
            let level = |i: usize| [40, 200][(i % width / size + i / width / size) % 2];
            (0..width * height).map(level).collect()
        };
        let (fine, coarse) = (board(8), board(40));
        assert!(sharpness(&fine) > 2.0 * sharpness(&coarse));
        let brighter: Vec<u8> = coarse.iter().map(|level| level + 30).collect();
        let moved: Vec<u8> =
            (0..width * height).map(|i| coarse[i / width * width + (i + 16) % width]).collect();
        let motion = |frame: &[u8]| difference(&squares(&coarse), &squares(frame));
        assert!(motion(&brighter) < 1e-9 && motion(&moved) > 10.0);
    }

    #[test]
    fn pictures_in_a_row_are_told_apart() {
        let one = [0xFF, 0xD8, 1, 0xFF, 0, 0xFF, 0xD9];
        let two = [0xFF, 0xD8, 2, 0xFF, 0xD9];
        assert_eq!(split(&[&one[..], &two].concat()), [one.to_vec(), two.to_vec()]);
    }
}
