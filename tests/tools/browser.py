"""A headless Chromium that draws by SwiftShader, for the tests of the page and for three.js.
`SEGSPLAT_BROWSER` names the browser.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, sync_playwright
from served import ROOT

TARGET = os.environ.get("CARGO_TARGET_DIR", str(ROOT / "target"))
NAMES = ["chromium-headless-shell", "chromium", "google-chrome"]
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--ignore-gpu-blocklist", "--enable-precise-memory-info"]


def browser_program() -> str:
    named = [os.environ.get("SEGSPLAT_BROWSER"), shutil.which(f"{TARGET}/tools/chromium")]
    found = [one for one in [*named, *map(shutil.which, NAMES)] if one]
    assert found, "no Chromium: run scripts/setup --ci, or set SEGSPLAT_BROWSER"
    return found[0]


@contextmanager
def opened_browser(*more: str) -> Iterator[Browser]:
    """The browser, with `more` of its own arguments."""
    with sync_playwright() as playwright:
        args = [*SOFTWARE, *more]
        browser = playwright.chromium.launch(executable_path=browser_program(), args=args)
        yield browser
        browser.close()
