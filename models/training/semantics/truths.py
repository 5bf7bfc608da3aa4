"""For the packers: embeddings of words, what is true of each class of a vocabulary, other words for a name."""
import json
import os
from collections import defaultdict

import numpy as np
import onnx
import onnxruntime as ort

from wordnet import BODILY, GENERAL

HERE = os.path.dirname(os.path.abspath(__file__))
NOUNS = 2500  # of WordNet, beside the names of the sets: things that a photo does not show


def everyday_names():
    """Names that people use for classes of ImageNet and COCO: class name -> further true words."""
    out = {}
    for row in open(os.path.join(HERE, "synonyms.txt")):
        if ":" in row and not row.startswith("#"):
            name, also = row.split(":")
            out[name.strip()] = [w.strip() for w in also.split(",")]
    return out


def synonyms(data):
    """name -> other words for it, of both lists."""
    out = defaultdict(set)
    for name, also in [*json.load(open(os.path.join(data, "images", "synonyms.json"))).items(), *everyday_names().items()]:
        out[name] |= set(also)
    return out


def more_nouns(vocab, net, rng):
    """Puts nouns of WordNet into the vocabulary: the shorter and the less special, the better."""
    pool = [w for w, offs in net.first.items() if net.kind[offs[0]] in BODILY and len(w) < 16 and w.count(" ") < 2 and w.isascii()]
    pool.sort(key=lambda w: -len(net.first[w]) + rng.random())
    for w in pool[:NOUNS]:
        if w not in GENERAL:
            vocab.word(w)


def embedded(folder, bundle, words):
    """Embeddings of words, and in the space before it is centred and turned, where likeness means likeness."""
    model = onnx.load(os.path.join(folder, bundle.manifest["text"]["file"]))
    sub = next(n for n in model.graph.node if n.op_type == "Sub" and "centre" in n.input)
    model.graph.output.append(onnx.helper.make_tensor_value_info(sub.input[0], onnx.TensorProto.FLOAT, None))
    run = ort.InferenceSession(model.SerializeToString())
    ids = [bundle.tokens.encode(w.lower()).ids[:24] for w in words]
    mine, raw, by = [None] * len(words), [None] * len(words), defaultdict(list)
    for i, t in enumerate(ids):
        by[len(t)].append(i)
    for group in by.values():
        for k in range(0, len(group), 256):
            part = group[k : k + 256]
            for i, x, y in zip(part, *run.run(None, {"input_ids": np.array([ids[i] for i in part], np.int64)})):
                mine[i], raw[i] = x, y
    return np.stack(mine), np.stack(raw)


def truth_table(vocab, net, everyday, raw, colours):
    """[classes + 1, words]: 1 true of the class, 0 false, -1 left open."""
    below = defaultdict(set)
    for w in vocab.words:
        offs = [o for o in net.first.get(w, []) if net.kind[o] in BODILY]
        for o in set().union(*[net.lineage(o) | {o} for o in offs]) if offs else set():
            below[o].add(vocab.index[w])
    truth = np.zeros((len(vocab.classes) + 1, len(vocab.words)), np.int8)
    for i, c in enumerate(vocab.classes):
        truth[i, raw @ raw[c["own"]] > 0.62] = -1
        truth[i, sorted(below.get(c["offset"], set()))] = -1
        said = everyday.alike[c["name"]] | everyday.alike[c["name"].split()[-1]] | everyday.parts[c["name"]] | everyday.parts[c["name"].split()[-1]]
        truth[i, [vocab.index[w] for w in said & set(vocab.index)]] = -1
        truth[i, colours] = -1
        truth[i, c["true"]] = 1
    return truth
