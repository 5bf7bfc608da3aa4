//! `segsplat serve`: both doors on one port until SIGTERM or Ctrl-C.

use std::{fmt::Write as _, sync::Arc};

use serde_json::json;
use tokio::net::TcpListener;

use super::{engine, output::Output};
use crate::{
    api::Doors,
    config::{AllArgs, Config},
    error::{Error, ErrorCode, Result},
    pipeline::PipelineLoader,
    service::Service,
    store::Place,
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pub(super) config: AllArgs,
    /// Print the configuration in force as JSON and stop
    #[arg(long)]
    print_config: bool,
}

/// `read_again` gives the configuration as the files say now.
pub(super) fn run(
    args: &Args,
    config: Config,
    read_again: impl Fn() -> Result<Config> + Send + 'static,
    out: &Output,
) -> Result<()> {
    if args.print_config {
        let text = serde_json::to_string_pretty(&config)
            .map_err(|e| Error::internal("the configuration is no JSON").caused_by(e))?;
        return out.answer(&text, &config);
    }
    config.check_doors()?;
    let (parts, engine) = engine::early_parts(&config)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|e| Error::internal("the async runtime does not start").caused_by(e))?;
    let (models, data_dir) = (parts.models.clone(), config.data_dir.clone());
    let scheme = if config.tls_cert.is_some() { "https" } else { "http" };
    let (renderer, listen) = (parts.renderer.name(), config.listen);
    let service = Service::open(&Place::of(&config)?, config, parts)?;
    let served = runtime.block_on(async {
        let listener = TcpListener::bind(listen).await.map_err(|e| {
            Error::invalid(format!("listen: {listen} cannot be used: {e}")).caused_by(e)
        })?;
        let address = listener
            .local_addr()
            .map_err(|e| Error::internal("the listener has no address").caused_by(e))?;
        let doors = Doors::new(service.clone())?;
        let (bundle, sha256) = (&models.bundle, models.bundle_sha256.get(..12).unwrap_or_default());
        tracing::info!(
            %address,
            renderer,
            bundle,
            bundle_sha256 = sha256,
            data_dir = %data_dir.display(),
            "serving HTTP and gRPC"
        );
        let mut text = format!("listening on {scheme}://{address}\n");
        let _ = write!(text, "renderer {renderer}, bundle {bundle}");
        let answer = json!({
            "listening": format!("{scheme}://{address}"),
            "renderer": renderer,
            "bundle": bundle,
        });
        out.answer(&text, &answer)?;
        reload_at_hangup(doors.clone(), read_again)?;
        tokio::select! {
            served = doors.serve(listener, stop_signal()?) => served,
            error = broken(engine) => Err(error),
        }
    });
    tracing::info!("stopping: jobs at work are queued again for the next start");
    service.shut_down();
    served
}

/// Resolves where the networks do not open: a server that can make nothing ends, as one that finds
/// nothing at its start does.
async fn broken(engine: Arc<PipelineLoader>) -> Error {
    let opened = tokio::task::spawn_blocking(move || engine.get().map(drop)).await;
    match opened {
        Ok(Err(error)) => error,
        _ => std::future::pending().await,
    }
}

/// Puts keys, limits and certificate in force again at each SIGHUP.
#[cfg_attr(not(unix), expect(clippy::unnecessary_wraps, reason = "signals are unix"))]
fn reload_at_hangup(
    doors: Doors,
    read_again: impl Fn() -> Result<Config> + Send + 'static,
) -> Result<()> {
    #[cfg(unix)]
    {
        use tokio::signal::unix::{SignalKind, signal};
        let mut hangup = signal(SignalKind::hangup()).map_err(|e| {
            Error::new(ErrorCode::Internal, "signals cannot be watched").caused_by(e)
        })?;
        tokio::spawn(async move {
            while hangup.recv().await.is_some() {
                if let Err(error) = read_again().and_then(|config| doors.reload(&config)) {
                    tracing::error!(%error, "nothing is read again: the old values stay in force");
                }
            }
        });
    }
    #[cfg(not(unix))]
    drop((doors, read_again));
    Ok(())
}

/// Resolves at the first SIGTERM or Ctrl-C.
fn stop_signal() -> Result<impl Future<Output = ()> + Send + 'static> {
    let watch = |e| Error::new(ErrorCode::Internal, "signals cannot be watched").caused_by(e);
    #[cfg(unix)]
    let mut terminate =
        tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate()).map_err(watch)?;
    #[cfg(unix)]
    let terminated = async move {
        terminate.recv().await;
    };
    #[cfg(not(unix))]
    let terminated = std::future::pending::<()>();
    Ok(async move {
        tokio::select! {
            _ = tokio::signal::ctrl_c() => {}
            () = terminated => {}
        }
    })
}
