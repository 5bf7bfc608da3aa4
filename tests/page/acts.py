"""What the tests do to a page and to the server behind it."""

from __future__ import annotations

import base64
import io
import json
import urllib.request
from pathlib import Path

import numpy as np
from form import form
from PIL import Image
from playwright.sync_api import Browser, Page

# Software drawing on a busy machine: states are waited for, and this is the end of waiting.
WAIT_MS = 300_000


def window(browser: Browser, **options: object) -> Page:
    """A page of its own, with the options of a browser's context, that waits as long as all do."""
    context = browser.new_context(**options)  # type: ignore[arg-type]
    context.set_default_timeout(WAIT_MS)
    return context.new_page()


def settled(page: Page) -> None:
    page.wait_for_selector("#view[data-state=settled]")


def until(page: Page, test: str) -> None:
    """Waits for a condition in the page. Playwright's own wait needs what the policy refuses."""
    page.evaluate(f"""() => new Promise((done, fail) => {{
      setTimeout(() => fail(new Error('waited too long')), {WAIT_MS});
      const ask = () => {{ if ({test}) done(); else setTimeout(ask, 20); }};
      ask(); }})""")


def open_scenes(page: Page) -> None:
    """Opens the panel with the list of scenes, where it is folded."""
    if not page.locator("#side").is_visible():
        page.click("#side-fold")


def drop(page: Page, files: dict[str, bytes]) -> None:
    """Drops files onto the page as a person does."""
    given = {name: base64.b64encode(data).decode() for name, data in files.items()}
    page.evaluate(
        """(given) => {
          const transfer = new DataTransfer();
          for (const [name, coded] of Object.entries(given)) {
            const bytes = Uint8Array.from(atob(coded), (c) => c.charCodeAt(0));
            transfer.items.add(new File([bytes], name));
          }
          document.getElementById('drop').dispatchEvent(
            new DragEvent('drop', { dataTransfer: transfer, bubbles: true, cancelable: true }));
        }""", given)


def sample(photos: Path) -> dict[str, bytes]:
    files = {path.name: path.read_bytes() for path in sorted((photos / "images").iterdir())}
    return {**files, "transforms.json": (photos / "transforms.json").read_bytes()}


def post(url: str, parts: list[tuple[str, str, bytes]]) -> str:
    """The id of the finished scene of an upload: fields, names of files, and the files."""
    body, kind = form(parts)
    request = urllib.request.Request(
        f"{url}/v1/scenes?wait_ms=600000", body, {"content-type": kind})
    with urllib.request.urlopen(request) as answer:
        made = json.load(answer)
    assert made["state"] == "done", made
    return made["id"]


def pixels(page: Page) -> np.ndarray:
    """The canvas once all is drawn, `[H, W, 3]`."""
    settled(page)
    return pixels_now(page)


def pixels_now(page: Page) -> np.ndarray:
    """The canvas, `[H, W, 3]`."""
    coded = page.evaluate("segsplat.pixels()").split(",")[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(coded))).convert("RGB"))


def look(page: Page, photo: int, shift: list[float]) -> None:
    page.evaluate(
        """([photo, shift]) => {
          const { look, cameraOf, state } = segsplat;
          const camera = cameraOf(state.scene.cameras[photo], state.scene.unit);
          look({ ...camera, eye: camera.eye.map((v, i) => v + shift[i]) }, true);
        }""", [photo, shift])


class Camera:
    """The page's camera: eye, target and up; `axes` are its right, down and forward."""

    def __init__(self, page: Page) -> None:
        told, matrix, self.focal = page.evaluate(
            """() => { const { state, matrixOf, focalOf } = segsplat;
              return [state.camera, matrixOf(state.camera),
                focalOf(state.camera, document.getElementById('stage').clientHeight)]; }""")
        self.eye, self.target, self.up = (np.array(told[k]) for k in ("eye", "target", "up"))
        self.axes = np.array(matrix).reshape(4, 4)[:3, :3].T
        self.reach = float(np.linalg.norm(self.target - self.eye))

    def seen(self, point: np.ndarray) -> np.ndarray:
        """A point of the world in pixels of the stage, from its middle."""
        right, down, ahead = self.axes @ (point - self.eye)
        return self.focal * np.array([right, down]) / ahead
