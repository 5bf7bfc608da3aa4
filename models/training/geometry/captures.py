"""Posed photos of public repositories, made small for training: undistorted, at most 640 pixels.

    python captures.py --mirror FOLDER --out data [--only NAME ...]

FOLDER holds bare git copies of the repositories in `captures.json` (`owner+name/repo`), which also
says where each comes from, its licence, and whether its place is held out; `solved` needs pycolmap. Each capture becomes
`data/<name>/<number>.jpg` and `data/<name>/cameras.json`: width, height, K in pixels and OpenCV
camera-to-world of each photo, world units of the source. Nothing here is under evaluation.
"""
import argparse
import io
import json
import os
import re
import struct
import subprocess
import tempfile
from dataclasses import dataclass, field

import cv2
import numpy as np
from PIL import Image

HERE = os.path.dirname(os.path.abspath(__file__))
LONG_SIDE = 640
QUALITY = 90
SOLVE_SIDE = 1000
EXHAUSTIVE_MOST = 40  # photos; more are taken as frames of a walk


@dataclass
class Shot:
    """A photo as its source stores it: where, and its camera (OpenCV axes, pixels)."""

    path: str
    size: tuple  # width, height that K belongs to
    K: np.ndarray
    c2w: np.ndarray
    distortion: list = field(default_factory=lambda: [0.0] * 5)


class Tree:
    """The files of one commit of a bare repository."""

    def __init__(self, folder, commit):
        self.git = ["git", f"--git-dir={folder}"]
        self.commit = commit
        self.names = self.run("ls-tree", "-r", "--name-only", "-z", commit).decode().split("\0")[:-1]

    def run(self, *args):
        return subprocess.run([*self.git, *args], check=True, capture_output=True).stdout

    def read(self, path):
        return self.run("cat-file", "blob", f"{self.commit}:{path}")

    def under(self, folder, pattern):
        prefix = folder.rstrip("/") + "/" if folder else ""
        return sorted(n for n in self.names if n.startswith(prefix) and re.fullmatch(pattern, n[len(prefix):]))


def pose(R, t):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = R, t
    return m


def lens(fx, fy, cx, cy):
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


# ---- layouts: each yields Shots -----------------------------------------------------------------
def transforms(tree, source):
    """nerfstudio and instant-ngp; photos are found by their file name."""
    top = json.loads(tree.read(source["cameras"]))
    photos = {os.path.basename(n): n for n in tree.under(source["photos"], source.get("pattern", ".*"))}
    for frame in top["frames"]:
        get = lambda key, default=0.0: frame.get(key, top.get(key, default))
        name = os.path.basename(frame["file_path"].replace("\\", "/"))
        path = photos.get(name) or next((p for n, p in photos.items() if os.path.splitext(n)[0] == name), None)
        if path is None:
            continue
        w, h = get("w", None), get("h", None)
        if w is None:
            w, h = Image.open(io.BytesIO(tree.read(path))).size
        fx = get("fl_x", None) or 0.5 * w / np.tan(0.5 * get("camera_angle_x"))
        c2w = np.array(frame["transform_matrix"], float)
        if source.get("axes", "opengl") == "opengl":
            c2w[:3, 1:3] *= -1
        K = lens(fx, get("fl_y", None) or fx, get("cx", w / 2), get("cy", h / 2))
        yield Shot(path, (int(w), int(h)), K, c2w, [get(k) for k in ("k1", "k2", "p1", "p2", "k3")])


def colmap(tree, source):
    """COLMAP's binary model: cameras of the models that photo collections have."""
    blob, lenses = tree.read(source["cameras"] + "/cameras.bin"), {}
    (count,), at = struct.unpack_from("<Q", blob), 8
    for _ in range(count):
        key, model, w, h = struct.unpack_from("<IiQQ", blob, at)
        n = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8}[model]
        p = struct.unpack_from(f"<{n}d", blob, at + 24)
        at += 24 + 8 * n
        if model in (1, 4):
            K, d = lens(*p[:4]), [*p[4:8], 0.0] if model == 4 else [0.0] * 5
        else:
            K, d = lens(p[0], p[0], p[1], p[2]), [p[3] if model > 1 else 0.0, p[4] if model > 2 else 0.0, 0.0, 0.0, 0.0]
        lenses[key] = (w, h), K, d
    blob = tree.read(source["cameras"] + "/images.bin")
    (count,), at = struct.unpack_from("<Q", blob), 8
    present = set(tree.names)
    for _ in range(count):
        _, qw, qx, qy, qz, tx, ty, tz, camera = struct.unpack_from("<I7dI", blob, at)
        end = blob.index(b"\0", at + 64)
        name = blob[at + 64 : end].decode()
        (points,) = struct.unpack_from("<Q", blob, end + 1)
        at = end + 9 + 24 * points
        path = f"{source['photos']}/{name}"
        if path in present:
            size, K, d = lenses[camera]
            R = np.array([
                [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)],
                [2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)],
                [2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)],
            ])
            yield Shot(path, size, K, pose(R.T, -R.T @ [tx, ty, tz]), d)


def strecha(tree, source):
    """A text file a photo: K, a row of zeros, rotation, centre, size."""
    for path in tree.under(source["photos"], r".*\.jpg"):
        numbers = tree.read(f"{source['cameras']}/{os.path.basename(path)}.camera").split()
        v = np.array([float(x) for x in numbers])
        yield Shot(path, (int(v[24]), int(v[25])), v[:9].reshape(3, 3), pose(v[12:21].reshape(3, 3), v[21:24]))


def llff(tree, source):
    """poses_bounds.npy: columns down, right, backwards, centre, (height, width, focal); name order."""
    rows = np.load(io.BytesIO(tree.read(source["cameras"])))[:, :15].reshape(-1, 3, 5)
    paths = tree.under(source["photos"], r"[^/]+\.(jpg|JPG|png)")
    if len(paths) != len(rows):
        raise SystemExit(f"{source['name']}: {len(paths)} photos, {len(rows)} poses")
    for path, m in zip(paths, rows):
        h, w, f = m[:, 4]
        R = np.stack([m[:, 1], m[:, 0], -m[:, 2]], 1)
        yield Shot(path, (int(w), int(h)), lens(f, f, w / 2, h / 2), pose(R, m[:, 3]))


def neus(tree, source):
    """cameras.npz: world_mat_i = K [R t]."""
    z = np.load(io.BytesIO(tree.read(source["cameras"])))
    for i, path in enumerate(tree.under(source["photos"], r".*\.png")):
        K, R, t = cv2.decomposeProjectionMatrix(z[f"world_mat_{i}"][:3].astype(np.float64))[:3]
        yield Shot(path, tuple(source["size"]), K / K[2, 2], pose(R.T, (t[:3] / t[3])[:, 0]))


def tsdf(tree, source):
    """frame-*.pose.txt (camera-to-world) and one K."""
    K = np.array(tree.read(source["cameras"]).split(), float)[:9].reshape(3, 3)
    for path in tree.under(source["photos"], r".*\.color\.png"):
        c2w = np.array(tree.read(path.replace("color.png", "pose.txt")).split(), float).reshape(4, 4)
        yield Shot(path, (640, 480), K, c2w)


def solved(tree, source):
    """Photos without cameras, solved by COLMAP at 1,000 pixels: one lens with a radial term for all of one size."""
    import pycolmap

    names = tree.under(source["photos"], source.get("pattern", r"[^/]+\.(jpg|JPG|jpeg|png)"))[:: source.get("every", 1)]
    names = names[: source.get("most", len(names))]
    with tempfile.TemporaryDirectory() as work:
        size, where = {}, {}
        for n, path in enumerate(names):
            img, name = Image.open(io.BytesIO(tree.read(path))), f"{n:03d}.png"
            size[name], where[name] = img.size, path
            img.draft("RGB", (SOLVE_SIDE, SOLVE_SIDE))
            img = img.convert("RGB")
            img.thumbnail((SOLVE_SIDE, SOLVE_SIDE))
            img.save(os.path.join(work, name))
        base = os.path.join(work, "base.db")
        found = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
        found.sift.max_num_features = 4096
        matched = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        mode = pycolmap.CameraMode.AUTO if len(set(size.values())) == 1 else pycolmap.CameraMode.PER_IMAGE
        pycolmap.extract_features(base, work, camera_mode=mode, reader_options=pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL"),
                                  extraction_options=found, device=pycolmap.Device.cpu)
        if len(names) > EXHAUSTIVE_MOST:
            pairing = pycolmap.SequentialPairingOptions(overlap=8, quadratic_overlap=True)
            pycolmap.match_sequential(base, matching_options=matched, pairing_options=pairing, device=pycolmap.Device.cpu)
        else:
            pycolmap.match_exhaustive(base, matching_options=matched, device=pycolmap.Device.cpu)
        models = pycolmap.incremental_mapping(base, work, os.path.join(work, "out"), pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=1))
        best = max(models.values(), key=lambda m: m.num_reg_images())
        print(f"{source['name']}: {best.num_reg_images()} of {len(names)} solved, {best.compute_mean_reprojection_error():.2f} px", flush=True)
        for image in best.images.values():
            if not image.has_pose:
                continue
            camera, m = best.cameras[image.camera_id], np.eye(4)
            m[:3] = image.cam_from_world().inverse().matrix()
            w, h = size[image.name]
            s = w / camera.width
            f, cx, cy, k = camera.params
            K = lens(f * s, f * h / camera.height, cx * s, cy * h / camera.height)
            yield Shot(where[image.name], (w, h), K, m, [k, 0.0, 0.0, 0.0, 0.0])


LAYOUTS = {f.__name__: f for f in (transforms, colmap, strecha, llff, neus, tsdf, solved)}


# ---- small copies -------------------------------------------------------------------------------
def small(tree, shot):
    """The photo undistorted and reduced: BGR, its K in its own pixels."""
    img = Image.open(io.BytesIO(tree.read(shot.path)))
    w, h = img.size
    if (w > h) != (shot.size[0] > shot.size[1]) and w != h:
        raise ValueError(f"{shot.path}: {w}x{h}, its camera says {shot.size}")
    img.draft("RGB", (2 * LONG_SIDE, 2 * LONG_SIDE))  # a JPEG is decoded at a half, quarter or eighth
    img = cv2.cvtColor(np.asarray(img.convert("RGB")), cv2.COLOR_RGB2BGR)
    h, w = img.shape[:2]
    K = np.diag([w / shot.size[0], h / shot.size[1], 1]) @ shot.K
    if any(shot.distortion):
        d = np.array(shot.distortion, float)
        half = np.diag([1.0, 1.0, 1.0])
        half[:2, 2] = -0.5  # OpenCV counts from the middle of the first pixel
        new, _ = cv2.getOptimalNewCameraMatrix(half @ K, d, (w, h), 0)
        maps = cv2.initUndistortRectifyMap(half @ K, d, None, new, (w, h), cv2.CV_32FC1)
        img = cv2.remap(img, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        half[:2, 2] = 0.5
        K = half @ new
    s = LONG_SIDE / max(w, h)
    if s < 1:
        nw, nh = round(w * s), round(h * s)
        img = cv2.resize(img, (nw, nh), interpolation=cv2.INTER_AREA)
        K = np.diag([nw / w, nh / h, 1]) @ K
    return img, K


def convert(source, mirror, out):
    folder = os.path.join(mirror, source["repository"].replace("/", "+"), "repo")
    git = os.path.join(folder, ".git")
    tree = Tree(git if os.path.isdir(git) else folder, source.get("commit", "HEAD"))
    os.makedirs(os.path.join(out, source["name"]), exist_ok=True)
    frames = []
    shots = sorted(LAYOUTS[source["layout"]](tree, source), key=lambda s: s.path)
    for shot in shots if source["layout"] == "solved" else shots[:: source.get("every", 1)]:
        img, K = small(tree, shot)
        name = f"{len(frames):03d}.jpg"
        cv2.imwrite(os.path.join(out, source["name"], name), img, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        frames.append({"file": name, "source": shot.path, "width": img.shape[1], "height": img.shape[0],
                       "K": K.tolist(), "c2w": shot.c2w.tolist()})
    about = {k: source[k] for k in ("name", "repository", "licence", "held_out") if k in source}
    with open(os.path.join(out, source["name"], "cameras.json"), "w") as file:
        json.dump({**about, "frames": frames}, file)
    return len(frames)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--mirror", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--only", nargs="*")
    args = ap.parse_args()
    with open(os.path.join(HERE, "captures.json")) as file:
        sources = json.load(file)
    for source in sources:
        if not args.only or source["name"] in args.only:
            print(source["name"], convert(source, args.mirror, args.out), flush=True)


if __name__ == "__main__":
    main()
