"""Photos to views, end to end: starts the server on a free port of loopback, posts photos, asks for
views at new poses and for things by text, writes views, depth, masks and boxes as PNG and all of it
as one index.html, prints its path, and stops the server. With --server it asks a server that runs
already, and stops nothing.

Run by `make demo`. Uses generated photos, and real ones where the shared data is found. Needs
only Python's own library.
"""

import argparse
import array
import base64
import html
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
import zlib
from dataclasses import dataclass, field
from pathlib import Path

from form import form

# Real scenes: name, frames to post (by position in transforms.json).
REAL = [("fox", [0, 1, 2, 3]), ("red_kitchen", [0, 1]), ("sceaux_castle", [4, 5, 6])]
# What each scene is asked for.
TEXTS = {"sample": ["box", "ball"], "fox": ["fox"], "red_kitchen": ["cup"],
         "sceaux_castle": ["castle"]}
# Colour of what a text selects, and the share of it in the pixel.
TINT, SHARE = (255, 110, 30), 0.55
# Where between the first two cameras to look from.
BETWEEN = [0.0, 0.5, 1.0]
READY_S, SCENE_S = 60, 300


def free_port() -> int:
    """A port of loopback that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def call(url: str, body: bytes | None = None, kind: str | None = None) -> bytes:
    """GET, or POST where there is a body. Exits with the server's own words on an error."""
    request = urllib.request.Request(url, body, {"Content-Type": kind} if kind else {})
    try:
        with urllib.request.urlopen(request, timeout=SCENE_S + 30) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        sys.exit(f"demo: {url} answered {error.code}: {error.read().decode(errors='replace')}")


def load(folder: Path, frames: list[int] | None) -> tuple[bytes, list[tuple[str, bytes]]]:
    """transforms.json with the chosen frames alone, and their photos."""
    transforms = json.loads((folder / "transforms.json").read_text())
    if frames is not None:
        transforms["frames"] = [transforms["frames"][i] for i in frames]
    names = [frame["file_path"] for frame in transforms["frames"]]
    return json.dumps(transforms).encode(), [(n, (folder / n).read_bytes()) for n in names]


def png(width: int, height: int, pixels: bytes) -> bytes:
    """An 8-bit PNG: RGB where there are three bytes a pixel, else grey."""

    def chunk(name: bytes, data: bytes) -> bytes:
        whole = name + data
        return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))

    deep = len(pixels) // (width * height)
    head = struct.pack(">IIBBBBB", width, height, 8, 2 if deep == 3 else 0, 0, 0, 0)
    long = deep * width
    rows = b"".join(b"\0" + pixels[y * long:(y + 1) * long] for y in range(height))
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows))
            + chunk(b"IEND", b""))


def depth_picture(npy: bytes) -> bytes:
    """A depth map (npy, float32) as a picture: near is bright, no depth is black."""
    start = 10 + struct.unpack("<H", npy[8:10])[0]
    header = npy[10:start].decode()
    shape = header.split("'shape':")[1].split("(")[1].split(")")[0].split(",")
    height, width = int(shape[0]), int(shape[1])
    depth = array.array("f", npy[start:start + 4 * width * height])
    inverse = [1.0 / d if d > 0 else 0.0 for d in depth]
    seen = sorted(v for v in inverse if v > 0) or [0.0, 1.0]
    low, high = seen[len(seen) // 100], seen[-1 - len(seen) // 100]
    scale = 215.0 / max(high - low, 1e-12)
    grey = bytes(max(0, min(255, round(40 + (v - low) * scale))) if v else 0 for v in inverse)
    return png(width, height, grey)


def edges(part: dict, camera: dict) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """The twelve edges of a box in the picture of a camera; those behind it are left out."""
    lens, pose = camera["intrinsics"], camera["camera_to_world"]
    eye = [pose[4 * i + 3] for i in range(3)]

    def corner(number: int) -> tuple[float, float] | None:
        place = list(part["center"])
        for k, (axis, size) in enumerate(zip(part["axes"], part["size"])):
            side = 0.5 if number >> k & 1 else -0.5
            place = [p + side * size * a for p, a in zip(place, axis)]
        x, y, z = (sum(pose[4 * i + j] * (place[i] - eye[i]) for i in range(3)) for j in range(3))
        if z <= 1e-6:
            return None
        return lens["fx"] * x / z + lens["cx"], lens["fy"] * y / z + lens["cy"]

    corners = [corner(number) for number in range(8)]
    pairs = [(i, i | 1 << k) for i in range(8) for k in range(3) if not i >> k & 1]
    return [(corners[i], corners[j]) for i, j in pairs if corners[i] and corners[j]]


def overlay(camera: dict, rgb: bytes, mask: bytes, parts: list[dict]) -> bytes:
    """A view with what a text selects in colour and the boxes of its parts, as PNG."""
    width, height = camera["intrinsics"]["width"], camera["intrinsics"]["height"]
    pixels = bytearray(rgb)
    for i, on in enumerate(mask):
        if on:
            for k in range(3):
                old = pixels[3 * i + k]
                pixels[3 * i + k] = round(old + SHARE * (TINT[k] - old))
    for (x0, y0), (x1, y1) in (edge for part in parts for edge in edges(part, camera)):
        steps = min(int(max(abs(x1 - x0), abs(y1 - y0))) + 1, 10_000)
        for step in range(steps + 1):
            x, y = (round(a + (b - a) * step / steps) for a, b in [(x0, x1), (y0, y1)])
            if 0 <= x < width and 0 <= y < height:
                pixels[3 * (y * width + x):3 * (y * width + x) + 3] = bytes([255, 255, 255])
    return png(width, height, bytes(pixels))


@dataclass
class Shown:
    """What there is of a scene: a line of figures, and pictures in groups, each with its words."""

    name: str
    figures: list[str] = field(default_factory=list)
    groups: dict[str, list[tuple[Path, str]]] = field(default_factory=dict)

    def add(self, group: str, path: Path, data: bytes, words: str) -> None:
        """Writes a picture."""
        path.write_bytes(data)
        self.groups.setdefault(group, []).append((path, words))

    def html(self, out: Path) -> str:
        """The section of the page."""
        esc = html.escape
        parts = [f"<h2>{esc(self.name)}</h2>", *(f"<p>{esc(line)}</p>" for line in self.figures)]
        for group, pictures in self.groups.items():
            figures = "".join(
                f'<figure><img src="{esc(str(path.relative_to(out)))}" alt="{esc(words)}">'
                f"<figcaption>{esc(words)}</figcaption></figure>" for path, words in pictures)
            parts.append(f"<h3>{esc(group)}</h3><div>{figures}</div>")
        return "".join(parts)


STYLE = """:root{color-scheme:light dark}body{font:16px/1.5 system-ui,sans-serif;margin:2rem auto;
max-width:72rem;padding:0 1rem}div{display:flex;flex-wrap:wrap;gap:1rem}figure{margin:0}
img{width:20rem;max-width:100%;border-radius:8px;display:block}h2{margin-top:3rem}
figcaption{max-width:20rem}p{max-width:60rem}"""


def page(shown: list[Shown], out: Path) -> Path:
    """One page with all pictures, beside them."""
    path = out / "index.html"
    body = "".join(one.html(out) for one in shown)
    path.write_text(f'<!doctype html><html lang="en"><meta charset="utf-8"><title>SegSplat</title>'
                    f"<style>{STYLE}</style><h1>Photos in, views out</h1>{body}</html>\n")
    return path


def show(server: str, name: str, folder: Path, frames: list[int] | None, out: Path) -> Shown:
    """Posts the photos of a folder and writes views of the scene."""
    transforms, photos = load(folder, frames)
    shown = Shown(name)
    (out / name).mkdir(exist_ok=True)
    for file, data in photos:
        shown.add("Photos", out / name / Path(file).name, data, file)
    parts = [("transforms", "transforms.json", transforms)]
    body, kind = form(parts + [("photo", name, data) for name, data in photos])
    begun = time.monotonic()
    scene = json.loads(call(f"{server}/v1/scenes?wait_ms={SCENE_S * 1000}", body, kind))
    if scene["state"] != "done":
        sys.exit(f"demo: {name}: the scene is {scene['state']}: {json.dumps(scene)}")
    view = f"{server}/v1/scenes/{scene['id']}/view?from=0&to=1"
    for t in BETWEEN:
        stem, words = out / f"{name}_{round(t * 100):03d}", f"{t:.0%} from photo 1 to photo 2"
        picture = call(f"{view}&t={t}&kind=color&format=png")
        shown.add("Views", stem.with_name(stem.name + "_color.png"), picture, words)
        depth = depth_picture(call(f"{view}&t={t}&kind=depth&format=npy"))
        shown.add("Depth", stem.with_name(stem.name + "_depth.png"), depth, words)
    report = scene.get("report", {})
    stages = ", ".join(f"{s['stage']} {s['ms'] / 1000:.1f} s" for s in report.get("stages", []))
    shown.figures.append(
        f"{len(photos)} photos, {report.get('gaussians', '?')} Gaussians, first views after "
        f"{time.monotonic() - begun:.1f} s ({stages})")
    for warning in report.get("warnings", []):
        shown.figures.append(f"warning {warning['code']}: {warning['message']}")
    if scene.get("semantics", {}).get("available"):
        for text in TEXTS[name]:
            ask(f"{server}/v1/scenes/{scene['id']}", text, shown, out)
    else:
        shown.figures.append(f"no texts: {scene.get('semantics', {}).get('reason')}")
    print("\n  ".join([f"{name}: {shown.figures[0]}", *shown.figures[1:]]))
    for pictures in shown.groups.values():
        for path, _ in pictures:
            print(f"  {path}")
    return shown


def ask(scene: str, text: str, shown: Shown, out: Path) -> None:
    """Asks the scene for a thing by text, and writes what it finds between the first two cameras:
    the mask, and over the view the mask and the boxes of its parts."""
    begun = time.monotonic()
    body = {"texts": [text], "camera": {"from": 0, "to": 1, "t": 0.5}, "mask": "png"}
    answer = json.loads(call(f"{scene}/query", json.dumps(body).encode(), "application/json"))
    seconds = time.monotonic() - begun
    found = answer["results"][0]
    view = f"{scene}/view?from=0&to=1&t=0.5"
    rgb = call(f"{view}&format=rgb8")
    mask = call(f"{view}&kind=mask&format=grey8&{urllib.parse.urlencode({'text': text})}")
    best = max(found["scores"], default=0)
    words = (f"{text!r}: {found['gaussians']} Gaussians in {len(found['parts'])} parts, "
             f"{found['view']['area']} px in view, best score {best:.2f}, "
             f"after {seconds:.1f} s (bank of {answer['bank_size']})")
    shown.figures.append(words)
    stem = f"{shown.name}_050_{text}"
    over = overlay(answer["camera"], rgb, mask, found["parts"])
    shown.add("Masks and boxes", out / f"{stem}_boxes.png", over, words)
    mask_png = base64.b64decode(found["view"]["mask_png"])
    shown.add("Masks and boxes", out / f"{stem}_mask.png", mask_png, f"the mask of {text!r}")


def wait_ready(server: str, process: subprocess.Popen, log: Path) -> None:
    """Returns when /readyz says yes; exits with the log where the server ended or takes long."""
    deadline = time.monotonic() + READY_S
    while time.monotonic() < deadline and process.poll() is None:
        try:
            with urllib.request.urlopen(f"{server}/readyz", timeout=5):
                return
        except OSError:
            time.sleep(0.1)
    sys.exit(f"demo: the server did not come up; its log:\n{log.read_text()[-3000:]}")


def main() -> None:
    """Starts, shows, stops."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--segsplat", type=Path, help="the program")
    parser.add_argument("--server", metavar="URL", help="a server that runs already")
    parser.add_argument("--sample", type=Path, metavar="FOLDER",
                        help="photos by `segsplat sample` (default: made with --segsplat)")
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    options = parser.parse_args()
    if not options.segsplat and not (options.server and options.sample):
        parser.error("--segsplat is missing, or both --server and --sample")
    for number in [signal.SIGTERM, signal.SIGHUP]:
        signal.signal(number, lambda *_: sys.exit(1))
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    sample = options.sample or out / "sample"
    if not options.sample:
        subprocess.run([options.segsplat, "sample", "-o", sample, "--photos", "4", "--size",
                        "320x240", "--seed", "1"], check=True, stdout=subprocess.DEVNULL)
    sets = [("sample", sample, None)]
    shared = Path(os.environ.get("SEGSPLAT_SHARED_DATA") or "../shared/data") / "scenes"
    sets += [(name, shared / name, frames) for name, frames in REAL if (shared / name).is_dir()]

    def show_all(server: str) -> Path:
        models = json.loads(call(f"{server}/v1/models"))
        print(f"server at {server}: {json.dumps(models)[:400]}")
        return page([show(server, *one, out) for one in sets], out)

    if options.server:
        print(f"all pictures on one page: {show_all(options.server).resolve()}")
        return
    server = f"http://127.0.0.1:{free_port()}"
    log = out / "server.log"
    with log.open("w") as sink:
        process = subprocess.Popen(
            [options.segsplat, "serve", "--listen", server.removeprefix("http://"),
             "--data-dir", out / "data"], stdout=sink, stderr=sink)
        try:
            wait_ready(server, process, log)
            index = show_all(server)
        finally:
            process.terminate()
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
    print(f"the server's log: {log}\nall pictures on one page: {index.resolve()}")


if __name__ == "__main__":
    main()
