//! One port for HTTP and gRPC, plain or TLS, and an orderly end.

use std::{future::Future, io, pin::pin, time::Duration};

use axum::{
    Router,
    serve::{Listener, ListenerExt},
};
use tokio::{
    net::{TcpListener, TcpStream},
    sync::watch,
};

use super::{
    app,
    connection::{self, Patience},
    tls::Tls,
};
use crate::{api::Api, config::Config, error::Result, service::Service};

/// How long connections without a call may take to close.
const CLOSING: Duration = Duration::from_millis(200);
/// Bytes of answers that the system takes before it has sent them. By default it takes megabytes at
/// once, so that a caller who takes them slowly would look like one who takes nothing.
#[cfg(target_os = "linux")]
const UNSENT_BYTES: u32 = 256 << 10;

/// HTTP and gRPC, ready to be served. Cloning shares everything.
#[derive(Clone, Debug)]
pub struct Server {
    api: Api,
    app: Router,
    tls: Option<Tls>,
}

impl Server {
    /// Serves `service` with the keys, the certificate and the limits of its configuration.
    ///
    /// # Errors
    /// `invalid_request` when keys, certificate or origins cannot be used.
    ///
    /// # Panics
    /// Outside of a tokio runtime.
    pub fn new(service: Service) -> Result<Self> {
        let tls = Tls::new(service.config())?;
        let api = Api::new(service)?;
        Ok(Self { app: app(&api)?, api, tls })
    }

    /// Puts keys, limits and certificate of `config` in force: all of them, or on an error none.
    ///
    /// # Errors
    /// `invalid_request` when keys or certificate cannot be used.
    pub fn reload(&self, config: &Config) -> Result<()> {
        // All are read before the first of them is changed.
        let put_tls = self.tls.as_ref().map(|tls| tls.read_again(config)).transpose()?;
        let put_others = self.api.read_again(config)?;
        if let Some(put_tls) = put_tls {
            put_tls();
        }
        put_others();
        Ok(())
    }

    /// Serves on `listener` until `stop` resolves, then drains: not ready any more, after
    /// `drain_notice_ms` no new calls, open ones get `drain_ms` to end.
    ///
    /// # Errors
    /// `internal` when the listener fails.
    pub async fn serve(
        self,
        listener: TcpListener,
        stop: impl Future<Output = ()> + Send + 'static,
    ) -> Result<()> {
        let mut listener = listener.tap_io(|stream| {
            if let Err(error) = prepare(stream) {
                tracing::debug!(%error, "an option of a socket is refused");
            }
        });
        let patience = Patience::new(&self.api.service.limits());
        let drained = async {
            stop.await;
            drain(&self.api).await;
        };
        let mut drained = pin!(drained);
        let (stopping, stopped) = watch::channel(false);
        loop {
            let (stream, _) = tokio::select! {
                accepted = listener.accept() => accepted,
                () = &mut drained => break,
            };
            let (app, tls) = (self.app.clone(), self.tls.clone());
            tokio::spawn(serve_one(stream, tls, app, patience, stopped.clone()));
        }
        drop((listener, stopped));
        stopping.send_replace(true);
        // The open calls had `drain_ms` to end.
        let _ = tokio::time::timeout(CLOSING, stopping.closed()).await;
        Ok(())
    }
}

fn prepare(stream: &TcpStream) -> io::Result<()> {
    // Nagle's algorithm against delayed acknowledgements costs a unary call 45 ms.
    stream.set_nodelay(true)?;
    #[cfg(target_os = "linux")]
    socket2::SockRef::from(stream).set_tcp_notsent_lowat(UNSENT_BYTES)?;
    Ok(())
}

/// Serves one connection, after its handshake where there is TLS.
async fn serve_one(
    stream: TcpStream,
    tls: Option<Tls>,
    app: Router,
    patience: Patience,
    mut stopping: watch::Receiver<bool>,
) {
    let Some(tls) = tls else { return connection::serve(stream, app, patience, stopping).await };
    let stream = tokio::select! {
        stream = tls.handshake(stream, patience.head_max) => stream,
        () = connection::stopped(&mut stopping) => None,
    };
    if let Some(stream) = stream {
        connection::serve(stream, app, patience, stopping).await;
    }
}

/// First the server is not ready, then it refuses new calls, then it waits for the open ones.
async fn drain(api: &Api) {
    let config = api.service.config();
    api.drain.begin();
    if config.drain_notice_ms > 0 {
        tracing::info!(ms = config.drain_notice_ms, "not ready any more; still serving");
        tokio::time::sleep(Duration::from_millis(config.drain_notice_ms)).await;
    }
    api.drain.refuse_calls();
    api.service.stop_waiting();
    let open_calls = api.drain.open_calls();
    if open_calls > 0 {
        tracing::info!(open_calls, ms = config.drain_ms, "draining");
    }
    if !api.drain.wait_for_calls(Duration::from_millis(config.drain_ms)).await {
        tracing::warn!(open_calls = api.drain.open_calls(), "calls are cut off: drain_ms is over");
    }
    let refused = api.drain.refused();
    if refused > 0 {
        tracing::info!(refused, "calls were refused while the server stopped");
    }
}
