"""Edits: of a word, of what was clicked and of a box, in a list that is undone and put in order; in
links, in frames of other pages, and by keys and fingers."""

from __future__ import annotations

import base64
import io
import json
import re
import urllib.request

import numpy as np
import pytest
from acts import Camera, pixels, settled, until, window
from PIL import Image
from playwright.sync_api import Browser, Page, expect
from test_panels import grave

SHUT = {"edits": []}


def kept(url: str, scene: str, edits: dict[str, object] | None = None) -> dict[str, object]:
    """The list that the server has; `edits` is put first."""
    body = None if edits is None else json.dumps(edits).encode()
    request = urllib.request.Request(f"{url}/v1/scenes/{scene}/edits", body,
                                     method="GET" if edits is None else "PUT")
    with urllib.request.urlopen(request) as answer:
        told: dict[str, object] = json.load(answer)
        return told


@pytest.fixture
def room(page: Page, url: str, scene: str):  # noqa: ANN201
    """The scene without edits in a wide window, and none of them afterwards."""
    kept(url, scene, SHUT)
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    yield page
    kept(url, scene, SHUT)


def find(page: Page, text: str) -> int:
    """The Gaussians that a word finds."""
    page.fill("#text", text)
    page.press("#text", "Enter")
    expect(page.locator("#words li strong").last).to_have_text(text)
    settled(page)
    return int(page.evaluate("segsplat.state.words.at(-1).gaussians"))


def edited(page: Page, says: str) -> None:
    expect(page.locator("#says")).to_contain_text(says)
    settled(page)


def rows(page: Page) -> list[str]:
    return [re.sub(r"\s*\(.*|\d[\d,]* Gaussians.*", "", one).strip()
            for one in page.locator("#edits li > span").all_inner_texts()]


def test_a_word_is_deleted_and_comes_back_bit_for_bit(room: Page, url: str, scene: str) -> None:
    before, all_of_it = pixels(room), room.evaluate("segsplat.drawing.count")
    n = find(room, "ball")
    assert n > 0
    room.get_by_role("button", name="Edit ball").click()
    expect(room.locator("#act-on")).to_have_text("ball")
    room.click("#act-delete")
    edited(room, f"Deleted: ball ({n:,} Gaussians)")
    assert room.evaluate("segsplat.drawing.count") == all_of_it - n
    assert kept(url, scene)["edits"] == [{"op": "delete", "select": {"text": "ball"}}]
    # Of what is gone nothing is shown, and nothing is offered.
    expect(room.locator("#words li")).to_have_count(0)
    expect(room.locator("#act")).to_be_hidden()
    assert np.abs(pixels(room).astype(int) - before).max() > 50
    expect(room.locator("#edits-count")).to_have_text("1")
    room.click("#undo")
    edited(room, "as it was made")
    assert np.array_equal(pixels(room), before), "undo gave another picture"
    assert kept(url, scene)["edits"] == []
    room.click("#redo")
    edited(room, "Deleted: ball")
    assert room.evaluate("segsplat.drawing.count") == all_of_it - n


def test_what_somebody_else_edits_is_shown_and_nothing_jumps(
        room: Page, url: str, scene: str) -> None:
    before, all_of_it = pixels(room), room.evaluate("segsplat.drawing.count")
    room.locator("#view").press("ArrowRight")
    settled(room)
    camera = room.evaluate("segsplat.state.camera")
    told = kept(url, scene, {"edits": [{"op": "delete", "select": {"text": "box"}}]})
    edited(room, "Deleted: box")
    assert rows(room) == ["Deleted: box"]
    n = told["counts"][0]  # type: ignore[index]
    assert n > 0 and room.evaluate("segsplat.drawing.count") == all_of_it - n
    assert room.evaluate("segsplat.state.camera") == camera
    kept(url, scene, SHUT)
    edited(room, "as it was made")
    assert rows(room) == []
    room.locator("#view").press("Home")
    settled(room)
    assert np.array_equal(pixels(room), before)


def test_holes_are_striped_where_the_server_says_and_nowhere_else(
        room: Page, url: str, scene: str) -> None:
    holes = room.locator("#holes")
    expect(holes).to_be_hidden()
    room.locator("#view").click(position={"x": 640, "y": 400})
    expect(room.locator("#act-on")).to_have_text("thing 1")
    room.click("#act-delete")
    edited(room, "Deleted: a clicked thing")
    expect(holes, "nothing is behind the wall").to_be_visible()
    with room.expect_response(lambda answer: "kind=holes" in answer.url) as asked:
        holes.click()
    assert asked.value.ok, asked.value.text()
    with urllib.request.urlopen(asked.value.url) as answer:
        seen = np.asarray(Image.open(io.BytesIO(answer.read())))
    assert seen.max() > 200 and (seen == 0).mean() > 0.1
    drawn = ("document.getElementById('over').getContext('2d')"
             ".getImageData(0, 0, 1280, 800).data.some((v) => v)")
    until(room, drawn)
    encoded = room.evaluate("document.getElementById('over').toDataURL()").split(",")[1]
    over = Image.open(io.BytesIO(base64.b64decode(encoded))).resize(seen.shape[::-1])
    alpha = np.asarray(over)[..., 3]
    striped = (np.add(*np.indices(seen.shape)) & 8).astype(bool)
    assert np.abs(alpha[striped].astype(int) - seen[striped]).mean() < 2
    assert alpha[~striped].mean() < 2 and alpha[seen == 0].max() == 0
    holes.click()
    until(room, f"!{drawn}")


def test_holes_are_asked_for_again_after_a_call_that_failed(room: Page) -> None:
    room.locator("#view").click(position={"x": 640, "y": 400})
    room.click("#act-delete")
    edited(room, "Deleted: a clicked thing")
    holes = room.locator("#holes")
    room.route("**/view?*kind=holes*", lambda route: route.abort())
    holes.click()
    expect(room.locator("#says")).to_contain_text("cannot be reached")
    room.unroute("**/view?*kind=holes*")
    holes.click()
    with room.expect_response(lambda answer: "kind=holes" in answer.url) as asked:
        holes.click()
    assert asked.value.ok, asked.value.text()


def test_what_is_clicked_is_recoloured_and_deleted_by_a_key(
        room: Page, url: str, scene: str) -> None:
    room.locator("#view").click(position={"x": 640, "y": 400})
    expect(room.locator("#act-on")).to_have_text("thing 1")
    expect(room.locator("#act-part")).to_be_hidden()
    room.click("#act-recolor")
    room.fill("#color", "#00ff00")
    room.fill("#amount", "1")
    room.locator("#recolor-form button").click()
    edited(room, "Recoloured: a clicked thing")
    told = kept(url, scene)
    assert told["edits"][0]["color"] == [0, 1, 0] and told["counts"][0] > 0  # type: ignore[index]
    middle = room.evaluate("[document.getElementById('view').width, "
                           "document.getElementById('view').height]")
    green = pixels(room)[middle[1] // 2, middle[0] // 2]
    assert green[1] > 200 and max(green[0], green[2]) < 60, green
    # Clicked again, it is deleted by a key; two presses undo both.
    room.locator("#view").click(position={"x": 640, "y": 400})
    expect(room.locator("#act")).to_be_visible()
    room.focus("#view")
    room.keyboard.press("Delete")
    edited(room, "Deleted: a clicked thing")
    assert rows(room) == ["Recoloured: a clicked thing", "Deleted: a clicked thing"]
    room.keyboard.press("Control+z")
    room.keyboard.press("Control+z")
    edited(room, "as it was made")
    room.keyboard.press("Control+Shift+z")
    edited(room, "Recoloured")


def test_a_thing_goes_where_its_outline_was(room: Page, url: str, scene: str) -> None:
    find(room, "table")
    room.get_by_role("button", name="Edit table").click()
    parts = room.locator("#act-part")
    expect(parts, "a word of several parts is needed here").to_be_visible(timeout=5000)
    parts.select_option("0")
    room.click("#act-move")
    expect(room.locator("#act-move")).to_have_attribute("aria-expanded", "true")
    camera = Camera(room)
    room.fill("#move-up", "0.5")
    room.locator("#move-form button[value=copy]").click()
    edited(room, "Copied: table 1")
    one = kept(url, scene)["edits"][0]  # type: ignore[index]
    assert (one["op"], one["select"]) == ("copy", {"text": "table", "parts": [0]})
    way = np.array(one["translation"])
    np.testing.assert_allclose(np.linalg.norm(way), 0.5)
    assert way @ camera.up > 0.4, "up is not up"


def test_a_box_crops_the_scene(room: Page, url: str, scene: str) -> None:
    all_of_it = room.evaluate("segsplat.drawing.count")
    room.click("#edit-box")
    expect(room.locator("#act-on")).to_have_text("a box")
    wide = float(room.input_value("#box-wide"))
    room.fill("#box-wide", str(2 * wide))
    room.fill("#box-right", str(0.1 * wide))
    room.click("#act-keep")
    edited(room, "Kept alone: a box")
    box = kept(url, scene)["edits"][0]["select"]["box"]  # type: ignore[index]
    np.testing.assert_allclose(box["size"][0], 2 * wide, rtol=1e-2)
    assert 0 < room.evaluate("segsplat.drawing.count") < all_of_it / 2


def test_the_list_is_put_in_order_and_the_focus_stays(room: Page, url: str, scene: str) -> None:
    words = [{"op": "recolor", "select": {"text": "ball"}, "color": [1, 0, 0]},
             {"op": "delete", "select": {"text": "box"}}]
    kept(url, scene, {"edits": words})
    room.reload()
    settled(room)
    expect(room.locator("#edits li")).to_have_count(2)
    assert rows(room) == ["Recoloured: ball", "Deleted: box"]
    up = room.get_by_role("button", name="Apply edit 2 earlier")
    up.focus()
    room.keyboard.press("Enter")
    until(room, "document.querySelector('#edits li').textContent.includes('box')")
    settled(room)
    assert kept(url, scene)["edits"] == words[::-1]
    assert room.evaluate("document.activeElement.closest('#edits') !== null"), "the focus is lost"
    room.get_by_role("button", name="Take back edit 1").click()
    expect(room.locator("#edits li")).to_have_count(1)
    edited(room, "Recoloured: ball")
    assert kept(url, scene)["edits"] == words[:1]


def test_what_others_edit_is_shown_when_one_comes_back(room: Page, url: str, scene: str) -> None:
    all_of_it = room.evaluate("segsplat.drawing.count")
    told = kept(url, scene, {"edits": [{"op": "delete", "select": {"text": "box"}}]})
    room.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    edited(room, "Deleted: box")
    assert room.evaluate("segsplat.drawing.count") == told["gaussians"] < all_of_it


def test_a_list_that_is_refused_changes_nothing(room: Page, url: str, scene: str) -> None:
    room.click("#edit-box")
    for side in ["wide", "high", "deep"]:
        room.fill(f"#box-{side}", "0")
    room.click("#act-keep")
    expect(room.locator("#says")).to_contain_text("leaves nothing of the scene")
    expect(room.locator("#edits li")).to_have_count(0)
    expect(room.locator("#undo")).to_be_disabled()
    assert kept(url, scene)["edits"] == []


def test_a_link_and_a_frame_show_the_edits_and_a_frame_offers_none(
        room: Page, browser: Browser, url: str, scene: str) -> None:
    n = find(room, "ball")
    all_of_it = room.evaluate("segsplat.drawing.count")
    room.get_by_role("button", name="Edit ball").click()
    room.click("#act-delete")
    edited(room, "Deleted: ball")
    for more in ["", "&embed=1"]:
        other = window(browser, viewport={"width": 1280, "height": 800})
        other.goto(room.url + more)
        settled(other)
        until(other, f"segsplat.drawing.count === {all_of_it - n}")
        expect(other.locator("#edits li")).to_have_count(1)
        assert other.locator("#edits-panel").is_visible() == (not more)
        other.locator("#view").click(position={"x": 640, "y": 400})
        expect(other.locator("#picked")).to_contain_text("from the camera")
        # The last that a click adds.
        expect(other.locator("#picked").get_by_text("Measure from here")).to_be_attached()
        expect(other.locator("#act")).to_be_visible(visible=not more)
        other.context.close()


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_axe_finds_nothing_serious_in_what_edits_show(
        room: Page, url: str, scene: str, theme: str) -> None:
    room.emulate_media(color_scheme=theme)  # type: ignore[arg-type]
    kept(url, scene, {"edits": [{"op": "recolor", "select": {"text": "box"}, "color": [1, 0, 0]}]})
    room.reload()
    settled(room)
    expect(room.locator("#edits li")).to_have_count(1)
    room.click("#edit-box")
    assert grave(room) == []
    for form in ["move", "recolor"]:
        room.click(f"#act-{form}")
        assert grave(room) == [], form


def test_on_a_phone_a_tap_chooses_and_a_tap_deletes(
        browser: Browser, url: str, scene: str) -> None:
    kept(url, scene, SHUT)
    page = window(browser, viewport={"width": 390, "height": 780}, has_touch=True,
                  reduced_motion="reduce")
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.touchscreen.tap(195, 390)
    expect(page.locator("#act")).to_be_visible()
    expect(page.locator("#act-on")).to_have_text("thing 1")
    act = page.locator("#act").bounding_box()
    assert act and act["x"] >= 0 and act["x"] + act["width"] <= 390
    for button in page.locator("#act button:visible").all():
        box = button.bounding_box()
        assert box and box["height"] >= 36, button.inner_text()
    page.locator("#act-delete").tap()
    edited(page, "Deleted: a clicked thing")
    page.context.close()
    kept(url, scene, SHUT)
