"""A small folder of ScanNet++'s layout: `python -m pytest benches/published`."""

import json

import numpy as np
import pytest
from PIL import Image

import scannetpp

LENS = "1 OPENCV_FISHEYE 120 80 60 60 60 40 0.02 -0.01 0.003 -0.001"


@pytest.fixture
def data(tmp_path):
    """A wall at z = 2 of four squares: chair, table, wall (renamed), and one that is not asked.
    Before the table's square stands a small chair. Photo `c.JPG` looks the other way.
    """
    scans, dslr = tmp_path / "data/abc/scans", tmp_path / "data/abc/dslr"
    benchmark = tmp_path / "metadata/semantic_benchmark"
    for folder in (scans, dslr / "resized_images", dslr / "colmap", benchmark):
        folder.mkdir(parents=True)
    squares = [(-2, -2, 2, 2), (0, -2, 2, 2), (-2, 0, 2, 2), (0, 0, 2, 2), (0.4, -0.6, 0.2, 1)]
    depths = [2, 2, 2, 2, 1]
    rows, faces = [], []
    for i, ((x, y, side, _), z) in enumerate(zip(squares, depths)):
        for dx, dy in [(0, 0), (1, 0), (1, 1), (0, 1)]:
            rows.append((x + dx * side, y + dy * side, z, 9, 9, 9))
        faces += [(3, (4 * i, 4 * i + 1, 4 * i + 2)), (3, (4 * i, 4 * i + 2, 4 * i + 3))]
    columns = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("r", "g", "b")]
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\nproperty float x\n"
        "property float y\nproperty float z\nproperty uchar red\nproperty uchar green\n"
        f"property uchar blue\nelement face {len(faces)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    body = np.array(rows, columns).tobytes()
    body += np.array(faces, [("n", "u1"), ("at", "<i4", 3)]).tobytes()
    (scans / "mesh_aligned_0.05.ply").write_bytes(header.encode() + body)
    segments = {"segIndices": [i for i in range(5) for _ in range(4)]}
    (scans / "segments.json").write_text(json.dumps(segments))
    labels = [("chair", [0, 4]), ("table", [1]), ("office wall", [2]), ("fluff", [3])]
    groups = [{"id": i, "label": name, "segments": at} for i, (name, at) in enumerate(labels)]
    (scans / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    (benchmark / "top100.txt").write_text("wall\nchair\ntable\n")
    table = "class,semantic_map_to\noffice wall,wall\nchair,\n"
    (benchmark / "map_benchmark.csv").write_text(table)
    (dslr / "colmap/cameras.txt").write_text(f"# Camera list\n{LENS}\n")
    images = "# Image list\n"
    turns = {"a": (1, 0, 0), "b": (1, 0, 0.1), "c": (0, 1, 0), "t": (1, 0, 0.05)}
    for i, (name, (w, y, x)) in enumerate(turns.items()):
        # World to camera: half a turn about y, or none, and a shift.
        images += f"{i + 1} {w} 0 {y} 0 {-x} 0 0 1 {name}.JPG\n1 1 -1\n"
        picture = np.full((80, 120, 3), 40 * i, np.uint8)
        Image.fromarray(picture).save(dslr / f"resized_images/{name}.JPG")
    (dslr / "colmap/images.txt").write_text(images)
    lists = {"train": ["c.JPG", "a.JPG", "b.JPG"], "test": ["t.JPG"]}
    (dslr / "train_test_lists.json").write_text(json.dumps(lists))
    return tmp_path


def test_labels_are_the_nearest_surface_through_the_lens(data, tmp_path):
    out = tmp_path / "out"
    assert scannetpp.convert(data, "abc", out, side=120) == (["abc_t"], [])
    classes = json.loads((out / "abc_t/masks/classes.json").read_text())
    assert classes == {"1": "wall", "2": "chair", "3": "table"}
    label = np.array(Image.open(out / "abc_t/masks/t.png"))
    assert label.shape == (80, 120)
    # Up left, up right, down left, and down right, which is not asked.
    assert [label[10, 20], label[10, 100], label[70, 20], label[70, 100]] == [2, 3, 1, 0]
    # The small chair's middle, at (0.5, -0.5, 1) from a camera at 0.05, by the formula of the lens.
    x, y = 0.45, -0.5
    radius = np.hypot(x, y)
    angle = np.arctan(radius)
    bent = angle * (1 + 0.02 * angle**2 - 0.01 * angle**4 + 0.003 * angle**6 - 0.001 * angle**8)
    column, row = 60 + 60 * bent * x / radius, 40 + 60 * bent * y / radius
    places, depth = scannetpp.Lens(LENS, 120).pixels(np.array([[x, y, 1.0]]))
    assert places[0] == pytest.approx([column, row]) and depth[0] == 1
    assert label[int(row), int(column)] == 2
    assert label[int(row), int(column) + 12] == 3
    assert (label[10:38, 62:95] > 0).all(), "no holes in triangles"


def test_inputs_see_the_same_surface_and_keep_the_fisheye_lens(data, tmp_path):
    out = tmp_path / "out"
    scannetpp.convert(data, "abc", out, side=60)
    cameras = json.loads((out / "abc_t/transforms.json").read_text())
    # `c` stands nearest and looks away.
    assert [frame["file_path"] for frame in cameras["frames"]] == [
        "images/a.png", "images/b.png", "images/t.png"]
    assert cameras["frames"][2]["mask_file"] == "masks/t.png"
    assert (cameras["camera_model"], cameras["k3"]) == ("OPENCV_FISHEYE", 0.003)
    assert (cameras["w"], cameras["h"], cameras["fl_x"], cameras["cy"]) == (60, 40, 30, 20)
    pose = np.array(cameras["frames"][2]["transform_matrix"])
    assert pose @ [0, 0, 0, 1] == pytest.approx([0.05, 0, 0, 1])
    assert pose[:3, :3] @ [0, 0, -1] == pytest.approx([0, 0, 1])
    (lists,) = data.glob("data/abc/dslr/train_test_lists.json")
    lists.write_text(json.dumps({"train": ["a.JPG", "c.JPG"], "test": ["t.JPG"]}))
    assert scannetpp.convert(data, "abc", tmp_path / "none") == ([], ["t.JPG"])
