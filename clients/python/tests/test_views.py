"""Views as arrays, held against what the server answers to plain HTTP."""

from __future__ import annotations

import io
import zlib
from pathlib import Path

import httpx
import numpy as np
import pytest

from segsplat import Camera, Client, InvalidRequest, Scene, View, Viewpoint
from segsplat.types import Kind


def raw(scene: Scene, url: str, **params: str | int | float) -> httpx.Response:
    answer = httpx.get(f"{url}/v1/scenes/{scene.id}/view", params=params, timeout=60)
    return answer.raise_for_status()


def test_colour_is_that_of_the_server(scene: Scene, url: str) -> None:
    view = scene.view(from_=0, to=1, t=0.25, width=80)
    assert view.image.shape == (60, 80, 3) and view.image.dtype == np.uint8
    answer = raw(scene, url, **{"from": 0}, to=1, t=0.25, width=80, format="rgb8")
    assert view.image.tobytes() == answer.content
    assert view.image.std() > 10, "one flat colour is no view"
    assert view.camera.K.shape == (3, 3) and view.camera.camera_to_world.shape == (4, 4)
    told = [float(number) for number in answer.headers["x-camera-to-world"].split(",")]
    assert view.camera.camera_to_world.reshape(16).tolist() == told


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        ("depth", np.float32),
        ("alpha", np.float32),
        ("relevancy", np.float32),
        ("mask", np.bool_),
        ("semantics", np.uint16),
    ],
)
def test_every_kind_has_its_shape_and_the_values_of_the_server(
    scene: Scene, url: str, kind: Kind, dtype: type
) -> None:
    text = "box" if kind in ("relevancy", "mask") else None
    array = getattr(scene.view(kind, text=text, width=64), kind)
    assert array.shape == (48, 64) and array.dtype == dtype
    params = {"from": 0, "kind": kind, "width": 64, "format": "npy"}
    numbers = np.load(
        io.BytesIO(raw(scene, url, **params, **({"text": text} if text else {})).content)
    )
    assert np.array_equal(array.astype(np.float32), numbers)
    assert np.ptp(array.astype(np.float32)) > 0, "it shows nothing"


def test_kinds_of_one_call_are_those_of_single_calls(scene: Scene) -> None:
    view = scene.view(["color", "depth", "mask"], text="box", width=64)
    assert np.array_equal(view.depth, scene.view("depth", width=64).depth)
    assert np.array_equal(view.mask, scene.view("mask", text="box", width=64).mask)
    image = scene.view(width=64).image
    # The numbers are rounded here; where almost nothing is behind, levels skip the backdrop.
    assert np.abs(view.image.astype(int) - image).max() <= 1
    with pytest.raises(AttributeError, match="without alpha"):
        _ = view.alpha


def test_cameras_of_every_form(scene: Scene) -> None:
    photo = scene.photos[0].camera
    assert photo.width == 320 and photo.K[0, 0] == 320
    first = scene.view(from_=0)
    for view in (
        scene.view(),
        scene.view(camera=photo),
        scene.view(K=photo.K, camera_to_world=photo.camera_to_world, width=320, height=240),
    ):
        assert np.array_equal(view.image, first.image)
    there = scene.view(eye=[0, -1.6, -3.4], target=[0, -0.6, 0], fov=50, width=40, height=30)
    assert np.allclose(there.camera.camera_to_world[:3, 3], [0, -1.6, -3.4])
    assert np.allclose(there.camera.K[1, 1], 15 / np.tan(np.radians(25)))
    part = scene.view(from_=0, crop=(100, 50, 64, 32), background="white")
    assert part.image.shape == (32, 64, 3)
    assert np.allclose(part.camera.K[:2, 2], first.camera.K[:2, 2] - [100, 50])
    with pytest.raises(ValueError, match="K has the shape"):
        scene.view(K=[1, 2, 3], camera_to_world=np.eye(4))
    with pytest.raises(InvalidRequest, match="from is 99"):
        scene.view(from_=99)


def test_depth_gives_points_that_project_back(scene: Scene) -> None:
    view = scene.view("depth", width=64)
    seen = view.depth > 0
    assert seen.mean() > 0.5
    points = view.points[seen]
    there = view.camera.camera_to_world
    z = ((points - there[:3, 3]) @ there[:3, :3])[:, 2]
    assert np.allclose(z, view.depth[seen], rtol=1e-6)
    rows, columns = np.nonzero(seen)
    assert np.allclose(view.camera.project(points), np.stack([columns, rows], 1) + 0.5, atol=1e-6)
    # What the server picks under a pixel is on its ray, as deep as it says. It is the surface,
    # near the depth that views blend.
    row, column = rows[0], columns[0]
    picked = scene.pick(column + 0.5, row + 0.5, camera=view.camera)
    assert picked.point is not None
    pixel = view.camera.project(picked.point[None])[0]
    assert np.allclose(pixel, [column + 0.5, row + 0.5], atol=1e-3)
    depth = (picked.point - there[:3, 3]) @ there[:3, 2]
    assert picked.depth == pytest.approx(depth, rel=1e-5)
    assert picked.depth == pytest.approx(view.depth[row, column], rel=0.08)


def test_views_show_and_save_themselves(scene: Scene, tmp_path: Path) -> None:
    view = scene.view(["color", "depth"], width=64)
    shown = view._repr_png_()
    assert pixels_of(shown, 3).tolist() == view.image.tolist()
    assert view.save(tmp_path / "view.png").read_bytes() == shown
    assert pixels_of(view.save(tmp_path / "d.png", "depth").read_bytes(), 1).std() > 10
    saved = np.load(view.save(tmp_path / "d.npy", "depth"))
    assert np.array_equal(saved, view.depth)
    with pytest.raises(ValueError, match="png or .npy"):
        view.save(tmp_path / "view.tiff")
    assert pixels_of(scene._repr_png_() or b"", 3).shape == (240, 320, 3)


def pixels_of(png: bytes, channels: int) -> np.ndarray:
    """Reads what `encode_png` writes."""
    assert png.startswith(b"\x89PNG")
    width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
    start = png.index(b"IDAT") + 4
    rows = np.frombuffer(zlib.decompressobj().decompress(png[start:]), np.uint8)
    pixels = rows.reshape(height, -1)[:, 1:]
    return pixels.reshape(height, width, 3) if channels == 3 else pixels


def test_a_thousand_views_lose_nothing(scene: Scene) -> None:
    steps = np.arange(1000) / 999
    views = scene.views(({"from_": 0, "to": 1, "t": float(t)} for t in steps), width=24)
    ends = [photo.camera.camera_to_world[:3, 3] for photo in scene.photos]
    count = 0
    for t, view in zip(steps, views, strict=True):
        centre = (1 - t) * ends[0] + t * ends[1]
        assert np.allclose(view.camera.camera_to_world[:3, 3], centre), f"view {count}"
        assert view.image.shape == (18, 24, 3) and view.image.std() > 5
        count += 1
    assert count == 1000


def test_an_iteration_can_end_early(scene: Scene, client: Client) -> None:
    views = scene.views(({"from_": 0} for _ in range(64)), ["color", "alpha"], width=24)
    view = next(views)
    assert isinstance(view, View) and view.alpha.max() > 0.5
    del views
    assert client.get(scene.id).status.state == "done"


def test_a_scene_of_photos_and_cameras(client: Client, scene: Scene, photos: Path) -> None:
    cameras: dict[str | Path, Camera] = {
        photos / photo.file: photo.camera for photo in scene.photos
    }
    twin = client.scene(cameras, semantics="off")
    assert np.array_equal(twin.view(width=64).image, scene.view(width=64).image)
    twin.delete()


def test_single_options_of_a_preset(scene: Scene) -> None:
    paper = scene.view(width=64, background="black", preset="paper").image
    single = scene.view(width=64, background="black", front_photos=0, magnify=False).image
    assert np.array_equal(single, paper)
    near: Viewpoint = {"eye": [0, -1.6, -1.0], "target": [0, -0.6, 0]}
    one = scene.view(**near, width=64, front_photos=1).image
    assert not np.array_equal(one, scene.view(**near, width=64, front_photos=0).image)
