//! `segsplat serve`: both doors on one port until SIGTERM or Ctrl-C.

use std::fmt::Write as _;

use serde_json::json;
use tokio::net::TcpListener;

use super::{engine, output::Output};
use crate::{
    api,
    config::{Config, ConfigArgs},
    error::{Error, ErrorCode, Result},
    service::Service,
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pub(super) config: ConfigArgs,
    /// Print the configuration in force as JSON and stop
    #[arg(long)]
    print_config: bool,
}

pub(super) fn run(args: &Args, config: Config, out: &Output) -> Result<()> {
    if args.print_config {
        let text = serde_json::to_string_pretty(&config)
            .map_err(|e| Error::internal("the configuration is no JSON").caused_by(e))?;
        return out.answer(&text, &config);
    }
    let parts = engine::parts(&config)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|e| Error::internal("the async runtime does not start").caused_by(e))?;
    let (models, data_dir) = (parts.models.clone(), config.data_dir.clone());
    let (renderer, listen) = (parts.renderer.name(), config.listen);
    let service = Service::open(config, parts)?;
    let served = runtime.block_on(async {
        let listener = TcpListener::bind(listen).await.map_err(|e| {
            Error::invalid(format!("listen: {listen} cannot be used: {e}")).caused_by(e)
        })?;
        let address = listener
            .local_addr()
            .map_err(|e| Error::internal("the listener has no address").caused_by(e))?;
        let provider = &models.execution_provider;
        let (bundle, sha256) = (&models.bundle, models.bundle_sha256.get(..12).unwrap_or_default());
        tracing::info!(
            %address,
            renderer,
            execution_provider = provider,
            bundle,
            bundle_sha256 = sha256,
            data_dir = %data_dir.display(),
            "serving HTTP and gRPC"
        );
        let mut text = format!("listening on http://{address}\n");
        let _ = write!(text, "renderer {renderer}, network on {provider}, bundle {bundle}");
        let answer = json!({
            "listening": format!("http://{address}"),
            "renderer": renderer,
            "execution_provider": provider,
            "bundle": bundle,
        });
        out.answer(&text, &answer)?;
        api::serve(listener, service.clone(), stop_signal()?).await
    });
    tracing::info!("stopping: jobs at work are queued again for the next start");
    service.shut_down();
    served
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
