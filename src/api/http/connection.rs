//! A connection from its first byte to its last: HTTP/1.1 or HTTP/2, and the time limits of both.

use std::{
    io::{self, IoSlice},
    pin::{Pin, pin},
    task::{Context, Poll},
    time::Duration,
};

use axum::{Router, extract::Request, response::Response};
use hyper::{
    body::Incoming,
    server::conn::{http1, http2},
};
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::graceful::GracefulConnection,
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncReadExt, AsyncWrite, ReadBuf},
    sync::watch,
    time::timeout,
};
use tower::ServiceExt;

use super::{answers::Answers, body::Pace};
use crate::limits::Limits;

/// The first bytes of HTTP/2. What begins otherwise is HTTP/1.
const PREFACE: [u8; 24] = *b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// How long a connection waits for its peer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    /// For a handshake, for the head of a request, for the answer to an HTTP/2 ping.
    pub(super) head_max: Duration,
    /// For an answer to be taken.
    answers: Pace,
}

impl Patience {
    pub(super) fn new(limits: &Limits) -> Self {
        let head_max = Duration::from_millis(limits.head_timeout_ms);
        Self { head_max, answers: Pace::of_answers(limits) }
    }
}

/// Serves `app` on one connection until either side ends it, or `stopping` becomes true: then it
/// finishes its open calls.
///
/// A head that is not whole in time ends the connection, and so does a peer that answers no HTTP/2
/// ping in time, or takes an answer too slowly.
pub(super) async fn serve<S>(
    mut stream: S,
    app: Router,
    patience: Patience,
    mut stopping: watch::Receiver<bool>,
) where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let head_max = patience.head_max;
    let first = tokio::select! {
        first = timeout(head_max, first_bytes(&mut stream)) => first,
        () = stopped(&mut stopping) => return,
    };
    let Ok(Ok(first)) = first else { return };
    let is_http2 = first == PREFACE;
    let answers = Answers::new(patience.answers);
    let owner = answers.clone();
    let app = ServiceExt::<Request<Incoming>>::map_response(app, move |answer: Response| {
        owner.own(answer)
    });
    let (stream, app) = (TokioIo::new(Reread { first, stream }), TowerToHyperService::new(app));
    if is_http2 {
        let mut builder = http2::Builder::new(TokioExecutor::new());
        builder.timer(TokioTimer::new());
        builder.keep_alive_interval(head_max).keep_alive_timeout(head_max);
        run(builder.serve_connection(stream, app), &answers, stopping).await;
    } else {
        let mut builder = http1::Builder::new();
        builder.timer(TokioTimer::new()).header_read_timeout(head_max);
        run(builder.serve_connection(stream, app), &answers, stopping).await;
    }
}

/// Runs a connection to its end. After an answer that is taken too slowly it takes no new calls;
/// the other open ones have a moment to end.
async fn run<C>(connection: C, answers: &Answers, mut stopping: watch::Receiver<bool>)
where
    C: GracefulConnection<Error = hyper::Error>,
{
    let mut connection = pin!(connection);
    let ended = tokio::select! {
        ended = connection.as_mut() => Some(ended),
        () = stopped(&mut stopping) => None,
        () = answers.too_slow() => None,
    };
    let ended = match ended {
        Some(ended) => ended,
        None => {
            connection.as_mut().graceful_shutdown();
            tokio::select! {
                ended = connection => ended,
                () = answers.only_slow() => {
                    tracing::debug!("a connection is closed: its caller takes too little");
                    return;
                }
            }
        }
    };
    if let Err(error) = ended {
        tracing::debug!(error = &error as &dyn std::error::Error, "a connection ended early");
    }
}

/// Resolves when the server stops. An error means that it has ended.
pub(super) async fn stopped(stopping: &mut watch::Receiver<bool>) {
    let _ = stopping.wait_for(|&stopping| stopping).await;
}

/// Reads until the protocol is known. The server's own time limits begin only then, so a silent
/// caller would stay for ever.
async fn first_bytes(stream: &mut (impl AsyncRead + Unpin)) -> io::Result<Vec<u8>> {
    let mut first = Vec::new();
    let mut piece = [0; PREFACE.len()];
    while first.len() < PREFACE.len() && PREFACE.starts_with(&first) {
        match stream.read(&mut piece[first.len()..]).await? {
            0 => break,
            read => first.extend_from_slice(&piece[first.len()..][..read]),
        }
    }
    Ok(first)
}

/// A stream of which the first bytes were read already.
struct Reread<S> {
    first: Vec<u8>,
    stream: S,
}

impl<S: AsyncRead + Unpin> AsyncRead for Reread<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        to: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.first.is_empty() {
            return Pin::new(&mut self.stream).poll_read(cx, to);
        }
        let count = self.first.len().min(to.remaining());
        to.put_slice(&self.first[..count]);
        self.first.drain(..count);
        Poll::Ready(Ok(()))
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Reread<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        pieces: &[IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write_vectored(cx, pieces)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }
}
