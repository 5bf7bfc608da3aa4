//! The list of edits of a scene: kept beside it, and applied where a scene is loaded. So views,
//! texts, picks and exports see edited Gaussians and know nothing of edits.
//!
//! What is kept is the list as it was sent, and beside it the same edits by entries of the bank and
//! places ([`crate::scene::Edit`]). A version of the scene has other Gaussians and the same bank,
//! so a load needs no network. Where the semantics were made again, the list is resolved again.

mod calls;
mod kept;
mod resolve;
mod spec;
mod uncovered;

pub(super) use self::kept::{EditList, Edits};
pub use self::spec::{EditBox, EditOp, EditPick, EditSelection, EditSpec, EditSphere, SceneEdits};
