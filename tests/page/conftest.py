"""A real server, the generated photos, and a headless Chromium that draws by SwiftShader.
`SEGSPLAT_BIN` names the program, `SEGSPLAT_BROWSER` the browser."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

ROOT = Path(__file__).parents[2]
PROGRAM = Path(os.environ.get("SEGSPLAT_BIN", ROOT / "target/debug/segsplat")).absolute()
TARGET = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
BROWSERS = ["chromium-headless-shell", "chromium", "google-chrome"]
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            "--ignore-gpu-blocklist"]
# Software drawing on a busy machine: states are waited for, and this is the end of waiting.
WAIT_MS = 300_000
expect.set_options(timeout=WAIT_MS)


def browser_program() -> str:
    named = [os.environ.get("SEGSPLAT_BROWSER"), shutil.which(str(TARGET / "tools/chromium"))]
    found = [one for one in [*named, *map(shutil.which, BROWSERS)] if one]
    assert found, "no Chromium: run scripts/setup --ci, or set SEGSPLAT_BROWSER"
    return found[0]


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample") / "photos"
    subprocess.run([PROGRAM, "sample", "--photos", "4", "-o", folder], cwd=ROOT, check=True)
    return folder


@pytest.fixture(scope="session")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("server")
    command = [PROGRAM, "serve", "--listen", "127.0.0.1:0", "--data-dir", folder / "data",
               "--renderer", "cpu"]
    with (
        (folder / "log").open("w") as log,
        subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=log) as server,
    ):
        assert server.stdout
        try:
            first = server.stdout.readline().decode()
            assert first.startswith("listening on "), first
            yield first.split()[-1]
        finally:
            server.terminate()


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_program(), args=SOFTWARE)
        yield browser
        browser.close()


@pytest.fixture
def faults() -> list[str]:
    """What scripts threw and the policy refused. It is empty at the end, or the test fails."""
    return []


@pytest.fixture
def page(browser: Browser, faults: list[str]) -> Iterator[Page]:
    """An empty page."""
    context = browser.new_context(viewport={"width": 760, "height": 640}, accept_downloads=True,
                                  reduced_motion="reduce")
    context.set_default_timeout(WAIT_MS)
    page = context.new_page()
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda line: "Content Security Policy" in line.text
            and faults.append(line.text))
    yield page
    context.close()
    assert not faults, faults
