"""Better versions of a scene that is refined: the page takes them, and the view stays."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from acts import pixels, post, sample, settled, until
from playwright.sync_api import Page, Route, expect
from served import ROOT, run, served


@pytest.fixture
def soon(tmp_path: Path) -> Iterator[str]:
    """The address of a server of its own, of small scenes: their versions come soon, and nothing
    is refined beside the tests that follow."""
    config = tmp_path / "segsplat.toml"
    config.write_text("[limits]\nrefine_steps_max = 100\n")
    with served(tmp_path / "data", "--renderer", "cpu", "--config", config,
                "--bundle", ROOT / "tests/fixtures/plane") as address:
        yield address


def test_a_better_version_is_shown_and_the_view_stays(
        page: Page, soon: str, tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    run("sample", "--photos", "6", "--size", "96x72", "-o", photos)
    scene = post(soon, [("transforms", name, data) if name == "transforms.json"
                       else ("photo", f"images/{name}", data)
                       for name, data in sample(photos).items()])
    with urllib.request.urlopen(f"{soon}/v1/scenes/{scene}/refine?refine=600000", b"") as answer:
        assert json.load(answer)["refinement"]["state"] == "running"
    page.goto(f"{soon}/#scene={scene}")
    settled(page)
    asked = "() => [segsplat.state.scene.gaussians, segsplat.state.camera]"
    count, camera = page.evaluate(asked)
    until(page, f"segsplat.state.scene.gaussians !== {count}")
    settled(page)
    better, same = page.evaluate(asked)
    assert camera == same
    with urllib.request.urlopen(f"{soon}/v1/scenes/{scene}") as answer:
        assert json.load(answer)["version"] > 1
    assert page.evaluate("segsplat.drawing.count") == better


def test_the_first_version_is_shown_again_with_what_was_gained(
        page: Page, url: str, splats: str) -> None:
    told = [{"event": "done"}, {"event": "version", "version": 2, "fraction": 1.0}]
    lines = "".join(f"data: {json.dumps(one)}\n\n" for one in told)

    def refined(route: Route) -> None:
        scene = route.fetch().json()
        scene["refinement"]["state"] = "running"
        scene["report"]["refinement"] = {"psnr_before": 21.04, "psnr_after": 24.96}
        route.fulfill(json=scene)

    page.route(f"**/v1/scenes/{splats}", refined)
    held: list[Route] = []
    page.route("**/events?edits=true", lambda route: held.append(route))
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    page.evaluate("segsplat.state.scene.first = true")
    while not held:
        page.wait_for_timeout(50)
    held[0].fulfill(body=lines, headers={"content-type": "text/event-stream"})
    expect(page.locator("#says")).to_have_text("A better version: 40 Gaussians")
    settled(page)
    page.click("#report summary")
    expect(page.locator("#gain-says")).to_contain_text("21.0 → 25.0 dB")
    before = page.locator("#before")
    for pressed in ["true", "false"]:
        before.click()
        expect(before).to_have_attribute("aria-pressed", pressed)
        settled(page)
        assert page.evaluate("Boolean(segsplat.state.scene.first)") == (pressed == "true")
        assert pixels(page).std() > 10, "the canvas is flat"
