//! A connection from its first byte to its last: HTTP/1.1 or HTTP/2, and the time limits of both.

use std::{
    io,
    pin::{Pin, pin},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};

use axum::{
    Router,
    body::{Body, Bytes},
};
use http_body::{Frame, SizeHint};
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::conn::auto::Builder,
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    sync::watch,
    time::{Sleep, sleep},
};

use crate::{
    error::{Error, ErrorCode},
    limits::Limits,
};

/// After this many bytes HTTP/1.1 and HTTP/2 differ, and the reader's own time limit begins.
const PREFACE_BYTES: usize = 24;

/// Serves `app` on one connection until either side ends it, or `stopping` becomes true: then it
/// finishes its open calls.
///
/// The connection ends if a head is not whole after `head_max`, or if the peer answers no HTTP/2
/// ping in that time.
pub(super) async fn serve<S>(
    stream: S,
    app: Router,
    head_max: Duration,
    mut stopping: watch::Receiver<bool>,
) where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let mut builder = Builder::new(TokioExecutor::new());
    builder.http1().timer(TokioTimer::new()).header_read_timeout(head_max);
    let mut http2 = builder.http2();
    http2.timer(TokioTimer::new()).keep_alive_interval(head_max).keep_alive_timeout(head_max);
    let stream = TokioIo::new(FirstBytes::new(stream, head_max));
    let mut connection = pin!(builder.serve_connection(stream, TowerToHyperService::new(app)));
    // An error means that the server has ended.
    let stopped = async { drop(stopping.wait_for(|&stopping| stopping).await) };
    let ended = tokio::select! {
        ended = connection.as_mut() => Some(ended),
        () = stopped => None,
    };
    let ended = match ended {
        Some(ended) => ended,
        None => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(error = &*error, "a connection ended early");
    }
}

/// A stream whose first bytes must come in time. The server's own limit on heads begins when it
/// knows the protocol. A silent caller never tells it.
struct FirstBytes<S> {
    stream: S,
    /// Runs until the protocol is known or something is answered.
    waiting: Option<Pin<Box<Sleep>>>,
    read: usize,
}

impl<S> FirstBytes<S> {
    fn new(stream: S, max: Duration) -> Self {
        Self { stream, waiting: Some(Box::pin(sleep(max))), read: 0 }
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for FirstBytes<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let filled = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(cx, buffer);
        self.read += buffer.filled().len() - filled;
        if self.read >= PREFACE_BYTES {
            self.waiting = None;
        }
        match &mut self.waiting {
            Some(waiting) if read.is_pending() => {
                waiting.as_mut().poll(cx).map(|()| Err(io::ErrorKind::TimedOut.into()))
            }
            _ => read,
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for FirstBytes<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        self.waiting = None;
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        self.waiting = None;
        Pin::new(&mut self.stream).poll_write_vectored(cx, bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

/// How fast the body of a request must come.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    /// Bytes that each `window` of waiting must bring.
    bytes: usize,
    window: Duration,
}

impl Pace {
    pub(super) fn new(limits: &Limits) -> Self {
        Self { bytes: limits.body_bytes_min, window: Duration::from_millis(limits.body_window_ms) }
    }

    /// The same body, which fails where it comes too slowly, and whether it did.
    pub(super) fn watch(self, body: Body) -> (Body, TooSlow) {
        let too_slow = TooSlow(Arc::default());
        if http_body::Body::is_end_stream(&body) {
            return (body, too_slow);
        }
        let paced = Paced { body, pace: self, waiting: None, came: 0, too_slow: too_slow.clone() };
        (Body::new(paced), too_slow)
    }

    /// What a caller is told whose body came too slowly.
    pub(super) fn error(self) -> Error {
        let (bytes, ms) = (self.bytes, self.window.as_millis());
        let message = format!("the body came too slowly: under {bytes} bytes in {ms} ms");
        Error::new(ErrorCode::DeadlineExceeded, message)
    }
}

/// Whether a body came too slowly.
#[derive(Clone, Debug)]
pub(super) struct TooSlow(Arc<AtomicBool>);

impl TooSlow {
    pub(super) fn get(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

/// A request's body that must come at a [`Pace`]; only the time that it is waited for counts.
struct Paced {
    body: Body,
    pace: Pace,
    waiting: Option<Pin<Box<Sleep>>>,
    /// Bytes since `waiting` began.
    came: usize,
    too_slow: TooSlow,
}

impl http_body::Body for Paced {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        if self.too_slow.get() {
            return Poll::Ready(None);
        }
        let frame = Pin::new(&mut self.body).poll_frame(cx);
        if let Poll::Ready(frame) = frame {
            if let Some(Ok(frame)) = &frame {
                self.came += frame.data_ref().map_or(0, Bytes::len);
            }
            if self.came >= self.pace.bytes {
                (self.came, self.waiting) = (0, None);
            }
            return Poll::Ready(frame);
        }
        let window = self.pace.window;
        let waiting = self.waiting.get_or_insert_with(|| Box::pin(sleep(window)));
        if waiting.as_mut().poll(cx).is_pending() {
            return Poll::Pending;
        }
        self.too_slow.0.store(true, Ordering::Release);
        Poll::Ready(Some(Err(axum::Error::new("too slow"))))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
