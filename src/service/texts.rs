//! Checks of the texts of a request: how many, how long, of what.

use super::request::{Kind, TextOptions};
use crate::{
    error::{Error, Result},
    limits::Limits,
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
pub(super) fn check_ask(kinds: &[Kind], ask: &TextOptions, limits: &Limits) -> Result<TextOptions> {
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

/// Each of `texts` checked; there must be 1 to `limits.texts_max`. `what` names the list.
pub(super) fn all_checked(texts: &[String], what: &str, limits: &Limits) -> Result<Vec<String>> {
    let max = limits.texts_max;
    if texts.is_empty() {
        return Err(Error::invalid(format!("no {what}; give 1 to {max}")));
    }
    if texts.len() > max {
        return Err(Error::limit(what, texts.len(), max));
    }
    let each = texts.iter().enumerate();
    each.map(|(i, text)| checked(text, &format!("{what}[{i}]"), limits)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;

    #[test]
    fn a_text_is_refused_for_what_is_wrong_with_it() {
        let limits = Limits::default();
        let refused = |text: &str| {
            let error = checked(text, "texts[3]", &limits).expect_err("refused");
            assert!(error.message().starts_with("texts[3]"), "{error}");
            (error.code(), error.message().to_owned())
        };
        assert!(refused("").1.contains("empty"));
        assert!(refused(" \u{a0} ").1.contains("empty"), "blanks alone");
        let (code, message) = refused(&"x".repeat(10_000));
        assert_eq!(code, ErrorCode::LimitExceeded);
        assert!(message.contains("10000 characters") && message.contains("256"), "{message}");
        assert!(refused("a\u{7}b").1.contains("U+0007 at 1"));
        assert!(refused("line\n").1.contains("U+000A at 4"));
        for good in ["chair", "🦊", "кресло", "a red  chair", &"é".repeat(256)] {
            assert_eq!(checked(good, "text", &limits).unwrap(), good);
        }
        assert_eq!(checked("  chair ", "text", &limits).unwrap(), "chair");
    }

    #[test]
    fn there_are_1_to_128_texts() {
        let limits = Limits::default();
        let refused = |count: usize| {
            let texts = vec!["chair".to_owned(); count];
            all_checked(&texts, "texts", &limits).map(|texts| texts.len()).map_err(|e| e.code())
        };
        assert_eq!(refused(0), Err(ErrorCode::InvalidRequest));
        assert_eq!(refused(128), Ok(128));
        assert_eq!(refused(129), Err(ErrorCode::LimitExceeded));
    }
}
