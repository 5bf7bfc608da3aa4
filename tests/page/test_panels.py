"""What floats over the canvas: panels that fold, photos to fly to, names, keys, the sample, a path
for a video, and the page in a frame of another page."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from acts import Camera, open_scenes, pixels, post, settled, until, window
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect
from served import ROOT, served
from test_origins import foreign  # noqa: F401 (a fixture)


def grave(page: Page) -> list[str]:
    """What axe finds that is serious."""
    found = Axe().run(page).response["violations"]
    return [f"{one['id']}: {[node['html'] for node in one['nodes']]}" for one in found
            if one["impact"] in ("serious", "critical")]


def test_panels_fold_and_the_photo_takes_their_room(page: Page, url: str, scene: str) -> None:
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    box = page.locator("#stage").bounding_box()
    assert box == {"x": 0, "y": 0, "width": 1280, "height": 800}
    wide = page.evaluate("segsplat.state.camera.fov")
    for panel in ["#side", "#tools"]:
        button = page.locator(f"{panel}-fold")
        expect(page.locator(panel)).to_be_visible()
        expect(button).to_have_attribute("aria-expanded", "true")
        button.click()
        expect(page.locator(panel)).to_be_hidden()
        expect(button).to_have_attribute("aria-expanded", "false")
    assert page.evaluate("segsplat.state.camera.fov") < wide, "the photo did not grow"


def test_photos_are_flown_to_by_a_press_and_by_keys(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    stops = page.locator("#stops button")
    expect(stops).to_have_count(4)
    expect(stops.nth(0)).to_have_attribute("aria-current", "true")
    # The server drew a small picture of each.
    until(page, "[...document.querySelectorAll('#stops .small')].every("
                "(one) => one.style.backgroundImage.startsWith('url'))")
    eyes = page.evaluate("segsplat.state.scene.cameras.map(({ camera_to_world: m }) =>"
                         " [m[3], m[7], m[11]])")
    stops.nth(2).click()
    np.testing.assert_allclose(Camera(page).eye, eyes[2])
    expect(stops.nth(2)).to_have_attribute("aria-current", "true")
    page.focus("#view")
    for key, photo in [("n", 3), ("n", 0), ("p", 3)]:
        page.keyboard.press(key)
        np.testing.assert_allclose(Camera(page).eye, eyes[photo])
        expect(stops.nth(photo)).to_have_attribute("aria-current", "true")


def test_keys_go_to_the_question_and_to_the_help_and_let_go(
        page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.focus("#view")
    page.keyboard.press("/")
    expect(page.locator("#text")).to_be_focused()
    page.keyboard.type("what is /?")
    expect(page.locator("#text")).to_have_value("what is /?")
    page.focus("#view")
    page.keyboard.press("?")
    expect(page.locator("#help")).to_be_visible()
    expect(page.locator("#help-box summary")).to_be_focused()
    page.locator("#view").click(position={"x": 250, "y": 330})
    expect(page.locator("#words li")).to_have_count(1)
    page.keyboard.press("Escape")
    expect(page.locator("#words li")).to_have_count(0)
    expect(page.locator("#picked")).to_be_empty()


def test_a_scene_has_a_name_which_its_link_carries(
        page: Page, browser: Browser, url: str, splats: str) -> None:
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    row = page.locator(f"#scenes button[data-id='{splats}']")
    expect(row).to_contain_text("40 Gaussians")
    page.fill("#name", "My table")
    page.press("#name", "Enter")
    expect(row.locator(".name")).to_have_text("My table")
    until(page, "location.hash.includes('name=My+table')")
    page.reload()
    settled(page)
    expect(page.locator("#name")).to_have_value("My table")
    # Another browser knows it by the link.
    other = window(browser, viewport={"width": 1280, "height": 800})
    other.goto(page.url)
    settled(other)
    expect(other.locator("#name")).to_have_value("My table")
    other.context.close()
    page.fill("#name", "")
    page.press("#name", "Enter")
    expect(row.locator(".name")).to_have_text("A file (ply)")


def test_the_sample_is_one_press_away(page: Page, url: str) -> None:
    page.goto(url)
    page.click("#sample")
    settled(page)
    expect(page.locator("#stops button")).to_have_count(6)
    assert pixels(page).std() > 20, "the canvas is flat"
    open_scenes(page)
    expect(page.locator("#scenes [aria-current=true] .name")).to_have_text("Sample")


def test_a_long_step_says_how_long_it_still_takes(page: Page, url: str) -> None:
    page.goto(url)
    said = page.evaluate("""async () => {
      const { step } = segsplat, said = [];
      for (const share of [0, 0.1, 0.2]) {
        step.at('work', share);
        said.push(document.getElementById('left').textContent);
        await new Promise((go) => setTimeout(go, 700));
      }
      step.at('work', 0.5);
      said.push(document.getElementById('left').textContent);
      step.end();
      return [...said, document.getElementById('left').textContent]; }""")
    # Half is done after 2.1 s or more.
    assert said[:2] == ["", ""] and said[-1] == "", said
    assert re.fullmatch(r"about \d+ s left", said[3]), said
    assert 2 <= int(re.sub(r"\D", "", said[3])) < 60, said


def test_a_true_length_makes_metres_which_a_link_carries(
        page: Page, browser: Browser, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.click("#measure")
    for x in (200, 300):
        page.locator("#view").click(position={"x": x, "y": 400})
        until(page, f"segsplat.state.marks.length === {(x - 100) // 100}")
    expect(page.locator("#picked")).to_contain_text("units of the capture between")
    page.fill("#picked input", "2.5")
    page.press("#picked input", "Enter")
    expect(page.locator("#picked")).to_contain_text("2.50 m between the two points.")
    page.click("#measure")
    other = window(browser, viewport={"width": 760, "height": 640})
    other.goto(page.url)
    settled(other)
    for one in [page, other]:
        one.locator("#view").click(position={"x": 250, "y": 330})
        expect(one.locator("#picked")).to_contain_text(re.compile(r"\d m from the camera"))
    expect(other.locator("#scale-says")).to_have_text(re.compile("by the length that was given"))
    other.context.close()
    # It is kept with the scene, and nothing said takes it back.
    say = ("(scale) => fetch(`/v1/scenes/${segsplat.state.scene.id}/scale`, scale)"
           ".then((answer) => answer.json())")
    assert page.evaluate(say, {})["source"] == "given"
    assert page.evaluate(say, {"method": "PUT", "body": "{}"})["source"] == "none"


def test_points_say_a_way_an_area_and_heights_over_the_ground(
        page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    until(page, "segsplat.state.scale?.ground")
    page.click("#measure")
    for n, (x, y) in enumerate([(250, 330), (420, 330), (350, 420)], 1):
        page.locator("#view").click(position={"x": x, "y": y})
        until(page, f"segsplat.state.marks.length === {n}")
    said = page.locator("#picked")
    expect(said).to_have_text(re.compile(r"along the points, [\d.e+-]+( m)?² between them\."))
    expect(said).to_contain_text(re.compile(r"The last one is -?[\d.e-]+( m)? over the ground\."))
    expect(page.locator("#picked input")).to_have_count(0)
    before = page.locator("#over").evaluate("(canvas) => canvas.toDataURL()")
    page.click("#ground")
    settled(page)
    assert page.locator("#over").evaluate("(canvas) => canvas.toDataURL()") != before
    page.click("#ground")
    page.click("#measure")


def test_a_video_goes_through_the_views_that_were_kept(page: Page, url: str, splats: str) -> None:
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    option = page.locator("#path-option")
    expect(option).to_be_disabled()
    for key in ["w", "ArrowLeft", "d"]:
        page.focus("#view")
        page.keyboard.press(key)
        page.click("#save")
    expect(page.locator("#kept li")).to_have_count(3)
    expect(option).to_be_enabled()
    near = page.evaluate("""() => {
      const { onPath, state: { kept } } = segsplat;
      const off = (a, b) => Math.max(...['eye', 'target', 'up'].flatMap((name) =>
        a[name].map((v, k) => Math.abs(v - b[name][k]))));
      const steps = Array.from({ length: 101 }, (_, i) => onPath(kept, i / 100));
      return [off(steps[0], kept[0]), off(steps[50], kept[1]), off(steps[100], kept[2]),
        Math.max(...steps.slice(1).map((one, i) => off(one, steps[i]))), off(kept[0], kept[2])]; }
        """)
    assert max(near[:3]) < 1e-6, near
    assert near[3] < 0.1 * near[4], "it jumps"
    page.get_by_role("button", name="Forget view 2").click()
    expect(page.locator("#kept li")).to_have_count(2)
    page.click("#film")
    page.select_option("#film-motion", "path")
    page.select_option("#film-seconds", "2")
    page.select_option("#film-side", "640")
    with page.expect_download() as waited:
        page.click("#film-make")
    assert waited.value.suggested_filename.endswith(".webm")


def test_what_no_photo_saw_fades_to_the_page(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    # Away from all photos, where only the backdrop is: the room behind the cameras is not drawn.
    page.evaluate("""() => {
      const { look, state: { home } } = segsplat;
      const back = home.eye.map((v, k) => 2 * v - home.target[k]);
      look({ ...home, target: back }, true); }""")
    for theme, ground in [("light", (0xe9, 0xed, 0xf2)), ("dark", (0x0e, 0x11, 0x15))]:
        page.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
        until(page, f"Math.abs(segsplat.drawing.fog[0] * 255 - {ground[0]}) < 1")
        seen = pixels(page)
        faded = (np.abs(seen.astype(int) - ground).max(axis=2) <= 2).mean()
        assert faded > 0.9, (theme, faded)


def test_the_page_is_shown_in_a_frame_of_a_page_that_is_named(
        page: Page, foreign: str, tmp_path: Path,  # noqa: F811
        faults: list[str]) -> None:
    source = ROOT / "tests/fixtures/splats/source.ply"
    for flags, there in [(["--cors-origins", foreign.rstrip("/")], True), ([], False)]:
        with served(tmp_path / f"data{there}", "--renderer", "cpu", *flags) as url:
            id = post(url, [("splats", source.name, source.read_bytes())])
            page.goto(f"{url}/#scene={id}")
            settled(page)
            page.click("#embed")
            line = page.input_value("#embedding-text")
            assert line.startswith("<iframe") and "embed=1" in line, line
            page.goto(foreign)
            page.set_content(line)
            frame = page.frame_locator("iframe")
            if not there:
                page.wait_for_timeout(1500)
                assert page.frames[1].url.startswith("chrome-error"), page.frames[1].url
                assert faults and all("frame-ancestors" in fault for fault in faults), faults
                faults.clear()
                continue
            expect(frame.locator("#view")).to_have_attribute("data-state", "settled")
            for hidden in ["#top #ask", "#side", "#tools", "#strip"]:
                expect(frame.locator(hidden)).to_be_hidden()


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_no_serious_fault_of_access_at_any_size(
        page: Page, url: str, scene: str, width: int, height: int, theme: str) -> None:
    page.set_viewport_size({"width": width, "height": height})
    page.emulate_media(color_scheme=theme)
    page.goto(url)
    expect(page.locator("#scenes button").first).to_be_visible()
    assert not grave(page)
    page.goto(f"{url}/#scene={scene}&text=box")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    settled(page)
    for panel in ["side", "tools"]:
        if not page.locator(f"#{panel}").is_visible():
            page.click(f"#{panel}-fold")
        assert not grave(page), panel
    # Nothing reaches beyond the window.
    assert page.evaluate("document.documentElement.scrollWidth") <= width
