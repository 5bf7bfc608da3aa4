"""Hands on the page: fingers, keys, less motion; and what the page does when its device goes."""

from __future__ import annotations

import urllib.request
from pathlib import Path

import numpy as np
import pytest
from acts import Camera, drop, open_scenes, pixels, sample, settled, until
from playwright.sync_api import CDPSession, Page, expect

CLOSE = {"rtol": 0.02, "atol": 1e-6}


@pytest.fixture
def shown(page: Page, url: str, splats: str) -> Page:
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    return page


class Fingers:
    """Touches on the canvas, in pixels from its middle, as the browser has them of a screen."""

    def __init__(self, page: Page) -> None:
        box = page.locator("#view").bounding_box()
        assert box
        self.middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.session: CDPSession = page.context.new_cdp_session(page)
        self.send("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)

    def send(self, method: str, **params: object) -> None:
        self.session.send(method, params)

    def move(self, begin: list[tuple[float, float]], end: list[tuple[float, float]]) -> None:
        """All fingers from where they begin to where they end, in ten steps."""
        start, stop = np.array(begin, float), np.array(end, float)
        for step in range(11):
            places = start + (stop - start) * step / 10
            points = [{"x": self.middle[0] + x, "y": self.middle[1] + y, "id": i}
                      for i, (x, y) in enumerate(places)]
            kind = "touchMove" if step else "touchStart"
            self.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


def test_one_finger_turns_about_the_target(shown: Page) -> None:
    before = Camera(shown)
    Fingers(shown).move([(0, 0)], [(90, 0)])
    after = Camera(shown)
    np.testing.assert_allclose(after.target, before.target)
    np.testing.assert_allclose(after.reach, before.reach)
    turned = np.arccos(np.clip(before.axes[2] @ after.axes[2], -1, 1))
    assert 0.2 < turned < 0.35, turned
    # What was in front of the target went with the finger.
    near = before.target - 0.1 * before.reach * before.axes[2]
    assert after.seen(near)[0] > before.seen(near)[0] + 1
    Fingers(shown).move([(0, 0)], [(0, 60)])
    assert Camera(shown).seen(near)[1] > after.seen(near)[1] + 1


def test_two_fingers_move_what_is_under_them(shown: Page) -> None:
    before = Camera(shown)
    Fingers(shown).move([(-60, 0), (60, 0)], [(40, 50), (160, 50)])
    after = Camera(shown)
    np.testing.assert_allclose(after.axes, before.axes, atol=1e-9)
    np.testing.assert_allclose(after.reach, before.reach, **CLOSE)
    np.testing.assert_allclose(after.seen(before.target), [100, 50], atol=2)


def test_fingers_that_part_go_nearer_and_back(shown: Page) -> None:
    before, fingers = Camera(shown), Fingers(shown)
    fingers.move([(-40, 0), (40, 0)], [(-80, 0), (80, 0)])
    np.testing.assert_allclose(Camera(shown).reach, before.reach / 2, **CLOSE)
    np.testing.assert_allclose(Camera(shown).target, before.target, atol=1e-6)
    fingers.move([(-80, 0), (80, 0)], [(-40, 0), (40, 0)])
    np.testing.assert_allclose(Camera(shown).reach, before.reach, **CLOSE)


def test_a_tap_is_a_click(shown: Page) -> None:
    Fingers(shown).move([(0, 0)], [(0, 0)])
    expect(shown.locator("#picked")).not_to_be_empty()


def drag(page: Page, key: str) -> None:
    """By 85 and 40 pixels with a key held. The first few may be a click."""
    box = page.locator("#view").bounding_box()
    assert box
    x, y = box["x"] + 200, box["y"] + 100
    page.keyboard.down(key)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 5, y)
    page.mouse.move(x + 85, y + 40, steps=8)
    page.mouse.up()
    page.keyboard.up(key)


def test_a_drag_with_shift_keeps_the_target_under_the_pointer(shown: Page) -> None:
    before = Camera(shown)
    drag(shown, "Shift")
    np.testing.assert_allclose(Camera(shown).seen(before.target), [85, 40], atol=1)


def test_a_drag_with_ctrl_turns_the_head(shown: Page) -> None:
    before = Camera(shown)
    drag(shown, "Control")
    after = Camera(shown)
    np.testing.assert_allclose(after.eye, before.eye)
    right, down = after.seen(before.target)
    assert right > 20 and down > 10, (right, down)


# Keys of the help, and the axis and sign of the eye's way: 0 right, 1 down, 2 forward.
FLY = {"w": (2, 1), "s": (2, -1), "a": (0, -1), "d": (0, 1), "q": (1, 1), "e": (1, -1)}
ARROWS = {"ArrowLeft": (0, 1), "ArrowRight": (0, -1), "ArrowUp": (1, 1), "ArrowDown": (1, -1)}


def test_every_key_of_the_help_does_what_it_says(shown: Page) -> None:
    told = shown.evaluate("document.getElementById('help').textContent.replace(/\\s+/g, ' ')")
    assert "Arrow keys turn, with Shift they move; W A S D Q E fly" in told, told
    assert "+ and - go nearer and farther, Home is the first photo" in told, told
    home = Camera(shown)
    shown.focus("#view")

    def pressed(key: str) -> Camera:
        shown.keyboard.press("Home")
        np.testing.assert_allclose(Camera(shown).eye, home.eye)
        shown.keyboard.press(key)
        return Camera(shown)

    for key, (axis, sign) in FLY.items():
        for written in (key, key.upper()):
            after = pressed(written)
            way = home.axes @ (after.eye - home.eye)
            assert sign * way[axis] > 0 and np.isclose(abs(way[axis]), np.linalg.norm(way)), key
            np.testing.assert_allclose(after.target - home.target, after.eye - home.eye)
    for key, (axis, sign) in ARROWS.items():
        after = pressed(key)
        np.testing.assert_allclose(after.target, home.target)
        np.testing.assert_allclose(after.reach, home.reach)
        way = home.axes @ (after.eye - home.eye)
        assert sign * way[axis] > 0.05 * home.reach and abs(way[1 - axis]) < 1e-6, (key, way)
        after = pressed(f"Shift+{key}")
        way = home.axes @ (after.eye - home.eye)
        assert sign * way[axis] > 0 and np.isclose(abs(way[axis]), np.linalg.norm(way)), key
        np.testing.assert_allclose(after.target - home.target, after.eye - home.eye)
    np.testing.assert_allclose(pressed("+").reach, 0.9 * home.reach)
    np.testing.assert_allclose(pressed("-").reach, 1.1 * home.reach)
    assert abs(pressed("Control+w").eye - home.eye).max() == 0, "Ctrl is the browser's"


def test_a_level_horizon_stays_level(shown: Page) -> None:
    upright = Camera(shown).up
    shown.focus("#view")
    for key in ["ArrowDown", "ArrowRight", "ArrowRight"] * 4:
        shown.keyboard.press(key)
        assert abs(Camera(shown).axes[0] @ upright) < 1e-9, key


def test_less_motion_flies_at_once(shown: Page) -> None:
    # Home is pressed and the camera read in one task, before any frame.
    home = """() => {
      const { state, look } = segsplat, view = document.getElementById('view');
      look({ ...state.home, eye: state.home.eye.map((v) => v + 1) }, true);
      view.dispatchEvent(new KeyboardEvent('keydown', { key: 'Home' }));
      return state.camera.eye.every((v, i) => v === state.home.eye[i]); }"""
    assert shown.evaluate(home), "it flew, though less motion was asked for"
    shown.emulate_media(reduced_motion="no-preference")
    assert not shown.evaluate(home), "it did not fly"
    until(shown, "segsplat.state.camera.eye.every((v, i) => "
                 "Math.abs(v - segsplat.state.home.eye[i]) < 1e-6)")


@pytest.mark.parametrize("where", ["server", "file"])
def test_a_lost_device_comes_back_with_the_scene(
        page: Page, url: str, splats: str, tmp_path: Path, where: str) -> None:
    address = f"{url}/#scene={splats}"
    if where == "file":
        with urllib.request.urlopen(f"{url}/v1/scenes/{splats}/export?format=html") as answer:
            (tmp_path / "scene.html").write_bytes(answer.read())
        address = (tmp_path / "scene.html").as_uri()
    page.goto(address)
    settled(page)
    page.focus("#view")
    page.keyboard.press("w")
    before = pixels(page)
    assert before.std() > 10, "the canvas is flat"
    page.evaluate("""() => {
      globalThis.loser = segsplat.drawing.gl.getExtension('WEBGL_lose_context');
      loser.loseContext(); }""")
    expect(page.locator("#says")).to_contain_text("loaded again")
    # Frames that are still asked for, as a move does, do not say that the scene is shown.
    page.evaluate("segsplat.look(segsplat.state.camera)")
    page.wait_for_timeout(700)
    expect(page.locator("#view")).to_have_attribute("data-state", "busy", timeout=1000)
    page.evaluate("loser.restoreContext()")
    expect(page.locator("#says")).to_contain_text("40 Gaussians")
    after = pixels(page)
    assert np.array_equal(after, before), "another picture came back"


def test_nothing_of_a_scene_stays_beside_the_next(page: Page, url: str, scene: str,
                                                  splats: str) -> None:
    page.goto(f"{url}/#scene={scene}&text=box")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    page.click("#save")
    expect(page.locator("#kept li")).to_have_count(1)
    open_scenes(page)
    page.click(f"#scenes button[data-id='{splats}']")
    expect(page.locator("#says")).to_contain_text("40 Gaussians")
    for left in ["#words li", "#kept li"]:
        expect(page.locator(left)).to_have_count(0)


def test_photos_of_one_scene_are_not_named_beside_another(
        page: Page, url: str, photos: Path, splats: str) -> None:
    page.goto(url)
    files = {name: data for name, data in sample(photos).items() if name.endswith(".png")}
    drop(page, dict(list(files.items())[:1]))
    expect(page.locator("#faults li")).to_contain_text("One photo")
    page.click(f"#scenes button[data-id='{splats}']")
    settled(page)
    for left in ["#faults li", "#photos li"]:
        expect(page.locator(left)).to_have_count(0)


def test_a_server_that_is_gone_is_named(page: Page, url: str, splats: str) -> None:
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    page.route("**/v1/**", lambda route: route.abort())
    page.fill("#text", "box")
    page.press("#text", "Enter")
    expect(page.locator("#says")).to_have_text("the server cannot be reached")


def test_an_order_that_comes_late_does_not_stop_the_next_scene(
        page: Page, url: str, scene: str, splats: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    # The next order is held back, and comes when the other scene has just begun.
    page.evaluate("""() => {
      const { drawing, look, state } = segsplat, give = drawing.worker.onmessage;
      const begin = drawing.begin.bind(drawing);
      drawing.worker.onmessage = (late) => {
        drawing.worker.onmessage = give;
        globalThis.held = true;
        drawing.begin = (...scene) => {
          const room = begin(...scene);
          give(late);
          globalThis.drawn = drawing.drawn;
          return room;
        };
      };
      look({ ...state.camera, eye: state.camera.eye.map((v) => v + 0.1) }, true); }""")
    until(page, "globalThis.held")
    page.evaluate("(id) => { location.hash = `scene=${id}`; }", splats)
    until(page, "segsplat.drawing.loaded === 40")
    settled(page)
    assert page.evaluate("drawn") == 0, "an order of another scene was taken"
    assert pixels(page).std() > 10, "the canvas is flat"


def test_without_a_scene_there_is_nothing_to_press(page: Page, url: str, splats: str) -> None:
    page.goto(url)
    expect(page.locator("#scenes button").first).to_be_visible()
    for hidden in ["#stage", "#tools", "#ask"]:
        expect(page.locator(hidden)).to_be_hidden()
    page.click(f"#scenes button[data-id='{splats}']")
    settled(page)
    for there in ["#stage", "#tools", "#ask"]:
        expect(page.locator(there)).to_be_visible()
