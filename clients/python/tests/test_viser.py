"""A scene shown in viser: a real server of it, and what it holds."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import anyio
import httpx
import numpy as np
import pytest
import viser

import segsplat
from segsplat import AsyncClient, Scene
from segsplat.viser import edges_of


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def test_a_scene_shows_gaussians_photos_and_boxes(
    scene: Scene, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    put: dict[str, dict[str, Any]] = {}
    for name in ("add_gaussian_splats", "add_camera_frustum", "add_line_segments"):
        kept = getattr(server.scene, name)
        monkeypatch.setattr(
            server.scene,
            name,
            lambda path, kept=kept, **given: (put.update({path: given}), kept(path, **given))[1],
        )
    boxes = scene.query("box", masks=False).boxes
    assert scene.show(boxes, server) is server
    page = httpx.get(f"http://127.0.0.1:{server.get_port()}")
    assert page.status_code == 200 and "viser" in page.text.lower()
    gaussians = scene.gaussians()
    splats = put["/scene"]
    assert np.allclose(splats["centers"] * splats["scale"], gaussians.means, atol=1e-5)
    # In the 16 bits that viser gives them, hardly any is lost.
    halves = np.linalg.det(splats["covariances"].astype(np.float16).astype(np.float64))
    whole = np.linalg.det(splats["covariances"].astype(np.float64))
    assert np.median(np.abs(halves / whole - 1)) < 0.01
    # A quarter of a pixel and more of the photo: without it small Gaussians leave holes.
    added = splats["covariances"] * splats["scale"] ** 2 - gaussians.covariances
    blur = np.sqrt(np.trace(added, axis1=1, axis2=2) / 3)
    assert scene.report
    pixel = scene.report.median_depth / scene.report.network_focal_px[0]
    assert 0.25 < np.median(blur) / pixel < 1
    assert len([path for path in put if path.startswith("/photos/")]) == len(scene.photos)
    where = put["/photos/1"]["position"]
    assert np.allclose(where, scene.photos[1].camera.camera_to_world[:3, 3])
    assert len([path for path in put if path.startswith("/boxes/")]) == len(boxes) > 0
    lengths = np.linalg.norm(np.diff(edges_of(boxes[0]), axis=1)[:, 0], axis=1)
    assert np.allclose(np.sort(lengths), np.sort(np.repeat(boxes[0].size, 4)))


def test_it_is_awaited_too(scene: Scene, url: str, server: viser.ViserServer) -> None:
    async def ask() -> None:
        async with AsyncClient(url) as client:
            assert await (await client.get(scene.id)).show(server=server) is server

    anyio.run(ask)


def test_without_the_extra_its_name_is_told(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "segsplat.viser", raising=False)
    monkeypatch.delattr(segsplat, "viser", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"segsplat\[viser\]"):
        scene.show()
