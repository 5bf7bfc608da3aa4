"""Texts asked of a scene."""

from __future__ import annotations

from pathlib import Path

import httpx
import numpy as np
import pytest

from segsplat import Client, InvalidRequest, Scene
from segsplat.types import decode_rle


def test_a_query_is_typed_and_that_of_the_server(scene: Scene, url: str) -> None:
    found = scene.query("box", " floor ", from_=1, width=64)
    body = {"texts": ["box", "floor"], "camera": {"from": 1}, "width": 64}
    told = httpx.post(f"{url}/v1/scenes/{scene.id}/query", json=body, timeout=60).json()
    assert len(found) == 2 and [match.text for match in found] == ["box", "floor"]
    assert found["floor"] is found[1] and found.bank_size == told["bank_size"]
    for match, raw in zip(found, told["results"], strict=True):
        assert match.scores.tolist() == raw["scores"] and match.score == max(raw["scores"])
        assert match.entries == tuple(raw["entries"]) and match.gaussians == raw["gaussians"]
        assert match.mask.sum() == raw["view"]["area"]
        assert [box.gaussians for box in match.boxes] == [p["gaussians"] for p in raw["parts"]]
        if match.mask.any():
            rows, columns = np.nonzero(match.mask)
            left, top = columns.min(), rows.min()
            assert raw["view"]["bbox"] == [
                left,
                top,
                columns.max() - left + 1,
                rows.max() - top + 1,
            ]
    assert found.masks.shape == (2, 48, 64) and found.masks.any()
    assert found.camera is not None and found.camera.width == 64
    # The mask of a query is that of a view.
    assert np.array_equal(found[0].mask, scene.view("mask", text="box", from_=1, width=64).mask)
    assert (found._repr_png_() or b"").startswith(b"\x89PNG")


def test_a_query_says_how_it_scored(scene: Scene) -> None:
    paper = scene.query("box", masks=False, preset="paper", cut=0.25).scoring
    assert paper.canon == ("object", "things", "stuff") and not paper.unit_rows
    assert (paper.tau, paper.cut) == (10.0, 0.25)
    assert scene.query("box", masks=False).scoring.unit_rows


def test_every_number_of_the_scoring_is_the_callers(scene: Scene) -> None:
    scoring = scene.query(
        "box",
        masks=False,
        canon=["a wall", "a floor"],
        unit_rows=False,
        coverage_floor=0.25,
        near_best=0.5,
    ).scoring
    assert scoring.canon == ("a wall", "a floor") and not scoring.unit_rows
    assert (scoring.coverage_floor, scoring.near_best) == (0.25, 0.5)
    whole, chosen = scene.gaussians("box"), scene.gaussians("box", cut=0.9)
    assert len(chosen.means) < len(whole.means)


def test_features_are_the_pixels_over_the_bank(scene: Scene) -> None:
    weights = scene.features(width=48)
    height, width = weights["size"]
    assert (height, width) == (36, 48) and len(weights["offsets"]) == height * width + 1
    assert weights["offsets"][-1] == len(weights["entries"]) == len(weights["weights"]) > 0
    dense = scene.features("features", width=48)["features"]
    assert dense.shape[:2] == (height, width)
    lengths = np.linalg.norm(dense, axis=2).reshape(-1)
    shown = np.diff(weights["offsets"].astype(int)) > 0
    assert np.allclose(lengths[shown], 1, atol=1e-5) and not lengths[~shown].any()
    with pytest.raises(InvalidRequest):
        scene.features(width=48, near=-1.0)


def test_without_a_camera_the_masks_are_in_the_first_photo(scene: Scene) -> None:
    found = scene.query("box")
    assert found.masks.shape == (1, 240, 320)
    assert np.array_equal(found[0].mask, scene.query("box", camera=scene.photos[0].camera)[0].mask)
    assert [match.text for match in scene.query(["box", "floor"], "wall", masks=False)] == [
        "box",
        "floor",
        "wall",
    ]
    alone = scene.query("box", masks=False)
    assert alone.camera is None and alone[0].mask.size == 0
    assert alone[0].scores.tolist() == found[0].scores.tolist()


def test_corners_are_those_of_the_box(scene: Scene) -> None:
    boxes = scene.query("box", "floor").boxes
    assert boxes
    for box in boxes:
        corners = box.corners
        assert corners.shape == (8, 3) and np.allclose(corners.mean(0), box.center)
        for axis, step in enumerate((4, 2, 1)):
            assert np.allclose(corners[step] - corners[0], box.axes[axis] * box.size[axis])
    aligned = scene.query("floor", boxes="aligned", masks=False).boxes[0]
    assert np.allclose(np.abs(aligned.axes), np.eye(3))


def test_an_answer_says_what_is_known_of_its_word(scene: Scene) -> None:
    box, nothing = scene.query("a photo of boxes", "zxqv", masks=False)
    trust = {known.word: known.trust for known in scene.client.models().words}
    assert (box.word, box.trust) == ("box", trust["box"])
    assert (nothing.word, nothing.trust, nothing.found) == (None, None, False)
    assert str(nothing) == "zxqv: not found (no word that was measured)"
    parts = f"{len(box.boxes)} part{'s' if len(box.boxes) > 1 else ''}"
    told = f"{box.gaussians:,} Gaussians in {parts}, score {box.score:.2f} ({box.trust})"
    assert str(box) == f"a photo of boxes: {told}"
    scores = [part.score for part in box.boxes]
    assert scores == sorted(scores, reverse=True) and 0.5 <= scores[0] <= box.score + 1e-6


def test_parts_say_where_how_wide_and_how_well_seen_they_are(scene: Scene) -> None:
    # The largest of what is taken for the floor.
    part, *_ = scene.query("floor", boxes="upright", masks=False).boxes
    # The two photos look down by 19 degrees; y is down in the room.
    assert part.axes[2] @ [0, -1, 0] > np.cos(np.radians(8))
    assert np.allclose(part.axes @ part.axes.T, np.eye(3)) and np.linalg.det(part.axes) > 0
    assert part.covariance.shape == (3, 3) and np.linalg.eigvalsh(part.covariance).min() > 0
    # A covariance is at most a quarter of the squared extent, and the centroid lies inside.
    assert (np.diag(part.axes @ part.covariance @ part.axes.T) < part.size**2).all()
    assert (np.abs(part.axes @ (part.centroid - part.center)) < part.size / 2).all()
    assert part.visibility.shape == (len(scene.photos),) and part.visibility.max() > 0.3


def test_a_pick_names_what_is_there(scene: Scene) -> None:
    picked = scene.pick(160.5, 200.5, labels=["floor", "box"])
    assert picked.point is not None and picked.point.shape == (3,)
    assert [label.relevancy for label in picked.labels] == sorted(
        (label.relevancy for label in picked.labels), reverse=True
    )
    assert {label.text for label in picked.labels} == {"floor", "box"}


def test_doubts_and_faults_of_texts(scene: Scene) -> None:
    (match,) = scene.query("a box " * 40, masks=False)
    assert [doubt.code for doubt in match.warnings] == ["text_cut"]
    with pytest.raises(InvalidRequest):
        scene.query("")
    with pytest.raises(KeyError):
        scene.query("box", masks=False)["chair"]


def test_run_lengths_of_coco() -> None:
    """Known answers of pycocotools: `encode(np.asfortranarray(mask))`."""
    mask = np.zeros((3, 4), bool)
    mask[1, 1:3] = True
    assert np.array_equal(decode_rle({"size": [3, 4], "counts": "41202"}), mask)
    assert not decode_rle({"size": [2, 3], "counts": "6"}).any()
    assert decode_rle({"size": [2, 3], "counts": "06"}).all()


def test_what_a_query_found_is_hidden_and_kept(client: Client, photos: Path) -> None:
    scene = client.scene(photos, semantics="eager")
    whole = len(scene.gaussians().means)
    found = scene.query("box", "a unicorn on the moon", masks=False)
    assert found[0].found and not found[1].found
    assert found.hide() == [found[0].gaussians], "an edit for what was found alone"
    assert scene.edits() == [{"op": "delete", "select": {"text": "box"}}]
    assert len(scene.gaussians().means) == whole - found[0].gaussians
    seen = scene.view(["alpha", "holes"])
    scene.undo()
    assert scene.view("holes").holes.max() == 0, "nothing is edited"
    gone = np.maximum(scene.view("alpha").alpha - seen.alpha, 0)
    np.testing.assert_allclose(seen.holes, gone, atol=1e-6)
    assert scene.query("box", masks=False).keep() == [found[0].gaussians]
    assert len(scene.gaussians().means) == found[0].gaussians
    with pytest.raises(ValueError, match="for one text"):
        found.keep()
    assert repr(found[0]).startswith("<Match box: ") and "array" not in repr(found[0])
    scene.delete()
