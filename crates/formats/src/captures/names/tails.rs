//! Paths by their last parts: a tree of parts from the last to the first.

use std::collections::HashMap;

/// Paths by their tails. A node stands for a tail: all paths that end with it.
pub(crate) struct Tails<'a> {
    next: HashMap<(usize, &'a str), usize>,
    nodes: Vec<Node>,
    /// The nodes of each path, the shortest tail first.
    of: HashMap<usize, Vec<usize>>,
}

#[derive(Default)]
struct Node {
    /// Paths that end with this tail; those that were taken are removed when they are met.
    paths: Vec<usize>,
    /// Those of them that have no other part.
    whole: Vec<usize>,
}

/// The node of the empty tail.
const ROOT: usize = 0;

impl<'a> Tails<'a> {
    /// The tree of paths, each with a number and its parts.
    pub(crate) fn new(paths: impl Iterator<Item = (usize, &'a [String])>) -> Self {
        let mut tails =
            Self { next: HashMap::new(), nodes: vec![Node::default()], of: HashMap::new() };
        for (path, parts) in paths {
            let mut node = ROOT;
            let mut nodes = Vec::with_capacity(parts.len());
            for part in parts.iter().rev() {
                let new = tails.nodes.len();
                node = *tails.next.entry((node, part)).or_insert(new);
                if node == new {
                    tails.nodes.push(Node::default());
                }
                tails.nodes[node].paths.push(path);
                nodes.push(node);
            }
            tails.nodes[node].whole.push(path);
            tails.of.insert(path, nodes);
        }
        tails
    }

    /// The nodes of the tails of `parts` that some path ends with, the shortest first.
    pub(crate) fn walk(&self, parts: &'a [String]) -> Vec<usize> {
        let mut node = ROOT;
        let step = |part: &'a String| {
            node = *self.next.get(&(node, part))?;
            Some(node)
        };
        parts.iter().rev().map_while(step).collect()
    }

    /// How many of the last parts some path ends with, and one such path.
    pub(crate) fn longest(&self, parts: &[String]) -> (usize, Option<usize>) {
        let (mut node, mut length) = (ROOT, 0);
        for part in parts.iter().rev() {
            let Some(&next) = self.next.get(&(node, part.as_str())) else { break };
            (node, length) = (next, length + 1);
        }
        let any = if length > 0 { self.nodes[node].paths.first().copied() } else { None };
        (length, any)
    }

    /// Up to two paths of a node that were not taken. Those that have no part before the tail come
    /// alone.
    pub(crate) fn free(&mut self, node: usize) -> Vec<usize> {
        let Node { paths, whole } = &mut self.nodes[node];
        let of = &self.of;
        let two = |paths: &mut Vec<usize>| {
            let mut at = paths.len();
            while at > paths.len().saturating_sub(2) && at > 0 {
                at -= 1;
                if !of.contains_key(&paths[at]) {
                    paths.swap_remove(at);
                    at = paths.len().min(at + 1);
                }
            }
            let mut two = paths[paths.len().saturating_sub(2)..].to_vec();
            two.sort_unstable();
            two
        };
        let alone = two(whole);
        if alone.is_empty() { two(paths) } else { alone }
    }

    /// Takes a path out.
    pub(crate) fn take(&mut self, path: usize) {
        self.of.remove(&path);
    }
}
