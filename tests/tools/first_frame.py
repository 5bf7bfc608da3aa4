"""A large scene in the page over a slow line: when its first frame is there, what had come for it,
how good the picture is after three seconds, and how much memory the browser takes.

    SEGSPLAT_BIN=target/release/segsplat PYTHONPATH=tests/page:scripts \\
        python tests/tools/first_frame.py --gaussians 5000000 --mbit 20

The scene is the room of `tests/page/large.py`, by a server of its own. Bytes and requests until the
first frame depend on no load; times do. After three seconds: of what had come by then, whatever
this machine had drawn of it (`--mbit` times three seconds, less what the page itself takes), held
to the picture of all of the scene. Memory: the script's heap, and the resident memory of the page's
process and of the one that draws, which holds textures too where no GPU is.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
from acts import WAIT_MS, pixels_now, post, settled, until
from browser import opened_browser
from large import room
from playwright.sync_api import CDPSession, Page
from served import served

MB, SECONDS = 1e6, 3.0
FIRST = """(longest) => new Promise((done, fail) => {
  setTimeout(() => fail(new Error('waited too long')), longest);
  const ask = () => {
    const drawing = window.segsplat?.drawing;
    if (drawing?.sortKnown > 0) return requestAnimationFrame(() => done(
      [performance.now(), drawing.sortKnown, drawing.count]));
    setTimeout(ask, 5);
  };
  ask(); })"""


def is_ours(process: Path) -> bool:
    """Whether a process is below this one."""
    number = process.name
    while number not in ("0", "1", str(os.getpid())):
        number = (Path("/proc") / number / "stat").read_text().rsplit(")", 1)[1].split()[1]
    return number == str(os.getpid())


def memory() -> dict[str, float]:
    """Most resident memory of a process of the browser so far, MB, by its kind."""
    found: dict[str, float] = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().decode()
            kind = re.search(r"--type=(renderer|gpu-process)", words)
            if not kind or not is_ours(process):
                continue
            rows = (process / "status").read_text().splitlines()
        except OSError:
            continue
        peak = next(row for row in rows if row.startswith("VmHWM")).split()[1]
        found[kind[1]] = max(found.get(kind[1], 0.0), int(peak) * 1024 / MB)
    return found


def throttled(page: Page, mbit: float) -> tuple[CDPSession, dict[str, int]]:
    """The page's line, and what comes over it."""
    line, seen = page.context.new_cdp_session(page), {"requests": 0, "bytes": 0, "page": 0}
    of_scene: set[str] = set()
    line.send("Network.enable")
    line.send("Network.setCacheDisabled", {"cacheDisabled": True})
    line.send("Network.emulateNetworkConditions", {
        "offline": False, "latency": 20, "downloadThroughput": mbit * 1e6 / 8,
        "uploadThroughput": mbit * 1e6 / 8})

    def sent(event: dict) -> None:
        seen["requests"] += 1
        if "/export" in event["request"]["url"]:
            of_scene.add(event["requestId"])

    def received(event: dict) -> None:
        seen["bytes"] += event["dataLength"]
        seen["page"] += event["dataLength"] * (event["requestId"] not in of_scene)

    line.on("Network.requestWillBeSent", sent)
    line.on("Network.dataReceived", received)
    return line, seen


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    parser.add_argument("--mbit", type=float, default=20.0)
    given = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        served(Path(folder) / "data", "--renderer", "cpu") as url,
        opened_browser() as browser,
    ):
        scene = post(url, [("splats", "room.splat", room(given.gaussians))])
        query = f"{url}/v1/scenes/{scene}/export?format=packed"
        with urllib.request.urlopen(query) as answer:
            packed = answer.read()
        context = browser.new_context(viewport={"width": 760, "height": 640})
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        _line, seen = throttled(page, given.mbit)
        load, begun = os.getloadavg()[0], time.monotonic()
        page.goto(f"{url}/#scene={scene}", wait_until="commit")
        first_ms, known, count = page.evaluate(FIRST, WAIT_MS)
        came = dict(seen)
        line_s = came["bytes"] * 8 / given.mbit / 1e6
        print(f"{given.gaussians} Gaussians, {given.mbit:g} Mbit/s (load {load:.0f}): first frame "
              f"after {first_ms / 1000:.2f} s, of {known} Gaussians; {came['requests']} requests "
              f"and {came['bytes'] / MB:.2f} MB until then, {line_s:.2f} s of the line", flush=True)
        settled(page)
        took, whole = time.monotonic() - begun, pixels_now(page).astype(float)
        heap = page.evaluate("performance.memory.usedJSHeapSize") / MB
        rows = page.evaluate("segsplat.drawing.rows")
        processes = ", ".join(f"{kind} {most:.0f} MB" for kind, most in memory().items())
        print(f"settled after {took:.0f} s; {count} of {given.gaussians} have room; heap {heap:.0f}"
              f" MB, textures {rows * 2048 * 52 / MB:.0f} MB; most resident memory of processes: "
              f"{processes}", flush=True)
        # What comes in three seconds beside the page itself.
        length = int.from_bytes(packed[:4], "little")
        header = json.loads(packed[4 : 4 + length])
        records = sum(form["gaussians"] for form in header["coarse"]) + header["gaussians"]
        before = len(packed) - 32 * records
        own = seen["page"]
        end = int(given.mbit * 1e6 / 8 * SECONDS) - own
        end = before + (end - before) // 32 * 32
        short = context.new_page()
        short.set_default_timeout(WAIT_MS)
        short.route(query, lambda route: route.fulfill(body=packed[:end]))
        short.goto(f"{url}/#scene={scene}")
        until(short, f"""window.segsplat?.drawing?.sortKnown === {(end - before) // 32}
            && segsplat.drawing.settled""")
        short.wait_for_timeout(300)
        error = np.mean((pixels_now(short).astype(float) - whole) ** 2)
        first = before + 32 * (header["coarse"][0]["gaussians"] if header["coarse"] else records)
        need = (own + first) / MB
        db = 10 * np.log10(255**2 / error)
        print(f"the page ({own / MB:.2f} MB) and the coarsest form are {need:.2f} MB, "
              f"{need * 8 / given.mbit:.2f} s of the line; after {SECONDS:g} s {end / MB:.2f} MB of"
              f" {len(packed) / MB:.1f} are there: {db:.1f} dB")


if __name__ == "__main__":
    main()
