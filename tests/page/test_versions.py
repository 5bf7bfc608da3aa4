"""Better versions of a scene that is refined: the page takes them, and the view stays."""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

from acts import post, sample, settled, until
from playwright.sync_api import Page
from served import run


def test_a_better_version_is_shown_and_the_view_stays(page: Page, url: str, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    run("sample", "--photos", "6", "--size", "96x72", "-o", photos)
    scene = post(url, [("transforms", name, data) if name == "transforms.json"
                       else ("photo", f"images/{name}", data)
                       for name, data in sample(photos).items()])
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}/refine?refine=600000", b"") as answer:
        assert json.load(answer)["refinement"]["state"] == "running"
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    asked = "() => [segsplat.state.scene.gaussians, segsplat.state.camera]"
    count, camera = page.evaluate(asked)
    until(page, f"segsplat.state.scene.gaussians !== {count}")
    settled(page)
    better, same = page.evaluate(asked)
    assert camera == same
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}") as answer:
        assert json.load(answer)["version"] > 1
    assert page.evaluate("segsplat.drawing.count") == better
