"""Large scenes: they come largest first, are a picture soon, and take what memory is said.

`PAGE_GAUSSIANS` is how many (400,000; `make page-long` has 4,000,000).
"""

from __future__ import annotations

import os
import time
import urllib.request

import numpy as np
import pytest
from acts import WAIT_MS, pixels, post
from large import room
from playwright.sync_api import Page, expect

COUNT = int(os.environ.get("PAGE_GAUSSIANS", "400000"))
MB = 1e6
# What the script holds: parts that were not sent on yet, never the scene (32 bytes a Gaussian).
HEAP_MAX_MB = 120


@pytest.fixture(scope="session")
def large(url: str) -> str:
    return post(url, [("splats", "room.splat", room(COUNT))])


# Reads the state and the memory of the script while the scene comes.
WATCH = """(longest) => new Promise((done, fail) => {
  setTimeout(() => fail(new Error('waited too long')), longest);
  const seen = { first: 0, share: 0, heap: 0, orders: 0 }, begun = performance.now();
  let known = 0;
  const ask = () => {
    const { drawing } = segsplat, now = performance.now() - begun;
    seen.heap = Math.max(seen.heap, performance.memory.usedJSHeapSize);
    if (drawing.sortKnown > 0 && drawing.sortKnown !== known) {
      known = drawing.sortKnown;
      seen.orders += 1;
      seen.first ||= now;
      seen.share ||= known / drawing.count;
    }
    if (document.getElementById('view').dataset.state !== 'settled') return setTimeout(ask, 5);
    done({ ...seen, all: now, sort: drawing.sortMs, count: drawing.count, rows: drawing.rows });
  };
  ask(); })"""


def test_a_large_scene_comes_largest_first_in_bounded_memory(
        page: Page, url: str, large: str) -> None:
    query = f"{url}/v1/scenes/{large}/export?format=packed"
    begun = time.monotonic()
    with urllib.request.urlopen(query) as answer:
        size = len(answer.read())
    served = time.monotonic() - begun
    assert size < 32 * COUNT + 200_000, size
    page.goto(f"{url}/#scene={large}")
    seen = page.evaluate(WATCH, WAIT_MS)
    print(f"{COUNT} Gaussians: {size / MB:.1f} MB, which the server gives in {served:.1f} s; "
          f"first picture after {seen['first'] / 1000:.1f} s with {seen['share']:.0%}, "
          f"all after {seen['all'] / 1000:.1f} s in {seen['orders']} orders; "
          f"sort {seen['sort']:.0f} ms; heap {seen['heap'] / MB:.0f} MB; "
          f"textures {seen['rows'] * 2048 * 68 / MB:.0f} MB")
    assert seen["count"] == COUNT
    assert seen["heap"] < HEAP_MAX_MB * MB, seen
    assert seen["share"] < 0.8, "the first picture waited for the scene"
    # Parts of 1 MB; an order each time that half as much again has come.
    most = 4 + np.log(COUNT * 32 / 2**20) / np.log(1.5)
    assert 2 <= seen["orders"] <= most, seen
    assert pixels(page).std() > 20, "the canvas is flat"


def test_a_device_without_room_takes_the_largest_and_says_so(
        page: Page, url: str, large: str) -> None:
    # A device with memory for an eighth of the scene.
    page.add_init_script("""(() => {
      const of = WebGL2RenderingContext.prototype, { texStorage2D, getError } = of;
      let full = false;
      of.texStorage2D = function (target, levels, format, width, height) {
        full = width * height > %d;
        if (!full) texStorage2D.call(this, target, levels, format, width, height);
      };
      of.getError = function () {
        const code = full ? this.OUT_OF_MEMORY : getError.call(this);
        full = false;
        return code;
      }; })()""" % (COUNT // 4 + 8192))
    page.goto(f"{url}/#scene={large}")
    expect(page.locator("#says")).to_contain_text(
        f"The {COUNT // 8:,} largest of {COUNT:,} Gaussians: more have no room here")
    assert page.evaluate("segsplat.drawing.loaded") == COUNT // 8
    assert pixels(page).std() > 10, "the canvas is flat"
