"""The async client has every call of the other one, and the same answers."""

from __future__ import annotations

import inspect
from pathlib import Path

import anyio
import numpy as np
import pytest

from segsplat import AsyncClient, AsyncScene, Client, Scene, SceneNotFound, Viewpoint


def test_both_clients_have_the_same_calls() -> None:
    for one, other in ((Client, AsyncClient), (Scene, AsyncScene)):
        names = {name for name in dir(one) if not name.startswith("_")}
        assert names == {name for name in dir(other) if not name.startswith("_")}
        for name in names:
            call, twin = getattr(one, name), getattr(other, name)
            if callable(call) and name != "client":
                assert call.__doc__ and twin.__doc__
                parameters = inspect.signature(call).parameters
                assert [*parameters] == [*inspect.signature(twin).parameters], name


def test_a_notebook_completes_the_options() -> None:
    known = inspect.signature(Scene.view).parameters
    assert {"kinds", "text", "from_", "eye", "K", "width", "crop", "preset", "wait"} <= set(known)


def test_the_answers_are_the_same(scene: Scene, url: str, tmp_path: Path) -> None:
    async def ask() -> None:
        async with AsyncClient(url) as client:
            twin = await client.get(scene.id)
            view = await twin.view(["color", "depth"], from_=0, to=1, t=0.5, width=48)
            same = scene.view(["color", "depth"], from_=0, to=1, t=0.5, width=48)
            assert np.array_equal(view.image, same.image)
            assert np.array_equal(view.depth, same.depth)
            found = await twin.query("box", width=48)
            assert np.array_equal(found.masks, scene.query("box", width=48).masks)
            assert (await twin.pick(9, 9)).gaussian == scene.pick(9, 9).gaussian
            centres = [
                view.camera.camera_to_world[:3, 3]
                async for view in twin.views([{"from_": 0}, {"from_": 1}], width=24)
            ]
            assert np.allclose(centres, [p.camera.camera_to_world[:3, 3] for p in twin.photos])
            assert [event.event async for event in twin.events()] == ["done"]
            arrays = await twin.features(width=24)
            assert np.array_equal(arrays["weights"], scene.features(width=24)["weights"])
            await twin.refine("off")
            assert twin.status.refinement == scene.status.refinement
            path = await twin.export(path=tmp_path / "async.ply")
            assert path.read_bytes() == scene.export(path=tmp_path / "sync.ply").read_bytes()
            assert scene.id in [one.id async for one in client.scenes(page=1)]
            with pytest.raises(SceneNotFound):
                await client.get("0" * 32)

    anyio.run(ask)


def test_many_at_once(scene: Scene, url: str) -> None:
    async def ask() -> None:
        async with AsyncClient(url) as client:
            twin = await client.get(scene.id)
            drawn = {}

            async def draw(task: int) -> None:
                spots: list[Viewpoint] = [
                    {"from_": 0, "to": 1, "t": (4 * task + i) / 15} for i in range(4)
                ]
                drawn[task] = [view.image async for view in twin.views(spots, width=32)]

            async with anyio.create_task_group() as group:
                for task in range(4):
                    group.start_soon(draw, task)
            for i in range(16):
                same = scene.view(from_=0, to=1, t=i / 15, width=32)
                assert np.array_equal(drawn[i // 4][i % 4], same.image)

    anyio.run(ask)


def test_a_scene_is_made(url: str, photos: Path) -> None:
    async def make() -> None:
        async with AsyncClient(url) as client:
            scene = await client.scene(photos, semantics="off")
            assert scene.report and scene.report.photos == 2
            await scene.delete()

    anyio.run(make)
