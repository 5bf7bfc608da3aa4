"""ScanNet++ as labelled folders for `segsplat-lab semantics`: a judged photo with its two inputs.

    python scannetpp.py DATA SCENE OUT [--count N] [--side 640]
    segsplat-lab semantics OUT --preset paper --bundle models/paper

DATA is the folder as it is published: `data/SCENE/dslr` (`resized_images`, `colmap/cameras.txt`
and `images.txt`, `train_test_lists.json`), `data/SCENE/scans` (`mesh_aligned_0.05.ply`,
`segments.json`, `segments_anno.json`) and `metadata/semantic_benchmark` (`top100.txt`,
`map_benchmark.csv`). Photos stay fisheye photos: the server reads their lens and removes it from
photos and labels alike. Labels are the mesh's, drawn with a depth buffer through the same lens. The
inputs of a test photo are the nearest two train photos that show at least 60 % of the surface that
it shows.

Needs numpy, pillow."""

import argparse
import csv
import json
import pathlib

import numpy as np
from PIL import Image

OVERLAP = 0.6
# Train photos whose overlap is computed: those whose cameras are nearest.
CANDIDATES = 8
# A surface within this share of the depth buffer's depth is the one that is seen.
NEAR = 0.05


def mesh(path):
    """Vertices `[V, 3]` and triangles `[F, 3]` of a binary little-endian PLY."""
    kinds = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4", "uint": "<u4"}
    with open(path, "rb") as file:
        counts, columns, element = {}, [], None
        while (line := file.readline().decode().split()) != ["end_header"]:
            if line[0] == "format" and line[1] != "binary_little_endian":
                raise ValueError(f"{path} is {line[1]}; it must be binary_little_endian")
            if line[0] == "element":
                element, counts[line[1]] = line[1], int(line[2])
            if line[0] == "property" and element == "vertex":
                columns.append((line[2], kinds[line[1]]))
        rows = np.frombuffer(file.read(counts["vertex"] * np.dtype(columns).itemsize), columns)
        faces = np.frombuffer(file.read(counts["face"] * 13), [("n", "u1"), ("at", "<i4", 3)])
    return np.stack([rows[name] for name in "xyz"], 1).astype(np.float64), faces["at"]


def classes(data, scene, vertices):
    """Names of the benchmark, and each vertex's place among them + 1, 0 = none of them."""
    benchmark = data / "metadata/semantic_benchmark"
    names = benchmark.joinpath("top100.txt").read_text().split("\n")
    names = [name.strip() for name in names if name.strip()]
    renamed, table = {}, benchmark / "map_benchmark.csv"
    if table.is_file():
        with table.open(newline="") as file:
            renamed = {row["class"]: row["semantic_map_to"] for row in csv.DictReader(file)}
    scans = data / "data" / scene / "scans"
    segments = np.array(json.loads((scans / "segments.json").read_text())["segIndices"])
    found = np.zeros(vertices, np.uint8)
    for group in json.loads((scans / "segments_anno.json").read_text())["segGroups"]:
        name = renamed.get(group["label"]) or group["label"]
        if name in names:
            found[np.isin(segments, group["segments"])] = names.index(name) + 1
    return names, found


class Lens:
    """COLMAP's OPENCV_FISHEYE at another size of the picture."""

    def __init__(self, line, side):
        kind, width, height, *numbers = line.split()[1:]
        if kind != "OPENCV_FISHEYE":
            raise ValueError(f"the camera is {kind}; it must be OPENCV_FISHEYE")
        scale = side / max(int(width), int(height))
        self.size = round(int(width) * scale), round(int(height) * scale)
        self.scale = self.size[0] / int(width), self.size[1] / int(height)
        fx, fy, cx, cy, *self.k = map(float, numbers)
        self.f = np.array([fx * self.scale[0], fy * self.scale[1]])
        self.c = np.array([cx * self.scale[0], cy * self.scale[1]])

    def pixels(self, points):
        """Places `[N, 2]` and depths `[N]` along the axis of points in the camera's frame."""
        radius = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-12)
        angle = np.arctan2(radius, points[:, 2])
        bent = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(self.k)))
        return points[:, :2] / radius[:, None] * bent[:, None] * self.f + self.c, points[:, 2]

    def inside(self, places, depth):
        return (depth > 0.01) & ((places >= 0) & (places < self.size)).all(1)


def poses(path):
    """World to camera `[4, 4]` by name of the photo; every other line of the file are points."""
    found, lines = {}, [x for x in path.read_text().splitlines() if not x.startswith("#")]
    for line in lines[::2]:
        _, w, x, y, z, *shift, _, name = line.split(maxsplit=9)
        w, x, y, z = np.array([w, x, y, z], float) / np.linalg.norm(np.array([w, x, y, z], float))
        rotation = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
        found[name] = np.vstack([np.c_[rotation, np.array(shift, float)], [0, 0, 0, 1]])
    return found


def drawn(lens, pose, vertices, faces, most=64):
    """Depth `[H, W]` (inf where nothing is) and the vertex that each pixel shows (-1: none)."""
    width, height = lens.size
    local = vertices @ pose[:3, :3].T + pose[:3, 3]
    places, depth = lens.pixels(local)
    faces = faces[lens.inside(places, depth)[faces].any(1) & (depth[faces] > 0.01).all(1)]
    span = np.ptp(places[faces], axis=1).max(1)
    buffer, shown = np.full(width * height, np.inf), np.full(width * height, -1)
    steps = 1
    while len(faces) and steps <= most:
        # Points that are at most half a pixel apart, of the triangles of this size.
        chosen = span * 2 <= steps if steps < most else np.ones(len(faces), bool)
        corners, faces, span = faces[chosen], faces[~chosen], span[~chosen]
        for i in range(steps + 1):
            for j in range(steps + 1 - i):
                share = np.array([i, j, steps - i - j]) / steps
                at, z = lens.pixels(np.tensordot(share, local[corners], (0, 1)))
                ok = lens.inside(at, z)
                cell = at[ok].astype(int) @ [1, width]
                order = np.argsort(-z[ok], kind="stable")
                cell, z = cell[order], z[ok][order]
                vertex = corners[ok, share.argmax()][order]
                closer = z < buffer[cell]
                buffer[cell[closer]], shown[cell[closer]] = z[closer], vertex[closer]
        steps *= 2
    return buffer.reshape(height, width), shown.reshape(height, width)


def overlap(lens, seen, other_pose, other_depth):
    """Share of the points `[N, 3]` in the world that the other photo shows too."""
    at, z = lens.pixels(seen @ other_pose[:3, :3].T + other_pose[:3, 3])
    ok = lens.inside(at, z)
    x, y = at[ok].astype(int).T
    return float((z[ok] <= other_depth[y, x] * (1 + NEAR)).sum() / max(len(seen), 1))


def inputs(lens, cameras, target, train, vertices, faces, shown):
    """The nearest two train photos with enough overlap; `None` where there are not two."""
    centre = {name: -pose[:3, :3].T @ pose[:3, 3] for name, pose in cameras.items()}
    away = sorted(train, key=lambda name: np.linalg.norm(centre[name] - centre[target]))
    seen, found = vertices[np.unique(shown[shown >= 0])], []
    for name in away[:CANDIDATES]:
        depth, _ = drawn(lens, cameras[name], vertices, faces)
        if overlap(lens, seen, cameras[name], depth) >= OVERLAP:
            found.append(name)
        if len(found) == 2:
            return found
    return None


def write(out, lens, dslr, cameras, names, target, chosen, label):
    """One folder of our layout: the inputs, and the target with its labels."""
    for folder in ("images", "masks"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    frames = []
    for name in [*chosen, target]:
        stem = pathlib.Path(name).stem
        photo = Image.open(dslr / "resized_images" / name).convert("RGB")
        photo.resize(lens.size, Image.BOX).save(out / f"images/{stem}.png")
        pose = np.linalg.inv(cameras[name]) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{stem}.png", "transform_matrix": pose.tolist()})
    frames[-1]["mask_file"] = f"masks/{stem}.png"
    Image.fromarray(label).save(out / frames[-1]["mask_file"])
    (width, height), (fx, fy), (cx, cy) = lens.size, lens.f, lens.c
    top = {"camera_model": "OPENCV_FISHEYE", "w": width, "h": height, "fl_x": fx, "fl_y": fy}
    top |= {"cx": cx, "cy": cy, **{f"k{i + 1}": k for i, k in enumerate(lens.k)}, "frames": frames}
    (out / "transforms.json").write_text(json.dumps(top))
    table = {str(i + 1): name for i, name in enumerate(names)}
    (out / "masks/classes.json").write_text(json.dumps(table))


def convert(data, scene, out, count=None, side=640):
    """Writes the folders of a scene; names of those written and of test photos without inputs."""
    dslr = data / "data" / scene / "dslr"
    lines = (dslr / "colmap/cameras.txt").read_text().splitlines()
    (line,) = [line for line in lines if line.strip() and not line.startswith("#")]
    lens, cameras = Lens(line, side), poses(dslr / "colmap/images.txt")
    vertices, faces = mesh(data / "data" / scene / "scans/mesh_aligned_0.05.ply")
    names, of_vertex = classes(data, scene, len(vertices))
    lists = json.loads((dslr / "train_test_lists.json").read_text())
    train, test = ([name for name in lists[key] if name in cameras] for key in ("train", "test"))
    written, left_out = [], []
    for target in test[:count]:
        _, shown = drawn(lens, cameras[target], vertices, faces)
        chosen = inputs(lens, cameras, target, train, vertices, faces, shown)
        if chosen is None:
            left_out.append(target)
            continue
        label = np.where(shown < 0, 0, of_vertex[shown]).astype(np.uint8)
        folder = f"{scene}_{pathlib.Path(target).stem}"
        write(out / folder, lens, dslr, cameras, names, target, chosen, label)
        written.append(folder)
    return written, left_out


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=pathlib.Path)
    parser.add_argument("scene")
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("--count", type=int, help="test photos, the first ones [default: all]")
    parser.add_argument("--side", type=int, default=640, help="longer side of the photos, pixels")
    args = parser.parse_args()
    written, left_out = convert(args.data, args.scene, args.out, args.count, args.side)
    print(f"{len(written)} folders; {len(left_out)} test photos without two inputs: {left_out}")


if __name__ == "__main__":
    main()
