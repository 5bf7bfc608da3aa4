"""The video: as many frames as it says, of the size that it says, once around; and Cancel."""

from __future__ import annotations

import base64
import io
import re
import time
from pathlib import Path

import numpy as np
from acts import Camera, pixels, settled, until
from PIL import Image
from playwright.sync_api import Page, expect

# Plays a file by the browser's own player: length, size, frames, and what it shows at some times.
PLAY = """async ([coded, times]) => {
  const bytes = Uint8Array.from(atob(coded), (c) => c.charCodeAt(0));
  const video = document.createElement('video'), canvas = document.createElement('canvas');
  video.muted = true;
  video.src = URL.createObjectURL(new Blob([bytes], { type: 'video/webm' }));
  await new Promise((ok, no) => {
    video.onloadeddata = ok;
    video.onerror = () => no(video.error);
  });
  const ended = new Promise((ok) => { video.onended = ok; });
  await video.play();
  await ended;
  const { duration, videoWidth: width, videoHeight: height } = video;
  const frames = video.getVideoPlaybackQuality().totalVideoFrames, shown = [];
  Object.assign(canvas, { width, height });
  for (const time of times) {
    const sought = new Promise((ok) => { video.onseeked = ok; });
    // On a busy machine the picture of a place comes after the word that it is there.
    const shows = new Promise((ok) => video.requestVideoFrameCallback(ok));
    video.currentTime = time;
    await sought;
    await Promise.race([shows, new Promise((ok) => setTimeout(ok, 2000))]);
    canvas.getContext('2d').drawImage(video, 0, 0);
    shown.push(canvas.toDataURL('image/png').split(',')[1]);
  }
  return { duration, width, height, frames, shown };
}"""


def picture(coded: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(coded))).convert("RGB")).astype(float)


def test_the_video_has_the_frames_and_the_size_that_it_says(
        page: Page, url: str, splats: str, tmp_path: Path) -> None:
    page.goto(f"{url}/#scene={splats}")
    first = pixels(page)
    page.click("#film")
    page.select_option("#film-seconds", "2")
    page.select_option("#film-side", "640")
    said = re.fullmatch(r"(\d+) frames of (\d+) × (\d+), (\d+) a second",
                        page.inner_text("#film-says"))
    assert said
    frames, width, height, rate = map(int, said.groups())
    assert (frames, rate, max(width, height)) == (60, 30, 640) and height % 2 == 0
    # There is one camera, so nothing is known of a front.
    expect(page.locator("#film-motion")).to_have_value("turn")
    before = Camera(page)
    with page.expect_download() as waited:
        page.click("#film-make")
    assert waited.value.suggested_filename == f"segsplat-{splats[:8]}.webm"
    waited.value.save_as(tmp_path / "film.webm")
    data = (tmp_path / "film.webm").read_bytes()
    # The view is as it was.
    np.testing.assert_array_equal(Camera(page).eye, before.eye)
    np.testing.assert_array_equal(pixels(page), first)
    # The page's own policy has no place for a player.
    player = page.context.new_page()
    played = player.evaluate(PLAY, [base64.b64encode(data).decode(), [0, 0.5, 1.0, 59.5 / 30]])
    player.close()
    assert abs(played["duration"] - frames / rate) < 1e-3
    assert (played["width"], played["height"], played["frames"]) == (width, height, frames)
    shown = [picture(coded) for coded in played["shown"]]
    apart = [np.abs(one - shown[0]).mean() for one in shown]
    print("differences from the first frame:", apart)
    assert min(apart[1], apart[2]) > 3 * apart[3], "it does not come back to where it began"
    start = np.asarray(Image.fromarray(first).resize((width, height))).astype(float)
    assert np.abs(shown[0] - start).mean() < 4, "the first frame is not the view"


def test_a_video_of_photos_that_look_one_way_goes_to_and_fro(
        page: Page, url: str, scene: str) -> None:
    page.goto(f"{url}/#scene={scene}")
    settled(page)
    page.click("#film")
    expect(page.locator("#film-motion")).to_have_value("swing")


def test_a_cancelled_video_leaves_no_file_and_the_view(page: Page, url: str, splats: str) -> None:
    page.goto(f"{url}/#scene={splats}")
    before = pixels(page)
    files: list[str] = []
    page.on("download", lambda one: files.append(one.suggested_filename))
    page.click("#film")
    page.select_option("#film-seconds", "10")
    page.click("#film-make")
    until(page, "document.getElementById('progress').value > 0")
    expect(page.locator("#film-make")).to_be_disabled()
    page.click("#film-stop")
    expect(page.locator("#says")).to_have_text("The video is cancelled.")
    expect(page.locator("#film-make")).to_be_enabled()
    expect(page.locator("#film-stop")).to_be_hidden()
    np.testing.assert_array_equal(pixels(page), before)
    assert not files, files


def test_without_an_encoder_the_browser_records(
        page: Page, far: str, splats: str, tmp_path: Path) -> None:
    page.goto(f"{far}/#scene={splats}")
    first = pixels(page)
    assert page.evaluate("[isSecureContext, typeof VideoEncoder]") == [False, "undefined"]
    page.click("#film")
    page.select_option("#film-seconds", "2")
    page.select_option("#film-side", "640")
    expect(page.locator("#film-says")).to_contain_text("up to 60 frames")
    begun = time.monotonic()
    with page.expect_download() as waited:
        page.click("#film-make")
    assert time.monotonic() - begun > 2, "it is recorded in real time"
    waited.value.save_as(tmp_path / "film.webm")
    data = (tmp_path / "film.webm").read_bytes()
    np.testing.assert_array_equal(pixels(page), first)
    player = page.context.new_page()
    played = player.evaluate(PLAY, [base64.b64encode(data).decode(), [0, 0.5, 1.0]])
    player.close()
    assert max(played["width"], played["height"]) == 640 and played["frames"] >= 2
    # A recorder writes no length; what it showed last has the time of the end.
    shown = [picture(coded) for coded in played["shown"]]
    start = np.asarray(Image.fromarray(first).resize((played["width"], played["height"])))
    assert np.abs(shown[0] - start).mean() < 6, "the first frame is not the view"
    assert max(np.abs(one - shown[0]).mean() for one in shown[1:]) > 2, "nothing moves"


def test_a_browser_that_can_do_neither_says_so(page: Page, far: str, splats: str) -> None:
    page.goto(f"{far}/#scene={splats}")
    settled(page)
    page.evaluate("delete globalThis.MediaRecorder")
    page.click("#film")
    page.click("#film-make")
    expect(page.locator("#says")).to_have_text(
        "This browser can neither encode nor record video.")
    settled(page)
