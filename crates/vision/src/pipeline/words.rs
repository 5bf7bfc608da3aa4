//! Words that a network masks in the photos of a scene: each photo is encoded once, each text is
//! found in it, and what is found is lifted to the scene's Gaussians.

use std::sync::{Arc, atomic::AtomicBool};

use super::{
    Pipeline,
    networks::opened,
    semantics::{SemanticsInput, check_input},
};
use crate::{
    error::Result,
    models::TextMaskNetwork,
    scene::{IndexMap, unless_cancelled},
    semantics::{self, Views},
};

impl Pipeline {
    /// The network that masks what a text says, opened at the first call.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has none or it does not open.
    pub fn text_masks(&self) -> Result<Arc<TextMaskNetwork>> {
        let open = || TextMaskNetwork::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.text_masks, "network of text masks", open)
    }
}

/// Of each text the score at each Gaussian, thousandths: `[T][N]`. Photos that made no Gaussian are
/// not looked at.
///
/// # Errors
/// `model_unavailable`, `cancelled`, `internal`; `invalid_request` when the network cannot read a
/// text, or the scene does not say which pixel made each Gaussian.
pub fn find_words(
    pipeline: &Pipeline,
    input: &SemanticsInput<'_>,
    texts: &[String],
    cancel: &AtomicBool,
) -> Result<Vec<Vec<u16>>> {
    check_input(input)?;
    let network = pipeline.text_masks()?;
    let mut maps: Vec<Vec<IndexMap>> = vec![Vec::new(); texts.len()];
    for (posed, camera) in input.photos.iter().zip(input.cameras) {
        unless_cancelled(cancel)?;
        if camera.network.is_none() {
            maps.iter_mut().for_each(|of| of.push(IndexMap::default()));
            continue;
        }
        let seen = network.see(&posed.photo)?;
        for (of, text) in maps.iter_mut().zip(texts) {
            unless_cancelled(cancel)?;
            of.push(network.find(&seen, text)?);
        }
    }
    let views = Views::new(input.gaussians, input.cameras);
    let lift = |maps: &Vec<IndexMap>| {
        let own = semantics::from_source(input.gaussians.source(), input.cameras, maps);
        semantics::lifted(&views, &own, maps)
    };
    Ok(maps.iter().map(lift).collect())
}
