//! What was measured of the word of a text.

use std::collections::HashMap;

use super::types::KnownWord;

/// The words that the bundle was measured with, by name in lower case.
#[derive(Debug, Default)]
pub(super) struct KnownWords(HashMap<String, KnownWord>);

impl KnownWords {
    pub(super) fn new(words: &[KnownWord]) -> Self {
        Self(words.iter().map(|known| (known.word.to_lowercase(), known.clone())).collect())
    }

    /// The word that a text is about: the longest listed end of it, also in the plural. So "a photo
    /// of two coffee mugs" is about "coffee mug".
    pub(super) fn of(&self, text: &str) -> Option<&KnownWord> {
        let text = text.to_lowercase();
        let words: Vec<&str> = text.split_whitespace().collect();
        (0..words.len()).find_map(|first| {
            let end = words[first..].join(" ");
            let singular = |ending| Some(end.strip_suffix(ending)?.to_owned());
            let names = [Some(end.clone()), singular("s"), singular("es")];
            names.iter().flatten().find_map(|name| self.0.get(name))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::service::Trust;

    #[test]
    fn a_text_is_about_the_longest_word_that_it_ends_with() {
        let known = |word: &str| KnownWord {
            word: word.to_owned(),
            trust: Trust::Good,
            things: 0,
            things_found: None,
            photographs: 0,
            photographs_found: None,
            absent: 0.0,
        };
        let words = KnownWords::new(&["Mug", "coffee mug", "box", "glasses"].map(known));
        let of = |text: &str| words.of(text).map(|known| known.word.clone());
        assert_eq!(of("a photo of two Coffee  Mugs").as_deref(), Some("coffee mug"));
        assert_eq!(of("my red mug").as_deref(), Some("Mug"));
        assert_eq!(of("boxes").as_deref(), Some("box"));
        assert_eq!(of("glasses").as_deref(), Some("glasses"));
        assert_eq!(of("mug rack"), None);
        assert_eq!(of("  "), None);
    }
}
