"""What other programs draw in a browser, held to what this one draws of the same file.

A judge gives its page by `opened`: a module of this folder and its imports; the page's
`shown(...)` answers with a PNG.
"""

from __future__ import annotations

import base64
import io
import json
import subprocess
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, Route

SIZE = (320, 240)
HOST = "http://judge/"


def run(segsplat: Path, *words: object) -> dict:
    """The program's answer."""
    line = [segsplat, *map(str, words), "--json"]
    told = subprocess.run(line, stdout=subprocess.PIPE, check=True)
    return json.loads(told.stdout)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of two pictures of 0 to 1, dB."""
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def opened(page: Page, module: str, imports: dict[str, str], roots: dict[str, Path]) -> list[str]:
    """Opens the page of a module, with these folders behind it; returns what it complains of."""
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(f"page: {error}"))
    page.on("console", lambda line: line.type == "error" and faults.append(f"page: {line.text}"))
    body = (f'<script type="importmap">{json.dumps({"imports": imports})}</script>'
            f'<script type="module" src="/tools/{module}"></script>')
    folders = {"tools": Path(__file__).parent, **roots}

    def give(route: Route) -> None:
        name = route.request.url.removeprefix(HOST)
        top, _, rest = name.partition("/")
        if top in folders:
            path = folders[top] / rest
            route.fulfill(path=path) if path.is_file() else route.fulfill(status=404)
        else:
            route.fulfill(body="" if name else body, content_type="text/html")

    page.route("**/*", give)
    page.goto(HOST)
    page.wait_for_function("() => Boolean(window.shown)")
    return faults


def picture(url: str) -> Image.Image:
    """That of a page's `toDataURL`."""
    return Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")


def lens(camera: dict) -> tuple[float, float]:
    """Focal length in pixels, and degrees from top to bottom, of a camera at our size."""
    height, k = SIZE[1], camera["intrinsics"]
    focal = k["fy"] * height / k["height"]
    return focal, float(np.degrees(2 * np.arctan(height / 2 / focal)))


def near(segsplat: Path, file: Path, camera: dict, theirs: Image.Image, out: Path,
         *flags: str) -> float:
    """The PSNR of their picture to ours of a file, dB. Both are written to `out`."""
    (width, height), (focal, _) = SIZE, lens(camera)
    ours = out.with_suffix(".ours.png")
    pose = ",".join(map(repr, np.ravel(camera["camera_to_world"]).tolist()))
    run(segsplat, "render", file, "-o", ours, "--camera-to-world", pose,
        "--width", width, "--height", height, "--fx", focal, "--fy", focal,
        "--cx", width / 2, "--cy", height / 2, *flags)
    theirs.save(out.with_suffix(".theirs.png"))
    a, b = (np.asarray(one.convert("RGB")) / 255 for one in (theirs, Image.open(ours)))
    return psnr(a, b)
