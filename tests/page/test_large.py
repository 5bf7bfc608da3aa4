"""Large scenes: they come coarse first, are a picture soon, and take what memory is said.

`PAGE_GAUSSIANS` is how many (400,000; `make page-long` has 4,000,000); `PAGE_SPLATS` is a file of
Gaussians to take in their place.
"""

from __future__ import annotations

import json
import os
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from acts import WAIT_MS, pixels, pixels_now, post
from large import room
from playwright.sync_api import Page, expect

COUNT = int(os.environ.get("PAGE_GAUSSIANS", "400000"))
MB = 1e6
# What the script holds: parts that were not sent on yet, never the scene (32 bytes a Gaussian).
HEAP_MAX_MB = 120


def header_of(packed: bytes) -> dict:
    length = int.from_bytes(packed[:4], "little")
    return json.loads(packed[4:4 + length])


def forms_of(header: dict) -> list[int]:
    """Records of each coarser form, the coarsest first, and of the scene itself."""
    return [form["gaussians"] for form in header["coarse"]] + [header["gaussians"]]


@pytest.fixture(scope="session")
def large(url: str) -> str:
    given = os.environ.get("PAGE_SPLATS")
    name, data = (given, Path(given).read_bytes()) if given else ("room.splat", room(COUNT))
    return post(url, [("splats", name, data)])


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


def test_a_large_scene_comes_coarse_first_in_bounded_memory(
        page: Page, url: str, large: str) -> None:
    query = f"{url}/v1/scenes/{large}/export?format=packed"
    begun = time.monotonic()
    with urllib.request.urlopen(query) as answer:
        packed = answer.read()
    served, size, header = time.monotonic() - begun, len(packed), header_of(packed)
    records = sum(forms_of(header))
    assert records < 1.35 * COUNT and size < 32 * records + 200_000, (records, size)
    page.goto(f"{url}/#scene={large}")
    seen = page.evaluate(WATCH, WAIT_MS)
    print(f"{COUNT} Gaussians: {size / MB:.1f} MB, which the server gives in {served:.1f} s; "
          f"first picture after {seen['first'] / 1000:.1f} s with {seen['share']:.0%}, "
          f"all after {seen['all'] / 1000:.1f} s in {seen['orders']} orders; "
          f"sort {seen['sort']:.0f} ms; heap {seen['heap'] / MB:.0f} MB; "
          f"textures {seen['rows'] * 2048 * 52 / MB:.0f} MB")
    assert seen["count"] == min(records, 4 << 20)
    assert seen["heap"] < HEAP_MAX_MB * MB, seen
    assert seen["share"] < 0.8, "the first picture waited for the scene"
    # Parts of 1 MB; an order each time that half as much again has come.
    most = 4 + np.log(COUNT * 32 / 2**20) / np.log(1.5)
    assert 2 <= seen["orders"] <= most, seen
    assert pixels(page).std() > 20, "the canvas is flat"


def test_the_start_of_a_large_scene_is_a_picture_of_all_of_it(
        page: Page, url: str, large: str) -> None:
    query = f"{url}/v1/scenes/{large}/export?format=packed"
    with urllib.request.urlopen(query) as answer:
        packed = answer.read()
    forms = forms_of(header_of(packed))
    first, second, total = *forms[:2], sum(forms)
    before = len(packed) - 32 * total
    parts = {"the coarsest form": first, "half of the next one": first + second // 2,
             "three seconds": (7_500_000 - before) // 32, "all": total}
    pictures = {}
    for name, records in parts.items():
        end = before + 32 * records
        if records < total:
            page.route(query, lambda route, _, end=end: route.fulfill(body=packed[:end]))
        page.goto(f"{url}/?{end}#scene={large}")
        page.wait_for_function("""(records) => segsplat.drawing.sortKnown === records
            && segsplat.drawing.settled""", arg=min(4 << 20, records))
        page.wait_for_timeout(300)
        pictures[name] = pixels_now(page).astype(float)
        page.unroute(query)
    found = {name: 10 * np.log10(255 ** 2 / np.mean((pictures[name] - pictures["all"]) ** 2))
             for name in list(parts)[:3]}
    print(f"{parts} records: " + ", ".join(f"{name} {db:.1f} dB" for name, db in found.items()))
    assert 20 < found["the coarsest form"] < found["half of the next one"], found
    # At 20 Mbit/s.
    assert found["three seconds"] > 24, found


def test_a_device_without_room_shows_a_part_merged_and_says_so(
        page: Page, url: str, large: str) -> None:
    # A device with memory for an eighth of the scene.
    page.add_init_script("""(() => {
      const of = WebGL2RenderingContext.prototype, { texStorage2D, getError } = of;
      let full = false;
      of.texStorage2D = function (target, levels, format, width, height) {
        full ||= width * height > %d;
        if (!full) texStorage2D.call(this, target, levels, format, width, height);
      };
      of.getError = function () {
        const code = full ? this.OUT_OF_MEMORY : getError.call(this);
        full = false;
        return code;
      }; })()""" % (COUNT // 4 + 8192))
    page.goto(f"{url}/#scene={large}")
    with urllib.request.urlopen(f"{url}/v1/scenes/{large}/export?format=packed") as answer:
        some = sum(forms_of(header_of(answer.read()))) // 8
    expect(page.locator("#says")).to_contain_text(
        f"{COUNT:,} Gaussians, some of them merged: there is room for {some:,} here")
    assert page.evaluate("segsplat.drawing.loaded") == some
    assert pixels(page).std() > 10, "the canvas is flat"
