//! The configuration: defaults, then the file, then the environment, then flags.
//!
//! Each option is a flag `--like-this` of the commands that need it, a variable
//! `SEGSPLAT_LIKE_THIS` and a key `like_this` of the TOML file that `--config` names. Limits are in
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
    scene::Refine,
};

/// Threads for each scene that is made at the same time as others, and most such scenes.
const THREADS_A_JOB: usize = 4;
const JOBS_MAX: usize = 8;

/// The type of an option in [`Config`]: without a default it may be absent.
macro_rules! option_type {
    ($type:ty) => { Option<$type> };
    ($type:ty, $default:expr) => { $type };
}

/// The value of an option that nobody sets.
macro_rules! option_default {
    () => {
        None
    };
    ($default:expr) => {
        $default
    };
}

/// Declares each option once: documentation, flag, variable, name, type and, where there is one,
/// the default. Makes one struct of flags for each group, and [`Config`].
macro_rules! options {
    ($(
        $(#[$group_doc:meta])*
        struct $group:ident as $field:ident {$(
            $(#[$meta:meta])*
            $variable:literal $name:ident: $type:ty $(= $default:expr)?,
        )+}
    )+) => {
        $(
            $(#[$group_doc])*
            #[derive(Args, Clone, Debug, Default)]
            pub struct $group {$(
                $(#[$meta])*
                #[arg(long, env = $variable)]
                pub $name: Option<$type>,
            )+}
        )+

        /// All flags and variables.
        #[derive(Args, Clone, Debug, Default)]
        pub struct AllArgs {$(
            $(#[$group_doc])*
            #[command(flatten)]
            pub $field: $group,
        )+}

        /// The configuration in force. The flags of the same names say what each field is.
        #[derive(Clone, Debug, Serialize, Deserialize)]
        #[serde(default, deny_unknown_fields)]
        #[expect(missing_docs, reason = "the flags have the documentation")]
        #[non_exhaustive]
        pub struct Config {
            $($(pub $name: option_type!($type $(, $default)?),)+)+
            pub limits: Limits,
        }

        impl Default for Config {
            fn default() -> Self {
                Self {
                    $($($name: option_default!($($default)?),)+)+
                    limits: Limits::default(),
                }
            }
        }

        impl Config {
            /// Replaces what is given as a flag or a variable.
            fn replace(&mut self, args: AllArgs) {
                $($(if let Some(value) = args.$field.$name {
                    self.$name = value.into();
                })+)+
            }
        }
    };
}

options! {
    /// Where the server listens: flags of `serve`, and of `health`, which calls it.
    struct ListenArgs as listen {
        /// Address and port to listen on [default: 127.0.0.1:8080]
        "SEGSPLAT_LISTEN" listen: SocketAddr = SocketAddr::from(([127, 0, 0, 1], 8080)),
        /// Certificate chain (PEM): serve TLS, with --tls-key; read again at SIGHUP
        #[arg(value_name = "FILE")]
        "SEGSPLAT_TLS_CERT" tls_cert: PathBuf,
        /// Private key of the certificate (PEM)
        #[arg(value_name = "FILE")]
        "SEGSPLAT_TLS_KEY" tls_key: PathBuf,
    }

    /// Flags of `serve` alone.
    struct ServerArgs as server {
        /// Folder of the scenes [default: ./data]
        "SEGSPLAT_DATA_DIR" data_dir: PathBuf = PathBuf::from("data"),
        /// Bucket that replicas share, `s3://BUCKET/PREFIX`; its keys are `AWS_ACCESS_KEY_ID` and
        /// `AWS_SECRET_ACCESS_KEY` of the environment [default: the data folder]
        "SEGSPLAT_STORE" store: String,
        /// URL of an S3-compatible server [default: Amazon's]
        "SEGSPLAT_S3_ENDPOINT" s3_endpoint: String,
        /// Region of the bucket [default: `AWS_REGION`, else us-east-1]
        "SEGSPLAT_S3_REGION" s3_region: String,
        /// Allow an S3 endpoint without TLS (plain http) [default: false]
        #[arg(num_args = 0..=1, default_missing_value = "true")]
        "SEGSPLAT_S3_ALLOW_HTTP" s3_allow_http: bool = false,
        /// Keep the photos of finished scenes; lazy semantics need them [default: true]
        #[arg(num_args = 0..=1, default_missing_value = "true")]
        "SEGSPLAT_KEEP_PHOTOS" keep_photos: bool = true,
        /// Scenes made at the same time, each on its share of the threads; 0: one for each four
        /// threads, and one at a time in a network [default: 0]
        "SEGSPLAT_JOBS" jobs: usize = 0,
        /// Whether finished scenes are refined where the create call does not say: where there are
        /// photos enough, never, or for so many milliseconds [default: auto]
        #[arg(value_name = "auto|off|MILLISECONDS")]
        "SEGSPLAT_REFINE" refine: Refine = Refine::Auto,
        /// File of API keys (TOML, made by `segsplat keys new`); read again at SIGHUP
        #[arg(value_name = "FILE")]
        "SEGSPLAT_KEYS" keys: PathBuf,
        /// Serve other machines without a key [default: only this machine]
        #[arg(num_args = 0..=1, default_missing_value = "true")]
        "SEGSPLAT_ANONYMOUS" anonymous: bool = false,
        /// Show /metrics to callers without an admin's key [default: false]
        #[arg(num_args = 0..=1, default_missing_value = "true")]
        "SEGSPLAT_OPEN_METRICS" open_metrics: bool = false,
        /// Origins whose pages may call, as `https://example.org`, or * for all [default: none]
        #[arg(value_delimiter = ',', value_name = "ORIGINS")]
        "SEGSPLAT_CORS_ORIGINS" cors_origins: Vec<String> = Vec::new(),
        /// Hosts that calls may name beside loopback and the listen address, or * for all
        /// [default: all with --keys, else none]
        #[arg(value_delimiter = ',', value_name = "HOSTS")]
        "SEGSPLAT_ALLOWED_HOSTS" allowed_hosts: Vec<String> = Vec::new(),
        /// Milliseconds after SIGTERM in which the server still serves but says that it is not
        /// ready, so that load balancers send calls elsewhere [default: 0]
        "SEGSPLAT_DRAIN_NOTICE_MS" drain_notice_ms: u64 = 0,
        /// Milliseconds that open calls get to end after that [default: 10000]
        "SEGSPLAT_DRAIN_MS" drain_ms: u64 = 10_000,
        /// Collector of traces, OTLP over HTTP, as `http://host:4318` [default: what OTEL_* name]
        #[arg(value_name = "URL")]
        "SEGSPLAT_OTLP" otlp: String,
    }

    /// Flags of every command that opens networks or a renderer.
    struct ConfigArgs as config {
        /// Folder of the model bundle [default: `models/embedded` beside the executable, in
        /// ../share/segsplat, in the checkout that it was built in or in the working folder]
        "SEGSPLAT_BUNDLE" bundle: PathBuf,
        /// ONNX Runtime library [default: `ORT_DYLIB_PATH`, beside the executable,
        /// ../share/segsplat, target/ort, the system's folders]
        "SEGSPLAT_ORT_LIBRARY" ort_library: PathBuf,
        /// Which renderer serves views [default: auto]
        #[arg(value_name = "auto|cpu|gpu", value_parser = named::<RendererChoice>)]
        "SEGSPLAT_RENDERER" renderer: RendererChoice = RendererChoice::Auto,
        /// Part of the name of the wgpu adapter to use; several with commas between
        "SEGSPLAT_ADAPTER" adapter: String,
        /// Execution provider of the networks [default: auto]
        #[arg(value_name = "auto|cpu|cuda|webgpu", value_parser = named::<ProviderChoice>)]
        "SEGSPLAT_PROVIDER" provider: ProviderChoice = ProviderChoice::Auto,
        /// Threads for networks and rendering [default: the cores this process really has]
        "SEGSPLAT_THREADS" threads: usize = available_cores(),
        /// Log filter in tracing's syntax [default: info,ort=warn]
        "SEGSPLAT_LOG" log: String = "info,ort=warn".to_owned(),
        /// Log lines as JSON [default: false]
        #[arg(num_args = 0..=1, default_missing_value = "true")]
        "SEGSPLAT_LOG_JSON" log_json: bool = false,
    }
}

impl Config {
    /// The configuration of these flags and variables and of the file, if one is named.
    ///
    /// # Errors
    /// `invalid_request` when the file cannot be read or parsed, or a value is out of range.
    pub fn resolve(file: Option<&std::path::Path>, args: AllArgs) -> Result<Self> {
        let mut config = match file {
            None => Self::default(),
            Some(path) => {
                let text = fs_err::read_to_string(path)
                    .map_err(|e| Error::invalid(format!("config file: {e}")))?;
                toml::from_str(&text).map_err(|e| Error::invalid(format!("config file: {e}")))?
            }
        };
        config.replace(args);
        config.validate()?;
        Ok(config)
    }

    /// Refuses to serve other machines without keys, unless the configuration allows it.
    ///
    /// # Errors
    /// `invalid_request`.
    pub fn check_open_to_others(&self) -> Result<()> {
        if self.keys.is_some() || self.anonymous || self.listen.ip().is_loopback() {
            return Ok(());
        }
        Err(Error::invalid(format!(
            "listen: other machines can reach {} and no keys are configured; give --keys FILE \
             (segsplat keys new), or --anonymous to serve callers without a key",
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
            jobs: self.jobs.max(1),
        }
    }

    /// Scenes made at the same time.
    #[must_use]
    pub fn workers(&self) -> usize {
        match self.jobs {
            0 => (self.threads / THREADS_A_JOB).clamp(1, JOBS_MAX),
            jobs => jobs,
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
        let limits = &self.limits;
        let is_host = |name: &str| {
            let plain = |c: u8| c.is_ascii_alphanumeric() || b"-._".contains(&c);
            name == "*"
                || name.parse::<std::net::IpAddr>().is_ok()
                || (!name.is_empty() && name.bytes().all(plain))
        };
        let odd_host = self.allowed_hosts.iter().find(|name| !is_host(name));
        let refine_max = limits.refine_ms_max;
        let wrong = if let Refine::Ms(ms) = self.refine
            && !(1..=refine_max).contains(&ms)
        {
            format!("refine is {ms} ms; it must be 1 to {refine_max}")
        } else if !(1..=1024).contains(&self.threads) {
            format!("threads is {}; it must be 1 to 1024", self.threads)
        } else if self.jobs > 64 {
            format!("jobs is {}; it must be 0 to 64", self.jobs)
        } else if limits.photos_min < 2 || limits.photos_max < limits.photos_min {
            "limits.photos_min must be at least 2 and at most photos_max".to_owned()
        } else if limits.network_photos_max < limits.photos_min {
            "limits.network_photos_max must be at least photos_min".to_owned()
        } else if limits.key_requests_per_s == 0 || limits.key_inflight_max == 0 {
            "limits.key_requests_per_s and key_inflight_max must be over 0".to_owned()
        } else if let Some(name) = odd_host {
            format!("allowed_hosts has {name:?}; give names or addresses without a port")
        } else if self.tls_cert.is_some() != self.tls_key.is_some() {
            "tls_cert and tls_key go together".to_owned()
        } else {
            return Ok(());
        };
        Err(Error::invalid(format!("config: {wrong}")))
    }
}

/// Cores this process may really use: the cgroup's quota (std reads v1 and v2) and affinity.
#[must_use]
pub fn available_cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}
