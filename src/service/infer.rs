//! Runs one network of the bundle by itself, for callers of the Open Inference Protocol.

use std::sync::Arc;

use super::{shared::Service, tasks::blocking};
use crate::{
    error::{Error, ErrorCode, Result, short},
    jobs::NetworkState,
    models::{NetworkTensors, Tensor},
    pipeline::NETWORKS,
};

/// When to ask again where too many networks are asked for, seconds.
const RETRY_AFTER_S: u32 = 1;

/// A run of a network.
#[derive(Clone, Debug, PartialEq)]
pub struct InferSpec {
    /// Name of the network in the bundle, as in `ModelInfo::name`.
    pub network: String,
    /// Its inputs, in any order.
    pub inputs: Vec<Tensor>,
    /// Names of the outputs to give, in their order; none: all.
    pub outputs: Vec<String>,
}

impl Service {
    /// Whether the networks are open.
    pub fn networks_ready(&self) -> bool {
        matches!(self.inner.jobs.networks(), NetworkState::Open(_))
    }

    /// Whether a network can be run now.
    ///
    /// # Errors
    /// `not_found` where the bundle has no network of this name.
    pub fn network_ready(&self, name: &str) -> Result<bool> {
        self.check_network(name).map(|()| self.networks_ready())
    }

    /// The tensors of a network, which is opened if it is not yet.
    ///
    /// # Errors
    /// `not_found` where the bundle has no network of this name, `model_unavailable`.
    pub async fn network_tensors(&self, name: &str) -> Result<NetworkTensors> {
        self.check_network(name)?;
        let (networks, name) = (Arc::clone(&self.inner.networks), name.to_owned());
        let tensors = move || {
            networks.pipeline()?.with_network(&name, |network| Ok(network.tensors().clone()))
        };
        blocking(tensors).await?
    }

    /// Runs a network on a session of the server's own, for which it waits as a job does.
    ///
    /// # Errors
    /// `not_found` where the bundle has no network of this name, `invalid_request` where the
    /// inputs are not those that it takes, `overloaded`, `model_unavailable`.
    pub async fn infer(&self, spec: InferSpec) -> Result<Vec<Tensor>> {
        self.check_network(&spec.network)?;
        let inner = &self.inner;
        let permit = Arc::clone(&inner.inferences).try_acquire_owned().map_err(|_| {
            let max = inner.config.limits.inferences_max;
            let why = format!("{max} calls run networks already, the most that may");
            Error::new(ErrorCode::Overloaded, why).retry_after_s(RETRY_AFTER_S)
        })?;
        let networks = Arc::clone(&inner.networks);
        let run = move || {
            // Held until the run ends, also where the caller has gone.
            let _permit = permit;
            let InferSpec { network, inputs, outputs } = spec;
            networks.pipeline()?.with_network(&network, |network| network.infer(&inputs, &outputs))
        };
        blocking(run).await?
    }

    fn check_network(&self, name: &str) -> Result<()> {
        let models = &self.inner.models.models;
        let there = |part: &&str| models.iter().any(|model| model.name == **part);
        let names: Vec<&str> = NETWORKS.into_iter().filter(there).collect();
        if names.contains(&name) {
            return Ok(());
        }
        let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let why = format!("no network {:?}; the bundle has {names}", short(name));
        Err(Error::new(ErrorCode::NotFound, why))
    }
}
