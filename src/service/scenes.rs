//! The records of scenes for callers: look up, list, delete, watch.

use std::{mem, sync::Arc, time::Duration};

use futures_util::{Stream, stream};
use tokio::sync::{OwnedSemaphorePermit, watch};

use super::{access::SceneAccess, request::PageRequest, shared::Service, tasks, types::Page};
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
        self.inner.foresight.forget(id);
        deleted
    }

    /// What happens to a scene, from its present state to the last event, or until the server
    /// stops.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn watch(&self, id: &SceneId) -> Result<impl Stream<Item = Event> + Send + use<>> {
        self.watch_for(id, WatchUntil::default()).await
    }

    /// As [`Self::watch`], for as long as `until` says.
    ///
    /// # Errors
    /// As [`Self::watch`]; `overloaded` where too many callers are told edits.
    pub async fn watch_for(
        &self,
        id: &SceneId,
        until: WatchUntil,
    ) -> Result<impl Stream<Item = Event> + Send + use<>> {
        let inner = &self.inner;
        let place = until.edits.then(|| inner.place_to_watch()).transpose()?;
        let watcher = Watcher {
            record: inner.jobs.watch(self.scene(id).await?.id())?,
            edits: inner.edits.watch(),
            service: self.clone(),
            id: id.clone(),
            until,
            before: None,
            refined: false,
            list: None,
            over: false,
            _place: place,
        };
        Ok(stream::unfold(watcher, async |mut watcher| Some((watcher.next().await?, watcher))))
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

/// How long a scene is watched after it is made.
#[derive(Clone, Copy, Debug, Default)]
pub struct WatchUntil {
    /// Until its semantics are made, too. They are begun by the first text, which may come later
    /// than the call.
    pub semantics: bool,
    /// Until it is deleted, or the caller leaves: each change of its edits is told, and what else
    /// happens to it.
    pub edits: bool,
}

/// One who watches a scene.
struct Watcher {
    service: Service,
    id: SceneId,
    until: WatchUntil,
    record: watch::Receiver<Arc<Record>>,
    /// Rung when the edits of any scene change.
    edits: watch::Receiver<()>,
    /// The last event but those of edits.
    before: Option<Event>,
    /// Whether the scene was being refined then.
    refined: bool,
    /// Hash of the list of edits that was told last.
    list: Option<String>,
    over: bool,
    _place: Option<OwnedSemaphorePermit>,
}

impl Watcher {
    async fn next(&mut self) -> Option<Event> {
        if self.over {
            return None;
        }
        loop {
            if self.before.is_some() {
                if let Some(edited) = self.edited().await {
                    return Some(edited);
                }
                if !self.changed().await? {
                    return self.gone();
                }
            }
            let status = self.record.borrow_and_update().status.clone();
            let status = self.service.shown(status);
            let WatchUntil { semantics, edits } = self.until;
            // Of a scene that waits for its semantics alone there is no other version.
            let versions = edits || !semantics || status.refinement.state != RefineState::None;
            let event = match self.service.event(&status) {
                Event::Done if versions && self.before.as_ref().is_some_and(is_version) => {
                    let fraction = status.refinement.fraction;
                    Event::Version { version: status.version, fraction }
                }
                event => event,
            };
            let goes_on = status.is_refined_now()
                || edits
                || semantics && awaits_semantics(&status, self.before.is_none());
            let refined = mem::replace(&mut self.refined, status.is_refined_now());
            // How far a refinement is, is told with the next version, or with its end.
            let ended = edits && refined && !self.refined;
            let same = |before: &Event| same_version(before, &event) || edits && *before == event;
            if goes_on && !ended && self.before.as_ref().is_some_and(same) {
                continue;
            }
            self.over = match event {
                Event::Failed(_) | Event::Cancelled => true,
                _ => (event.is_last() || is_version(&event)) && !goes_on,
            };
            self.before = Some(event.clone());
            return Some(event);
        }
    }

    /// Waits until something may have changed; `None` where the server stops, `false` where the
    /// scene is gone.
    async fn changed(&mut self) -> Option<bool> {
        let inner = &self.service.inner;
        // Of lists that other replicas put nothing rings.
        let look_again = self.until.edits && inner.store.is_shared();
        let fresh = Duration::from_millis(inner.limits().record_fresh_ms.max(1));
        tokio::select! {
            changed = self.record.changed() => Some(changed.is_ok()),
            Ok(()) = self.edits.changed(), if self.until.edits => Some(true),
            () = tokio::time::sleep(fresh), if look_again => Some(true),
            () = inner.stopped_waiting() => None,
        }
    }

    /// The list of edits, where it is not the one that was told.
    async fn edited(&mut self) -> Option<Event> {
        if !self.until.edits {
            return None;
        }
        // What cannot be read now is told when it can.
        let access = self.service.scene(&self.id).await.and_then(SceneAccess::finished).ok()?;
        let (list, told) = (access.edits(), self.list.as_deref());
        if told == Some(list.sha256()) {
            return None;
        }
        self.list = Some(list.sha256().to_owned());
        Some(Event::Edited { edits: list.len() })
    }

    /// The end of a scene that was deleted, for who waits for nothing else.
    fn gone(&mut self) -> Option<Event> {
        self.over = true;
        self.until.edits.then_some(Event::Cancelled)
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
