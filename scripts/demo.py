"""Photos to views, end to end: starts the server on a free port of loopback, posts photos, asks
for views at new poses and for a thing by text, writes views and mask as PNG, prints where, and
stops the server. With --server it asks a server that runs already, and stops nothing.

Run by `make demo`. Uses generated photos, and real ones where the shared data is found. Needs
only Python's own library.
"""

import argparse
import array
import base64
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
import urllib.error
import urllib.request
import zlib
from pathlib import Path

from form import form

# Real scenes: name, frames to post (by position in transforms.json).
REAL = [("fox", [0, 1, 2, 3]), ("red_kitchen", [0, 1]), ("sceaux_castle", [4, 5, 6])]
# What each scene is asked for.
TEXTS = {"sample": "box", "fox": "fox", "red_kitchen": "cup", "sceaux_castle": "castle"}
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


def grey_png(width: int, height: int, pixels: bytes) -> bytes:
    """An 8-bit grey PNG."""

    def chunk(name: bytes, data: bytes) -> bytes:
        whole = name + data
        return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = b"".join(b"\0" + pixels[y * width:(y + 1) * width] for y in range(height))
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
    return grey_png(width, height, grey)


def show(server: str, name: str, folder: Path, frames: list[int] | None, out: Path) -> None:
    """Posts the photos of a folder and writes views of the scene."""
    transforms, photos = load(folder, frames)
    parts = [("transforms", "transforms.json", transforms)]
    body, kind = form(parts + [("photo", name, data) for name, data in photos])
    begun = time.monotonic()
    scene = json.loads(call(f"{server}/v1/scenes?wait_ms={SCENE_S * 1000}", body, kind))
    if scene["state"] != "done":
        sys.exit(f"demo: {name}: the scene is {scene['state']}: {json.dumps(scene)}")
    view = f"{server}/v1/scenes/{scene['id']}/view?from=0&to=1"
    written = []
    for t in BETWEEN:
        for what in ["color", "depth"]:
            path = out / f"{name}_{round(t * 100):03d}_{what}.png"
            if what == "color":
                picture = call(f"{view}&t={t}&kind=color&format=png")
            else:
                picture = depth_picture(call(f"{view}&t={t}&kind=depth&format=npy"))
            path.write_bytes(picture)
            written.append(path)
    report = scene.get("report", {})
    stages = ", ".join(f"{s['stage']} {s['ms'] / 1000:.1f} s" for s in report.get("stages", []))
    print(f"{name}: {len(photos)} photos, {report.get('gaussians', '?')} Gaussians, first views "
          f"after {time.monotonic() - begun:.1f} s ({stages})")
    for warning in report.get("warnings", []):
        print(f"  warning {warning['code']}: {warning['message']}")
    if scene.get("semantics", {}).get("available"):
        written += ask(f"{server}/v1/scenes/{scene['id']}", name, out)
    else:
        print(f"  no texts: {scene.get('semantics', {}).get('reason')}")
    for path in written:
        print(f"  {path}")


def ask(scene: str, name: str, out: Path) -> list[Path]:
    """Asks the scene for a thing by text; writes its mask between the first two cameras."""
    text = TEXTS[name]
    begun = time.monotonic()
    body = {"texts": [text], "camera": {"from": 0, "to": 1, "t": 0.5}, "mask": "png"}
    answer = json.loads(call(f"{scene}/query", json.dumps(body).encode(), "application/json"))
    found = answer["results"][0]
    path = out / f"{name}_050_mask.png"
    path.write_bytes(base64.b64decode(found["view"]["mask_png"]))
    seconds = time.monotonic() - begun
    print(f"  {text!r}: {found['gaussians']} Gaussians in {len(found['parts'])} parts, "
          f"{found['view']['area']} px in view, best score {max(found['scores'], default=0):.2f}, "
          f"after {seconds:.1f} s (bank of {answer['bank_size']})")
    return [path]


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

    def show_all(server: str) -> None:
        models = json.loads(call(f"{server}/v1/models"))
        print(f"server at {server}: {json.dumps(models)[:400]}")
        for name, folder, frames in sets:
            show(server, name, folder, frames, out)

    if options.server:
        show_all(options.server)
        print(f"views are in {out}")
        return
    server = f"http://127.0.0.1:{free_port()}"
    log = out / "server.log"
    with log.open("w") as sink:
        process = subprocess.Popen(
            [options.segsplat, "serve", "--listen", server.removeprefix("http://"),
             "--data-dir", out / "data"], stdout=sink, stderr=sink)
        try:
            wait_ready(server, process, log)
            show_all(server)
        finally:
            process.terminate()
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
    print(f"views are in {out}, the photos of `sample` in {sample}, the server's log in {log}")


if __name__ == "__main__":
    main()
