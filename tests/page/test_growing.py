"""Photos join the scene that is shown, one is taken out again, and words keep things out."""

from __future__ import annotations

import json
import urllib.request
from pathlib import Path

import pytest
from acts import drop, open_scenes, post, sample, settled, until
from playwright.sync_api import Page, Route, expect
from served import run
from test_panels import grave


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("growing") / "photos"
    run("sample", "--photos", "5", "--size", "128x96", "-o", folder)
    return sample(folder)


def cut(capture: dict[str, bytes], numbers: list[int]) -> dict[str, bytes]:
    """These photos alone, with their cameras."""
    cameras = json.loads(capture["transforms.json"])
    cameras["frames"] = [cameras["frames"][n] for n in numbers]
    files = {Path(frame["file_path"]).name: b"" for frame in cameras["frames"]}
    return {**{name: capture[name] for name in files},
            "transforms.json": json.dumps(cameras).encode()}


def made(url: str, files: dict[str, bytes]) -> str:
    return post(url, [("transforms", name, data) if name.endswith(".json")
                      else ("photo", f"images/{name}", data) for name, data in files.items()])


def names(url: str, scene: str) -> list[str]:
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}") as answer:
        return [Path(camera["file"]).name for camera in json.load(answer)["cameras"]]


def test_photos_join_the_scene_that_is_shown_and_leave_it(
        page: Page, url: str, capture: dict[str, bytes]) -> None:
    scene = made(url, cut(capture, [0, 1, 2]))
    first = names(url, scene)
    page.set_viewport_size({"width": 1280, "height": 800})
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    camera = page.evaluate("segsplat.state.camera")
    open_scenes(page)
    page.get_by_label("Add to the scene that is shown").check()
    # Photos that join leave out what the scene leaves out.
    expect(page.locator("#ignore")).to_be_hidden()
    drop(page, cut(capture, [3, 4]))
    expect(page.locator("#says")).to_contain_text("2 photos joined")
    settled(page)
    assert len(names(url, scene)) == 5 and names(url, scene)[:3] == first
    expect(page.locator("#stops li")).to_have_count(5)
    assert page.evaluate("segsplat.state.camera") == camera, "the view moved"
    assert page.evaluate("segsplat.state.scene.id") == scene
    assert not grave(page)
    # The photo that is looked through goes again, once the question is answered with yes.
    page.click("#tools-fold") if not page.locator("#tools").is_visible() else None
    page.locator("#stops button").nth(4).click()
    settled(page)
    page.click("#leave")
    dialog = page.get_by_role("dialog", name="out?")
    expect(dialog).to_contain_text("What only this photo shows")
    page.keyboard.press("Escape")
    assert len(names(url, scene)) == 5, "a question that was not answered took a photo out"
    page.click("#leave")
    dialog.get_by_role("button", name="Take it out").click()
    expect(page.locator("#says")).to_contain_text("1 photo was taken out")
    expect(page.locator("#stops li")).to_have_count(4)
    expect(page.locator("#leave")).to_be_disabled()
    assert set(names(url, scene)) == set(cut(capture, [0, 1, 2, 3])) - {"transforms.json"}


def test_photos_that_cannot_join_are_named_and_the_scene_stays(
        page: Page, url: str, capture: dict[str, bytes]) -> None:
    scene = made(url, cut(capture, [0, 1]))
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    open_scenes(page)
    page.get_by_label("Add to the scene that is shown").check()
    drop(page, cut(capture, [1]))
    expect(page.locator("#photos")).to_contain_text("0001")
    expect(page.locator("#photos .fault, #faults li").first).to_be_visible()
    assert len(names(url, scene)) == 2
    expect(page.locator("#stops li")).to_have_count(2)


def test_only_scenes_of_photos_take_more(page: Page, url: str, splats: str) -> None:
    page.goto(f"{url}/#scene={splats}")
    settled(page)
    open_scenes(page)
    expect(page.locator("#join-row")).to_be_hidden()


def test_words_of_what_is_left_out_are_sent(
        page: Page, url: str, capture: dict[str, bytes]) -> None:
    sent: list[bytes] = []

    def taken(route: Route) -> None:
        sent.append(route.request.post_data_buffer or b"")
        route.fulfill(status=400, json={"code": "invalid_argument", "message": "enough seen"})

    page.route("**/v1/scenes", lambda route: taken(route)
               if route.request.method == "POST" else route.continue_())
    page.goto(url)
    page.get_by_label("Leave out").fill(" person, ,car")
    drop(page, cut(capture, [0, 1]))
    expect(page.locator("#says")).to_have_text("enough seen")
    words = sent[0].split(b'name="ignore"\r\n\r\n')[1:]
    assert [word.split(b"\r\n")[0] for word in words] == [b"person", b"car"]


def test_a_scene_that_is_opened_meanwhile_stays(
        page: Page, url: str, capture: dict[str, bytes], splats: str) -> None:
    scene = made(url, cut(capture, [0, 1, 3]))
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    open_scenes(page)
    page.get_by_label("Add to the scene that is shown").check()
    held: list[Route] = []
    page.route("**/photos", lambda route: held.append(route))
    drop(page, cut(capture, [4]))
    while not held:
        page.wait_for_timeout(50)
    page.goto(f"{url}/#scene={splats}")
    until(page, f"segsplat.state.scene?.id === '{splats}'")
    held[0].continue_()
    while len(names(url, scene)) < 4:
        page.wait_for_timeout(100)
    page.wait_for_timeout(1000)
    settled(page)
    assert page.evaluate("[segsplat.state.scene.id, segsplat.drawing.count]") == [splats, 40]
