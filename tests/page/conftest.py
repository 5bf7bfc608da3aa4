"""A real server, the generated photos, and the browser."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from acts import WAIT_MS, post, sample, window
from browser import opened_browser
from playwright.sync_api import Browser, Page, expect
from served import ROOT, run, served

# A name of loopback that a browser takes for another machine: plain http from there is not secure.
FAR = "far.test"
expect.set_options(timeout=WAIT_MS)


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample") / "photos"
    run("sample", "--photos", "4", "-o", folder)
    return folder


@pytest.fixture(scope="session")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served(tmp_path_factory.mktemp("server") / "data", "--renderer", "cpu",
                "--allowed-hosts", FAR) as address:
        yield address


@pytest.fixture(scope="session")
def far(url: str) -> str:
    """The same server as another machine sees it."""
    return url.replace("127.0.0.1", FAR)


@pytest.fixture(scope="session")
def scene(url: str, photos: Path) -> str:
    """The id of a scene with semantics that a program made, for the tests that only look."""
    made = post(url, [("transforms", name, data) if name == "transforms.json"
                      else ("photo", f"images/{name}", data)
                      for name, data in sample(photos).items()])
    ask = json.dumps({"texts": ["box"], "wait_ms": 600_000}).encode()
    with urllib.request.urlopen(f"{url}/v1/scenes/{made}/query", ask) as answer:
        assert json.load(answer)["results"][0]["gaussians"] > 0
    return made


@pytest.fixture(scope="session")
def splats(url: str) -> str:
    """The id of a scene of 40 Gaussians, of a file: quick to draw."""
    source = ROOT / "tests/fixtures/splats/source.ply"
    return post(url, [("splats", source.name, source.read_bytes())])


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    with opened_browser(f"--host-resolver-rules=MAP {FAR} 127.0.0.1") as browser:
        yield browser


@pytest.fixture
def faults() -> list[str]:
    """What scripts threw and the policy refused. It is empty at the end, or the test fails."""
    return []


@pytest.fixture
def page(browser: Browser, faults: list[str]) -> Iterator[Page]:
    """An empty page."""
    page = window(browser, viewport={"width": 760, "height": 640}, accept_downloads=True,
                  reduced_motion="reduce")
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda line: "Content Security Policy" in line.text
            and faults.append(line.text))
    yield page
    page.context.close()
    assert not faults, faults
