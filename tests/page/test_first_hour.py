"""What a person meets in the first hour: files of a phone, the first word, unknown words."""

from __future__ import annotations

import io
import json
import urllib.request
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
from acts import drop, pixels, sample, settled, until
from PIL import Image
from playwright.sync_api import Page, Route, expect
from served import run


def shown_scene(page: Page, url: str) -> dict:
    """The scene that the page shows, as the server tells it."""
    settled(page)
    id = page.evaluate("segsplat.state.scene.id")
    with urllib.request.urlopen(f"{url}/v1/scenes/{id}") as answer:
        return json.load(answer)


def lines(page: Page) -> int:
    """Pixels of the drawing over the canvas that are not clear."""
    settled(page)
    return page.evaluate(
        """() => { const canvas = document.getElementById('over');
          const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
          let n = 0;
          for (let i = 3; i < data.length; i += 4) if (data[i]) n++;
          return n; }""")


def test_a_list_of_more_cameras_than_photos_makes_a_scene_and_says_so(
        page: Page, url: str, photos: Path) -> None:
    page.goto(url)
    files = sample(photos)
    names = sorted(name for name in files if name.endswith(".png"))
    del files[names[2]]
    drop(page, files)
    scene = shown_scene(page, url)
    assert [camera["file"].split("/")[-1] for camera in scene["cameras"]] == [
        name for name in names if name != names[2]]
    expect(page.locator("#notes li")).to_have_text(
        f"1 of 4 cameras have no photo here, as images/{names[2]}: they are left out.")
    expect(page.locator("#photos .fault")).to_have_count(0)
    expect(page.locator("#photos li").nth(2)).to_contain_text("no photo; it is left out")


def test_a_format_that_is_not_read_is_named_with_what_to_do(
        page: Page, url: str, photos: Path) -> None:
    page.goto(url)
    files = sample(photos)
    drop(page, {"IMG_0001.HEIC": b"x", "IMG_0002.heic": b"x",
                "transforms.json": files["transforms.json"]})
    fault = page.locator("#faults li").first
    expect(fault).to_contain_text("IMG_0001.HEIC and 1 more: HEIC is a format that is not read")
    expect(fault).to_contain_text("export it as JPEG")
    # Beside photos that are read it is a note.
    drop(page, {**files, "IMG_0001.HEIC": b"x"})
    settled(page)
    expect(page.locator("#notes li")).to_contain_text("HEIC is a format that is not read")


def held(png: Path, turn: int) -> bytes:
    """A photo as a phone writes it: a JPEG that says how the phone was held."""
    exif = Image.Exif()
    exif[0x0112] = turn
    file = io.BytesIO()
    Image.open(png).convert("RGB").save(file, "JPEG", quality=95, exif=exif)
    return file.getvalue()


def test_too_many_and_too_large_photos_are_chosen_and_made_smaller(
        page: Page, url: str, tmp_path: Path) -> None:
    page.goto(url)
    run("sample", "--photos", "7", "--size", "640x480", "-o", tmp_path)
    told = json.loads((tmp_path / "transforms.json").read_text())
    files = {}
    for i, frame in enumerate(told["frames"]):
        files[f"{i}.jpg"] = held(tmp_path / frame["file_path"], 6)
        frame["file_path"] = f"{i}.jpg"
    # The lens does not say for which size it is.
    lens = {name: told.pop(name, None) or told["frames"][0][name]
            for name in ["fl_x", "fl_y", "cx", "cy"]}
    for scope in [told, *told["frames"]]:
        scope.pop("w", None), scope.pop("h", None)
    told |= lens
    sizes = sum(len(data) for data in files.values())
    def told_less(route: Route) -> None:
        told = route.fetch().json()
        told["limits"] |= {"photos_max": 4, "upload_bytes_max": sizes // 4,
                           "photos_pixels_kept_max": 4 * 320 * 240}
        route.fulfill(json=told)

    page.route("**/v1/models", told_less)
    drop(page, {**files, "transforms.json": json.dumps(told).encode()})
    scene = shown_scene(page, url)
    assert [camera["file"] for camera in scene["cameras"]] == ["0.jpg", "2.jpg", "4.jpg", "6.jpg"]
    for camera in scene["cameras"]:
        made = camera["intrinsics"]
        assert (made["width"], made["height"]) == (320, 240), "the photo was turned"
        assert np.allclose([made[name] for name in ["fx", "fy", "cx", "cy"]],
                           [lens[name] / 2 for name in ["fl_x", "fl_y", "cx", "cy"]])
    notes = page.locator("#notes li")
    expect(notes.nth(0)).to_contain_text("4 are sent, evenly chosen")
    expect(notes.nth(1)).to_contain_text("4 photos were made smaller before sending")


def test_the_first_word_shows_how_far_it_is(page: Page, url: str, photos: Path) -> None:
    page.goto(url)
    files = sample(photos)
    # Other photos than those of the scene that other tests share: it has its semantics.
    drop(page, dict(list(files.items())[:2]) | {"transforms.json": files["transforms.json"]})
    settled(page)
    page.evaluate(
        """() => { globalThis.said = [];
          const says = document.getElementById('says');
          new MutationObserver(() => said.push(says.textContent)).observe(
            says, { childList: true, characterData: true, subtree: true }); }""")
    watched = []
    page.on("request", lambda request: "/events" in request.url
            and "edits=true" not in request.url and watched.append(request.url))
    page.fill("#text", "box")
    page.press("#text", "Enter")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    assert [url.split("?")[-1] for url in watched] == ["semantics=true"], "one stream tells all"
    said = page.evaluate("said")
    assert any(text.startswith("finding things: ") for text in said), said
    expect(page.locator("#progress")).to_be_hidden()


def test_a_word_says_how_well_it_fits_and_how_well_it_is_known(
        page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    with urllib.request.urlopen(f"{url}/v1/models") as answer:
        trust = {one["word"]: one["trust"] for one in json.load(answer)["words"]}
    shown = {"good": "known well", "fair": "known fairly", "poor": "known poorly",
             "unmeasured": "not measured"}
    for text in ["a box", "zxqv"]:
        page.fill("#text", text)
        page.press("#text", "Enter")
        expect(page.locator("#words li strong").last).to_have_text(text)
    chips = page.locator("#words li")
    expect(chips.nth(0).locator(".score")).to_contain_text(shown[trust["box"]])
    expect(chips.nth(1).locator(".score")).to_contain_text("not in the list")
    said = f'"zxqv" is not in the list of {len(trust)} words'
    expect(page.locator("#says")).to_contain_text(said)
    words = page.evaluate("segsplat.state.words")
    body = json.dumps({"texts": ["a box"], "boxes": "upright"}).encode()
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}/query", body) as answer:
        truth = json.load(answer)["results"][0]
    assert f"{max(truth['scores']):.2f}" in chips.nth(0).locator(".score").inner_text()
    # The parts are those of the server, with upright boxes.
    assert words[0]["parts"] == truth["parts"] != []


def test_a_word_that_is_nowhere_is_not_found(page: Page, url: str, scene: str) -> None:
    def nothing(route: Route) -> None:
        told = route.fetch().json()
        told["results"][0] |= {"found": False, "gaussians": 0, "parts": [], "entries": []}
        told["results"][0]["scores"] = [0.31] * len(told["results"][0]["scores"])
        route.fulfill(json=told)

    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.route("**/query", nothing)
    page.fill("#text", "unicorn")
    page.press("#text", "Enter")
    expect(page.locator("#words .score")).to_contain_text("not found")
    expect(page.locator("#says")).to_contain_text("unicorn: not found, the best score is 0.31")


def test_nothing_of_a_word_stays_after_it_is_removed(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}&text=box")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    page.focus("#view")
    page.keyboard.press("w")
    assert lines(page) > 100
    page.click("#words button[aria-label='Remove box']")
    assert "box" not in page.inner_text("#says")
    # A click asks the server alone.
    page.evaluate(
        "() => { segsplat.drawing.pointAt = () => { throw new Error('asked the device'); }; }")
    for _ in range(3):
        page.locator("#view").click(position={"x": 360, "y": 130})
        expect(page.locator("#picked")).to_contain_text("wide")
        page.keyboard.press("Escape")
        expect(page.locator("#words li")).to_have_count(0)
        assert lines(page) == 0


def test_the_whole_photo_is_in_the_canvas(page: Page, url: str, scene: str) -> None:
    page.set_viewport_size({"width": 420, "height": 900})
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    width, height, fov, lens = page.evaluate(
        """() => { const { clientWidth, clientHeight } = document.getElementById('stage'),
          { state } = segsplat;
          return [clientWidth, clientHeight, state.camera.fov, state.scene.cameras[0].intrinsics]; }
        """)
    assert width < height and lens["width"] > lens["height"]
    across = 2 * np.degrees(np.arctan(np.tan(np.radians(fov / 2)) * width / height))
    want = 2 * np.degrees(np.arctan(lens["width"] / 2 / lens["fx"]))
    assert abs(across - want) < 0.1, (across, want)
    # Nothing lies over it, and what is far above it was seen by no photo.
    assert lines(page) == 0
    ground = (0xE9, 0xED, 0xF2)
    high = round(width * lens["height"] / lens["width"] * len(pixels(page)) / height)
    seen = pixels(page).astype(int)
    apart = np.abs(seen - ground).max(axis=2)
    middle = len(seen) // 2
    assert np.median(apart[: middle - high]) <= 2 < np.median(apart[middle - high // 2:][:high])
    # Turned and wide, the whole photo is in it as well.
    page.set_viewport_size({"width": 900, "height": 420})
    until(page, "Math.abs(view.clientWidth - 900) < 1")
    settled(page)
    fov = page.evaluate("segsplat.state.camera.fov")
    assert fov >= 2 * np.degrees(np.arctan(lens["height"] / 2 / lens["fy"])) - 0.1


def test_the_box_of_the_sample_is_the_cardboard_box_and_not_the_picture(
        url: str, scene: str) -> None:
    ask = json.dumps({"texts": ["box"]}).encode()
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}/query", ask) as answer:
        [found] = json.load(answer)["results"]
    assert len(found["parts"]) == 1, [part["center"] for part in found["parts"]]
    view = f"{url}/v1/scenes/{scene}/view?kind=mask&text=box&from=1&width=320&format=png"
    with urllib.request.urlopen(view) as answer:
        marked = np.asarray(Image.open(io.BytesIO(answer.read())).convert("L")) > 127
    assert marked.shape == (240, 320)
    # By the photo: the cardboard box, the picture on the wall over it.
    assert marked[110:160, 115:155].mean() > 0.9
    assert marked[5:40, 130:200].mean() == 0


def test_a_thing_is_selected_by_a_click_without_a_word(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.focus("#view")
    page.keyboard.press("w")
    picks: list[str] = []
    page.on("request", lambda sent: picks.append(sent.url) if "/pick?" in sent.url else None)
    with page.expect_response("**/pick?*") as asked:
        page.locator("#view").click(position={"x": 360, "y": 130})
    found = asked.value.json()
    expect(page.locator("#words li strong")).to_have_text(["thing 1"])
    # All words that are known were asked, each once.
    names = [name for sent in picks for name in parse_qs(urlsplit(sent).query)["label"]]
    trusted = page.evaluate("fetch('/v1/models').then((it) => it.json())")["words"]
    known = [word["word"] for word in trusted if word["trust"] in ("good", "fair")]
    assert sorted(names) == sorted(known) and len(known) > 100, (len(names), len(known))
    expect(page.locator("#words .score")).to_have_text("clicked")
    [word] = page.evaluate("segsplat.state.words")
    assert word["entries"] == [found["entry"]]
    assert word["scores"][found["entry"] - 1] == 1 and sum(word["scores"]) == 1
    # What was clicked lies in its box, but for the farthest Gaussians.
    [box] = word["parts"]
    assert 10 < box["gaussians"] == word["gaussians"]
    off = np.array(box["axes"]) @ (np.array(found["point"]) - box["center"])
    assert (abs(off) < 0.6 * np.array(box["size"]) + 0.05).all(), (off, box)
    assert lines(page) > 100
    # It is shown as a word is, and is no text of the link.
    page.select_option("#kind", "3")
    white = pixels(page)
    high, wide = white.shape[:2]
    width, height = page.evaluate("[view.clientWidth, view.clientHeight]")
    assert white[round(130 / height * high), round(360 / width * wide)].min() == 255
    assert 0.001 < (white[..., 0] == 255).mean() < 0.9
    assert "text=" not in page.evaluate("location.hash")
    page.click("#words button[aria-label='Remove thing 1']")
    expect(page.locator("#words li")).to_have_count(0)
    assert page.evaluate("segsplat.state.words") == []
    assert lines(page) == 0
