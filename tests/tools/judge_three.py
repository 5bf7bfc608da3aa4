"""three.js, in a headless Chromium, shows a GLB that this program writes: GLTFLoader with its own
GLTFGaussianSplatLoaderExtension reads it, GaussianSplat draws it. Its picture is held to ours of
the same file. `make judge-three` gets three.js and the browser's driver.

python3 judge_three.py SEGSPLAT FOLDER_OF_THREE [OUT]
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from browser import opened_browser
from drawn import SIZE, lens, near, opened, picture, run
from playwright.sync_api import Page

segsplat, three = Path(sys.argv[1]).absolute(), Path(sys.argv[2])
# three.js ends a Gaussian at two standard deviations, we where it is under 1/255. It takes the
# opacity of small ones back, as our `antialiased` does.
# Without the blur of magnified views the scene is under it (28.5 dB, as `formats` had it then).
LEAST_DB = 33.0
IMPORTS = {"three": "/three/build/three.webgpu.js", "three/webgpu": "/three/build/three.webgpu.js",
           "three/tsl": "/three/build/three.tsl.js", "three/addons/": "/three/examples/jsm/"}
# The turn from the scene's axes (y down, z forward) into glTF's, and a camera's from OpenCV's.
TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def judged(page: Page, glb: Path, camera: dict, out: Path) -> list[str]:
    """What is wrong with a file as three.js shows it from a camera, OpenCV axes."""
    pose = np.array(camera["camera_to_world"]).reshape(4, 4)
    given = ["/files/" + glb.name, (TURN @ pose @ TURN).ravel().tolist(), lens(camera)[1], *SIZE]
    shown = page.evaluate("(given) => shown(...given)", given)
    db = near(segsplat, glb, camera, picture(shown["png"]), out / glb.name, "--antialiased")
    told = run(segsplat, "inspect", glb)
    low, high = (np.array(corner) * [1, -1, -1] for corner in told["bounds"])
    off = np.abs([np.minimum(low, high), np.maximum(low, high)] - np.array(shown["bounds"])).max()
    print(f"{glb.name}: three.js finds {shown['count']} of {told['gaussians']} Gaussians, bounds "
          f"within {off:.2g}, {db:.1f} dB to our picture")
    wrong = [] if shown["count"] == told["gaussians"] else [f"{glb.name}: {shown['count']}"]
    wrong += [f"{glb.name}: bounds are {off} off"] if off > 1e-5 else []
    return wrong + ([f"{glb.name}: {db:.1f} dB, not {LEAST_DB}"] if db < LEAST_DB else [])


with tempfile.TemporaryDirectory() as folder, opened_browser() as browser:
    top = Path(folder)
    out = Path(sys.argv[3]) if len(sys.argv) > 3 else top
    run(segsplat, "sample", "-o", top / "capture", "--photos", 2)
    page = browser.new_page()
    faults = opened(page, "three.mjs", IMPORTS, {"three": three, "files": top})
    source = Path("tests/fixtures/splats/source.ply")
    for name, what in [("scene", top / "capture"), ("harmonics", source)]:
        made = run(segsplat, "reconstruct", what, "-o", top / f"{name}.segsplat")
        run(segsplat, "export", top / f"{name}.segsplat", "-o", top / f"{name}.glb")
        faults += judged(page, top / f"{name}.glb", made["cameras"][0], out)
sys.exit("\n".join(faults) or None)
