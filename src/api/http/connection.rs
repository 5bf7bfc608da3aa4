//! A connection from its first byte to its last: HTTP/1.1 or HTTP/2, and the time limits of both.

use std::{
    io::{self, Cursor},
    pin::pin,
    time::Duration,
};

use axum::Router;
use hyper_util::{
    rt::{TokioExecutor, TokioIo, TokioTimer},
    server::conn::auto::Builder,
    service::TowerToHyperService,
};
use tokio::{
    io::{AsyncRead, AsyncReadExt, AsyncWrite, join, split},
    sync::watch,
    time::timeout,
};

/// The first bytes of HTTP/2. What begins otherwise is HTTP/1.
const PREFACE: [u8; 24] = *b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

/// Serves `app` on one connection until either side ends it, or `stopping` becomes true: then it
/// finishes its open calls.
///
/// A head that is not whole after `head_max` ends the connection, and so does a peer that answers
/// no HTTP/2 ping in that time.
pub(super) async fn serve<S>(
    mut stream: S,
    app: Router,
    head_max: Duration,
    mut stopping: watch::Receiver<bool>,
) where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let first = tokio::select! {
        first = timeout(head_max, first_bytes(&mut stream)) => first,
        () = stopped(&mut stopping) => return,
    };
    let Ok(Ok(first)) = first else { return };
    let (reader, writer) = split(stream);
    let stream = TokioIo::new(join(Cursor::new(first).chain(reader), writer));

    let mut builder = Builder::new(TokioExecutor::new());
    builder.http1().timer(TokioTimer::new()).header_read_timeout(head_max);
    let mut http2 = builder.http2();
    http2.timer(TokioTimer::new()).keep_alive_interval(head_max).keep_alive_timeout(head_max);
    let mut connection = pin!(builder.serve_connection(stream, TowerToHyperService::new(app)));
    let ended = tokio::select! {
        ended = connection.as_mut() => ended,
        () = stopped(&mut stopping) => {
            connection.as_mut().graceful_shutdown();
            connection.await
        }
    };
    if let Err(error) = ended {
        tracing::debug!(error = &*error, "a connection ended early");
    }
}

/// Resolves when the server stops. An error means that it has ended.
async fn stopped(stopping: &mut watch::Receiver<bool>) {
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
