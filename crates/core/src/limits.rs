//! Every limit in one place, with its unit and its reason. The server's configuration file sets
//! them.

use std::sync::Arc;

use parking_lot::RwLock;
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// Bytes of an idempotency key: what a UUID and a prefix need many times over.
pub const IDEMPOTENCY_KEY_BYTES_MAX: usize = 256;

/// Rows of a semantic bank: a busy photo has a hundred masks, so this is never met by photos; it
/// bounds what the products of all pairs of rows take.
pub const BANK_ROWS_MAX: usize = 4_096;

/// Photos of `fuse_layers` and `front_photos`: no scene has more.
pub const SCENE_PHOTOS_MAX: u32 = 1_024;

/// Canonical texts that a text is compared with: LERF has four.
pub const CANON_MAX: usize = 64;

/// Least and largest `lambda`: rows of the bank over the mean number of masks of a photo.
pub const LAMBDA_RANGE: [f64; 2] = [0.01, 100.0];

/// Least and largest `tau`, the sharpness of the comparison of texts: LERF has 10.
pub const TAU_RANGE: [f64; 2] = [1e-3, 1e6];

/// Vertical fields of view, degrees: a picture is flat, so it must stay under 180.
pub const FOV_RANGE: [f64; 2] = [0.1, 170.0];

/// Focal lengths of views and photos, pixels; principal points of views lie within the largest of
/// the origin. A picture is at most some thousands wide.
pub const FOCAL_RANGE: [f64; 2] = [1.0, 1e6];

/// Declares the limits: name, type and default; `restart` where a new number counts only after a
/// restart, because it sizes something at start. All others are read from [`LiveLimits`] at each
/// use.
macro_rules! limits {
    ($($(#[$doc:meta])+ $name:ident: $type:ty = $default:expr $(, $restart:ident)?;)+) => {
        /// Caps on what a caller may send or ask for.
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct Limits {
            $($(#[$doc])+ pub $name: $type,)+
        }

        impl Default for Limits {
            fn default() -> Self {
                Self { $($name: $default,)+ }
            }
        }

        impl Limits {
            /// Gives each limit that counts only after a restart the number that it has in
            /// `start`; names those that had another.
            fn hold_to_start(&mut self, start: &Self) -> Vec<&'static str> {
                let mut names = Vec::new();
                $($(
                    let $restart = stringify!($name);
                    if self.$name != start.$name {
                        names.push($restart);
                        self.$name = start.$name;
                    }
                )?)+
                names
            }
        }
    };
}

limits! {
    /// Photos that one scene is made of: those that the networks see, and those that only the steps
    /// of its refinement learn. Of more the best are taken.
    photos_max: usize = 1_000;
    /// Photos of one scene that the networks see: their time and memory grow with them. Of more,
    /// those that see most from different places.
    network_photos_max: usize = 64;
    /// Fewest photos that give parallax.
    photos_min: usize = 2;
    /// Bytes of one upload, all parts together: 1,000 photos of 12 megapixels have some 5 GB.
    upload_bytes_max: usize = 8 << 30;
    /// Bytes of one file of an upload but its archive, and of one file in an archive or a folder:
    /// what is in memory while it is read.
    upload_file_bytes_max: usize = 256 << 20;
    /// Bytes of one upload that stay in memory while it is received. What comes after them goes to
    /// the store as it comes, each file as an object of its own.
    upload_memory_bytes_max: usize = 32 << 20;
    /// Bytes in memory of all uploads being received; one more byte is refused as `overloaded`.
    uploads_bytes_max: usize = 1 << 30, restart;
    /// Bytes of one JSON part (`transforms`, `cameras`) or JSON body.
    json_bytes_max: usize = 8 << 20, restart;
    /// Values in one JSON part or body, counted before it is read: eight megabytes of empty objects
    /// would take hundreds of megabytes. 64 cameras have some 2,000.
    json_values_max: usize = 250_000;
    /// Pixels of one photo that are decoded, read from the header before. A larger JPEG is decoded
    /// at a half or a quarter of its sides, a larger photo of another format if its pixels take no
    /// more than 8 bytes for each of these.
    photo_pixels_max: u64 = 24_000_000;
    /// Longer side in pixels to which a photo is reduced after decoding: no stage looks closer.
    photo_side_kept_max: u32 = 2_048;
    /// Pixels of all photos of one scene together after decoding, three bytes each: 16 photos keep
    /// a longer side of 2048, 64 keep 1,100. Photos are reduced alike until they fit.
    photos_pixels_kept_max: u64 = 50_000_000;
    /// Files and folders in an archive, a form or a folder: captures of phones have six files a
    /// photo.
    archive_entries_max: usize = 16_384;
    /// Bytes of one file of cameras that is no JSON: COLMAP's `images.bin` has 24 bytes for each
    /// feature, 200 kB a photo.
    camera_file_bytes_max: usize = 128 << 20;
    /// Bytes of one archive unpacked, one file at a time. Over 512 MiB they may be four times those
    /// of the archive: what a zip bomb meets.
    archive_unpacked_bytes_max: u64 = 8 << 30;
    /// Length of a photo's file name in bytes.
    file_name_bytes_max: usize = 256;
    /// Width or height of a rendered view in pixels.
    view_side_max: u32 = 4_096;
    /// Cameras in one `views` request.
    cameras_max: usize = 64;
    /// Kinds of picture in one `views` request.
    kinds_max: usize = 8;
    /// Texts in one `query` request, and labels in one `pick`.
    texts_max: usize = 128;
    /// Edits of one scene, applied one after the other when it is loaded.
    edits_max: usize = 256;
    /// Characters of one text: more than any noun phrase needs.
    text_chars_max: usize = 256;
    /// Milliseconds a text waits for semantics that are being made, unless it says how long.
    text_wait_ms: u64 = 120_000;
    /// Embeddings of texts kept in memory, those asked last: a few kilobytes each.
    texts_cached_max: usize = 4_096, restart;
    /// Bytes of banks kept in memory ready to be scored.
    scorers_cache_bytes_max: u64 = 512 << 20, restart;
    /// Bytes of views' semantic entries kept in memory, so that the next text draws nothing.
    entries_cache_bytes_max: u64 = 512 << 20, restart;
    /// Bytes of the features (F) of one view: 1024 x 512 pixels of 512 numbers.
    features_bytes_max: u64 = 1 << 30;
    /// Bytes kept of the parts of scenes that were looked for to give boxes.
    pieces_cache_bytes_max: u64 = 128 << 20, restart;
    /// Parts of one text's selection that an answer lists, the largest first; points of one call
    /// that are measured.
    parts_max: usize = 64;
    /// Bytes of photos that the create call read, kept in memory for the jobs of their scenes. A
    /// job whose photos do not fit reads them again.
    read_uploads_bytes_max: u64 = 512 << 20, restart;
    /// Milliseconds for which the photos of a scene that was made with `semantics=lazy` stay in
    /// memory after it is done, within `read_uploads_bytes_max`: its first text need not read them.
    first_text_photos_ms: u64 = 120_000, restart;
    /// Jobs that wait; one more is refused as `overloaded`.
    queued_jobs_max: usize = 64, restart;
    /// Renders at work or waiting; one more is refused as `overloaded`.
    queued_renders_max: usize = 256;
    /// Pixels of renders at work or waiting. One render may take a quarter of what is left, so that
    /// large views leave room for small ones; else it is refused as `overloaded`.
    queued_pixels_max: u64 = 256 << 20;
    /// Pixels of renders at work: being drawn or encoded, some 20 to 30 bytes each. A larger view
    /// is drawn alone.
    active_pixels_max: u64 = 64 << 20, restart;
    /// Pixels of all pictures of one `views` request.
    views_pixels_max: u64 = 512 << 20;
    /// Milliseconds one `views` request may take.
    views_timeout_ms: u64 = 300_000;
    /// Points of an export as COLMAP or nerfstudio, those that cover most: as many as a sparse
    /// model of some hundred photos has.
    folder_points_max: usize = 100_000;
    /// Exports as folders at work: each has the upload of a scene in memory. One more is refused
    /// as `overloaded`.
    folder_exports_max: usize = 2, restart;
    /// Bytes of one call that runs a network: the largest inputs of the published networks have 13
    /// million.
    inference_bytes_max: usize = 16 << 20, restart;
    /// Callers that are told the edits of scenes as they change: each holds a connection while it
    /// listens. One more is refused as `overloaded`.
    watchers_max: usize = 1_024, restart;
    /// Calls that run a network, at work or waiting for its session. One more is refused as
    /// `overloaded`.
    inferences_max: usize = 8, restart;
    /// Bytes of scenes kept in memory.
    cache_bytes_max: u64 = 4 << 30, restart;
    /// Bytes of edited scenes kept in memory, beside `cache_bytes_max` for those without edits.
    edited_cache_bytes_max: u64 = 2 << 30, restart;
    /// Bytes of scenes kept on one GPU device: what a card of 8 GB has to spare beside its frames.
    /// A larger scene stays in host memory; of it the device has what its last views showed.
    device_scene_bytes_max: u64 = 2 << 30, restart;
    /// Milliseconds in which the head of a request must come, from the connection's start or the
    /// end of the call before it. A connection that sends none in this time is closed.
    head_timeout_ms: u64 = 10_000, restart;
    /// Bytes that a request's body must bring in each `body_window_ms` that it is waited for.
    body_bytes_min: usize = 8 << 10, restart;
    /// Milliseconds in which `body_bytes_min` must come: half a kilobyte a second, unless set.
    body_window_ms: u64 = 16_000, restart;
    /// Bytes that an answer must lose to its caller in each `answer_window_ms` in which the server
    /// waits for the caller. Else the connection is closed.
    answer_bytes_min: usize = 128 << 10, restart;
    /// Milliseconds in which `answer_bytes_min` must be taken: 8 kilobytes a second, unless set.
    answer_window_ms: u64 = 16_000, restart;
    /// Bytes of pictures and other whole answers in memory until their callers have taken them; at
    /// most a quarter of `memory_bytes_max`. One answer may take a quarter of what is left, or be
    /// alone; else it is refused as `overloaded`.
    answers_bytes_max: u64 = 1 << 30;
    /// Exports that are being written or sent. One more is refused as `overloaded`.
    exports_max: usize = 16;
    /// Bytes that exports being written or sent may take in memory together, beside the scenes. One
    /// more is refused as `overloaded`. One that takes more than three quarters counts as those.
    exports_bytes_max: u64 = 512 << 20;
    /// Milliseconds one render may take.
    render_timeout_ms: u64 = 30_000;
    /// Milliseconds one scene may take.
    scene_timeout_ms: u64 = 600_000;
    /// Milliseconds of work that one refinement may be given.
    refine_ms_max: u64 = 600_000;
    /// Steps of one refinement: those of some minutes on a GPU.
    refine_steps_max: u32 = 100_000;
    /// Share of the threads, percent, that refinements have where no GPU draws; two at least, where
    /// there are two. All others go first.
    refine_threads_percent: u32 = 50, restart;
    /// Gaussians that a refinement may end with. It begins with at most 150,000.
    refine_gaussians_max: usize = 1_000_000;
    /// Longer side at which a refinement on a GPU learns photos, pixels; on the processor it is at
    /// most 640.
    refine_side_max: u32 = 1_600;
    /// Bytes that a refinement may take on a GPU device; what needs more is refined on the
    /// processor.
    refine_device_bytes_max: u64 = 2 << 30;
    /// Milliseconds a caller may hold a request open with `wait_ms`.
    wait_ms_max: u64 = 600_000;
    /// Requests a second of one API key that says no number of its own; a second's worth at once.
    key_requests_per_s: u32 = 500;
    /// Calls of one API key that may be open at the same time, where it says no number of its own.
    key_inflight_max: usize = 128;
    /// Milliseconds one call to the store may take.
    store_timeout_ms: u64 = 60_000, restart;
    /// Milliseconds between two looks for what a crash left in the store.
    sweep_every_ms: u64 = 600_000;
    /// Milliseconds for which a replica believes what it read of a scene made elsewhere.
    record_fresh_ms: u64 = 1_000;
    /// Milliseconds between two heartbeats of a replica.
    replica_beat_ms: u64 = 2_000;
    /// Milliseconds without a heartbeat after which others make a replica's scenes.
    replica_lease_ms: u64 = 10_000;
    /// Resident bytes of the process beyond which uploads are refused as `overloaded`; 0: four
    /// fifths of what the machine or the container has.
    memory_bytes_max: u64 = 0, restart;
    /// Scenes on one page of a list.
    page_max: usize = 100;
    /// Gaussians in one scene, made of photos or read from a file.
    gaussians_max: usize = 16_777_216;
    /// Bytes that the Gaussians of a file that is sent may take in memory: what a small packed file
    /// with many of them meets. As many as `gaussians_max` of degree 0, 4.4 million of degree 3.
    splats_bytes_max: u64 = 1 << 30;
}

/// The limits in force. Who follows a reload reads them here at each use.
#[derive(Debug)]
pub struct LiveLimits {
    start: Limits,
    now: RwLock<Arc<Limits>>,
}

impl LiveLimits {
    /// The limits of the start.
    pub fn new(start: Limits) -> Self {
        Self { now: RwLock::new(Arc::new(start.clone())), start }
    }

    /// The limits now.
    pub fn get(&self) -> Arc<Limits> {
        Arc::clone(&self.now.read())
    }

    /// Puts others in force, but for those that count only after a restart; names those of them
    /// that differ.
    pub fn reload(&self, mut new: Limits) -> Vec<&'static str> {
        let later = new.hold_to_start(&self.start);
        *self.now.write() = Arc::new(new);
        later
    }
}

impl Limits {
    /// Holds a JSON text, called `what`, to its caps before anything is made of it.
    ///
    /// # Errors
    /// `limit_exceeded` with the number of bytes or values.
    pub fn check_json(&self, what: &str, json: &[u8]) -> Result<()> {
        let (bytes, max) = (json.len(), self.json_bytes_max);
        if bytes > max {
            let bytes = format!("{bytes} bytes of JSON");
            return Err(Error::limit(what, bytes, format!("{max} bytes")));
        }
        let (mut values, mut in_text, mut escaped) = (1_usize, false, false);
        for byte in json {
            match byte {
                _ if escaped => escaped = false,
                b'\\' => escaped = in_text,
                b'"' => in_text = !in_text,
                b',' | b':' | b'[' | b'{' if !in_text => values += 1,
                _ => {}
            }
        }
        let max = self.json_values_max;
        if values > max {
            return Err(Error::limit(what, format!("{values} values of JSON"), max));
        }
        Ok(())
    }
}
