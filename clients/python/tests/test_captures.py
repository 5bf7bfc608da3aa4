"""The files of a capture that are worth sending: the page and this package send the same."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from served import ROOT, run

from segsplat import Client, InvalidRequest, calls, formats, photos, video
from segsplat.wire import Part

FOLDERS = ["", "images/", "depth/", "a/lowres_depth/", "highres_depth/b/", "confidence/",
           "sparse/0/", ".git/", "a/.cache/"]
STEMS = ["0001", "cameras", "images", "points3D", "rigs", "frames", "project", "._0001",
         "metadata", "a.b"]
# Endings of the page and of the package, and some that neither sends.
OTHERS = ["", ".PNG", ".JPG", ".obj", ".usdz", ".mp4", ".md", ".db", ".zip", ".tar"]


def rule(name: str) -> re.Pattern[str]:
    """A regular expression of the page: Python reads it as JavaScript does."""
    found = re.search(rf"\b{name} = /(.*)/i?[,;]$", (ROOT / "web/capture.js").read_text(), re.M)
    assert found, f"web/capture.js has no {name}"
    return re.compile(found[1], re.IGNORECASE)


def test_the_page_and_the_package_send_the_same_files() -> None:
    photo, cameras = map(rule, ["PHOTO", "CAMERAS"])
    left_out = [*map(rule, ["HIDDEN", "UNREAD_FILE", "UNREAD_FOLDER"])]
    endings = [*sorted(calls.PHOTOS | calls.CAMERAS), *formats.SPLATS, *OTHERS]
    sent = 0
    for folder, stem, ending in itertools.product(FOLDERS, STEMS, endings):
        name = folder + stem + ending
        page = bool(photo.search(name) or cameras.search(name))
        page = page and not any(one.search(name) for one in left_out)
        assert calls._belongs(Path(name)) == page, name
        sent += page
    assert sent > 100, sent


def capture(tmp_path: Path, count: int, size: str = "640x480") -> dict[str, Any]:
    """Writes a capture whose lens does not say for which size it is; gives its cameras."""
    run("sample", "--photos", str(count), "--size", size, "-o", tmp_path)
    told: dict[str, Any] = json.loads((tmp_path / "transforms.json").read_text())
    for scope in [told, *told["frames"]]:
        scope.pop("w", None)
        scope.pop("h", None)
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    return told


def test_a_list_of_more_cameras_than_photos_is_sent_with_a_warning(
    client: Client, tmp_path: Path
) -> None:
    told = capture(tmp_path, 4, "256x192")
    gone = tmp_path / told["frames"][1]["file_path"]
    gone.rename(gone.with_suffix(".heic"))
    with pytest.warns(UserWarning, match=r"1 of 4 cameras have no photo .*0001\.png.*HEIC is a"):
        scene = client.scene(tmp_path, semantics="off")
    assert [Path(photo.file).name for photo in scene.photos] == ["0000.png", "0002.png", "0003.png"]
    scene.delete()


def test_photos_are_found_as_the_server_finds_them(client: Client, tmp_path: Path) -> None:
    told = capture(tmp_path, 2, "256x192")
    # Without their ending, and from another folder.
    told["frames"][0]["file_path"] = "./images/0000"
    told["frames"][1]["file_path"] = "../elsewhere/0001.png"
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    scene = client.scene(tmp_path, semantics="off")
    assert len(scene.photos) == 2
    scene.delete()


def test_a_shared_file_name_never_takes_a_photo(tmp_path: Path) -> None:
    for name in ["b/1.png", "c/2.png"]:
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    assert calls._matched(tmp_path, ["a/1.png", "b/1.png", "x/2", "../../gone.png"]) == [
        None,
        tmp_path / "b/1.png",
        tmp_path / "c/2.png",
        None,
    ]


def test_photos_alone_are_sent(tmp_path: Path) -> None:
    (tmp_path / "IMG_1.HEIC").touch()
    with pytest.raises(FileNotFoundError, match=r"IMG_1\.HEIC: HEIC is a format.*as JPEG"):
        calls.parts_of(tmp_path)
    (tmp_path / "b").mkdir()
    for name in ("a.png", "b/c.jpg", "transforms.json"):
        (tmp_path / name).touch()
    sent = [part.name for part in calls.parts_of(tmp_path, solve=True)]
    assert sent == ["a.png", "b/c.jpg"], "the cameras are to be solved"
    (tmp_path / "transforms.json").unlink()
    assert [part.name for part in calls.parts_of(tmp_path)] == sent
    with pytest.raises(FileNotFoundError, match="there is no such file or folder"):
        calls.parts_of(tmp_path / "none")


def test_a_video_is_sent_as_sharp_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = tmp_path / "Film.MP4"
    film.touch()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    with pytest.raises(InvalidRequest, match=r"Film\.MP4: it is a video, .* install"):
        calls.parts_of(film)
    # Stands for the program: three seconds that do not move, then the frames that are asked for.
    program = tmp_path / "bin/ffmpeg"
    program.parent.mkdir()
    size = video.WIDTH * video.HEIGHT * 30
    program.write_text(f"""#!/bin/sh
case "$*" in
*rawvideo*) /usr/bin/head -c {size} /dev/zero;;
*"eq(n\\,0)+eq(n\\,2)+"*)
    for i in 0 1 2 3 4 5 6 7 8 9 a b c d e f; do printf '\\377\\330\\377\\331'; done;;
esac
""")
    program.chmod(0o755)
    sent = calls.parts_of(film)
    assert [part.name for part in sent][:3] == ["00000.00s.jpg", "00000.20s.jpg", "00000.40s.jpg"]
    assert len(sent) == 16 and {part.content for part in sent} == {b"\xff\xd8\xff\xd9"}


def test_sharp_frames_are_chosen_over_the_motion() -> None:
    still = [(1.0, 0.0)] * 100
    moving = [(3.0 - i % 2, 2.0) for i in range(20)]
    places = video.chosen(still + moving, 9)
    assert len(places) == 9 and all(place >= 100 for place in places[1:])
    assert all((still + moving)[place][0] == 3.0 for place in places[1:])
    assert video.chosen(still[:5], 16) == [0, 1, 2, 3, 4]


def test_the_limits_are_those_that_the_server_says(client: Client) -> None:
    limits = client.models().limits
    rust = (ROOT / "crates/core/src/limits.rs").read_text()
    assert limits
    for name, told in dataclasses.asdict(limits).items():
        limit = re.search(rf"\b{name}: \w+ = ([0-9_< ]+)", rust)
        assert limit and eval(limit[1]) == told, name


def test_too_many_and_too_large_photos_are_chosen_and_made_smaller(
    client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = capture(tmp_path, 7)
    for i, frame in enumerate(told["frames"]):
        # As a phone writes them: they say how it was held.
        exif = Image.Exif()
        exif[0x0112] = 6
        whole = Image.open(tmp_path / frame["file_path"]).convert("RGB")
        whole.save(tmp_path / f"{i}.jpg", quality=95, exif=exif)
        frame["file_path"] = f"{i}.jpg"
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    limits = client.models().limits
    assert limits
    few = dataclasses.replace(
        limits,
        photos_max=4,
        upload_bytes_max=2 * (tmp_path / "0.jpg").stat().st_size,
        photos_pixels_kept_max=4 * 320 * 240,
    )
    # What this server would have said.
    monkeypatch.setattr(client.policy, "limits", few)
    with pytest.warns(UserWarning) as said:
        scene = client.scene(tmp_path, semantics="off")
    assert [str(one.message)[:28] for one in said] == [
        "7 photos have 1 MB; 4 are se",
        "4 photos were made smaller b",
    ]
    assert [photo.file for photo in scene.photos] == ["0.jpg", "2.jpg", "4.jpg", "6.jpg"]
    lens = {**told, **told["frames"][0]}
    want = np.array([lens[name] for name in ("fl_x", "fl_y", "cx", "cy")]) / 2
    for photo in scene.photos:
        assert (photo.camera.width, photo.camera.height) == (320, 240), "the photo was turned"
        k = photo.camera.K
        assert np.allclose([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], want)
    # One photo of too many pixels is made smaller by itself.
    one = [Part("photo", "0.jpg", tmp_path / "0.jpg")]
    kept = dataclasses.replace(limits, photo_pixels_max=640 * 480 - 1)
    sent, sizes = photos.fit(one, kept)
    assert sizes == {} and isinstance(sent[0].content, Path), "the server keeps it as it is"
    with pytest.warns(UserWarning, match="1 photos were made smaller"):
        sent, sizes = photos.fit(one, dataclasses.replace(kept, photo_side_kept_max=320))
    assert sizes == {"0.jpg": (640, 480)} and isinstance(sent[0].content, bytes)
    small = Image.open(io.BytesIO(sent[0].content))
    assert small.size == (320, 240) and small.getexif()[0x0112] == 6
    scene.delete()


def test_masks_fit_the_photo_that_was_asked(client: Client, tmp_path: Path) -> None:
    capture(tmp_path, 2)
    scene = client.scene(tmp_path)
    assert scene.query("box", from_=1).masks.shape == (1, 480, 640)
    assert client.get(scene.id).query("box").masks.shape == (1, 480, 640)
    assert scene.query("box", from_=1, width=64).masks.shape == (1, 48, 64)
    assert scene.query("box", from_=0, to=1, t=0.5).masks.shape[2] == 384
    # A pixel of a mask is that of a pick.
    picked = scene.pick(600.5, 440.5, from_=1)
    there = scene.view("depth", from_=1, width=640)
    assert picked.depth == pytest.approx(float(there.depth[440, 600]), rel=0.05)
    listed = next(one for one in client.scenes() if one.id == scene.id)
    assert listed.query("box", from_=1).masks.shape == (1, 480, 640)
    scene.delete()


def test_masks_are_sent_with_their_photos(tmp_path: Path) -> None:
    told = capture(tmp_path, 2, "64x48")
    names = [frame["file_path"] for frame in told["frames"]]
    stems = [Path(name).stem for name in names]
    for path in [f"masks/{stems[0]}.png", "alphas/second.png", "depths/second.png"]:
        (tmp_path / path).parent.mkdir(exist_ok=True)
        Image.new("L", (64, 48)).save(tmp_path / path)
    # A photo that lies elsewhere is not taken for its mask.
    told["frames"][0]["file_path"] = f"/elsewhere/{Path(names[0]).name}"
    told["frames"][1]["mask_path"] = "./alphas/second.png"
    (tmp_path / "transforms.json").write_text(json.dumps(told))
    sent = [part.name for part in calls.parts_of(tmp_path)]
    # `masks` without a word of it may be labels.
    assert sent == ["transforms.json", *names, "alphas/second.png"]
    more = calls.masks_in(tmp_path / "alphas")
    assert [(part.field, part.name) for part in more] == [("photo", "masks/second.png")]
    assert calls.masks_in(None) == []
    with pytest.raises(FileNotFoundError, match="no folder with masks"):
        calls.masks_in(tmp_path / "none")
