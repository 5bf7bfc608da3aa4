//! No circles of files: what each file of a crate takes from which other files of it, read from
//! the text, and the groups of files that take from each other.
//!
//! An import is a name of another file that the code uses: in a `use` or in a path
//! (`crate::cpu::background`). It leads to the file that defines the name, also where a module
//! passes it on by `pub use`: a re-export hides nothing, and is no import of the file that has it
//! unless the code there uses the name too. A line `mod x;` is no import. So `x/mod.rs` and a child
//! are a circle where it uses the child and the child uses something that `x/mod.rs` defines.
//! Methods are not seen: a call does not say which file has them.

use std::collections::{BTreeMap, BTreeSet};

/// What a file takes from others: names by file.
pub(super) type Imports = BTreeMap<String, BTreeSet<String>>;

/// A file of a crate as far as imports need it.
struct Source {
    /// Its module, from the crate's root.
    module: Vec<String>,
    /// Its code without its `use` statements.
    code: String,
    /// Names that it defines at its top level.
    defined: BTreeSet<String>,
    /// Local names of its `use` statements, and their paths.
    used: Vec<(String, Vec<String>)>,
}

/// A crate's files by their names.
struct Sources(BTreeMap<String, Source>);

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// The code without what stands behind `//` in a line. In a module inside the file, `super` is the
/// file.
fn simplified(code: &str) -> String {
    let (mut lines, mut inside) = (Vec::new(), false);
    for line in code.lines() {
        let begins = !line.starts_with(' ') && line.ends_with('{') && line.contains("mod ");
        inside = (inside || begins) && line != "}";
        let line = line.split(" // ").next().unwrap_or_default();
        lines.push(if inside { line.replace("super::", "self::") } else { line.to_owned() });
    }
    lines.join("\n")
}

/// Takes the `use` statements out of some code: what is left, and their trees.
fn split_uses(code: &str) -> (String, Vec<String>) {
    let (mut rest, mut trees) = (String::new(), Vec::new());
    let mut tail = code;
    while let Some(at) = tail.find("use ") {
        let (before, statement) = tail.split_at(at);
        let line = before.rsplit('\n').next().unwrap_or_default().trim();
        let starts = line.is_empty() || (line.starts_with("pub") && !line.contains(' '));
        let end = statement.find(';').unwrap_or(statement.len());
        rest.push_str(before);
        if starts {
            trees.push(statement[4..end].split_whitespace().collect::<Vec<_>>().join(" "));
            tail = &statement[end..];
        } else {
            rest.push_str("use ");
            tail = &statement[4..];
        }
    }
    rest.push_str(tail);
    (rest, trees)
}

/// The names that a tree of a `use` statement brings, each with its path.
fn leaves(tree: &str, before: &[String], found: &mut Vec<(String, Vec<String>)>) {
    let tree = tree.trim();
    if let Some(at) = tree.find('{') {
        let mut path = before.to_vec();
        path.extend(
            tree[..at].split("::").map(str::trim).filter(|s| !s.is_empty()).map(String::from),
        );
        let inner = &tree[at + 1..tree.rfind('}').unwrap_or(tree.len())];
        let (mut depth, mut start) = (0, 0);
        for (i, c) in inner.char_indices() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    leaves(&inner[start..i], &path, found);
                    start = i + 1;
                }
                _ => {}
            }
        }
        return leaves(&inner[start..], &path, found);
    }
    if tree.is_empty() {
        return;
    }
    let (path, alias) = tree.split_once(" as ").unwrap_or((tree, ""));
    let mut whole = before.to_vec();
    whole.extend(path.split("::").map(|s| s.trim().to_owned()));
    if whole.len() > 1 && whole.last().is_some_and(|last| last == "self") {
        whole.pop();
    }
    let own = whole.last().cloned().unwrap_or_default();
    found.push((if alias.is_empty() { own } else { alias.trim().to_owned() }, whole));
}

/// Whether a line is `mod x;`: another file.
fn is_declaration(line: &str) -> bool {
    let words: Vec<&str> = line.split_whitespace().collect();
    line.ends_with(';') && words.iter().rev().nth(1) == Some(&"mod")
}

/// The name that a line at the left edge defines.
fn definition(line: &str) -> Option<String> {
    const KINDS: [&str; 10] = [
        "struct",
        "enum",
        "trait",
        "type",
        "fn",
        "const",
        "static",
        "union",
        "macro_rules!",
        "mod",
    ];
    if line.starts_with(' ') {
        return None;
    }
    let mut words = line
        .split_whitespace()
        .skip_while(|word| word.starts_with("pub") || ["async", "unsafe"].contains(word));
    let mut kind = words.next()?;
    let mut name = words.next()?;
    if kind == "const" && name == "fn" {
        (kind, name) = ("fn", words.next()?);
    }
    KINDS.contains(&kind).then(|| name.chars().take_while(|c| is_word(*c)).collect())
}

/// The paths of two or more names in some code, such as `a::b::C`.
fn paths(code: &str) -> BTreeSet<Vec<String>> {
    let mut found = BTreeSet::new();
    let part = |c: char| is_word(c) || c == ':';
    for piece in code.split(|c| !part(c)).filter(|piece| piece.contains("::")) {
        let names = piece.split("::").map(|name| name.trim_matches(':').to_owned());
        let names: Vec<_> = names.take_while(|name| !name.is_empty()).collect();
        if names.len() > 1 {
            found.insert(names);
        }
    }
    found
}

impl Sources {
    /// The files of the crate whose sources are in `folder`: name and code of each. A program's
    /// `main.rs` is another crate.
    fn new(folder: &str, files: &[(String, String)]) -> Self {
        let mut all = BTreeMap::new();
        for (name, code) in files {
            let Some(module) = name.strip_prefix(folder).and_then(|n| n.strip_suffix(".rs")) else {
                continue;
            };
            let mut module: Vec<String> = module.split('/').map(str::to_owned).collect();
            if ["mod", "lib"].contains(&module[module.len() - 1].as_str()) {
                module.pop();
            }
            if module == ["main"] {
                continue;
            }
            let (code, trees) = split_uses(&simplified(code));
            let code: Vec<&str> = code.lines().filter(|line| !is_declaration(line)).collect();
            let (code, defined) =
                (code.join("\n"), code.iter().filter_map(|line| definition(line)).collect());
            let mut used = Vec::new();
            trees.iter().for_each(|tree| leaves(tree, &[], &mut used));
            all.insert(name.clone(), Source { module, code, defined, used });
        }
        Self(all)
    }

    fn at(&self, module: &[String]) -> Option<&str> {
        let found = self.0.iter().find(|(_, source)| source.module == module);
        found.map(|(name, _)| name.as_str())
    }

    /// The module of this crate that a path begins at, seen from `from`, and the names after it.
    /// `None`: the path is of another crate.
    fn start<'p>(
        &self,
        from: &[String],
        path: &'p [String],
    ) -> Option<(Vec<String>, &'p [String])> {
        let (mut module, mut rest) = (from.to_vec(), path);
        match path.first()?.as_str() {
            "crate" => (module, rest) = (Vec::new(), &path[1..]),
            "self" => rest = &path[1..],
            "super" => {
                while rest.first().is_some_and(|name| name == "super") {
                    module.pop();
                    rest = &rest[1..];
                }
            }
            name => {
                module.push(name.to_owned());
                self.at(&module)?;
                rest = &path[1..];
            }
        }
        Some((module, rest))
    }

    /// The module that a path leads to and the name in it; no name where the path is a module's.
    fn resolve(&self, from: &[String], path: &[String]) -> Option<(Vec<String>, Option<String>)> {
        let (mut module, mut rest) = self.start(from, path)?;
        while let Some(name) = rest.first() {
            module.push(name.clone());
            if self.at(&module).is_none() {
                module.pop();
                break;
            }
            rest = &rest[1..];
        }
        let Some(name) = rest.first() else { return Some((module, None)) };
        let source = &self.0[self.at(&module)?];
        if !source.defined.contains(name) {
            // Passed on from another file, or from another crate.
            if let Some((_, passed)) = source.used.iter().find(|(local, _)| local == name) {
                let mut whole = passed.clone();
                whole.extend_from_slice(&rest[1..]);
                let known = *passed != path && self.start(&module, passed).is_some();
                return if known { self.resolve(&module, &whole) } else { None };
            }
        }
        Some((module, Some(name.clone())))
    }

    fn imports_of(&self, name: &str, source: &Source) -> Imports {
        let mut found = Imports::new();
        let mut add = |from: &[String], path: &[String]| {
            if let Some((module, Some(item))) = self.resolve(from, path)
                && let Some(file) = self.at(&module)
                && file != name
            {
                found.entry(file.to_owned()).or_default().insert(item);
            }
        };
        let paths = paths(&source.code);
        let words: BTreeSet<&str> = source.code.split(|c| !is_word(c)).collect();
        for path in &paths {
            add(&source.module, path);
        }
        for (local, path) in &source.used {
            match self.resolve(&source.module, path) {
                // A module: what the code takes from it by its name.
                Some((module, None)) => {
                    for inner in paths.iter().filter(|inner| inner[0] == *local) {
                        let mut whole = vec!["crate".to_owned()];
                        whole.extend(module.iter().chain(&inner[1..]).cloned());
                        add(&[], &whole);
                    }
                }
                // Also a trait for its methods alone, and all that a module has.
                Some(_) if words.contains(local.as_str()) || ["_", "*"].contains(&&**local) => {
                    add(&source.module, path);
                }
                _ => {}
            }
        }
        found
    }
}

/// What each file of the crate in `folder` takes from its others, of all `files`: name and code.
pub(super) fn imports(folder: &str, files: &[(String, String)]) -> BTreeMap<String, Imports> {
    let all = Sources::new(folder, files);
    all.0.iter().map(|(name, source)| (name.clone(), all.imports_of(name, source))).collect()
}

/// Groups of files that take from each other, round about.
pub(super) fn circles(imports: &BTreeMap<String, Imports>) -> Vec<Vec<String>> {
    let reached = |from: &String| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![from]);
        while let Some(file) = open.pop() {
            for next in imports.get(file).into_iter().flat_map(BTreeMap::keys) {
                if seen.insert(next) {
                    open.push(next);
                }
            }
        }
        seen
    };
    let reached: BTreeMap<&String, BTreeSet<&String>> =
        imports.keys().map(|file| (file, reached(file))).collect();
    let mut found: Vec<Vec<String>> = Vec::new();
    for (file, to) in &reached {
        if to.contains(file) && !found.iter().flatten().any(|known| known == *file) {
            let back = |other: &&&String| reached[**other].contains(file);
            found.push(to.iter().filter(back).map(|other| (*other).clone()).collect());
        }
    }
    found
}
