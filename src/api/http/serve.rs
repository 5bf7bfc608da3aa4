//! One port for HTTP and gRPC, plain or TLS, and an orderly end.

use std::{future::Future, pin::pin, time::Duration};

use axum::{
    Router,
    serve::{Listener, ListenerExt},
};
use tokio::{net::TcpListener, sync::watch};

use super::{app, connection, tls::Tls};
use crate::{api::Api, config::Config, error::Result, service::Service};

/// How long connections without a call may take to close.
const CLOSING: Duration = Duration::from_millis(200);

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
        // Nagle's algorithm against delayed acknowledgements costs a unary call 45 ms.
        let listener = listener.tap_io(|stream| {
            if let Err(error) = stream.set_nodelay(true) {
                tracing::debug!(%error, "TCP_NODELAY refused");
            }
        });
        match &self.tls {
            None => run(listener, self.app, self.api, stop).await,
            Some(tls) => run(tls.listen(listener)?, self.app, self.api, stop).await,
        }
    }
}

async fn run<L: Listener>(
    mut listener: L,
    app: Router,
    api: Api,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<()> {
    let head_max = Duration::from_millis(api.service.limits().head_timeout_ms);
    let drained = async {
        stop.await;
        drain(&api).await;
    };
    let mut drained = pin!(drained);
    let (stopping, stopped) = watch::channel(false);
    loop {
        let (stream, _) = tokio::select! {
            accepted = listener.accept() => accepted,
            () = &mut drained => break,
        };
        tokio::spawn(connection::serve(stream, app.clone(), head_max, stopped.clone()));
    }
    drop((listener, stopped));
    stopping.send_replace(true);
    // The open calls had `drain_ms` to end.
    let _ = tokio::time::timeout(CLOSING, stopping.closed()).await;
    Ok(())
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
    let open_calls = api.drain.open_calls();
    if open_calls > 0 {
        tracing::info!(open_calls, ms = config.drain_ms, "draining");
    }
    if !api.drain.wait_for_calls(Duration::from_millis(config.drain_ms)).await {
        tracing::warn!(open_calls = api.drain.open_calls(), "calls are cut off: drain_ms is over");
    }
}
