"""WordNet's nouns (the folder `dict` of Debian's wordnet-base): words, glosses, what is a kind of what."""
import os
import re

# Too general to be asked for, or to be told from anything else.
GENERAL = """entity|physical entity|abstraction|abstract entity|object|physical object|whole|unit|artifact|artefact|
thing|matter|substance|part|piece|relation|group|grouping|living thing|animate thing|organism|being|causal agent|
cause|causal agency|psychological feature|attribute|measure|quantity|amount|state|instrumentality|instrumentation|
device|material|stuff|solid|commodity|trade good|good|creation|structure|construction|consumer goods|covering|
vertebrate|craniate|chordate|placental|placental mammal|eutherian|eutherian mammal|carnivore|domestic animal|
domesticated animal|implement|equipment|durables|durable goods|consumer durables|conveyance|transport|
body part|natural object|nutriment|nourishment|nutrition|sustenance|aliment|alimentation|victuals|vascular plant|
tracheophyte|reproductive structure|plant organ|plant part|plant structure|entertainer|system|product|production|
component|constituent|element|way|area|location|region|surface|horizontal surface|extremity|end|line|shape|form""".replace("\n", "").split("|")

# Lexicographer files of what can be seen: animals, artifacts, bodies, food, objects, people, plants, substances.
BODILY = {5, 6, 8, 13, 17, 18, 20, 27}


class WordNet:
    """`synsets`: offset -> (words, gloss, hypernym offsets); `first`: word -> offsets in WordNet's order."""

    def __init__(self, folder):
        self.synsets, self.first, self.kind = {}, {}, {}
        with open(os.path.join(folder, "data.noun"), encoding="latin-1") as file:
            for row in file:
                if row.startswith("  "):
                    continue
                data, gloss = row.split(" | ", 1)
                f = data.split()
                n = int(f[3], 16)
                words = [f[4 + 2 * i].replace("_", " ") for i in range(n)]
                rest = f[4 + 2 * n :]
                up = [int(rest[2 + 4 * i]) for i in range(int(rest[0])) if rest[1 + 4 * i] in ("@", "@i")]
                self.kind[int(f[0])] = int(f[1])
                self.synsets[int(f[0])] = (words, gloss.split(";")[0].strip(), up)
        with open(os.path.join(folder, "index.noun"), encoding="latin-1") as file:
            for row in file:
                if row.startswith("  "):
                    continue
                f = row.split()
                senses = int(f[2])
                word = f[0].replace("_", " ")
                self.first[word] = [int(x) for x in f[-senses:]]

    def find(self, name):
        """Offset of the first bodily sense of a name or of its singular, else of its first sense, else None."""
        name = name.lower().strip()
        for form in (name, re.sub(r"ies$", "y", name), re.sub(r"es$", "", name), re.sub(r"s$", "", name)):
            if form in self.first:
                senses = self.first[form]
                return next((o for o in senses if self.kind[o] in BODILY), senses[0])
        return None

    def above(self, offset, most=9):
        """Words of what it is a kind of, nearest first, without what is too general."""
        out, todo, seen = [], [(u, 1) for u in self.synsets[offset][2]], set()
        while todo:
            at, depth = todo.pop(0)
            if at in seen or depth > most:
                continue
            seen.add(at)
            out += [w.lower() for w in self.synsets[at][0] if w.lower() not in GENERAL]
            todo += [(u, depth + 1) for u in self.synsets[at][2]]
        return out

    def lineage(self, offset):
        """Offsets of all that it is a kind of."""
        out, todo = set(), list(self.synsets[offset][2])
        while todo:
            at = todo.pop()
            if at not in out:
                out.add(at)
                todo += self.synsets[at][2]
        return out
