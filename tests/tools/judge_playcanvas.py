"""PlayCanvas' engine, in a headless Chromium, streams levels of detail that this program writes:
its asset `gsplat` of `lod-meta.json` in the unpacked folder of a `.sog.zip`. Its picture of the
finest level is held to ours of the same scene; coarser ones are near it. `make judge-playcanvas`
gets the engine and the browser's driver.

python3 judge_playcanvas.py SEGSPLAT FOLDER_OF_PLAYCANVAS [OUT]
"""

import json
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from browser import opened_browser
from drawn import SIZE, lens, near, opened, picture, run
from playwright.sync_api import Page

sys.path.append(str(Path(__file__).parents[1] / "page"))
from large import room  # noqa: E402

segsplat, engine = Path(sys.argv[1]).absolute(), Path(sys.argv[2])
LARGE = 300_000
# The engine ends a Gaussian at 2.8 standard deviations and brings its edge to 0 there.
LEAST_DB, LEAST_COARSE_DB = 30.0, 20.0
# A camera's axes from OpenCV's. The scene keeps its own (y down, z forward).
TURN = np.diag([1.0, -1.0, -1.0, 1.0])
INSIDE = {"intrinsics": {"fy": 200.0, "height": 240},
          "camera_to_world": [0.8, 0, 0.6, -1, 0, 1, 0, 0.5, -0.6, 0, 0.8, -1, 0, 0, 0, 1]}


def judged(page: Page, scene: Path, camera: dict, top: Path, out: Path) -> list[str]:
    """What is wrong with the levels of a scene as the engine shows them from a camera."""
    name = scene.stem
    told = run(segsplat, "export", scene, "-o", top / f"{name}.sog.zip")
    with zipfile.ZipFile(top / f"{name}.sog.zip") as archive:
        archive.extractall(top / name)
    meta = json.loads((top / name / "lod-meta.json").read_text())
    mode = json.loads((top / name / meta["filenames"][0]).read_text()).get("antialias", False)
    pose = np.array(camera["camera_to_world"]).reshape(4, 4) @ TURN
    flags, wrong = ["--antialiased"] if mode else [], []
    for level, count in enumerate(meta["counts"]):
        shown = page.evaluate("(given) => shown(...given)", [
            f"/files/{name}/lod-meta.json", pose.ravel().tolist(), lens(camera)[1], *SIZE,
            level, level, mode])
        db = near(segsplat, scene, camera, picture(shown["png"]), out / f"{name}-{level}", *flags)
        print(f"{name}: PlayCanvas finds {shown['count']} Gaussians and draws {shown['drawn']} of "
              f"{count} of level {level}, {db:.1f} dB to our picture of the scene")
        bar = LEAST_COARSE_DB if level else LEAST_DB
        wrong += [f"{name}: {shown['count']}"] if shown["count"] != meta["counts"][0] else []
        wrong += [f"{name}: level {level}: {db:.1f} dB, not {bar}"] if db < bar else []
    return wrong


with tempfile.TemporaryDirectory() as folder, opened_browser() as browser:
    top = Path(folder)
    out = Path(sys.argv[3]) if len(sys.argv) > 3 else top
    run(segsplat, "sample", "-o", top / "capture", "--photos", 2)
    (top / "room.splat").write_bytes(room(LARGE))
    page = browser.new_page()
    imports = {"playcanvas": "/engine/build/playcanvas.mjs"}
    faults = opened(page, "playcanvas.mjs", imports, {"engine": engine, "files": top})
    source = Path("tests/fixtures/splats/source.ply").absolute()
    for name, what, camera in [("scene", top / "capture", None), ("harmonics", source, None),
                               ("room", top / "room.splat", INSIDE)]:
        made = run(segsplat, "reconstruct", what, "-o", top / f"{name}.segsplat")
        faults += judged(page, top / f"{name}.segsplat", camera or made["cameras"][0], top, out)
sys.exit("\n".join(faults) or None)
