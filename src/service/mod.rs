//! The use cases: create, look up, list, delete, watch, render, export. No transport's words.
//!
//! [`Service`] is a cheap clone; its calls are async and never do heavy work on the async threads.

mod access;
mod camera;
mod coarse;
mod create;
mod edits;
mod encode;
mod export;
mod features;
mod folder;
mod infer;
mod memory;
mod offline;
mod page;
mod photos;
mod pick;
mod query;
mod refine;
mod request;
mod scale;
mod scenes;
mod schedule;
mod search;
mod semantics;
mod shared;
mod tags;
mod tasks;
mod texts;
mod times;
mod types;
mod view;
mod words;
mod work;

pub(crate) use self::{create::checked_words, refine::check_refine, request::numbers};
pub use self::{
    edits::{EditBox, EditOp, EditPick, EditSelection, EditSpec, EditSphere, SceneEdits},
    export::{scene_levels, scene_splats},
    folder::FolderSpec,
    infer::InferSpec,
    memory::Share,
    offline::OfflineService,
    page::{VIEWER, ViewerPage},
    request::{
        AddPhotos, BackgroundSpec, Boxes, CameraFields, CameraSpec, CreateScene, FeatureKind,
        FeaturesSpec, Format, LensSpec, MaskFormat, PageRequest, PickSpec, PictureKind,
        PictureOptions, PoseSpec, QuerySpec, ScoringOptions, TextOptions, ViewOptions, ViewSpec,
        ViewsSpec,
    },
    scale::{BoxSide, Measured, ScaleSource, ScaleSpec, ScaleThing, SceneScale},
    scenes::WatchUntil,
    shared::{Parts, Service},
    times::ViewTimes,
    types::{
        CallerLimits, Created, Export, ExportBody, ExportPlace, InstanceBox, KnownWord, Label,
        ModelInfo, ModelsInfo, Page, Peak, Picked, QueryAnswer, Readiness, RenderedView,
        TextResult, TextView, TextWarning, Trust,
    },
};
pub use crate::formats::{rle::Rle, table::ExportFormat};
pub use crate::render::{
    budget::{ERROR_FAST, MaxError},
    plan::default_near,
};
pub use crate::scene::{
    Density, Event, MaskLevel, Method, Preset, SceneCamera, SceneError, SceneOptions, SceneState,
    SceneStatus, SemanticsMode, SemanticsState, SemanticsStatus, Upload, UploadCameras, UploadFile,
};
pub(crate) use crate::store::Receiving;
