"""A video on the page: sharp frames, spread over its motion, are its photos."""

from __future__ import annotations

import base64
import re

from acts import drop, until
from playwright.sync_api import Page, Route, expect

# A camera that stands still for a second, goes over a picture for two, and is out of focus in every
# other frame of its way, recorded by the browser: a WebM.
RECORDED = """async () => {
  const canvas = document.createElement('canvas');
  Object.assign(canvas, { width: 320, height: 240 });
  const pen = canvas.getContext('2d'), wall = new OffscreenCanvas(1200, 240);
  const paint = wall.getContext('2d');
  for (let i = 0; i < 900; i++) {
    paint.fillStyle = `hsl(${(i * 47) % 360} 80% ${30 + (i * 13) % 50}%)`;
    paint.fillRect((i * 331) % 1200, (i * 97) % 240, 18, 14);
  }
  const recorder = new MediaRecorder(canvas.captureStream(30), { mimeType: 'video/webm' });
  const pieces = [];
  recorder.ondataavailable = (e) => pieces.push(e.data);
  recorder.start();
  const begun = performance.now();
  for (let n = 0; ; n++) {
    const seconds = (performance.now() - begun) / 1000;
    if (seconds > 3) break;
    pen.filter = seconds > 1 && Math.floor(seconds * 5) % 2 ? 'blur(6px)' : 'none';
    pen.drawImage(wall, -Math.max(0, seconds - 1) * 400, 0);
    await new Promise(requestAnimationFrame);
  }
  await new Promise((done) => { recorder.onstop = done; recorder.stop(); });
  const bytes = new Uint8Array(await new Blob(pieces).arrayBuffer());
  return btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(''));
}"""


def test_a_video_is_sent_as_its_sharp_frames(page: Page, url: str) -> None:
    page.goto(url)
    video = base64.b64decode(page.evaluate(RECORDED))
    assert len(video) > 10_000
    sent: list[bytes] = []

    def refuse(route: Route) -> None:
        sent.append(route.request.post_data_buffer or b"")
        route.fulfill(status=503, json={"code": "overloaded", "message": "not today"})

    page.route("**/v1/scenes", lambda route: refuse(route)
               if route.request.method == "POST" else route.continue_())
    drop(page, {"walk.webm": video})
    expect(page.locator("#notes")).to_contain_text(re.compile(r"\d+ frames of walk\.webm"))
    until(page, "document.getElementById('faults').textContent.includes('not today')")
    names = page.locator("#photos li span").all_inner_texts()
    seconds = [float(name.removesuffix("s.jpg")) for name in names]
    assert 8 <= len(names) <= 16 and seconds == sorted(seconds), names
    still = [at for at in seconds if at < 0.9]
    assert len(still) <= 3, f"most of the frames are of the way: {names}"
    # Out of focus are the odd fifths of a second.
    sharp = [at for at in seconds if at > 1 and int((at + 0.02) * 5) % 2 == 0]
    way = [at for at in seconds if at > 1]
    assert len(sharp) >= 0.7 * len(way), f"{len(sharp)} of {len(way)} are sharp: {names}"
    body = sent[0]
    assert body.count(b"\xff\xd8\xff") == len(names), "each is a JPEG"


def test_a_file_that_is_no_video_is_said_to_be_none(page: Page, url: str) -> None:
    page.goto(url)
    drop(page, {"broken.mp4": b"no video at all"})
    expect(page.locator("#faults")).to_contain_text("broken.mp4: this browser cannot play it.")
