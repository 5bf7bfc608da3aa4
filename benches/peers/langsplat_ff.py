"""Feed-forward LangSplat beside our bank, on the same Gaussians, masks and embeddings.

    python langsplat_ff.py SEGSPLAT SCENES OUT [--bundle DIR --only A,B --recipe langsplat]

SEGSPLAT is the program, SCENES a folder of labelled scene folders (`masks/classes.json`, photos
without distortion), OUT takes a row a scene. A scene is made twice of the photos nearest to its
first labelled photo, with `preset=paper`: once with the paper's bank, once with
`bank_rows=4096`, so that each embedding of a mask is a row of its own. LangSplat (arXiv
2312.16084) without its training of the scene takes the second: its autoencoder (D to 3 and
back, its widths and its loss) is trained on the embeddings, each Gaussian gets the three numbers
of its mask, a view blends them, and the decoder gives each pixel its feature. Both are scored by
one function: LERF's relevancy, cut at 0.5. What differs is the bank against the autoencoder.

`--recipe paper` (the default) trains the autoencoder as SegSplat's paper does: AdamW, 2e-2,
batches of 2, 2,000 steps. The paper does not say two of what. Here they are two photos, so with
`--photos 2` each step has all embeddings; `--recipe paper-embeddings` takes two embeddings, of
which LangSplat's batch normalisation makes next to nothing. `--recipe langsplat` has LangSplat's
own rate, Adam 7e-4, with all embeddings in each step; the rows of 2026-11-22 have it.

Needs torch, numpy, onnxruntime, tokenizers, pillow."""

import argparse
import json
import os
import pathlib
import shutil
import statistics
import subprocess
import tempfile
import time
import tomllib

import numpy as np
import onnxruntime
import torch
from PIL import Image
from tokenizers import Tokenizer

# LangSplat's own: autoencoder/train.py and test.py, for CLIP's 512 numbers.
ENCODER = [256, 128, 64, 32, 3]
DECODER = [16, 32, 64, 128, 256, 256]
# How the autoencoder is trained: optimiser, rate, embeddings of a step (all: None).
RECIPES = {
    "paper": (torch.optim.AdamW, 2e-2, None),
    "paper-embeddings": (torch.optim.AdamW, 2e-2, 2),
    "langsplat": (torch.optim.Adam, 7e-4, None),
}


def run(program, bundle, *line):
    """The answer of the program, as JSON."""
    command = [program, *map(str, line), "--bundle", bundle, "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
    return json.loads(done.stdout)


class Texts:
    """The bundle's text tower."""

    def __init__(self, bundle):
        text = tomllib.loads((bundle / "bundle.toml").read_text())["image_text"]
        self.canon, self.tower = text["canon"], text["text"]
        self.tokenizer = Tokenizer.from_file(str(bundle / self.tower["tokenizer"]))
        self.tokenizer.no_padding()
        self.session = onnxruntime.InferenceSession(
            str(bundle / self.tower["file"]), providers=["CPUExecutionProvider"]
        )

    def embed(self, texts):
        """`[N, D]`, of length 1."""
        rows = []
        for text in texts:
            ids = np.array([self.tokenizer.encode(text).ids[: self.tower["context"]]], np.int64)
            feed = {self.tower.get("input_ids", "input_ids"): ids}
            mask = self.tower.get("attention_mask")
            feed |= {mask: np.ones_like(ids)} if mask else {}
            rows.append(self.session.run([self.tower["output"]], feed)[0][0])
        return unit(np.array(rows))


def unit(rows):
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)


class Autoencoder(torch.nn.Module):
    """LangSplat's: linear layers with batch normalisation and ReLU between those of the encoder."""

    def __init__(self, dim):
        super().__init__()
        layers, width = [], dim
        for i, next_width in enumerate(ENCODER):
            if i:
                layers += [torch.nn.BatchNorm1d(width), torch.nn.ReLU()]
            layers.append(torch.nn.Linear(width, next_width))
            width = next_width
        self.encoder = torch.nn.Sequential(*layers)
        layers = []
        for next_width in [*DECODER, dim]:
            if layers:
                layers.append(torch.nn.ReLU())
            layers.append(torch.nn.Linear(width, next_width))
            width = next_width
        self.decoder = torch.nn.Sequential(*layers)

    def encode(self, rows):
        return torch.nn.functional.normalize(self.encoder(rows), dim=-1)

    def decode(self, codes):
        return torch.nn.functional.normalize(self.decoder(codes), dim=-1)


def batches(count, size, seed):
    """Indices of the rows of each step, without end: all rows in a new order, some at a time. What
    is left of an order is fewer than a step needs, so it is left out.
    """
    order = torch.Generator().manual_seed(seed)
    size = min(size or count, count)
    while True:
        yield from torch.randperm(count, generator=order)[: count // size * size].split(size)


def train(rows, recipe, iterations, seed):
    """The autoencoder of these embeddings `[N, D]`, and its seconds."""
    torch.manual_seed(seed)
    model, rows = Autoencoder(rows.shape[1]), torch.from_numpy(rows)
    kind, rate, size = RECIPES[recipe]
    optimiser = kind(model.parameters(), lr=rate)
    begun = time.perf_counter()
    for _, chosen in zip(range(iterations), batches(len(rows), size, seed)):
        some = rows[chosen]
        found = model.decode(model.encode(some))
        apart = ((found - some) ** 2).sum(dim=1).mean()
        angle = (1 - torch.nn.functional.cosine_similarity(found, some, dim=0)).mean()
        loss = apart + 1e-3 * angle
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    seconds = time.perf_counter() - begun
    return model.eval(), seconds


def blended(view, values):
    """`[H * W, C]`: the values of the entries, weighted as the view's pixels show them (E)."""
    offsets = view["offsets"].astype(np.int64)
    pixels = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    weights = torch.sparse_coo_tensor(
        torch.from_numpy(np.stack([pixels, view["entries"].astype(np.int64) - 1])),
        torch.from_numpy(view["weights"]),
        (len(offsets) - 1, len(values)),
    )
    return torch.sparse.mm(weights, torch.from_numpy(np.ascontiguousarray(values)))


def selected(features, texts, canon, tau=10.0):
    """`[N, P]`: where each text selects, by LERF's relevancy; nothing where there is no feature."""
    phrases, canon = torch.from_numpy(texts), torch.from_numpy(canon)
    known = features.abs().sum(dim=1) > 0
    own, other = tau * features @ phrases.T, tau * features @ canon.T
    nearest = other.max(dim=1).values
    return ((own >= nearest[:, None]) & known[:, None]).T.numpy()


def mean_iou(masks, labels, names, asked):
    """Mean over the asked classes that the photo shows."""
    ious = []
    for mask, name in zip(masks, asked):
        truth = labels == names[name]
        if truth.any():
            ious.append((mask & truth).sum() / (mask | truth).sum())
    return statistics.fmean(map(float, ious))


def timed(work, rounds=5):
    """What `work` gives, and the median of its seconds."""
    seconds = []
    for _ in range(rounds):
        begun = time.perf_counter()
        found = work()
        seconds.append(time.perf_counter() - begun)
    return found, statistics.median(seconds)


def scene(args, texts, folder):
    """The row of one scene."""
    given = json.loads((folder / "transforms.json").read_text())
    assert not any(given.get(name) for name in ("k1", "k2", "p1", "p2")), "photos are undistorted"
    frames = given["frames"]
    poses = np.array([frame["transform_matrix"] for frame in frames])
    target = next(i for i, frame in enumerate(frames) if "mask_file" in frame)
    away = ((poses[:, :3, 3] - poses[target, :3, 3]) ** 2).sum(axis=1)
    away[target] = np.inf
    inputs = np.argsort(away, kind="stable")[: args.photos]
    classes = {
        name: int(k) for k, name in json.loads((folder / "masks/classes.json").read_text()).items()
    }
    about = folder / "scene.json"
    around = json.loads(about.read_text()).get("surroundings", []) if about.is_file() else []
    asked = [name for name in classes if name not in around]
    labels = np.array(Image.open(folder / frames[target]["mask_file"])).ravel()
    # OpenGL to OpenCV: y down, z forwards.
    pose = (poses[target] @ np.diag([1, -1, -1, 1])).ravel()
    camera = ["--camera-to-world=" + ",".join(map(repr, map(float, pose)))]
    camera += [
        f"--{name}={given[key]}"
        for name, key in zip(
            ["fx", "fy", "cx", "cy", "width", "height"], ["fl_x", "fl_y", "cx", "cy", "w", "h"]
        )
    ]
    phrases, canon = texts.embed(asked), texts.embed(["object", "things", "stuff"])
    row = {"scene": folder.name, "classes": len(asked), "inputs": [int(i) for i in inputs]}
    with tempfile.TemporaryDirectory() as place:
        place = pathlib.Path(place)
        photos = place / "photos"
        (photos / "images").mkdir(parents=True)
        chosen = [frames[i] for i in inputs]
        for frame in chosen:
            shutil.copy(folder / frame["file_path"], photos / frame["file_path"])
        kept = [{k: frame[k] for k in ("file_path", "transform_matrix")} for frame in chosen]
        (photos / "transforms.json").write_text(json.dumps({**given, "frames": kept}))
        files = {}
        for name, rows in (("ours", 0), ("each", 4096)):
            file = place / f"{name}.segsplat"
            made = run(
                args.segsplat,
                args.bundle,
                "reconstruct",
                photos,
                "-o",
                file,
                "--preset",
                "paper",
                "--semantics",
                "eager",
                "--method",
                f"bank_rows={rows}",
            )
            for kind, rest in (("bank", []), ("view", camera)):
                out = place / f"{name}-{kind}.npz"
                run(
                    args.segsplat,
                    args.bundle,
                    "features",
                    file,
                    "-o",
                    out,
                    *rest,
                    "--renderer",
                    "cpu",
                )
                files[name, kind] = dict(np.load(out))
            if name == "ours":
                stages = {stage["stage"]: stage["ms"] for stage in made["semantics"]["stages"]}
                row["gaussians"] = made["report"]["gaussians"]
    assert (files["ours", "bank"]["masks"][:, :2] == files["each", "bank"]["masks"][:, :2]).all()
    assert row["gaussians"] == len(files["each", "bank"]["index"]), "the same Gaussians"

    bank, view = files["ours", "bank"]["bank"], files["ours", "view"]
    features, view_s = timed(lambda: torch.nn.functional.normalize(blended(view, bank), dim=1))
    masks, text_s = timed(lambda: selected(features, phrases, canon))
    row["ours"] = {
        "miou": mean_iou(masks, labels, classes, asked),
        "rows": len(bank),
        "scene_s": stages["bank"] / 1e3,
        "view_s": view_s,
        "text_s": text_s,
        "bytes": bank.nbytes + 2 * row["gaussians"],
    }

    each, view = unit(files["each", "bank"]["bank"]), files["each", "view"]
    model, train_s = train(each, args.recipe, args.iterations, args.seed)
    with torch.no_grad():
        codes, encode_s = timed(lambda: model.encode(torch.from_numpy(each)))

        def seen():
            code = blended(view, codes.numpy())
            found = torch.zeros(len(code), each.shape[1])
            known = code.abs().sum(dim=1) > 0
            found[known] = model.decode(code[known])
            return found

        features, view_s = timed(seen)
        masks, text_s = timed(lambda: selected(features, phrases, canon))
        back = torch.nn.functional.cosine_similarity(model.decode(codes), torch.from_numpy(each))
    decoder = sum(values.numel() for values in model.decoder.parameters())
    row["langsplat_ff"] = {
        "miou": mean_iou(masks, labels, classes, asked),
        "embeddings": len(each),
        "cosine": float(back.mean()),
        "scene_s": train_s + encode_s,
        "view_s": view_s,
        "text_s": text_s,
        "bytes": 4 * decoder + 4 * 3 * row["gaussians"],
    }
    # The most that any code of the embeddings could give here.
    features = torch.nn.functional.normalize(blended(view, each), dim=1)
    row["uncompressed"] = {
        "miou": mean_iou(selected(features, phrases, canon), labels, classes, asked)
    }
    return row


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("segsplat")
    parser.add_argument("scenes", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--bundle", type=pathlib.Path, default=pathlib.Path("models/embedded"))
    parser.add_argument("--only", help="names of scenes, separated by commas")
    parser.add_argument("--photos", type=int, default=2)
    parser.add_argument("--recipe", choices=RECIPES, default="paper")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--table", default="langsplat-ff")
    parser.add_argument("--hashes", type=json.loads, default={}, help="of `report --hashes`")
    parser.add_argument("--commit", default="")
    parser.add_argument("--machine", default="this machine")
    args = parser.parse_args()
    if args.recipe == "paper" and args.photos != 2:
        parser.error(f"two photos a batch are all only with --photos 2, not {args.photos}")
    torch.set_num_threads(args.threads)
    texts, rows = Texts(args.bundle), []
    named = args.only.split(",") if args.only else None
    folders = [path.parents[1] for path in sorted(args.scenes.glob("*/masks/classes.json"))]
    for folder in folders:
        if named and folder.name not in named:
            continue
        rows.append(scene(args, texts, folder))
        print(json.dumps(rows[-1]), flush=True)
    ways = ("ours", "langsplat_ff", "uncompressed")
    mean = {
        way: {key: statistics.fmean(row[way][key] for row in rows) for key in rows[0][way]}
        for way in ways
    }
    mean |= {key: statistics.fmean(row[key] for row in rows) for key in ("gaussians", "classes")}
    rows.append({"scene": "**mean of scenes**", **mean})
    command = (
        f"langsplat_ff.py segsplat SCENES OUT --photos {args.photos} --recipe {args.recipe} "
        f"--iterations {args.iterations}"
    )
    with args.out.open("a") as file:
        for row in rows:
            source = {
                "table": args.table,
                "command": command,
                "hashes": args.hashes,
                "commit": args.commit,
                "machine": args.machine,
                "unix_s": int(time.time()),
                "error": {"one_less_miou": 1 - row["ours"]["miou"]},
            }
            file.write(json.dumps({**source, **row}) + "\n")


if __name__ == "__main__":
    main()
