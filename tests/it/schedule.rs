//! Views at the same time: which are drawn, in which order, and which are refused.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use futures_util::StreamExt;
use segsplat::{
    error::{ErrorCode, Result},
    render::{Frame, RenderRequest, Renderer},
    scene::{Gaussians, SceneId},
    service::{PictureKind, ViewOptions, ViewSpec, ViewsSpec},
};

use crate::common::server::{PATIENCE, PointRenderer, TestServer, first_view};

/// Side of a large view, pixels.
pub(crate) const LARGE: u32 = 1024;

/// [`PointRenderer`] that draws `concurrency` views at the same time, and holds large ones back
/// until it is told to go on.
#[derive(Debug, Default)]
pub(crate) struct HoldingRenderer {
    pub(crate) concurrency: usize,
    pub(crate) go_on: AtomicBool,
    /// Views being drawn now, and the most there were.
    pub(crate) drawing: AtomicUsize,
    pub(crate) most: AtomicUsize,
    /// Views that were begun.
    pub(crate) begun: AtomicUsize,
}

impl Renderer for HoldingRenderer {
    fn name(&self) -> String {
        PointRenderer.name()
    }

    fn concurrency(&self) -> usize {
        self.concurrency
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let drawing = self.drawing.fetch_add(1, Ordering::AcqRel) + 1;
        self.most.fetch_max(drawing, Ordering::AcqRel);
        self.begun.fetch_add(1, Ordering::AcqRel);
        let begun = Instant::now();
        let large = request.camera.intrinsics.width >= LARGE;
        while large && !self.go_on.load(Ordering::Acquire) && begun.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(1));
        }
        let frame = PointRenderer.render(gaussians, request);
        self.drawing.fetch_sub(1, Ordering::AcqRel);
        frame
    }
}

pub(crate) fn sized(side: u32) -> ViewSpec {
    let options = ViewOptions { width: Some(side), height: Some(side), ..ViewOptions::default() };
    ViewSpec { options, ..first_view() }
}

fn many(spec: &ViewSpec, cameras: usize, kinds: &[PictureKind]) -> ViewsSpec {
    ViewsSpec {
        cameras: vec![spec.camera; cameras],
        kinds: kinds.to_vec(),
        options: spec.options.clone(),
        picture: spec.picture.clone(),
        text: spec.text.clone(),
    }
}

async fn server(
    renderer: &Arc<HoldingRenderer>,
    change: impl FnOnce(&mut segsplat::limits::Limits),
) -> (TestServer, SceneId) {
    let given = Arc::clone(renderer);
    let server = TestServer::with(|config, parts| {
        parts.renderer = given;
        change(&mut config.limits);
    })
    .await;
    let id = server.scene().await.id;
    (server, id)
}

#[tokio::test(flavor = "multi_thread")]
async fn large_views_do_not_starve_a_small_one() {
    let renderer = Arc::new(HoldingRenderer { concurrency: 1, ..HoldingRenderer::default() });
    let (server, id) = server(&renderer, |limits| limits.queued_pixels_max = 16 << 20).await;
    let (answered, refused) = (AtomicUsize::new(0), AtomicUsize::new(0));
    let large = async {
        let each = (0..32).map(|_| async {
            match server.service.render(&id, sized(LARGE)).await {
                Ok(_) => answered.fetch_add(1, Ordering::AcqRel),
                Err(error) => {
                    assert_eq!(
                        (error.code(), error.retry_after()),
                        (ErrorCode::Overloaded, Some(1))
                    );
                    refused.fetch_add(1, Ordering::AcqRel)
                }
            }
        });
        futures_util::future::join_all(each).await;
    };
    let small = async {
        while refused.load(Ordering::Acquire) == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        for _ in 0..8 {
            server.service.render(&id, sized(64)).await.expect("a small view is drawn");
        }
        assert_eq!(answered.load(Ordering::Acquire), 0, "before every large one");
        renderer.go_on.store(true, Ordering::Release);
    };
    tokio::join!(large, small);
    let (answered, refused) = (answered.into_inner(), refused.into_inner());
    assert!(answered >= 4 && answered + refused == 32, "{answered} answered, {refused} refused");
}

#[tokio::test(flavor = "multi_thread")]
async fn views_of_one_call_reach_the_renderer_together_and_come_in_their_order() {
    let renderer = Arc::new(HoldingRenderer { concurrency: 4, ..HoldingRenderer::default() });
    let (server, id) = server(&renderer, |_| ()).await;
    let pictures =
        server.service.render_many(&id, &many(&sized(LARGE), 5, &[PictureKind::Color])).await;
    let let_go = async {
        let begun = Instant::now();
        while renderer.drawing.load(Ordering::Acquire) < 4 && begun.elapsed() < PATIENCE / 6 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        renderer.go_on.store(true, Ordering::Release);
    };
    let (pictures, ()) =
        tokio::join!(pictures.expect("a good request").collect::<Vec<_>>(), let_go);
    let order: Vec<_> =
        pictures.into_iter().map(|view| view.expect("a view").camera_index).collect();
    assert_eq!(order, [0, 1, 2, 3, 4]);
    assert_eq!(renderer.most.load(Ordering::Acquire), 4, "as many as the renderer draws at once");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_call_for_many_views_has_a_bound_of_pixels_and_of_time() {
    let renderer = Arc::new(HoldingRenderer { concurrency: 1, ..HoldingRenderer::default() });
    let (server, id) = server(&renderer, |limits| limits.views_timeout_ms = 0).await;
    let kinds = [PictureKind::Color, PictureKind::Depth, PictureKind::Alpha];
    let refused = server.service.render_many(&id, &many(&sized(4096), 64, &kinds)).await;
    let error = refused.err().expect("3.2 billion pixels");
    assert_eq!(error.code(), ErrorCode::LimitExceeded);
    assert!(error.message().contains("64 cameras, 3 kinds: 3221225472 px"), "{error}");
    let views = server.service.render_many(&id, &many(&sized(64), 3, &kinds)).await;
    let answers: Vec<_> = views.expect("a small request").collect().await;
    let codes: Vec<_> = answers.into_iter().map(|view| view.map_err(|e| e.code()).err()).collect();
    assert_eq!(codes, [Some(ErrorCode::DeadlineExceeded)], "no time for all together");
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_more_is_drawn_for_a_caller_who_has_gone() {
    let renderer = Arc::new(HoldingRenderer { concurrency: 1, ..HoldingRenderer::default() });
    let (server, id) = server(&renderer, |limits| limits.render_timeout_ms = 600_000).await;
    let pictures =
        server.service.render_many(&id, &many(&sized(LARGE), 8, &[PictureKind::Color])).await;
    let pictures = pictures.expect("a good request");
    let until = |done: &dyn Fn() -> bool| {
        let begun = Instant::now();
        while !done() {
            assert!(begun.elapsed() < PATIENCE / 2, "it is not so yet");
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    // One is drawn, and the next one of the call waits behind it.
    until(&|| renderer.begun.load(Ordering::Acquire) == 1);
    until(&|| server.service.ready().renders == 2);
    drop(pictures);
    until(&|| server.service.ready().renders == 1);
    renderer.go_on.store(true, Ordering::Release);
    until(&|| server.service.ready().renders == 0);
    assert_eq!(renderer.begun.load(Ordering::Acquire), 1);
}
