//! The networks that are opened at their first use.

use std::sync::Arc;

use parking_lot::Mutex;

use crate::{
    error::{Error, ErrorCode, Result},
    models::{
        CameraNetwork, FeatureNetwork, ImageText, MaskNetwork, MatcherNetwork, NetworkOptions,
        TextMaskNetwork,
    },
};

/// The networks that not every scene needs, opened at the first use and kept.
#[derive(Debug)]
pub(super) struct LazyNetworks {
    pub(super) options: NetworkOptions,
    pub(super) masks: Mutex<Option<Arc<MaskNetwork>>>,
    pub(super) image_text: Mutex<Option<Arc<ImageText>>>,
    pub(super) text_masks: Mutex<Option<Arc<TextMaskNetwork>>>,
    pub(super) features: Mutex<Option<Arc<FeatureNetwork>>>,
    pub(super) matcher: Mutex<Option<Arc<MatcherNetwork>>>,
    pub(super) cameras: Mutex<Option<Arc<CameraNetwork>>>,
}

impl LazyNetworks {
    pub(super) fn new(options: &NetworkOptions) -> Self {
        let options = options.clone();
        let (masks, image_text, text_masks, features, matcher, cameras) = Default::default();
        Self { options, masks, image_text, text_masks, features, matcher, cameras }
    }

    /// Why an open network is not computed where it was to be; one that is being opened says
    /// nothing yet.
    pub(super) fn remark(&self) -> Option<String> {
        let masks = || self.masks.try_lock()?.as_ref()?.remark();
        masks()
            .or_else(|| self.image_text.try_lock()?.as_ref()?.remark())
            .or_else(|| self.text_masks.try_lock()?.as_ref()?.remark())
            .or_else(|| self.cameras.try_lock()?.as_ref()?.remark())
    }
}

/// The network in `place`; it is opened if it is not there yet. A failure is not kept.
pub(super) fn opened<T>(
    place: &Mutex<Option<Arc<T>>>,
    what: &str,
    open: impl FnOnce() -> Result<Option<T>>,
) -> Result<Arc<T>> {
    let mut kept = place.lock();
    if let Some(network) = &*kept {
        return Ok(Arc::clone(network));
    }
    let network = open()?.ok_or_else(|| {
        Error::new(ErrorCode::ModelUnavailable, format!("the bundle has no {what}"))
    })?;
    Ok(Arc::clone(kept.insert(Arc::new(network))))
}
