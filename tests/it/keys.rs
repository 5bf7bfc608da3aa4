//! The file of API keys: which keys it holds, what it refuses.

use segsplat::keys::{Keys, Scope, generate, key_sha256};

const READ: &str = "scopes = [\"read\"]";

fn file(rows: &[(&str, &str, &str)]) -> String {
    let row = |(name, key, rest): &(&str, &str, &str)| {
        format!("[[key]]\nname = \"{name}\"\nsha256 = \"{}\"\n{rest}\n", key_sha256(key))
    };
    rows.iter().map(row).collect()
}

#[test]
fn a_key_is_found_by_itself_alone() {
    let (first, second) = (generate().unwrap(), generate().unwrap());
    assert_ne!(first, second);
    assert_eq!(first.len(), "segsplat_".len() + 64);
    let text = file(&[
        ("a", &first, "scopes = [\"read\"]"),
        ("b", &second, "owner = \"team\"\nscopes = [\"write\", \"read\"]"),
    ]);
    let keys = Keys::parse(&text).unwrap();
    assert_eq!(&*keys.find(&first).unwrap().1.name, "a");
    let (at, found) = keys.find(&second).unwrap();
    assert_eq!(at, 1);
    assert_eq!((&*found.name, &*found.owner, found.scope), ("b", "team", Scope::Write));
    for wrong in ["", "a", &first[1..], &key_sha256(&first), &format!("{first} ")] {
        assert!(keys.find(wrong).is_none(), "{wrong:?} is let in");
    }
}

#[test]
fn an_owner_sees_its_own_and_admin_sees_all() {
    let all = file(&[("a", "x", "scopes = [\"admin\"]"), ("b", "y", "scopes = [\"read\"]")]);
    let keys = Keys::parse(&all).unwrap();
    let (admin, reader) = (keys.find("x").unwrap().1.caller(), keys.find("y").unwrap().1.caller());
    assert_eq!((admin.owner(), reader.owner()), (None, Some("b")));
    for owner in [None, Some("b"), Some("c")] {
        assert!(admin.sees(owner));
        assert_eq!(reader.sees(owner), owner == Some("b"), "{owner:?}");
    }
}

#[test]
fn a_wrong_file_is_refused_without_showing_its_hashes() {
    let sha = key_sha256("x");
    for (text, want) in [
        (String::new(), "no [[key]]"),
        (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}\"\nscopes = []"), "scopes is empty"),
        (format!("[[key]]\nname = \"a b\"\nsha256 = \"{sha}\"\nscopes = [\"read\"]"), "name"),
        (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}0\"\nscopes = [\"read\"]"), "64 hex"),
        (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}\"\nscopes = [\"root\"]"), "variant"),
        (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}\" x\nscopes = [\"read\"]"), ""),
        (file(&[("a", "x", READ), ("a", "y", READ)]), "twice"),
        (file(&[("a", "x", READ), ("b", "x", READ)]), "twice"),
        (file(&[("a", "x", &format!("{READ}\nkey = \"x\""))]), "unknown field"),
        (file(&[("a", "x", &format!("{READ}\nrequests_per_s = 0"))]), "over 0"),
    ] {
        let error = Keys::parse(&text).expect_err(&text);
        assert!(error.message().contains(want), "{}: {want}", error.message());
        assert!(!error.message().contains(&sha), "{}", error.message());
    }
}
