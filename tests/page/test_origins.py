"""A page of another origin writes nothing: not through HTTP, and not through gRPC."""

from __future__ import annotations

import json
import threading
import urllib.request
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
from form import form
from playwright.sync_api import Page
from served import ROOT

SOURCE = ROOT / "tests/fixtures/splats/source.ply"
# Types that a browser sends to another origin without asking it first.
SIMPLE = ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data; boundary=b", ""]


class Empty(BaseHTTPRequestHandler):
    """A page without anything."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("content-type", "text/html")
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def foreign() -> Iterator[str]:
    """The address of a page that the server knows nothing of."""
    with HTTPServer(("127.0.0.1", 0), Empty) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def number(value: int) -> bytes:
    """A varint."""
    low, rest = value & 127, value >> 7
    return bytes([low | 128]) + number(rest) if rest else bytes([low])


def field(tag: int, value: bytes) -> bytes:
    return bytes([tag << 3 | 2]) + number(len(value)) + value


def framed(*messages: bytes) -> bytes:
    return b"".join(b"\0" + len(one).to_bytes(4, "big") + one for one in messages)


def scenes(url: str) -> list[str]:
    with urllib.request.urlopen(f"{url}/v1/scenes") as answer:
        return [one["id"] for one in json.load(answer)["scenes"]]


def test_a_page_of_another_origin_writes_nothing(
        page: Page, url: str, splats: str, foreign: str) -> None:
    before = scenes(url)
    assert splats in before
    piece = field(1, SOURCE.name.encode()) + field(2, SOURCE.read_bytes())
    body, _ = form([("splats", SOURCE.name, SOURCE.read_bytes())])
    rpc = "/segsplat.v1.SceneService/"
    named = framed(field(1, splats.encode()))
    calls = [
        ("/v1/scenes", body),
        (f"/v1/scenes/{splats}/refine", b""),
        (f"{rpc}CreateScene", framed(field(1, b""), field(4, piece))),
        (f"{rpc}RefineScene", named),
        (f"{rpc}DeleteScene", named),
    ]
    statuses: list[int] = []
    page.on("response", lambda answer: answer.url.startswith(url)
            and statuses.append(answer.status))
    page.goto(foreign)
    for path, sent in calls:
        for kind in SIMPLE:
            page.evaluate(
                """async ([to, bytes, type]) => {
                  const body = new Blob([new Uint8Array(bytes)], { type });
                  await fetch(to, { method: 'POST', mode: 'no-cors', body });
                }""", [url + path, list(sent), kind])
    assert statuses == [403] * len(calls) * len(SIMPLE), statuses
    assert scenes(url) == before
