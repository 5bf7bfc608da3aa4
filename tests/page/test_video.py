"""A video on the page: sharp frames, spread over its motion, are its photos.

`walk.webm` (VP8, 320 x 240, 20 frames a second, 3 s): a camera that stands still for a second and
then goes over a wall of random patches, out of focus in every other fifth of a second.
"""

from __future__ import annotations

import re

from acts import drop, until
from playwright.sync_api import Page, Route, expect
from served import ROOT

WALK = ROOT / "tests/fixtures/video/walk.webm"


def test_a_video_is_sent_as_its_sharp_frames(page: Page, url: str) -> None:
    sent: list[bytes] = []

    def refuse(route: Route) -> None:
        if route.request.method != "POST":
            return route.continue_()
        sent.append(route.request.post_data_buffer or b"")
        route.fulfill(status=503, json={"code": "overloaded", "message": "not today"})

    page.route("**/v1/scenes", refuse)
    page.goto(url)
    drop(page, {"walk.webm": WALK.read_bytes()})
    until(page, "document.getElementById('faults').textContent.includes('not today')")
    expect(page.locator("#notes")).to_contain_text(re.compile(r"\d+ frames of walk\.webm"))
    names = page.locator("#photos li span").all_text_contents()
    seconds = [float(name.removesuffix("s.jpg")) for name in names]
    assert 8 <= len(names) <= 16 and seconds == sorted(seconds), names
    still = [at for at in seconds if at < 0.95]
    assert len(still) <= 2, f"most of the frames are of the way: {names}"
    # Out of focus are the odd fifths of a second.
    way = [at for at in seconds if at > 1]
    sharp = [at for at in way if int((at + 0.01) * 5) % 2 == 0]
    assert len(sharp) >= 0.6 * len(way), f"{len(sharp)} of {len(way)} are sharp: {names}"
    assert len(sent) == 1 and sent[0].count(b"\xff\xd8\xff") == len(names), "each is a JPEG"


def test_a_file_that_is_no_video_is_said_to_be_none(page: Page, url: str) -> None:
    page.goto(url)
    drop(page, {"broken.mp4": b"no video at all"})
    expect(page.locator("#faults")).to_contain_text("broken.mp4: this browser cannot play it.")
