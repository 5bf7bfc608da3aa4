//! `segsplat serve`: HTTP and gRPC on one port until SIGTERM or Ctrl-C.

use std::sync::Arc;

use serde_json::json;
use tokio::net::TcpListener;
#[cfg(unix)]
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::{engine, output::Output};
use crate::{
    api::Server,
    config::{AllArgs, Config},
    error::{Error, Result},
    pipeline::PipelineLoader,
    service::Service,
    store::StoreLocation,
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pub(super) config: AllArgs,
    /// Print the configuration in force as JSON and stop
    #[arg(long)]
    print_config: bool,
}

/// `read_again` gives the configuration that the files hold now.
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
    config.check_open_to_others()?;
    let (parts, engine) = engine::parts(&config)?;
    // A network that takes no fewer photos says so at the door, and not in the job.
    let views_min = engine.bundle().geometry().views_min;
    let at_the_door = move |mut config: Config| {
        config.limits.photos_min = config.limits.photos_min.max(views_min);
        config
    };
    let config = at_the_door(config);
    let read_again = move || read_again().map(at_the_door);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|e| Error::internal("the async runtime does not start").caused_by(e))?;
    let (models, data_dir) = (parts.models.clone(), config.data_dir.clone());
    let scheme = if config.tls_cert.is_some() { "https" } else { "http" };
    let (renderer, listen) = (parts.renderer.name(), config.listen);
    let service = Service::open(&StoreLocation::of(&config)?, config, parts)?;
    let served = runtime.block_on(async {
        let listener = TcpListener::bind(listen).await.map_err(|e| {
            Error::invalid(format!("listen: {listen} cannot be used: {e}")).caused_by(e)
        })?;
        let address = listener
            .local_addr()
            .map_err(|e| Error::internal("the listener has no address").caused_by(e))?;
        let server = Server::new(service.clone())?;
        let (bundle, sha256) = (&models.bundle, models.bundle_sha256.get(..12).unwrap_or_default());
        tracing::info!(
            %address,
            renderer,
            bundle,
            bundle_sha256 = sha256,
            data_dir = %data_dir.display(),
            "serving HTTP and gRPC"
        );
        let url = format!("{scheme}://{address}");
        let text = format!("listening on {url}\nrenderer {renderer}, bundle {bundle}");
        let answer = json!({ "listening": url, "renderer": renderer, "bundle": bundle });
        out.answer(&text, &answer)?;
        reload_at_hangup(server.clone(), read_again)?;
        tokio::select! {
            served = server.serve(listener, stop_signal()?) => served,
            error = broken(engine) => Err(error),
        }
    });
    tracing::info!("stopping: jobs at work are queued again for the next start");
    service.shut_down();
    served
}

/// Resolves where the networks do not open: then the server ends, as it does where it finds no
/// bundle at its start.
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
    server: Server,
    read_again: impl Fn() -> Result<Config> + Send + 'static,
) -> Result<()> {
    #[cfg(unix)]
    {
        let mut hangup = watch(SignalKind::hangup())?;
        tokio::spawn(async move {
            while hangup.recv().await.is_some() {
                if let Err(error) = read_again().and_then(|config| server.reload(&config)) {
                    tracing::error!(%error, "keys, limits and certificate are not changed");
                }
            }
        });
    }
    #[cfg(not(unix))]
    drop((server, read_again));
    Ok(())
}

/// Resolves at the first SIGTERM or Ctrl-C.
fn stop_signal() -> Result<impl Future<Output = ()> + Send + 'static> {
    #[cfg(unix)]
    let mut terminate = watch(SignalKind::terminate())?;
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

#[cfg(unix)]
fn watch(kind: SignalKind) -> Result<Signal> {
    signal(kind).map_err(|e| Error::internal("signals cannot be watched").caused_by(e))
}
