//! Checks of the texts of a request: how many, how long, of what.

use super::request::{PictureKind, ScoringOptions, TextOptions};
use crate::{
    error::{Error, Result},
    formats::table::ExportFormat,
    limits::Limits,
    scene::{Preset, ScoringMethod},
};

/// A text without the blanks around it, within its bounds; `what` names it: `texts[3]`.
pub(super) fn checked(text: &str, what: &str, limits: &Limits) -> Result<String> {
    let max = limits.text_chars_max;
    let count = text.chars().count();
    if count > max {
        return Err(Error::limit(what, format!("{count} characters"), format!("{max} characters")));
    }
    if let Some((at, odd)) = text.chars().enumerate().find(|(_, c)| c.is_control()) {
        return Err(Error::invalid(format!(
            "{what} has the control character U+{:04X} at {at}",
            odd as u32
        )));
    }
    let text = text.trim();
    if text.is_empty() {
        return Err(Error::invalid(format!("{what} is empty; say what to look for")));
    }
    Ok(text.to_owned())
}

/// Refuses a text without a kind that takes one, and such a kind without a text; gives the text
/// checked.
pub(super) fn check_ask(
    kinds: &[PictureKind],
    ask: &TextOptions,
    limits: &Limits,
) -> Result<TextOptions> {
    check_scoring(&ask.scoring, limits)?;
    let takes = kinds.iter().find(|kind| kind.takes_text());
    let text = match (&ask.text, takes) {
        (None, None) => None,
        (Some(text), Some(_)) => Some(checked(text, "text", limits)?),
        (None, Some(kind)) => {
            return Err(Error::invalid(format!("kind={kind} needs text: what to look for")));
        }
        (Some(_), None) => {
            let names: Vec<_> = kinds.iter().map(ToString::to_string).collect();
            return Err(Error::invalid(format!(
                "text goes with kind=relevancy and kind=mask, not with {}",
                names.join(", ")
            )));
        }
    };
    Ok(TextOptions { text, ..ask.clone() })
}

/// The texts of an export that shows several: one a line.
pub(super) fn lines(ask: &TextOptions) -> Vec<String> {
    ask.text.iter().flat_map(|text| text.lines().map(str::to_owned)).collect()
}

/// The refusal of a text of an export whose format, `name`, takes none.
pub(super) fn not_with(name: &str) -> Error {
    let names = ExportFormat::listed(|format| format.lines, |row| row.name);
    Error::invalid(format!("text goes with the formats of Gaussians, {names}, not with {name}"))
}

/// Refuses a list that is empty or longer than `max`; `what` names it.
pub(super) fn check_count(what: &str, count: usize, max: usize) -> Result<()> {
    match count {
        0 => Err(Error::invalid(format!("no {what}; give 1 to {max}"))),
        _ if count > max => Err(Error::limit(what, count, max)),
        _ => Ok(()),
    }
}

/// Each of `texts` checked; there must be 1 to `limits.texts_max`. `what` names the list.
pub(super) fn all_checked(texts: &[String], what: &str, limits: &Limits) -> Result<Vec<String>> {
    check_count(what, texts.len(), limits.texts_max)?;
    let each = texts.iter().enumerate();
    each.map(|(i, text)| checked(text, &format!("{what}[{i}]"), limits)).collect()
}

/// Checks the changes of a request before anything is made for it: numbers, and canonical texts as
/// other texts.
pub(super) fn check_scoring(changes: &ScoringOptions, limits: &Limits) -> Result<()> {
    let canon = ScoringMethod::CANON.map(str::to_owned).to_vec();
    changes.change(ScoringMethod::of(Preset::Paper, canon, 1.0, 0.0, 0.0, 1.0)).check()?;
    if changes.canon.is_empty() {
        Ok(())
    } else {
        all_checked(&changes.canon, "canon", limits).map(drop)
    }
}
