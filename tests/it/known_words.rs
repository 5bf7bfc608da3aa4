//! What the embedded bundle says of everyday words, held to the page that says it to people.

use segsplat::{
    cli::engine::models_info,
    models::Bundle,
    service::{KnownWord, Trust},
};

use crate::common::root;

#[test]
fn the_models_answer_and_the_page_of_words_say_the_same() {
    let bundle = Bundle::open(&root().join("models/embedded")).unwrap();
    let words = models_info(&bundle, "cpu").unwrap().words;
    assert!(words.len() >= 300, "{} words", words.len());
    let page = std::fs::read_to_string(root().join("docs/words.md")).unwrap();
    for known in &words {
        let trust = serde_json::to_value(known.trust).unwrap();
        let found = |count: u32, share: Option<f32>| match share {
            Some(share) => format!("{count}, {:.0} %", 100.0 * share),
            None => "-".to_owned(),
        };
        let row = format!(
            "\n| {} | {} | {} | {} | {:.1} % |\n",
            known.word,
            trust.as_str().unwrap(),
            found(known.things, known.things_found),
            found(known.photographs, known.photographs_found),
            100.0 * known.absent,
        );
        assert!(page.contains(&row), "docs/words.md: no row {row:?}");
        let KnownWord { things_found, photographs_found, absent, .. } = known;
        let shares = [*things_found, *photographs_found, Some(*absent)];
        assert!(shares.iter().flatten().all(|v| (0.0..=1.0).contains(v)), "{known:?}");
        assert_eq!(things_found.is_none(), known.things == 0, "{known:?}");
        assert_eq!(photographs_found.is_none(), known.photographs == 0, "{known:?}");
    }
    let rows = page.lines().filter(|line| line.ends_with(" % |")).count();
    assert_eq!(rows, words.len(), "rows of docs/words.md");
    let count = |trust: Trust| words.iter().filter(|known| known.trust == trust).count();
    for (trust, what) in [
        (Trust::Good, "good"),
        (Trust::Fair, "fair"),
        (Trust::Poor, "poor"),
        (Trust::Unmeasured, "unmeasured"),
    ] {
        assert!(page.contains(&format!("{} {what}", count(trust))), "{} {what}", count(trust));
    }
}
