//! The check of a scene's owner, as a type that all code which uses a scene requires.

use std::sync::{Arc, LazyLock};

use super::{edits::EditList, shared::Service, tasks::blocking};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{SceneError, SceneId, SceneState},
    store::{Record, not_found},
};

/// A scene that the caller may use. [`Service::scene`] alone makes one from an id, so nobody
/// forgets to check the owner.
#[derive(Clone, Debug)]
pub(super) struct SceneAccess {
    record: Arc<Record>,
    /// Why it cannot be drawn where its list cannot be read.
    edits: Result<Arc<EditList>, SceneError>,
}

impl SceneAccess {
    pub(super) fn id(&self) -> &SceneId {
        &self.record.status.id
    }

    /// The record at the time of the check.
    pub(super) fn record(&self) -> &Record {
        &self.record
    }

    /// Its edits at the time of the check.
    pub(super) fn edits(&self) -> &EditList {
        static NONE: LazyLock<EditList> = LazyLock::new(EditList::default);
        self.edits.as_deref().unwrap_or(&NONE)
    }

    /// The same scene, where it can be rendered.
    pub(super) fn finished(self) -> Result<Self> {
        let access = self.done()?;
        match &access.edits {
            Ok(_) => Ok(access),
            Err(error) => Err(error.to_error()),
        }
    }

    /// The scene as it was made, without its edits, where that can be rendered.
    pub(super) fn unedited(self) -> Result<Self> {
        Ok(Self { edits: Ok(Arc::default()), ..self.done()? })
    }

    fn done(self) -> Result<Self> {
        let (status, id) = (&self.record.status, self.id());
        let not_ready = |why: String| Err(Error::new(ErrorCode::SceneNotReady, why));
        match (status.state, &status.error) {
            (SceneState::Done, _) => Ok(self),
            (_, Some(error)) if is_of_the_store(error) => Err(error.to_error()),
            (SceneState::Failed, Some(error)) => {
                not_ready(format!("scene {id} failed with {}: {}", error.code, error.message))
            }
            (state, _) => not_ready(format!("scene {id} is {state}")),
        }
    }
}

/// Whether it is what is stored of a scene that cannot be read.
fn is_of_the_store(error: &SceneError) -> bool {
    matches!(error.to_error().code(), ErrorCode::SceneCorrupt | ErrorCode::OtherVersion)
}

impl Service {
    /// The scene, where this caller may use it.
    /// Fails with `scene_not_found` where there is none, or it is another owner's.
    pub(super) async fn scene(&self, id: &SceneId) -> Result<SceneAccess> {
        if self.inner.jobs.may_be_stale(id) {
            let (inner, id) = (Arc::clone(&self.inner), id.clone());
            blocking(move || inner.jobs.refresh(&id)).await??;
        }
        let record = self.inner.jobs.record(id)?;
        if !self.caller.sees(record.owner.as_deref()) {
            return Err(not_found(id));
        }
        let edits = match record.status.state {
            SceneState::Done => self.inner.edit_list(id).await.map_err(|e| SceneError::from(&e)),
            _ => Ok(Arc::default()),
        };
        Ok(SceneAccess { record, edits })
    }
}
