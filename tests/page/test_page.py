"""The page as people use it: drop photos, look, ask, click, share, take a file away."""

from __future__ import annotations

import io
import json
import urllib.parse
import urllib.request
from pathlib import Path

import numpy as np
from acts import drop, look, pixels, sample, settled
from axe_playwright_python.sync_playwright import Axe
from PIL import Image
from playwright.sync_api import Page, expect

PSNR_DB, IOU = 35.0, 0.95
# Poses: each photo's, and one between them that magnifies.
POSES = [(0, [0, 0, 0]), (1, [0, 0, 0]), (2, [0, 0, 0]), (3, [0, 0, 0]), (0, [0.3, -0.1, 0.6])]


def served(page: Page, url: str, shape: tuple[int, ...], **options: str) -> np.ndarray:
    """The server's picture of the page's camera."""
    height, width = shape[:2]
    camera, focal, scene = page.evaluate(
        """(height) => { const { state, matrixOf, focalOf } = segsplat;
          return [matrixOf(state.camera), focalOf(state.camera, height), state.scene.id]; }""",
        height)
    query = urllib.parse.urlencode({
        "camera_to_world": ",".join(map(str, camera)), "fx": focal, "width": width,
        "height": height, "format": "png", **options})
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}/view?{query}") as answer:
        return np.asarray(Image.open(io.BytesIO(answer.read())).convert("RGB"))


def test_photos_are_dropped_and_the_scene_is_flown_asked_clicked_shared_and_kept(
        page: Page, url: str, photos: Path, tmp_path: Path) -> None:
    page.goto(url)
    drop(page, sample(photos))
    settled(page)
    expect(page.locator("#photos li")).to_have_count(4)
    seen = pixels(page)
    assert seen.std() > 20, "the canvas is flat"
    # Flies by keys.
    page.focus("#view")
    page.keyboard.press("w")
    settled(page)
    assert np.abs(pixels(page).astype(float) - seen).mean() > 1, "the view stayed"
    page.keyboard.press("Home")
    settled(page)
    # A word; the first one has the semantics made.
    page.fill("#text", "box")
    page.press("#text", "Enter")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    assert page.locator("#words .parts button").count() > 0
    assert "Gaussians in" in page.inner_text("#says")
    settled(page)
    # A click.
    page.locator("#view").click(position={"x": 360, "y": 130})
    expect(page.locator("#picked")).to_contain_text("from the camera")
    expect(page.locator("#words li")).to_have_count(2)
    page.keyboard.press("Escape")
    expect(page.locator("#words li")).to_have_count(1)
    # The link has scene, pose and word: another page shows the same.
    page.click("#share")
    before, link = pixels(page), page.url
    assert "scene=" in link and "text=box" in link
    again = page.context.new_page()
    again.goto(link)
    expect(again.locator("#words li strong")).to_have_text(["box"])
    assert np.abs(pixels(again).astype(float) - before).mean() < 0.5
    again.close()
    # One file, opened from the disk, with the word in it and no server.
    with page.expect_download() as waited:
        page.select_option("#export", "html")
    kept = tmp_path / "scene.html"
    waited.value.save_as(kept)
    alone = page.context.new_page()
    calls: list[str] = []
    alone.on("request", lambda one: one.url.startswith("http") and calls.append(one.url))
    alone.goto(kept.as_uri() + "#" + link.split("#")[1])
    expect(alone.locator("#words li strong")).to_have_text(["box"])
    assert np.abs(pixels(alone).astype(float) - before).mean() < 0.5
    # There is no server to ask for a file.
    expect(alone.locator("#export")).to_be_hidden()
    assert not calls, calls
    alone.close()


def test_a_file_of_gaussians_is_dropped_and_shown(page: Page, url: str) -> None:
    page.goto(url)
    source = Path(__file__).parents[1] / "fixtures/splats/source.ply"
    drop(page, {"source.ply": source.read_bytes()})
    settled(page)
    expect(page.locator("#photos li")).to_have_text(["source.ply"])
    expect(page.locator("#about")).to_contain_text("40 Gaussians of a file (ply)")
    seen = pixels(page)
    # Its colours do not depend on the direction as much as the page leaves out.
    want = served(page, url, seen.shape)
    assert seen.std() > 10 and np.abs(seen.astype(float) - want).mean() < 12
    page.fill("#text", "box")
    page.press("#text", "Enter")
    expect(page.locator("#says")).to_contain_text("(ply) without semantics")


def test_the_server_recognises_a_capture_that_was_dropped(
        page: Page, url: str, photos: Path) -> None:
    page.goto(url)
    files = sample(photos)
    frames = json.loads(files.pop("transforms.json"))["frames"]
    for i, frame in enumerate(frames):
        rows = frame["transform_matrix"]
        pose = {f"t_{r}{c}": rows[r][c] for r in range(3) for c in range(4)}
        lens = {"fx": frame["fl_x"], "fy": frame["fl_y"], "cx": frame["cx"], "cy": frame["cy"]}
        files[f"keyframes/cameras/{i:04}.json"] = json.dumps({**pose, **lens}).encode()
    files = {f"keyframes/images/{name}" if name.endswith(".png") else name: data
             for name, data in files.items()}
    drop(page, files)
    settled(page)
    expect(page.locator("#photos li")).to_have_count(4)
    assert pixels(page).std() > 20, "the canvas is flat"


def test_the_canvas_is_the_servers_view(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    for photo, shift in POSES:
        look(page, photo, shift)
        shown = pixels(page)
        truth = served(page, url, shown.shape)
        error = np.mean((shown.astype(float) - truth) ** 2)
        psnr = 10 * np.log10(255**2 / max(error, 1e-9))
        print(f"photo {photo} {shift}: {psnr:.1f} dB")
        assert psnr >= PSNR_DB, (photo, shift, psnr)


def test_the_mask_of_a_word_is_the_servers(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}&text=box&kind=mask")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    for photo, shift in POSES[::2]:
        look(page, photo, shift)
        shown = pixels(page)[..., 0] > 127
        truth = served(page, url, shown.shape, kind="mask", text="box")[..., 0] > 127
        share = (shown & truth).sum() / max(1, (shown | truth).sum())
        print(f"photo {photo} {shift}: {share:.4f} of {truth.sum()} pixels")
        assert truth.sum() > 500 and share >= IOU, (photo, shift, share)


def test_a_broken_capture_shows_its_fault_at_its_photo(
        page: Page, url: str, photos: Path) -> None:
    page.goto(url)
    files = sample(photos)
    names = [name for name in files if name.endswith(".png")]
    sent: list[str] = []
    page.on("request", lambda request: request.method == "POST" and sent.append(request.url))
    drop(page, {**files, names[1]: b"no picture"})
    rows = page.locator("#photos li")
    expect(rows.nth(1).locator(".fault")).to_have_text("it cannot be read as a picture")
    expect(rows.nth(0).locator(".fault")).to_have_count(0)
    drop(page, {names[0]: files[names[0]]})
    expect(page.locator("#faults li")).to_contain_text("One photo")
    drop(page, {"transforms.json": files["transforms.json"], "other.png": files[names[0]]})
    expect(page.locator("#faults li")).to_have_text(
        f"4 of 4 cameras have no photo here; the first is images/{names[0]}.")
    assert not sent, sent
    # What only the server sees: a mirrored pose.
    cameras = json.loads(files["transforms.json"])
    matrix = cameras["frames"][3]["transform_matrix"]
    cameras["frames"][3]["transform_matrix"] = [[-v for v in row[:1]] + row[1:] for row in matrix]
    drop(page, {**files, "transforms.json": json.dumps(cameras).encode()})
    expect(rows.nth(3).locator(".fault")).to_contain_text("mirrored")


def test_markup_from_outside_stays_text(
        page: Page, url: str, scene: str, faults: list[str]) -> None:
    bad = "<img src=x onerror=\"document.title='broken'\">"
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.fill("#text", bad)
    page.press("#text", "Enter")
    expect(page.locator("#words li strong")).to_have_text([bad])
    cameras = json.dumps({"frames": [{"file_path": bad, "transform_matrix": []}]}).encode()
    drop(page, {"transforms.json": cameras, f"{bad}.png": b""})
    expect(page.locator("#photos li").first).to_contain_text(bad)
    drop(page, {f"{bad}.json": b"{"})
    expect(page.locator("#faults li").first).to_contain_text(bad)
    # A file for the disk has it, too.
    query = urllib.parse.urlencode({"format": "html", "text": f"box\n</script>{bad}"})
    with urllib.request.urlopen(f"{url}/v1/scenes/{scene}/export?{query}") as answer:
        assert f"</script>{bad}".encode() not in answer.read()
    assert page.locator("img").count() == 0
    assert page.title() == "SegSplat"
    # The policy stops a script that is not the page's own.
    refused = page.evaluate(
        """() => { const node = document.createElement('script');
          node.textContent = 'globalThis.ran = true';
          return new Promise((done) => {
            document.addEventListener('securitypolicyviolation', () => done(!globalThis.ran));
            document.body.append(node);
            setTimeout(() => done(false), 20000);
          }); }""")
    assert refused, "an inline script was not refused"
    assert faults and all("Content Security Policy" in fault for fault in faults), faults
    faults.clear()


def test_the_page_has_no_serious_fault_of_access(page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}&text=box")
    expect(page.locator("#words li strong")).to_have_text(["box"])
    settled(page)
    for theme in ["light", "dark"]:
        page.evaluate("(theme) => { document.documentElement.dataset.theme = theme; }", theme)
        found = Axe().run(page).response["violations"]
        grave = [f"{one['id']}: {[node['html'] for node in one['nodes']]}" for one in found
                 if one["impact"] in ("serious", "critical")]
        assert not grave, (theme, grave)
