"""The paper's five rows of run time, through HTTP: photos to the first text, stage by stage.

    segsplat serve --bundle BUNDLE --provider cuda --listen 127.0.0.1:8080 --open-metrics &
    python runtime.py http://127.0.0.1:8080 SCENE OUT.jsonl [--frames 4 5 --side 256 --runs 9]

SCENE is a folder with a `transforms.json`; two of its photos are cropped and resized to SIDE x
SIDE. Each run posts them anew (`preset=paper`, `semantics=eager`) and asks a text that no run
before asked; the time ends with its mask. The first run is not counted. OUT takes one row of the
table `paper-time`: medians, of stages and calls alike. Needs pillow."""

import argparse
import io
import json
import pathlib
import re
import statistics
import sys
import time
import urllib.request

from PIL import Image

sys.path.append(str(pathlib.Path(__file__).parents[2] / "scripts"))
from form import form  # noqa: E402

# Calls of a known text and of a view.
CALLS = 50


def call(url, body=None, content="application/json", method=None):
    """The answer's body and its headers."""
    headers = {"content-type": content} if body else {}
    request = urllib.request.Request(url, body, headers, method=method)
    with urllib.request.urlopen(request, timeout=600) as answer:
        return answer.read(), answer.headers


def photos(scene, frames, side):
    """PNG files of SIDE x SIDE and their `transforms.json`: the middle of each photo, resized."""
    lens = json.loads((scene / "transforms.json").read_text())
    files, out = [], []
    for at in frames:
        frame = {**lens, **lens["frames"][at]}
        photo = Image.open(scene / frame["file_path"]).convert("RGB")
        scale = min(photo.size) / side
        x, y = ((size - side * scale) / 2 for size in photo.size)
        box = (x, y, x + side * scale, y + side * scale)
        file = io.BytesIO()
        photo.resize((side, side), Image.LANCZOS, box=box).save(file, "PNG")
        files.append(file.getvalue())
        # The lens distorts in coordinates of the image plane, so its terms stay.
        named = ["transform_matrix", "k1", "k2", "p1", "p2"]
        kept = {name: frame[name] for name in named if name in frame}
        centre = {"cx": (frame["cx"] - x) / scale, "cy": (frame["cy"] - y) / scale}
        focal = {"fl_x": frame["fl_x"] / scale, "fl_y": frame["fl_y"] / scale}
        out.append({"file_path": f"{at}.png", "w": side, "h": side, **kept, **focal, **centre})
    return files, {"frames": out}


def timing(headers):
    """Stages of a `Server-Timing` header in milliseconds."""
    return {k: float(v) for k, v in re.findall(r"(\w+);dur=([\d.]+)", headers["server-timing"])}


def milliseconds(report):
    """Stages of a report by name."""
    return {stage["stage"]: stage["ms"] for stage in report["stages"]}


def networks(url):
    """Seconds in runs of each network since the start, by the server's metrics."""
    text = call(f"{url}/metrics")[0].decode()
    rows = re.findall(r'^segsplat_network_seconds_sum\{network="(.+)"\} (\S+)', text, re.M)
    return {name.replace(" ", "_"): float(seconds) for name, seconds in rows}


def once(args, at, files, transforms):
    """Figures of one new scene by name; times in milliseconds."""
    parts = [("transforms", "transforms.json", json.dumps(transforms).encode())]
    parts += [("photo", f["file_path"], data) for f, data in zip(transforms["frames"], files)]
    body, content = form(parts)
    before, begun = networks(args.url), time.perf_counter()
    query = f"{args.url}/v1/scenes?preset=paper&semantics=eager&refine=off&wait_ms=60000"
    status = json.loads(call(query, body, content)[0])
    if status["state"] != "done":
        raise SystemExit(f"the scene is {status}")
    made_in = time.perf_counter() - begun
    scene = f"{args.url}/v1/scenes/{status['id']}"
    view = {"from": 0, "to": 1, "t": 0.0}
    # A text that no run before asked, so that its embedding is not known.
    ask = {"texts": [f"chair {at}"], "camera": view, "mask": "png", "wait_ms": 60000}
    ask = json.dumps(ask).encode()
    first = timing(call(f"{scene}/query", ask)[1])
    total = time.perf_counter() - begun
    ran = {name: (s - before[name]) * 1e3 for name, s in networks(args.url).items()}
    known = []
    for _ in range(CALLS):
        start = time.perf_counter()
        headers = call(f"{scene}/query", ask)[1]
        known.append({"call": (time.perf_counter() - start) * 1e3, **timing(headers)})
    views = [timing(call(f"{scene}/view?from=0&to=1&t=0")[1]) for _ in range(CALLS)]
    status = json.loads(call(scene)[0])
    call(scene, method="DELETE")
    made = milliseconds(status["report"]) | milliseconds(status["semantics"]["report"])
    median = lambda rows, name: statistics.median(row.get(name, 0) for row in rows)  # noqa: E731
    return {
        "total_ms": total * 1e3,
        "scene_ms": made_in * 1e3,
        "stages": made,
        "first_text": first,
        "capture_ms": made["capture"],
        "gaussians_ms": made["geometry"],
        "masks_ms": made["masks"],
        "embed_ms": made["embed"],
        "bank_ms": made["bank"] + made["assign"],
        "query_call_ms": median(known, "call"),
        "score_ms": median(known, "score"),
        "mask_render_ms": median(known, "render"),
        "view_render_ms": median(views, "render"),
        "masks": status["semantics"]["report"]["masks"],
        "bank": status["semantics"]["bank_size"],
        **{f"network_{name}_ms": ms for name, ms in ran.items()},
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("url")
    parser.add_argument("scene", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--frames", type=int, nargs=2, default=[4, 5], help="of transforms.json")
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--networks", default="of the bundle", help="what the row calls them")
    parser.add_argument("--machine", default="this machine")
    parser.add_argument("--hashes", type=json.loads, default={}, help="of `report --hashes`")
    parser.add_argument("--commit", default="")
    args = parser.parse_args()
    files, transforms = photos(args.scene, args.frames, args.side)
    runs = [once(args, at, files, transforms) for at in range(args.runs + 1)][1:]
    each = ("stages", "first_text")
    names = [name for name in runs[0] if name not in ("masks", "bank", *each)]
    middle = {name: statistics.median(run[name] for run in runs) for name in names}
    medians = {
        of: {name: statistics.median(run[of][name] for run in runs) for name in runs[0][of]}
        for of in each
    }
    row = {
        "table": "paper-time",
        "command": "benches/published/runtime.py URL SCENE OUT; segsplat serve --bundle BUNDLE",
        "hashes": args.hashes,
        "commit": args.commit,
        "machine": args.machine,
        "unix_s": int(time.time()),
        "networks": args.networks,
        "photos": len(files),
        "size": [args.side, args.side],
        "runs": args.runs,
        **{name: float(f"{value:.4g}") for name, value in middle.items()},
        "slowest_ms": max(run["total_ms"] for run in runs),
        **medians,
        "masks": runs[0]["masks"],
        "bank": runs[0]["bank"],
    }
    with args.out.open("a") as out:
        out.write(json.dumps(row) + "\n")
    print(json.dumps(row, indent=1))


if __name__ == "__main__":
    main()
