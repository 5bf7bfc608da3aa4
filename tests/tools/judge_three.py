"""three.js, in a headless Chromium, shows a GLB that this program writes: GLTFLoader with its own
GLTFGaussianSplatLoaderExtension reads it, GaussianSplat draws it. Its picture is held to ours of
the same file. `make judge-three` gets three.js and the browser's driver.

python3 judge_three.py SEGSPLAT FOLDER_OF_THREE [OUT]
"""

import base64
import io
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from browser import opened_browser
from PIL import Image
from playwright.sync_api import Page, Route

segsplat, three = Path(sys.argv[1]).absolute(), Path(sys.argv[2])
SIZE = (320, 240)
# three.js ends a Gaussian at two standard deviations, we where it is under 1/255. It takes the
# opacity of small ones back, as our `antialiased` does.
# Without the blur of magnified views the scene is under it (28.5 dB, as `formats` had it then).
LEAST_DB = 33.0
HOST = "http://judge/"
PAGE = """<script type="importmap">{"imports": {"three": "/three/build/three.webgpu.js",
"three/webgpu": "/three/build/three.webgpu.js", "three/tsl": "/three/build/three.tsl.js",
"three/addons/": "/three/examples/jsm/"}}</script>
<script type="module" src="/tools/three.mjs"></script>"""
# The turn from the scene's axes (y down, z forward) into glTF's, and a camera's from OpenCV's.
TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def run(*words: object) -> dict:
    """The program's answer."""
    line = [segsplat, *map(str, words), "--json"]
    told = subprocess.run(line, stdout=subprocess.PIPE, check=True)
    return json.loads(told.stdout)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of two pictures of 0 to 1, dB."""
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def opened(page: Page, files: Path) -> list[str]:
    """Opens the page, with three.js and these files behind it; returns what it complains of."""
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(f"page: {error}"))
    page.on("console", lambda line: line.type == "error" and faults.append(f"page: {line.text}"))

    def give(route: Route) -> None:
        name = route.request.url.removeprefix(HOST)
        roots = {"three": three, "tools": Path(__file__).parent, "files": files}
        top, _, rest = name.partition("/")
        path = roots.get(top, files) / rest
        if path.is_file():
            route.fulfill(path=path)
        else:
            route.fulfill(body=PAGE if not name else "", content_type="text/html")

    page.route("**/*", give)
    page.goto(HOST)
    page.wait_for_function("() => Boolean(window.shown)")
    return faults


def judged(page: Page, glb: Path, camera: dict, out: Path) -> list[str]:
    """What is wrong with a file as three.js shows it from a camera, OpenCV axes."""
    width, height = SIZE
    k = camera["intrinsics"]
    focal = k["fy"] * height / k["height"]
    pose = np.array(camera["camera_to_world"]).reshape(4, 4)
    fov = float(np.degrees(2 * np.arctan(height / 2 / focal)))
    given = ["/files/" + glb.name, (TURN @ pose @ TURN).ravel().tolist(), fov, width, height]
    shown = page.evaluate("(given) => shown(...given)", given)
    theirs = Image.open(io.BytesIO(base64.b64decode(shown["png"].split(",")[1]))).convert("RGB")
    ours = out / f"{glb.stem}.ours.png"
    run("render", glb, "-o", ours, "--camera-to-world", ",".join(map(repr, pose.ravel().tolist())),
        "--width", width, "--height", height, "--fx", focal, "--fy", focal,
        "--cx", width / 2, "--cy", height / 2, "--antialiased")
    theirs.save(out / f"{glb.stem}.three.png")
    a, b = (np.asarray(one.convert("RGB")) / 255 for one in (theirs, Image.open(ours)))
    told = run("inspect", glb)
    low, high = (np.array(corner) * [1, -1, -1] for corner in told["bounds"])
    off = np.abs([np.minimum(low, high), np.maximum(low, high)] - np.array(shown["bounds"])).max()
    near = psnr(a, b)
    print(f"{glb.name}: three.js finds {shown['count']} of {told['gaussians']} Gaussians, bounds "
          f"within {off:.2g}, {near:.1f} dB to our picture")
    wrong = [] if shown["count"] == told["gaussians"] else [f"{glb.name}: {shown['count']}"]
    wrong += [f"{glb.name}: bounds are {off} off"] if off > 1e-5 else []
    return wrong + ([f"{glb.name}: {near:.1f} dB, not {LEAST_DB}"] if near < LEAST_DB else [])


with tempfile.TemporaryDirectory() as folder, opened_browser() as browser:
    top = Path(folder)
    out = Path(sys.argv[3]) if len(sys.argv) > 3 else top
    run("sample", "-o", top / "capture", "--photos", 2)
    page = browser.new_page()
    faults = opened(page, top)
    source = Path("tests/fixtures/splats/source.ply")
    for name, what in [("scene", top / "capture"), ("harmonics", source)]:
        made = run("reconstruct", what, "-o", top / f"{name}.segsplat")
        run("export", top / f"{name}.segsplat", "-o", top / f"{name}.glb")
        faults += judged(page, top / f"{name}.glb", made["cameras"][0], out)
sys.exit("\n".join(faults) or None)
