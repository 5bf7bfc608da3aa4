//! The page: the files of `web` as one HTML document, for the server, or with a scene in it for a
//! disk. Its policy names its one script and its one style by their hashes, so that nothing else
//! runs.

use std::{
    io::{self, Write},
    sync::LazyLock,
};

use base64::{Engine as _, prelude::BASE64_STANDARD, write::EncoderWriter};
use sha2::{Digest, Sha256};
use tokio::sync::OnceCell;

use super::{shared::Service, tasks::blocking, types::QueryAnswer};
use crate::{
    error::{Error, ErrorCode, Result},
    formats::{packed::write_packed, table::ExportFormat},
    render::plan::default_near,
    sample::{self, SampleOptions},
    scene::Scene,
};

const SHELL: &str = include_str!("../../web/index.html");
const STYLE: &str = include_str!("../../web/page.css");
const SCRIPT: &str = concat!(
    include_str!("../../web/words.js"),
    include_str!("../../web/math.js"),
    include_str!("../../web/scene.js"),
    include_str!("../../web/draw.js"),
    include_str!("../../web/film.js"),
    include_str!("../../web/server.js"),
    include_str!("../../web/video.js"),
    include_str!("../../web/capture.js"),
    include_str!("../../web/state.js"),
    include_str!("../../web/canvas.js"),
    include_str!("../../web/find.js"),
    include_str!("../../web/edits.js"),
    include_str!("../../web/scenes.js"),
    include_str!("../../web/ways.js"),
    include_str!("../../web/keep.js"),
    include_str!("../../web/vr.js"),
    include_str!("../../web/page.js"),
);

/// The page without a scene, and its policy.
#[derive(Debug)]
pub struct ViewerPage {
    /// The document.
    pub html: String,
    /// Its Content-Security-Policy, but for who may show it in a frame. Styles and scripts that
    /// are not the page's own do not run.
    pub policy: String,
}

/// The page of the server.
pub static VIEWER: LazyLock<ViewerPage> = LazyLock::new(|| {
    let policy = format!("{}; form-action 'self'", policy("'self'"));
    ViewerPage { html: around_data().concat().replace("<!--policy-->", ""), policy }
});

/// What the page offers for a first try.
const SAMPLE: SampleOptions = SampleOptions { photos: 6, width: 400, height: 300, seed: 1 };

impl Service {
    /// Generated photos of a room with their cameras, as a zip that is an upload. Made when it is
    /// first asked for.
    ///
    /// # Errors
    /// `internal` where it cannot be made.
    pub async fn sample(&self) -> Result<&'static [u8]> {
        static ZIP: OnceCell<Vec<u8>> = OnceCell::const_new();
        let made = async || blocking(|| sample::archive(&SAMPLE)).await?;
        ZIP.get_or_try_init(made).await.map(Vec::as_slice)
    }
}

/// What the page may do; `connect` is where it may call.
fn policy(connect: &str) -> String {
    let hash = |text: &str| format!("'sha256-{}'", BASE64_STANDARD.encode(Sha256::digest(text)));
    let (script, style) = (hash(SCRIPT), hash(STYLE));
    format!(
        "default-src 'none'; script-src {script}; style-src {style}; worker-src blob:; \
         img-src 'self' blob: data:; media-src blob:; connect-src {connect}; base-uri 'none'"
    )
}

/// The document before and after the place of a scene.
fn around_data() -> [String; 2] {
    let (start, end) = SHELL.split_once("<!--scene-->").unwrap_or((SHELL, ""));
    let splats = ExportFormat::listed(|format| format.is_splats(), |row| row.title);
    let filled = |part: &str| {
        let part = part.replace("<!--formats-->", &options()).replace("<!--splats-->", &splats);
        part.replace("/*style*/", STYLE).replace("/*script*/", SCRIPT)
    };
    [filled(start), filled(end)]
}

/// The formats of exports for the page's list: the ending of files of Gaussians, which the page
/// takes too, and whether the file shows texts.
fn options() -> String {
    let option = |format: ExportFormat| {
        let data = match format.is_splats() {
            true => format!(r#" data-splats="{}""#, format.ending),
            false if format.lines => " data-lines".to_owned(),
            false => String::new(),
        };
        format!(r#"<option value="{format}"{data}>{}</option>"#, format.title)
    };
    ExportFormat::all().map(option).collect()
}

/// Writes the page with a scene, and what some texts found in it.
pub(super) fn write_page(
    scene: &Scene,
    texts: Option<&QueryAnswer>,
    to: &mut dyn Write,
) -> Result<()> {
    let unwritten = |cause: io::Error| {
        Error::new(ErrorCode::StoreUnavailable, "the page cannot be written").caused_by(cause)
    };
    let texts = serde_json::to_string(&texts)
        .map_err(|e| Error::internal("the texts have no JSON").caused_by(e))?;
    let policy = policy("'none'");
    let meta = format!(r#"<meta http-equiv="Content-Security-Policy" content="{policy}">"#);
    let [start, end] = around_data();
    let mut put = |text: &str| to.write_all(text.as_bytes()).map_err(unwritten);
    put(&start.replace("<!--policy-->", &meta))?;
    // A text cannot end the element that it stands in.
    put(r#"<script type="application/json" id="texts">"#)?;
    put(&texts.replace('<', "\\u003c"))?;
    put(r#"</script><script type="application/octet-stream" id="packed">"#)?;
    let mut coded = EncoderWriter::new(&mut *to, &BASE64_STANDARD);
    write_packed(scene, default_near(scene.meta.report.median_depth), None, &mut coded)?;
    coded.finish().map_err(unwritten)?;
    drop(coded);
    to.write_all(b"</script>").and_then(|()| to.write_all(end.as_bytes())).map_err(unwritten)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_one_small_file_whose_policy_allows_its_own_script_alone() {
        let ViewerPage { html, policy } = &*VIEWER;
        assert!(html.len() <= 200 << 10, "{} bytes", html.len());
        assert!(!policy.contains("unsafe") && !policy.contains("http"), "{policy}");
        for (open, close) in [("<style>", "</style>"), ("<script type=\"module\">", "</script>")] {
            let (_, rest) = html.split_once(open).unwrap();
            let (text, _) = rest.split_once(close).unwrap();
            let hash = BASE64_STANDARD.encode(Sha256::digest(text));
            assert!(policy.contains(&format!("'sha256-{hash}'")), "{open}");
        }
        for mark in ["<!--", "/*style*/", "/*script*/", "://", " style="] {
            // Names of XML languages are no addresses.
            let html = html.replace("http://www.w3.org/", "");
            assert!(!html.contains(mark), "{mark}");
        }
    }
}
