"""Making, finding, watching, exporting and deleting scenes."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest
from served import run

from segsplat import (
    Cancelled,
    Client,
    Event,
    Growth,
    InvalidRequest,
    Refinement,
    Scene,
    SceneNotFound,
    SegSplatError,
)


def test_a_scene_tells_how_it_was_made(scene: Scene, client: Client) -> None:
    assert scene.status.state == "done" and scene.status.semantics.state == "ready"
    report = scene.report
    assert report and report.photos == 2 and report.gaussians > 10_000
    assert {stage.stage for stage in report.stages} >= {"geometry", "lift"}
    assert report.depth_range[0] < report.median_depth < report.depth_range[1]
    assert [photo.file for photo in scene.photos] == ["images/0000.png", "images/0001.png"]
    assert client.get(scene.id).report is not None
    assert f"{report.gaussians} Gaussians" in repr(scene)


def test_events_go_on_until_the_first_text_is_answered(client: Client, photos: Path) -> None:
    scene = client.scene(photos, density="full", progress=False)
    events = scene.events(semantics=True)
    assert next(events) == Event("done"), "the scene, which nobody has asked"
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(scene.query, "box")
        *told, last = events
        assert asked.result()[0].found
    assert last == Event("done") and list(scene.events(semantics=True)) == [last]
    assert "masks" in [event.stage for event in told]
    fractions = [event.fraction for event in told]
    assert fractions == sorted(fractions)
    scene.delete()


def test_who_asks_for_edits_is_told_each_change(client: Client, photos: Path) -> None:
    scene = client.scene(photos, semantics="off", density="full", progress=False)
    events = scene.events(edits=True)
    assert [next(events), next(events)] == [Event("done"), Event("edited", edits=0)]
    client.get(scene.id).edit({"op": "delete",
                               "select": {"sphere": {"center": [0, 0, 0], "radius": 0.01}}})
    assert next(events) == Event("edited", edits=1), "whoever changed it"
    scene.delete()
    assert list(events) == [Event("cancelled")]


def test_events_end_with_the_last(client: Client, photos: Path) -> None:
    scene = client.scene(photos, wait=False, semantics="off", density="full")
    events = list(scene.events())
    assert events[-1] == Event("done")
    fractions = [event.fraction for event in events[:-1] if event.event == "running"]
    assert fractions == sorted(fractions) and fractions
    assert all(event.stage for event in events if event.event == "running")
    scene.wait()
    assert scene.report and scene.report.gaussians > 50_000
    scene.delete()
    with pytest.raises(SceneNotFound):
        scene.refresh()
    with pytest.raises(SceneNotFound):
        scene.delete()


def test_a_bar_is_drawn_when_asked(
    client: Client, scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.wait()
    assert capsys.readouterr().err == "", "no terminal, no bar"
    scene.wait(True)
    assert capsys.readouterr().err.endswith("#" * 24 + " 100% done        \n")
    told: list[Event] = []
    scene.wait(told.append)
    assert told == [Event("done")]


def test_pages_are_one_iterator(client: Client, scene: Scene, photos: Path) -> None:
    made = [client.scene(photos, wait=False, semantics="off") for _ in range(3)]
    ids = [one.id for one in client.scenes(page=1)]
    assert ids[:3] == [one.id for one in reversed(made)] and scene.id in ids
    assert ids == [one.id for one in client.scenes()]
    for one in made:
        one.delete()
    assert not {one.id for one in made} & {one.id for one in client.scenes(page=2)}


def test_an_export_is_streamed_to_a_file(
    scene: Scene, url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = scene.export("ply")
    assert path == Path(f"{scene.id}.ply")
    whole = httpx.get(f"{url}/v1/scenes/{scene.id}/export", params={"format": "ply"}).content
    assert path.read_bytes() == whole and whole.startswith(b"ply\n")
    part = scene.export(path=tmp_path / "box.ply", text="box")
    assert 0 < part.stat().st_size < len(whole)
    with pytest.raises(InvalidRequest):
        scene.export(path=tmp_path / "none.ply", text="")
    assert sorted(tmp_path.iterdir()) == sorted([part, tmp_path / path])


def test_folders_for_other_programs(
    client: Client, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    colmap = scene.export("colmap")
    assert colmap == Path(f"{scene.id}.colmap.zip")
    with zipfile.ZipFile(colmap) as files:
        maps = [name for name in files.namelist() if name.startswith("stereo/depth_maps/")]
        assert len(maps) == len(scene.photos) and "sparse/0/points3D.bin" in files.namelist()
    twin = client.scene(colmap, semantics="off")
    for one, other in zip(scene.photos, twin.photos, strict=True):
        assert np.allclose(one.camera.camera_to_world, other.camera.camera_to_world, atol=1e-12)
        assert np.array_equal(one.camera.K, other.camera.K)
    twin.delete()
    nerfstudio = scene.export("nerfstudio", tmp_path / "n.zip")
    with zipfile.ZipFile(nerfstudio) as files:
        told = json.loads(files.read("transforms.json"))
        depth = np.load(io.BytesIO(files.read(told["frames"][0]["depth_file_path"])))
    photo = scene.photos[0].camera
    seen = scene.view("depth", camera=photo).depth
    assert np.allclose(depth * told["depth_unit_scale_factor"], seen, rtol=1e-6)
    with zipfile.ZipFile(scene.export("coco", text=["box", "carpet"])) as files:
        coco = json.loads(files.read("annotations.json"))
    assert [one["name"] for one in coco["categories"]] == ["box", "carpet"]
    found = scene.query("box", "carpet", camera=photo)
    areas = [int(match.mask.sum()) for match in found if match.mask.any()]
    assert [one["area"] for one in coco["annotations"] if one["image_id"] == 1] == areas
    with pytest.raises(InvalidRequest, match="give 1 to 128"):
        scene.export("labelme", tmp_path / "none.zip")
    assert not (tmp_path / "none.zip").exists()


def test_archives_and_folders(client: Client, scene: Scene, photos: Path, tmp_path: Path) -> None:
    archive = shutil.make_archive(str(tmp_path / "photos"), "zip", photos)
    twin = client.scene(archive, semantics="off")
    assert np.array_equal(twin.view(width=64).image, scene.view(width=64).image)
    twin.delete()
    with pytest.raises(FileNotFoundError, match="no folder with photos"):
        client.scene(tmp_path)
    # A folder whose cameras lie deeper: the server finds them.
    shutil.copytree(photos, tmp_path / "dslr")
    (tmp_path / "dslr" / "nerfstudio").mkdir()
    (tmp_path / "dslr" / "transforms.json").rename(
        tmp_path / "dslr" / "nerfstudio" / "transforms.json"
    )
    (tmp_path / "photos.zip").unlink()
    twin = client.scene(tmp_path, semantics="off")
    assert np.array_equal(twin.view(width=64).image, scene.view(width=64).image)
    twin.delete()


def test_a_scene_that_fails_says_why(client: Client, photos: Path, tmp_path: Path) -> None:
    shutil.copytree(photos, tmp_path, dirs_exist_ok=True)
    transforms = json.loads((photos / "transforms.json").read_text())
    transforms["frames"][1]["transform_matrix"] = np.diag([1.0, 1, -1, 1]).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(transforms))
    with pytest.raises(SegSplatError) as mirrored:
        client.scene(tmp_path)
    assert mirrored.value.code == "invalid_request" and "0001" in mirrored.value.message
    # One that is deleted while it is being made.
    scene = client.scene(photos, wait=False)
    stop = iter([scene.delete])
    with pytest.raises(Cancelled) as stopped:
        scene.wait(lambda _: next(stop, lambda: None)())
    assert stopped.value.scene == scene.id


@pytest.mark.parametrize(
    "text",
    ["{}", "[]", "no json", '{"frames": [1]}', '{"frames": [{"file_path": "../outside.png"}]}'],
)
def test_a_description_is_read_before_photos_are_sent(tmp_path: Path, text: str) -> None:
    (tmp_path / "outside.png").touch()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "transforms.json").write_text(text)
    with pytest.raises(InvalidRequest):
        Client("http://127.0.0.1:9").scene(tmp_path / "photos")


def test_every_format_of_a_file(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    begins = {
        "ply": b"ply\n",
        "compressed.ply": b"ply\n",
        "spz": b"\x1f\x8b",
        "v4.spz": b"NGSP\x04",
        "sog": b"PK",
        "glb": b"glTF",
        "splat": b"",
        "npz": b"PK",
        "segsplat": b"",
        "html": b"<!doctype html>",
    }
    paths = [
        scene.export("ply"),
        scene.export("compressed_ply"),
        scene.export("spz"),
        scene.export("spz4"),
        scene.export("sog"),
        scene.export("glb"),
        scene.export("splat"),
        scene.export("npz"),
        scene.export("packed"),
        scene.export("html", text=["box", "carpet"]),
    ]
    for path, (ending, start) in zip(paths, begins.items(), strict=True):
        assert path.name == f"{scene.id}.{ending}"
        assert path.read_bytes().startswith(start) and path.stat().st_size > 1000


def test_a_scene_is_refined_while_it_is_served(client: Client, photos: Path) -> None:
    scene = client.scene(photos, semantics="off", refine="off", votes=False, lambda_=1.5)
    assert scene.report and scene.report.method["votes"] is False
    assert (scene.report.method["lambda"], scene.report.method["mask_level"]) == (1.5, "widest")
    assert (scene.status.version, scene.status.refinement) == (1, Refinement())
    scene.refine(500)
    assert (scene.status.state, scene.status.refinement.state) == ("done", "running")
    assert scene.view(width=32).image.any()
    scene.wait()  # it is made already
    events = list(scene.events())
    assert events[0] == Event("done")
    assert [event.event for event in events[1:]] == ["version"] * len(events[1:])
    scene.refresh()
    assert scene.status.refinement.state == "done" and scene.status.refinement.error is None
    report = scene.report.refinement
    assert report and report.steps > 0 and report.gaussians_after == scene.report.gaussians
    assert [event.version for event in events[-1:] if event.version] in ([], [scene.status.version])
    scene.refine(600_000)
    scene.refine("off")
    assert client.get(scene.id).status.refinement.state in ("none", "done")
    with pytest.raises(InvalidRequest, match="refine is 0 ms"):
        scene.refine(0)
    scene.delete()


def test_photos_join_a_scene_and_leave_it(client: Client, tmp_path: Path) -> None:
    run("sample", "--photos", "5", "-o", tmp_path / "all")
    described = json.loads((tmp_path / "all" / "transforms.json").read_bytes())
    frames = described["frames"]

    def some(name: str, which: list[int]) -> Path:
        folder = tmp_path / name
        shutil.copytree(tmp_path / "all" / "images", folder / "images")
        told = {**described, "frames": [frames[i] for i in which]}
        (folder / "transforms.json").write_text(json.dumps(told))
        return folder

    scene = client.scene(some("first", [0, 1, 2]), refine="off")
    assert scene.status.growth == Growth()
    scene.add(some("more", [3, 4]))
    assert scene.status.growth.state == "done" and scene.status.version == 2
    assert len(scene.photos) == 5 and scene.view(from_=4, width=32).image.any()
    with pytest.raises(InvalidRequest, match="already"):
        scene.add(some("again", [4]))
    scene.remove(scene.photos[0])
    assert len(scene.photos) == 4 and scene.status.version == 3
    with pytest.raises(SegSplatError, match="no photo"):
        scene.remove("images/0000.png")
    scene.delete()


def test_a_file_of_gaussians_is_a_scene(client: Client, scene: Scene, tmp_path: Path) -> None:
    camera = scene.photos[0].camera
    own = scene.view(camera=camera, width=64, near=0.05, background="black").image
    paths = [scene.export("glb", tmp_path / "a.glb"), scene.export("spz", tmp_path / "a.spz")]
    for path, semantics in zip(paths, ["ready", "off"], strict=True):
        made = client.scene(path)
        assert made.report and made.report.file_format == path.suffix[1:]
        assert made.report.photos == 0
        assert made.status.semantics.state == semantics
        assert [photo.file for photo in made.photos] == ["overview"]
        assert made.view(width=64).image.any(), "its own camera sees it"
        seen = made.view(camera=camera, width=64, near=0.05).image
        assert np.abs(seen.astype(int) - own).mean() < 6
        if semantics == "ready":
            assert made.query("box", masks=False)["box"].gaussians > 0
        else:
            with pytest.raises(SegSplatError, match="without semantics"):
                made.query("box", masks=False)
        made.delete()
    with pytest.raises(FileNotFoundError):
        client.scene(tmp_path / "none.ply")


def test_a_scene_is_in_metres_once_a_length_is_said(scene: Scene) -> None:
    assert (before := scene.scale()).source == "none" and before.metres_per_unit is None
    assert np.linalg.norm(before.up) == pytest.approx(1)
    points = [(0, 0, 0), (3, 0, 4), (3, 5, 4)]
    try:
        assert scene.measure(points).unit == "unknown"
        known = scene.set_scale(2.5, points=points[:2])
        assert (known.source, known.metres_per_unit) == ("given", 0.5)
        found = scene.measure(points)
        assert (found.unit, found.length, found.legs) == ("metre", 5.0, (2.5, 2.5))
        assert found.area == pytest.approx(3.125) and len(found.heights) in (0, 3)
        size = scene.query("box").boxes[0].size
        by_thing = scene.set_scale(1.0, thing={"text": "box", "side": "longest"})
        assert by_thing.metres_per_unit == pytest.approx(1 / max(size))
        assert scene.set_scale(metres_per_unit=0.25).metres_per_unit == 0.25
        with pytest.raises(InvalidRequest, match="points or with thing"):
            scene.set_scale(1.0)
    finally:
        assert scene.set_scale().source == "none"
