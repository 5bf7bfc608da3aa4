//! The records of scenes for callers: look up, list, delete, watch.

use std::sync::Arc;

use futures_util::{Stream, stream};

use super::{request::PageRequest, shared::Service, tasks, types::Page};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        Event, RefineState, SceneError, SceneId, SceneState, SceneStatus, SemanticsState, Stage,
    },
    store::Record,
};

impl Service {
    /// The status of a scene, with its report and cameras once done.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn get(&self, id: &SceneId) -> Result<SceneStatus> {
        Ok(self.shown(self.scene(id).await?.record().status.clone()))
    }

    /// A page of scenes, newest first, without cameras.
    ///
    /// # Errors
    /// `invalid_request` when `limit` is out of range or `after` not a `next` of an earlier page.
    pub async fn list(&self, page: &PageRequest) -> Result<Page> {
        let max = self.limits().page_max;
        let limit = match page.limit {
            Some(limit) if !(1..=max).contains(&limit) => {
                return Err(Error::invalid(format!("limit is {limit}; it must be 1 to {max}")));
            }
            Some(limit) => limit,
            None => max,
        };
        let after = page.after.as_deref().map(parse_cursor).transpose()?;
        let inner = Arc::clone(&self.inner);
        if inner.store.is_shared() {
            tasks::blocking(move || inner.jobs.refresh_all()).await??;
        }
        let (records, more) = self
            .inner
            .jobs
            .records
            .page(after, limit, |record| self.caller.sees(record.owner.as_deref()));
        let next = records.last().filter(|_| more).map(|last| cursor(last));
        let without_cameras = |record: &Arc<Record>| {
            self.shown(SceneStatus { cameras: Vec::new(), ..record.status.clone() })
        };
        Ok(Page { scenes: records.iter().map(without_cameras).collect(), next })
    }

    /// Stops the scene's job if it has one and removes everything kept of it.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`.
    pub async fn delete(&self, id: &SceneId) -> Result<()> {
        let scene = self.scene(id).await?;
        let (inner, gone) = (Arc::clone(&self.inner), scene.id().clone());
        let deleted = tasks::blocking(move || inner.jobs.delete(&gone)).await?;
        self.inner.edits.forget(id);
        deleted
    }

    /// What happens to a scene, from its present state to the last event, or until the server
    /// stops.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn watch(&self, id: &SceneId) -> Result<impl Stream<Item = Event> + Send + use<>> {
        self.watch_for(id, false).await
    }

    /// As [`Self::watch`]; with `semantics` a scene that is made is watched until its semantics
    /// are, too. They are begun by the first text, which may come later than this call.
    ///
    /// # Errors
    /// As [`Self::watch`].
    pub async fn watch_for(
        &self,
        id: &SceneId,
        semantics: bool,
    ) -> Result<impl Stream<Item = Event> + Send + use<>> {
        let watcher = self.inner.jobs.watch(self.scene(id).await?.id())?;
        let service = self.clone();
        let first = Some((service, watcher, semantics, None));
        Ok(stream::unfold(first, async |state| {
            let (service, mut watcher, semantics, before) = state?;
            loop {
                if before.is_some() {
                    tokio::select! {
                        changed = watcher.changed() => changed.ok()?,
                        () = service.inner.stopped_waiting() => return None,
                    }
                }
                let status = service.shown(watcher.borrow_and_update().status.clone());
                // Of a scene that waits for its semantics alone there is no other version.
                let versions = !semantics || status.refinement.state != RefineState::None;
                let event = match service.event(&status) {
                    Event::Done if versions && before.as_ref().is_some_and(is_version) => {
                        let fraction = status.refinement.fraction;
                        Event::Version { version: status.version, fraction }
                    }
                    event => event,
                };
                // How far a refinement is, is told with the next version, or with its end.
                let goes_on = status.is_refined_now()
                    || semantics && awaits_semantics(&status, before.is_none());
                if goes_on && before.as_ref().is_some_and(|before| same_version(before, &event)) {
                    continue;
                }
                let last = event.is_last() || is_version(&event);
                let next =
                    (!last || goes_on).then(|| (service, watcher, semantics, Some(event.clone())));
                return Some((event, next));
            }
        }))
    }

    fn event(&self, status: &SceneStatus) -> Event {
        let semantics = &status.semantics;
        match status.state {
            SceneState::Done if status.is_growing() => Event::Running {
                stage: status
                    .growth
                    .stage
                    .clone()
                    .unwrap_or_else(|| Stage::SCENE[0].name().to_owned()),
                fraction: status.growth.fraction,
            },
            SceneState::Done if semantics.state == SemanticsState::Running => Event::Running {
                stage: semantics
                    .stage
                    .clone()
                    .unwrap_or_else(|| Stage::SEMANTICS[0].name().to_owned()),
                fraction: semantics.fraction,
            },
            SceneState::Queued => {
                Event::Queued { ahead: self.inner.jobs.ahead(&status.id).unwrap_or(0) }
            }
            SceneState::Running => Event::Running {
                stage: status.stage.clone().unwrap_or_else(|| Stage::SCENE[0].name().to_owned()),
                fraction: status.fraction,
            },
            SceneState::Done => Event::Done,
            SceneState::Cancelled => Event::Cancelled,
            SceneState::Failed => Event::Failed(status.error.clone().unwrap_or(SceneError {
                code: ErrorCode::Internal.name().to_owned(),
                message: "the reason was not kept".to_owned(),
            })),
        }
    }
}

/// Whether a scene that can be viewed may still get its semantics. Those that failed before a
/// watcher came, as its first look shows, are tried again by the next text.
fn awaits_semantics(status: &SceneStatus, first: bool) -> bool {
    let open = match status.semantics.state {
        SemanticsState::None | SemanticsState::Running => true,
        SemanticsState::Failed => first,
        SemanticsState::Off | SemanticsState::Ready => false,
    };
    open && status.semantics.available && status.state == SceneState::Done
}

/// Whether it says what is served of a scene that is done.
fn is_version(event: &Event) -> bool {
    matches!(event, Event::Done | Event::Version { .. })
}

fn same_version(one: &Event, other: &Event) -> bool {
    match (one, other) {
        (Event::Version { version: a, .. }, Event::Version { version: b, .. }) => a == b,
        (Event::Done, Event::Done) => true,
        // A scene is done as its first version.
        (Event::Done, Event::Version { version, .. }) => *version == 1,
        _ => false,
    }
}

/// Where the next page starts: creation time and id of the last scene of this one.
fn cursor(last: &Record) -> String {
    format!("{}-{}", last.status.created_ms, last.status.id)
}

fn parse_cursor(text: &str) -> Result<(u64, SceneId)> {
    let parts = text
        .split_once('-')
        .and_then(|(created, id)| Some((created.parse().ok()?, id.parse::<SceneId>().ok()?)));
    parts.ok_or_else(|| {
        let shown: String = text.chars().take(60).collect();
        Error::invalid(format!("after is {shown:?}, not the `next` of an earlier page"))
    })
}
