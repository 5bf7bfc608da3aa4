//! Every limit in one place, with its unit and its reason. The server's configuration file sets
//! them.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// Bytes of an idempotency key: what a UUID and a prefix need many times over.
pub const IDEMPOTENCY_KEY_BYTES_MAX: usize = 256;

/// Rows of a semantic bank: a busy photo has a hundred masks, so this is never met by photos; it
/// bounds what the products of all pairs of rows take.
pub const BANK_ROWS_MAX: usize = 4_096;

/// [`Limits::layers_cache_bytes_max`] unless something else is said.
pub const LAYERS_CACHE_BYTES_MAX: u64 = 512 << 20;

/// [`Limits::magnified_cache_bytes_max`] unless something else is said.
pub const MAGNIFIED_CACHE_BYTES_MAX: u64 = 256 << 20;

/// Caps on what a caller may send or ask for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Limits {
    /// Photos in one scene: the pipeline's time grows with their number.
    pub photos_max: usize,
    /// Fewest photos that give parallax.
    pub photos_min: usize,
    /// Bytes of one upload, all parts together.
    pub upload_bytes_max: usize,
    /// Bytes of all uploads being received; one more byte is refused as `overloaded`.
    pub uploads_bytes_max: usize,
    /// Bytes of one JSON part (`transforms`, `cameras`) or JSON body.
    pub json_bytes_max: usize,
    /// Values in one JSON part or body, counted before it is read: eight megabytes of empty objects
    /// would take hundreds of megabytes. 64 cameras have some 2,000.
    pub json_values_max: usize,
    /// Pixels of one photo, read from the header before decoding.
    pub photo_pixels_max: u64,
    /// Longer side in pixels to which a photo is reduced after decoding: no stage looks closer, and
    /// it bounds the memory of a full upload.
    pub photo_side_kept_max: u32,
    /// Entries in an archive, files and folders alike.
    pub archive_entries_max: usize,
    /// Bytes of one archive unpacked: what a zip bomb meets.
    pub archive_unpacked_bytes_max: u64,
    /// Length of a photo's file name in bytes.
    pub file_name_bytes_max: usize,
    /// Width or height of a rendered view in pixels.
    pub view_side_max: u32,
    /// Cameras in one `views` request.
    pub cameras_max: usize,
    /// Kinds of picture in one `views` request.
    pub kinds_max: usize,
    /// Texts in one `query` request, and labels in one `pick`.
    pub texts_max: usize,
    /// Characters of one text: more than any noun phrase needs.
    pub text_chars_max: usize,
    /// Milliseconds a text waits for semantics that are being made, unless it says how long.
    pub text_wait_ms: u64,
    /// Embeddings of texts kept in memory, those asked last: a few kilobytes each.
    pub texts_cached_max: usize,
    /// Bytes of banks kept in memory ready to be scored.
    pub scorers_cache_bytes_max: u64,
    /// Bytes of views' semantic entries kept in memory, so that the next text draws nothing.
    pub entries_cache_bytes_max: u64,
    /// Bytes of layers kept for views to come: three camera sets of a scene of sixteen photos.
    pub layers_cache_bytes_max: u64,
    /// Bytes of magnified Gaussians kept for views to come: thirty views of a scene of two photos.
    pub magnified_cache_bytes_max: u64,
    /// Memory of the connected pieces of scenes that were asked for boxes, bytes.
    pub pieces_cache_bytes_max: u64,
    /// Parts of one text's selection that an answer lists, the largest first.
    pub parts_max: usize,
    /// Bytes of photos that the create call read, kept in memory for the jobs of their scenes. A
    /// job whose photos do not fit reads them again.
    pub read_uploads_bytes_max: u64,
    /// Jobs that wait; one more is refused as `overloaded`.
    pub queued_jobs_max: usize,
    /// Renders at work or waiting; one more is refused as `overloaded`.
    pub queued_renders_max: usize,
    /// Pixels of renders at work or waiting. One render may take a quarter of what is left, so that
    /// large views leave room for small ones; else it is refused as `overloaded`.
    pub queued_pixels_max: u64,
    /// Pixels of renders at work: being drawn or encoded, some 20 to 30 bytes each. A larger view
    /// is drawn alone.
    pub active_pixels_max: u64,
    /// Pixels of all pictures of one `views` request.
    pub views_pixels_max: u64,
    /// Milliseconds one `views` request may take.
    pub views_timeout_ms: u64,
    /// Bytes of scenes kept in memory.
    pub cache_bytes_max: u64,
    /// Bytes of scenes kept on one GPU device: what a card of 8 GB has to spare beside its frames.
    pub device_scene_bytes_max: u64,
    /// Milliseconds in which the head of a request must come, from the connection's start or the
    /// end of the call before it. A connection that sends none in this time is closed.
    pub head_timeout_ms: u64,
    /// Bytes that a request's body must bring in each `body_window_ms` that it is waited for.
    pub body_bytes_min: usize,
    /// Milliseconds in which `body_bytes_min` must come: half a kilobyte a second, unless set.
    pub body_window_ms: u64,
    /// Milliseconds one render may take.
    pub render_timeout_ms: u64,
    /// Milliseconds one scene may take.
    pub scene_timeout_ms: u64,
    /// Milliseconds a caller may hold a request open with `wait_ms`.
    pub wait_ms_max: u64,
    /// Requests a second of one API key that says no number of its own; a second's worth at once.
    pub key_requests_per_s: u32,
    /// Calls of one API key that may be open at the same time, where it says no number of its own.
    pub key_inflight_max: usize,
    /// Milliseconds one call to the store may take.
    pub store_timeout_ms: u64,
    /// Milliseconds between two looks for what a crash left in the store.
    pub sweep_every_ms: u64,
    /// Milliseconds for which a replica believes what it read of a scene made elsewhere.
    pub record_fresh_ms: u64,
    /// Milliseconds between two heartbeats of a replica.
    pub replica_beat_ms: u64,
    /// Milliseconds without a heartbeat after which others make a replica's scenes.
    pub replica_lease_ms: u64,
    /// Resident bytes of the process beyond which uploads are refused as `overloaded`; 0: four
    /// fifths of what the machine or the container has.
    pub memory_bytes_max: u64,
    /// Scenes on one page of a list.
    pub page_max: usize,
    /// Gaussians in one scene, made or imported.
    pub gaussians_max: usize,
}

impl Limits {
    /// Holds a JSON text, called `what`, to its caps before anything is made of it.
    ///
    /// # Errors
    /// `limit_exceeded` with the number of bytes or values.
    pub fn check_json(&self, what: &str, json: &[u8]) -> Result<()> {
        let (bytes, max) = (json.len(), self.json_bytes_max);
        if bytes > max {
            return Err(Error::limit(
                what,
                format!("{bytes} bytes of JSON"),
                format!("{max} bytes"),
            ));
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

    /// Names of the caps that size something made at start: a changed one needs a restart.
    #[must_use]
    pub fn changed_for_next_start(&self, new: &Self) -> Vec<&'static str> {
        let mut names = Vec::new();
        macro_rules! compare {
            ($($field:ident),*) => {
                $(if self.$field != new.$field { names.push(stringify!($field)); })*
            };
        }
        compare!(
            uploads_bytes_max,
            texts_cached_max,
            scorers_cache_bytes_max,
            entries_cache_bytes_max,
            read_uploads_bytes_max,
            queued_jobs_max,
            queued_renders_max,
            active_pixels_max,
            head_timeout_ms,
            body_bytes_min,
            body_window_ms,
            cache_bytes_max,
            scene_timeout_ms
        );
        names
    }
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            photos_max: 64,
            photos_min: 2,
            upload_bytes_max: 256 << 20,
            uploads_bytes_max: 1 << 30,
            json_bytes_max: 8 << 20,
            json_values_max: 250_000,
            photo_pixels_max: 24_000_000,
            photo_side_kept_max: 2_048,
            archive_entries_max: 1_024,
            archive_unpacked_bytes_max: 512 << 20,
            file_name_bytes_max: 256,
            view_side_max: 4_096,
            cameras_max: 64,
            kinds_max: 8,
            texts_max: 128,
            text_chars_max: 256,
            text_wait_ms: 120_000,
            texts_cached_max: 4_096,
            scorers_cache_bytes_max: 512 << 20,
            entries_cache_bytes_max: 512 << 20,
            layers_cache_bytes_max: LAYERS_CACHE_BYTES_MAX,
            magnified_cache_bytes_max: MAGNIFIED_CACHE_BYTES_MAX,
            pieces_cache_bytes_max: 128 << 20,
            parts_max: 64,
            read_uploads_bytes_max: 512 << 20,
            queued_jobs_max: 64,
            queued_renders_max: 256,
            queued_pixels_max: 256 << 20,
            active_pixels_max: 64 << 20,
            views_pixels_max: 512 << 20,
            views_timeout_ms: 300_000,
            cache_bytes_max: 4 << 30,
            device_scene_bytes_max: 2 << 30,
            head_timeout_ms: 10_000,
            body_bytes_min: 8 << 10,
            body_window_ms: 16_000,
            render_timeout_ms: 30_000,
            scene_timeout_ms: 600_000,
            wait_ms_max: 600_000,
            key_requests_per_s: 500,
            key_inflight_max: 128,
            store_timeout_ms: 60_000,
            sweep_every_ms: 600_000,
            record_fresh_ms: 1_000,
            replica_beat_ms: 2_000,
            replica_lease_ms: 10_000,
            memory_bytes_max: 0,
            page_max: 100,
            gaussians_max: 16_777_216,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_a_json_text_are_counted_outside_of_its_strings() {
        let limits = |json_values_max| Limits { json_values_max, ..Limits::default() };
        for (json, count) in [
            ("7", 1),
            ("[1,2,3]", 4),
            (r#"{"a":[{},{}],"b":"[,:{"}"#, 9),
            (r#""\",[\\""#, 1),
            (r#"["\\",2]"#, 3),
        ] {
            limits(count).check_json("x", json.as_bytes()).expect(json);
            let error = limits(count - 1).check_json("x", json.as_bytes()).unwrap_err();
            assert!(error.message().contains(&format!("{count} values")), "{json}: {error}");
        }
    }
}
