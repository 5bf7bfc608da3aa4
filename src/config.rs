//! One configuration struct: defaults < file < environment < flags.
//!
//! Every field is a flag `--like-this` of the commands that need it, a variable
//! `SEGSPLAT_LIKE_THIS` and a key `like_this` of the TOML file named by `--config`. Limits live in
//! the file's `[limits]` table.

use std::{net::SocketAddr, path::PathBuf};

use clap::Args;
use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    limits::Limits,
    models::{NetworkOptions, ProviderChoice},
    names::named,
    render::{RendererChoice, RendererOptions},
};

/// Flags of every command that opens networks or a renderer; what is not given stays as it is.
#[derive(Args, Clone, Debug, Default)]
pub struct ConfigArgs {
    /// Folder of the model bundle [default: `models/embedded` beside the executable, in
    /// ../share/segsplat, in the checkout that it was built in or in the working folder]
    #[arg(long, env = "SEGSPLAT_BUNDLE")]
    pub bundle: Option<PathBuf>,
    /// ONNX Runtime library [default: `ORT_DYLIB_PATH`, beside the executable,
    /// ../share/segsplat, target/ort, the system's folders]
    #[arg(long, env = "SEGSPLAT_ORT_LIBRARY")]
    pub ort_library: Option<PathBuf>,
    /// Which renderer serves views [default: auto]
    #[arg(long, env = "SEGSPLAT_RENDERER", value_name = "auto|cpu|gpu")]
    #[arg(value_parser = named::<RendererChoice>)]
    pub renderer: Option<RendererChoice>,
    /// Part of the name of the wgpu adapter to use; several with commas between
    #[arg(long, env = "SEGSPLAT_ADAPTER")]
    pub adapter: Option<String>,
    /// Execution provider of the networks [default: auto]
    #[arg(long, env = "SEGSPLAT_PROVIDER", value_name = "auto|cpu|cuda|webgpu")]
    #[arg(value_parser = named::<ProviderChoice>)]
    pub provider: Option<ProviderChoice>,
    /// Threads for networks and rendering [default: the cores this process really has]
    #[arg(long, env = "SEGSPLAT_THREADS")]
    pub threads: Option<usize>,
    /// Log filter in tracing's syntax [default: info,ort=warn]
    #[arg(long, env = "SEGSPLAT_LOG")]
    pub log: Option<String>,
    /// Log lines as JSON [default: false]
    #[arg(long, env = "SEGSPLAT_LOG_JSON", num_args = 0..=1, default_missing_value = "true")]
    pub log_json: Option<bool>,
}

/// Flags that say where the server is reached: of `serve`, and of `health`, which asks it.
#[derive(Args, Clone, Debug, Default)]
pub struct DoorArgs {
    /// Address and port to listen on [default: 127.0.0.1:8080]
    #[arg(long, env = "SEGSPLAT_LISTEN")]
    pub listen: Option<SocketAddr>,
    /// Certificate chain (PEM): serve TLS, with --tls-key; read again at SIGHUP
    #[arg(long, env = "SEGSPLAT_TLS_CERT", value_name = "FILE")]
    pub tls_cert: Option<PathBuf>,
    /// Private key of the certificate (PEM)
    #[arg(long, env = "SEGSPLAT_TLS_KEY", value_name = "FILE")]
    pub tls_key: Option<PathBuf>,
}

/// Flags of `serve` alone.
#[derive(Args, Clone, Debug, Default)]
pub struct ServerArgs {
    /// Folder of the scenes [default: ./data]
    #[arg(long, env = "SEGSPLAT_DATA_DIR")]
    pub data_dir: Option<PathBuf>,
    /// Bucket that replicas share, `s3://BUCKET/PREFIX`; its keys are `AWS_ACCESS_KEY_ID` and
    /// `AWS_SECRET_ACCESS_KEY` of the environment [default: the data folder]
    #[arg(long, env = "SEGSPLAT_STORE")]
    pub store: Option<String>,
    /// URL of an S3-compatible server [default: Amazon's]
    #[arg(long, env = "SEGSPLAT_S3_ENDPOINT")]
    pub s3_endpoint: Option<String>,
    /// Region of the bucket [default: `AWS_REGION`, else us-east-1]
    #[arg(long, env = "SEGSPLAT_S3_REGION")]
    pub s3_region: Option<String>,
    /// Whether the S3 endpoint may be plain http [default: false]
    #[arg(long, env = "SEGSPLAT_S3_ALLOW_HTTP", num_args = 0..=1, default_missing_value = "true")]
    pub s3_allow_http: Option<bool>,
    /// Keep the photos of finished scenes; lazy semantics need them [default: true]
    #[arg(long, env = "SEGSPLAT_KEEP_PHOTOS", num_args = 0..=1, default_missing_value = "true")]
    pub keep_photos: Option<bool>,
    /// Scenes made at the same time [default: 1]
    #[arg(long, env = "SEGSPLAT_JOBS")]
    pub jobs: Option<usize>,
    /// File of API keys (TOML, made by `segsplat keys new`); read again at SIGHUP
    #[arg(long, env = "SEGSPLAT_KEYS", value_name = "FILE")]
    pub keys: Option<PathBuf>,
    /// Serve other machines without asking for a key [default: only this machine]
    #[arg(long, env = "SEGSPLAT_ANONYMOUS", num_args = 0..=1, default_missing_value = "true")]
    pub anonymous: Option<bool>,
    /// Show /metrics to callers without an admin's key [default: false]
    #[arg(long, env = "SEGSPLAT_OPEN_METRICS", num_args = 0..=1, default_missing_value = "true")]
    pub open_metrics: Option<bool>,
    /// Origins whose pages may call, as `https://example.org`, or * for all [default: none]
    #[arg(long, env = "SEGSPLAT_CORS_ORIGINS", value_delimiter = ',', value_name = "ORIGINS")]
    pub cors_origins: Option<Vec<String>>,
    /// Hosts that calls may name beside loopback and the listened address, or * for all
    /// [default: all with --keys, else none]
    #[arg(long, env = "SEGSPLAT_ALLOWED_HOSTS", value_delimiter = ',', value_name = "HOSTS")]
    pub allowed_hosts: Option<Vec<String>>,
    /// Milliseconds to serve on, not ready, after SIGTERM, so that balancers look away [default: 0]
    #[arg(long, env = "SEGSPLAT_DRAIN_NOTICE_MS")]
    pub drain_notice_ms: Option<u64>,
    /// Milliseconds that open calls get to end after that [default: 10000]
    #[arg(long, env = "SEGSPLAT_DRAIN_MS")]
    pub drain_ms: Option<u64>,
    /// Collector of traces, OTLP over HTTP, as `http://host:4318` [default: what OTEL_* name]
    #[arg(long, env = "SEGSPLAT_OTLP", value_name = "URL")]
    pub otlp: Option<String>,
}

/// Everything that can be typed or set in the environment.
#[derive(Args, Clone, Debug, Default)]
pub struct AllArgs {
    /// Where the server is reached.
    #[command(flatten)]
    pub door: DoorArgs,
    /// What the server does.
    #[command(flatten)]
    pub server: ServerArgs,
    /// Networks, renderer, log.
    #[command(flatten)]
    pub config: ConfigArgs,
}

/// The configuration in force.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[non_exhaustive]
pub struct Config {
    /// Address and port to listen on.
    pub listen: SocketAddr,
    /// Folder of the scenes.
    pub data_dir: PathBuf,
    /// Bucket that replicas share, `s3://BUCKET/PREFIX`; `None`: the data folder.
    pub store: Option<String>,
    /// URL of an S3-compatible server; `None`: Amazon's.
    pub s3_endpoint: Option<String>,
    /// Region of the bucket; `None`: the environment's.
    pub s3_region: Option<String>,
    /// Whether the S3 endpoint may be plain http.
    pub s3_allow_http: bool,
    /// Whether the photos of finished scenes are kept.
    pub keep_photos: bool,
    /// Folder of the model bundle; `None`: search.
    pub bundle: Option<PathBuf>,
    /// ONNX Runtime library; `None`: search.
    pub ort_library: Option<PathBuf>,
    /// Which renderer serves views.
    pub renderer: RendererChoice,
    /// Part of the name of the wgpu adapter to use, or of several, with commas between.
    pub adapter: Option<String>,
    /// Execution provider of the networks.
    pub provider: ProviderChoice,
    /// Threads for networks and rendering.
    pub threads: usize,
    /// Scenes made at the same time.
    pub jobs: usize,
    /// File of API keys; `None`: nobody is asked for one.
    pub keys: Option<PathBuf>,
    /// Serve other machines without asking for a key.
    pub anonymous: bool,
    /// Show `/metrics` to callers without an admin's key.
    pub open_metrics: bool,
    /// Certificate chain, PEM; `None`: no TLS.
    pub tls_cert: Option<PathBuf>,
    /// Private key of the certificate, PEM.
    pub tls_key: Option<PathBuf>,
    /// Origins whose pages may call.
    pub cors_origins: Vec<String>,
    /// Hosts that calls may name beside loopback and the listened address; `*` allows all.
    pub allowed_hosts: Vec<String>,
    /// Milliseconds to serve on, not ready, after the stop signal.
    pub drain_notice_ms: u64,
    /// Milliseconds that open calls get to end after that.
    pub drain_ms: u64,
    /// Collector of traces; `None`: what the `OTEL_*` variables say.
    pub otlp: Option<String>,
    /// Log filter.
    pub log: String,
    /// Log lines as JSON.
    pub log_json: bool,
    /// Caps on requests.
    pub limits: Limits,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8080)),
            data_dir: PathBuf::from("data"),
            store: None,
            s3_endpoint: None,
            s3_region: None,
            s3_allow_http: false,
            keep_photos: true,
            bundle: None,
            ort_library: None,
            renderer: RendererChoice::Auto,
            adapter: None,
            provider: ProviderChoice::Auto,
            threads: available_cores(),
            jobs: 1,
            keys: None,
            anonymous: false,
            open_metrics: false,
            tls_cert: None,
            tls_key: None,
            cors_origins: Vec::new(),
            allowed_hosts: Vec::new(),
            drain_notice_ms: 0,
            drain_ms: 10_000,
            otlp: None,
            log: "info,ort=warn".to_owned(),
            log_json: false,
            limits: Limits::default(),
        }
    }
}

impl Config {
    /// Defaults, then the file's keys (if a file is named), then flags and environment.
    ///
    /// # Errors
    /// `invalid_request` when the file cannot be read or parsed, or a value is out of range.
    pub fn resolve(file: Option<&std::path::Path>, typed: AllArgs) -> Result<Self> {
        let mut config = match file {
            None => Self::default(),
            Some(path) => {
                let text = fs_err::read_to_string(path)
                    .map_err(|e| Error::invalid(format!("config file: {e}")))?;
                toml::from_str(&text).map_err(|e| Error::invalid(format!("config file: {e}")))?
            }
        };
        macro_rules! put_over {
            ($args:expr, $($name:ident),+) => {
                $(if let Some(value) = $args.$name { config.$name = value.into(); })+
            };
        }
        let AllArgs { door, server, config: common } = typed;
        put_over!(door, listen, tls_cert, tls_key);
        put_over!(
            server,
            data_dir,
            store,
            s3_endpoint,
            s3_region,
            s3_allow_http,
            keep_photos,
            jobs,
            keys,
            anonymous,
            open_metrics,
            cors_origins,
            allowed_hosts,
            drain_notice_ms,
            drain_ms,
            otlp
        );
        put_over!(common, bundle, ort_library, renderer, adapter, provider, threads, log, log_json);
        config.validate()?;
        Ok(config)
    }

    /// Refuses to let other machines in without a key, unless that is asked for.
    ///
    /// # Errors
    /// `invalid_request`.
    pub fn check_doors(&self) -> Result<()> {
        if self.keys.is_some() || self.anonymous || self.listen.ip().is_loopback() {
            return Ok(());
        }
        Err(Error::invalid(format!(
            "listen: {} is open to other machines and no keys are configured; give --keys FILE \
             (segsplat keys new), or --anonymous to let anybody in",
            self.listen
        )))
    }

    /// Bucket and prefix of the shared store; `None` where scenes are in the data folder.
    ///
    /// # Errors
    /// `invalid_request` when it is no `s3://BUCKET/PREFIX`.
    pub fn bucket(&self) -> Result<Option<(&str, &str)>> {
        let Some(store) = &self.store else { return Ok(None) };
        let place = store.strip_prefix("s3://").unwrap_or_default();
        let (bucket, prefix) = place.split_once('/').unwrap_or((place, ""));
        if bucket.is_empty() {
            return Err(Error::invalid(format!(
                "config: store is {store:?}; it must be s3://BUCKET or s3://BUCKET/PREFIX"
            )));
        }
        Ok(Some((bucket, prefix.trim_matches('/'))))
    }

    /// What opening the networks needs.
    #[must_use]
    pub fn networks(&self) -> NetworkOptions {
        NetworkOptions {
            bundle: self.bundle.clone(),
            ort_library: self.ort_library.clone(),
            provider: self.provider,
            threads: self.threads,
            jobs: self.jobs,
        }
    }

    /// What opening the renderer needs.
    #[must_use]
    pub fn renderer(&self) -> RendererOptions {
        RendererOptions {
            renderer: self.renderer,
            adapter: self.adapter.clone(),
            threads: self.threads,
            scene_bytes_max: self.limits.device_scene_bytes_max,
            ..RendererOptions::default()
        }
    }

    fn validate(&self) -> Result<()> {
        self.bucket()?;
        for (name, value, max) in [("threads", self.threads, 1024), ("jobs", self.jobs, 64)] {
            if value == 0 || value > max {
                return Err(Error::invalid(format!(
                    "config: {name} is {value}; it must be 1 to {max}"
                )));
            }
        }
        if self.limits.photos_min < 2 || self.limits.photos_max < self.limits.photos_min {
            return Err(Error::invalid(
                "config: limits.photos_min must be at least 2 and at most photos_max",
            ));
        }
        if self.limits.key_requests_per_s == 0 || self.limits.key_inflight_max == 0 {
            return Err(Error::invalid(
                "config: limits.key_requests_per_s and key_inflight_max must be over 0",
            ));
        }
        let is_host = |name: &String| {
            name == "*"
                || name.parse::<std::net::IpAddr>().is_ok()
                || (!name.is_empty()
                    && name.bytes().all(|c| c.is_ascii_alphanumeric() || b"-._".contains(&c)))
        };
        if let Some(name) = self.allowed_hosts.iter().find(|name| !is_host(name)) {
            return Err(Error::invalid(format!(
                "config: allowed_hosts has {name:?}; give names or addresses without a port"
            )));
        }
        if self.tls_cert.is_some() != self.tls_key.is_some() {
            return Err(Error::invalid("config: tls_cert and tls_key go together"));
        }
        Ok(())
    }
}

/// Cores this process may really use: the cgroup's quota (std reads v1 and v2) and affinity.
#[must_use]
pub fn available_cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}
