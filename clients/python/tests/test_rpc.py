"""gRPC: the same calls over the other wire. The fixture `client` asks most tests over both; here is
what is gRPC's own.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from served import run, served

import segsplat
from segsplat import AsyncClient, Camera, Client, Scene, Viewpoint
from segsplat.types import ViewOptions


def grpc(url: str) -> str:
    return url.replace("http", "grpc")


def test_both_wires_tell_the_same(scene: Scene, url: str) -> None:
    one, other = Client(url).get(scene.id), Client(grpc(url)).get(scene.id)
    assert repr(one.status) == repr(other.status) and repr(one.photos) == repr(other.photos)
    assert [*one.events()] == [*other.events()]
    assert repr(one.client.models()) == repr(other.client.models())
    assert one.client.models().words, "the bundle knows words"
    for text in (None, "box"):
        assert np.array_equal(one.gaussians(text).means, other.gaussians(text).means)
    spot: Viewpoint = {"eye": [0, -1.6, -3.4], "target": [0, -0.6, 0], "fov": 50.0}
    for background in ("black", "#102030", [0.1, 0.2, 0.3]):
        how: ViewOptions = {"width": 48, "crop": (8, 4, 16, 12), "error": "fast"}
        how["background"] = background
        views = [one_of.view(**spot, **how) for one_of in (one, other)]
        assert views[0].image.shape == (12, 16, 3)
        assert np.array_equal(views[0].image, views[1].image)
        assert np.array_equal(views[0].camera.K, views[1].camera.K)
    answers = [
        (found := one_of.query("box", "a floor", boxes="upright", tau=5, width=64), found[0])
        for one_of in (one, other)
    ]
    (all_one, match), (all_other, twin) = answers
    assert all_one.scoring == all_other.scoring and all_one.scoring.tau == 5
    assert np.array_equal(all_one.masks, all_other.masks) and all_one.masks.any()
    assert np.array_equal(match.scores, twin.scores) and match.peak == twin.peak
    assert repr(match.boxes) == repr(twin.boxes) and match.boxes
    picks = [one_of.pick(160, 120, labels=["box", "floor"]) for one_of in (one, other)]
    assert repr(picks[0]) == repr(picks[1]) and picks[0].labels


def test_refusals_have_the_same_class_and_words(scene: Scene, url: str) -> None:
    twin = Client(grpc(url)).get(scene.id)
    wrongs: list[dict[str, Any]] = [{"width": 4097}, {"from_": 99}, {"fov": -1.0}]
    for wrong in [*wrongs, {"crop": (0, 0, 9999, 9)}]:
        faults = []
        for asked in (Client(url).get(scene.id), twin):
            with pytest.raises(segsplat.SegSplatError) as refused:
                asked.view(**wrong)
            faults.append((type(refused.value), refused.value.message, refused.value.retry))
            assert refused.value.request_id
        assert faults[0] == faults[1], wrong
    # What no message can hold is refused before it is sent.
    with pytest.raises(segsplat.InvalidRequest, match="-1"):
        twin.view(width=-1)
    with pytest.raises(segsplat.InvalidRequest, match="SMELL"):
        twin.view("smell")  # type: ignore[arg-type]
    with pytest.raises(segsplat.InvalidRequest, match="background"):
        twin.view(background="sky")


def test_a_key_is_shown_and_a_full_share_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = tmp_path / "keys.toml"
    key = run("keys", "new", "reader", "--scope", "read", "--keys", keys).split()[0]
    keys.write_text(keys.read_text().rstrip() + "\nrequests_per_s = 2\n")
    slept: list[float] = []
    really = time.sleep

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        really(seconds)

    monkeypatch.setattr("segsplat.rpc.time.sleep", sleep)
    with served(tmp_path / "data", "--keys", keys) as url:
        with pytest.raises(segsplat.Unauthenticated):
            list(Client(grpc(url)).scenes())
        client = Client(grpc(url), api_key=key)
        for _ in range(6):
            assert list(client.scenes()) == []
        assert slept and min(slept) >= 1, "the server said how long"


def test_what_cannot_be_reached_or_read_is_said(tmp_path: Path, url: str) -> None:
    with pytest.raises(segsplat.ConnectionLost, match="UNAVAILABLE"):
        Client("grpc://127.0.0.1:9", retries=0).get("0" * 32)
    lens = Camera(np.eye(3), np.eye(4), 8, 8)
    with pytest.raises(FileNotFoundError, match="absent"):
        Client(grpc(url)).scene({tmp_path / "absent.png": lens})
    with pytest.raises(ValueError, match="certificates"):
        Client("grpcs://127.0.0.1:9", verify=False).models()


def test_without_the_extra_its_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "segsplat.rpc", raising=False)
    monkeypatch.delattr(segsplat, "rpc", raising=False)
    monkeypatch.setitem(sys.modules, "grpc", None)
    with pytest.raises(ImportError, match=r"segsplat\[grpc\]"):
        Client("grpc://127.0.0.1:9")


def test_the_awaited_client_has_it_too(scene: Scene, url: str, photos: Path) -> None:
    async def ask() -> None:
        async with AsyncClient(grpc(url)) as client:
            twin = await client.get(scene.id)
            view = await twin.view(["color", "depth"], width=48)
            assert np.array_equal(view.depth, scene.view(["color", "depth"], width=48).depth)
            assert (await twin.query("box", width=48)).masks.any()
            shown = [view async for view in twin.views([{"from_": 0}, {"from_": 1}], width=24)]
            assert len(shown) == 2
            assert len((await twin.gaussians()).means) == (scene.report and scene.report.gaussians)
            made = await client.scene(photos, progress=False)
            assert [event.event async for event in made.events()] == ["done"]
            await made.delete()
            with pytest.raises(segsplat.SceneNotFound):
                await made.refresh()

    anyio.run(ask)
