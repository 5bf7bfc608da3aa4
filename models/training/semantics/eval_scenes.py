"""Twenty labelled scenes for evaluation, of meshes that the training of masks and words never sees.

The training of geometry saw 69 of these 74 meshes.

    python eval_scenes.py --data ../../../../shared/data --out ../../../target/eval/scenes

Each scene is a folder in the layout of the shared scenes: `images/*.png`, `transforms.json`
(OpenGL poses), `masks/*.png` (value = class, every pixel labelled) and `masks/classes.json`; beside
them `instances/*.png` (value = object) and `scene.json` (which mesh is which object, where it is, its
smallest upright box, and which classes are only surroundings: floor and walls are counted as wrong
where a text selects them, and are not asked for). Odd scenes are a table top, even ones a room with furniture. The same
seed gives the same bytes of every picture with the same versions of numpy, pillow and trimesh; others
may choose other things.
"""
import argparse
import ctypes
import importlib.util
import io
import json
import math
import os
import subprocess
import sys
import tarfile
import tempfile

import numpy as np
from PIL import Image, ImageDraw

HERE = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, HERE)
from names import plain_name, read_index  # noqa: E402

_spec = importlib.util.spec_from_file_location("geometry_prepare", os.path.join(HERE, "..", "geometry", "prepare.py"))
_prepare = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_prepare)
TEX, mesh_triangles = _prepare.TEX, _prepare.mesh_triangles

SEED = 1300
WIDTH, HEIGHT, VIEWS = 480, 360, 12
LEVELS = 8
# Longest side of a thing in metres. Small things are a little larger than life, so that each is
# at least a few percent of the picture's width.
SIZE = {
    "apple": 0.12, "banana": 0.22, "boat": 0.34, "book": 0.27, "bottle": 0.26, "bowl": 0.22, "broccoli": 0.18,
    "cactus": 0.2, "car": 0.3, "carrot": 0.24, "cheese": 0.2, "coffee mug": 0.16, "cup": 0.15, "cutting board": 0.4,
    "donut": 0.15, "frying pan": 0.44, "hamburger": 0.16, "hammer": 0.3, "headphones": 0.24, "jar": 0.17,
    "ketchup bottle": 0.24, "keyboard": 0.44, "lemon": 0.11, "milk carton": 0.25, "mustard bottle": 0.24,
    "onion": 0.12, "orange": 0.12, "pear": 0.13, "pineapple": 0.32, "pizza": 0.34, "plate": 0.28, "pot": 0.32,
    "pumpkin": 0.26, "rabbit": 0.26, "race car": 0.3, "remote control": 0.22, "sandwich": 0.24, "scissors": 0.24,
    "soda can": 0.15, "stapler": 0.18, "table lamp": 0.45, "teacup": 0.15, "tin can": 0.13, "tomato": 0.12,
    "tractor": 0.32, "vase": 0.32, "wine bottle": 0.34,
    # on a floor
    "armchair": 1.0, "bed": 2.0, "cabinet": 1.2, "chair": 0.95, "coffee table": 1.2, "crate": 0.6, "guitar": 1.05,
    "picture frame": 0.8, "pillow": 0.55, "potted plant": 1.0, "refrigerator": 1.75, "round table": 1.2,
    "shelf": 0.9, "sofa": 2.1, "stool": 0.6, "stove": 1.1, "television": 1.2,
}
FLOOR = ["armchair", "bed", "cabinet", "chair", "crate", "guitar", "potted plant", "refrigerator", "round table",
         "sofa", "stool", "stove", "television"]
# Held out, but in no picture: a person does not know them in their render.
OUT = ["boat", "coffee table", "pillow", "shelf"]
TABLE = [n for n in SIZE if n not in FLOOR + OUT + ["picture frame"]]
# Folders whose meshes have +z up; the others have +y up.
UP_Z = ("house", "libero", "urdf", "ycb")
# Turn about the upright axis, degrees, that brings a thing's front to the viewer.
FRONT = {"television": 90}
# Names so near each other that one picture would have two right answers.
NEAR = [
    {"cup", "coffee mug", "teacup"}, {"tin can", "soda can", "jar"}, {"car", "race car", "tractor"},
    {"bottle", "wine bottle", "ketchup bottle", "mustard bottle", "vase"}, {"bowl", "plate", "pot", "frying pan"},
    {"apple", "tomato", "orange", "lemon", "pear", "onion", "pumpkin"}, {"sofa", "armchair"},
    {"chair", "stool", "armchair"}, {"round table", "stool"}, {"cabinet", "crate"}, {"cutting board", "book"},
    {"hamburger", "sandwich", "donut", "pizza"}, {"potted plant", "cactus"},
]


# ---- the ray caster -------------------------------------------------------------------------------
class Caster:
    """Meshes, textures and the compiled ray caster."""

    def __init__(self, meshes, images):
        folder = tempfile.mkdtemp()
        lib = os.path.join(folder, "raycast.so")
        subprocess.check_call(["g++", "-O3", "-shared", "-fPIC", "-pthread", os.path.join(HERE, "raycast_host.cpp"), "-o", lib])
        self.lib = ctypes.CDLL(lib)
        self.lib.world_new.restype = ctypes.c_void_p
        rows = np.ascontiguousarray(np.concatenate(meshes), np.float32)
        ranges = np.cumsum([0] + [len(m) for m in meshes]).astype(np.int64)
        self.world = ctypes.c_void_p(self.lib.world_new(self._p(rows), self._p(ranges), len(meshes)))
        self.bank = np.ascontiguousarray(np.stack([mips(i) for i in images]))

    @staticmethod
    def _p(a):
        return a.ctypes.data_as(ctypes.c_void_p)

    def render(self, insts, light, cam, width, height, threads, colour=True):
        insts = np.ascontiguousarray(insts, np.float32)
        light = np.ascontiguousarray(light, np.float32)
        cam = np.ascontiguousarray(cam, np.float32)
        rgb = np.zeros((height, width, 3), np.uint8) if colour else None
        depth = np.zeros((height, width), np.float32)
        ids = np.zeros((height, width), np.int32)
        self.lib.render(self.world, self._p(insts), len(insts), self._p(light), self._p(self.bank), TEX, LEVELS,
                        self._p(cam), width, height, threads, self._p(rgb) if colour else None, self._p(depth), self._p(ids))
        return rgb, depth, ids


def mips(img):
    a, out = img.astype(np.float32), []
    for _ in range(LEVELS):
        out.append(a.round().clip(0, 255).astype(np.uint8).reshape(-1))
        a = a.reshape(a.shape[0] // 2, 2, a.shape[1] // 2, 2, 3).mean((1, 3))
    return np.concatenate(out)


def rows_of(p, uv, rgb, tex):
    out = np.zeros((len(p), 20), np.float32)
    out[:, 0:3], out[:, 3:6], out[:, 6:9] = p[:, 0], p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    out[:, 9:15], out[:, 15:18], out[:, 18] = uv.reshape(len(p), 6), rgb, tex
    return out


def box():
    """A box of half sides 1, its uv 0..1 on each side; side = slot 0..5 (-x +x -y +y -z +z)."""
    rows = []
    for axis in range(3):
        for side in range(2):
            a, b = (axis + 1) % 3, (axis + 2) % 3
            q = np.zeros((4, 3))
            q[:, axis] = side * 2 - 1
            q[:, a], q[:, b] = [-1, 1, 1, -1], [-1, -1, 1, 1]
            t = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
            r = rows_of(q[[[0, 1, 2], [0, 2, 3]]], t[[[0, 1, 2], [0, 2, 3]]], 1.0, -1)
            r[:, 19] = axis * 2 + side
            rows.append(r)
    return np.concatenate(rows)


# ---- surfaces -------------------------------------------------------------------------------------
def noise(rng, h, w, gh, gw):
    g = rng.standard_normal((gh, gw)).astype(np.float32)
    g = np.asarray(Image.fromarray(g).resize((w, h), Image.BICUBIC))
    return (g - g.min()) / max(float(g.max() - g.min()), 1e-6)


def surface(rng, kind):
    """A 256 x 256 colour map: `wood`, `plaster`, `cloth`, `tiles`."""
    fine = sum(noise(rng, TEX, TEX, n, n) / k for k, n in enumerate([9, 33, 129], 1))
    if kind == "wood":
        a = np.array([rng.uniform(95, 190)] * 3) * [1.0, rng.uniform(0.62, 0.8), rng.uniform(0.35, 0.58)]
        grain = 0.6 * noise(rng, TEX, TEX, int(rng.integers(3, 6)), int(rng.integers(50, 110))) + 0.25 * fine
        planks = (np.arange(TEX) * 4 // TEX)
        tone = rng.uniform(0.82, 1.06, 4)[planks] * np.where(np.arange(TEX) % (TEX // 4) < 2, 0.6, 1.0)
        return (a * (1.1 - 0.5 * grain)[..., None] * tone[None, :, None]).clip(0, 255).astype(np.uint8)
    if kind == "tiles":
        a, y, x = rng.uniform(0.85, 1.0, 3) * rng.uniform(120, 220), *np.mgrid[0:TEX, 0:TEX]
        n = TEX // int(rng.choice([2, 4]))
        line = ((y % n) < 3) | ((x % n) < 3)
        tone = rng.uniform(0.9, 1.05, (8, 8))[(y // n) % 8, (x // n) % 8]
        return (a * (tone * (0.92 + 0.08 * fine) * np.where(line, 0.72, 1.0))[..., None]).clip(0, 255).astype(np.uint8)
    if kind == "cloth":
        a, y, x = rng.uniform(60, 210, 3), *np.mgrid[0:TEX, 0:TEX]
        weave = 0.5 + 0.25 * np.sin(x * math.pi / 2) + 0.25 * np.sin(y * math.pi / 2)
        return (a * (0.8 + 0.12 * weave + 0.1 * fine)[..., None]).clip(0, 255).astype(np.uint8)
    a = rng.uniform(0.82, 1.0, 3) * rng.uniform(150, 235)
    stripes = 1.0
    if rng.random() < 0.4:
        stripes = np.where((np.arange(TEX) * int(rng.choice([8, 16])) // TEX) % 2 == 0, 1.0, rng.uniform(0.86, 0.94))[None]
    return (a * ((0.9 + 0.07 * fine) * stripes)[..., None]).clip(0, 255).astype(np.uint8)


# ---- scenes ---------------------------------------------------------------------------------------
def upright(entry):
    """Rotation from a mesh's own frame to ours (x right, y down, z away from the viewer)."""
    if entry["file"].split("/")[0] in UP_Z:
        return np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    return np.diag([1.0, -1.0, -1.0])


def turn(degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def instance(mesh, linear, centre, tex=(-2,) * 6, tint=(1, 1, 1), show=1.0, repeat=1.0, spec=0.05, casts=1.0):
    inv = np.linalg.inv(linear)
    return np.concatenate([np.concatenate([inv, -(inv @ centre)[:, None]], 1).ravel(), [mesh], tex, tint, [show, repeat, spec, casts, 0.3]])


class Maker:
    def __init__(self, data):
        with open(os.path.join(HERE, "heldout_meshes.txt")) as f:
            kept = f.read().split()
        textures, self.things, meshes = {}, [], [box()]
        with tarfile.open(os.path.join(data, "assets3d", "assets3d.tar")) as tar:
            for entry in (e for e in read_index(data) if e["file"] in kept):
                got = mesh_triangles(tar.extractfile(entry["file"]).read(), textures, 10000)
                if got is None:
                    raise SystemExit(f"{entry['file']}: no triangles")
                p, uv, rgb, tex = got
                meshes.append(rows_of(p.astype(np.float32), uv.astype(np.float32), rgb / 255.0, tex))
                turned = p.astype(float).reshape(-1, 3) @ upright(entry).T
                self.things.append({"file": entry["file"], "name": plain_name(entry), "mesh": len(meshes) - 1,
                                    "up": upright(entry), "lo": turned.min(0), "hi": turned.max(0),
                                    "points": np.unique(p.astype(float).reshape(-1, 3), axis=0)})
        if len(self.things) != len(kept):
            raise SystemExit(f"{len(kept)} held-out meshes listed, {len(self.things)} found")
        images = [np.asarray(Image.open(io.BytesIO(v[1])).convert("RGB")) for v in sorted(textures.values())]
        rng = np.random.default_rng(SEED)
        self.kinds = {}
        for kind in ("wood", "plaster", "cloth", "tiles"):
            self.kinds[kind] = range(len(images), len(images) + 8)
            images += [surface(rng, kind) for _ in range(8)]
        self.caster, self.used = Caster(meshes, images), {}

    def place(self, thing, size, yaw, x, ground, z):
        """Instance of a thing that stands on `ground`, its footprint's centre at (x, z)."""
        scale = size / 2.0
        linear = turn(yaw) @ thing["up"] * scale
        lo, hi = self.extent(thing, size, yaw)
        centre = np.array([x - (lo[0] + hi[0]) / 2, ground - hi[1], z - (lo[2] + hi[2]) / 2])
        return linear, centre

    @staticmethod
    def extent(thing, size, yaw):
        corners = np.array([[x, y, z] for x in (thing["lo"][0], thing["hi"][0]) for y in (thing["lo"][1], thing["hi"][1])
                            for z in (thing["lo"][2], thing["hi"][2])]) * (size / 2) @ turn(yaw).T
        return corners.min(0), corners.max(0)


def upright_box(points):
    """The box of points that stands upright (y is down) and covers the least ground: the form of `parts` of a query."""
    def bounds(degrees):
        turned = points @ turn(degrees)
        return turned.min(0), turned.max(0)

    def ground(degrees):
        lo, hi = bounds(degrees)
        return (hi[0] - lo[0]) * (hi[2] - lo[2])

    yaw = min(range(90), key=ground)
    lo, hi = bounds(yaw)
    across, along = turn(yaw)[:, 0], turn(yaw)[:, 2]
    return {"center": (turn(yaw) @ ((lo + hi) / 2)).tolist(), "axes": [across.tolist(), along.tolist(), [0.0, -1.0, 0.0]],
            "size": [hi[0] - lo[0], hi[2] - lo[2], hi[1] - lo[1]]}


def sheet(maker, path, threads):
    """Every held-out thing from the front, for a look at axes and sizes."""
    cells, side = [], 112
    for thing in sorted(maker.things, key=lambda t: t["name"]):
        for yaw in (0, 40):
            linear, centre = maker.place(thing, 1.0, FRONT.get(thing["name"], 0) + yaw, 0, 0.0, 0.0)
            insts = [instance(thing["mesh"], linear, centre, casts=0.0)]
            cam = look([0.7, -1.0, -1.8], [0, -0.35, 0], side * 1.15, side, side)
            rgb, _, _ = maker.caster.render(insts, [2, -3, -3, -3, -2, -2, .6, .6, .6, .25, .25, .25, .4], cam, side, side, threads)
            img = Image.fromarray(rgb)
            ImageDraw.Draw(img).text((3, 3), thing["name"] + "\n" + thing["file"].split("/")[0], fill=(255, 255, 0))
            cells.append(img)
    cols = 14
    out = Image.new("RGB", (cols * side, -(-len(cells) // cols) * side))
    for i, c in enumerate(cells):
        out.paste(c, (i % cols * side, i // cols * side))
    out.save(path)


def look(eye, at, focal, width, height):
    eye, at = np.asarray(eye, float), np.asarray(at, float)
    f = (at - eye) / np.linalg.norm(at - eye)
    r = np.cross(f, [0, -1, 0])
    r /= np.linalg.norm(r)
    m = np.stack([r, np.cross(f, r), f, eye], 1)
    return np.concatenate([m.ravel(), [focal, focal, width / 2, height / 2]])


def compose(maker, number):
    """Instances, light and cameras of one scene; all in metres, y down, the floor at y = 0."""
    rng = np.random.default_rng([SEED, number])
    table = number % 2 == 1
    pick = lambda kind: int(rng.choice(list(maker.kinds[kind])))  # noqa: E731
    # The room: a box whose side 3 (+y) is the floor. Its own light never falls from outside.
    half = np.array([rng.uniform(2.2, 3.0), rng.uniform(1.25, 1.45), rng.uniform(2.4, 3.0)])
    middle = np.array([0.0, -half[1], 0.0])
    floor, wall = pick("wood" if rng.random() < 0.6 else "tiles"), pick("plaster")
    tex = [wall, wall, wall, floor, wall, wall]
    room = instance(0, np.diag(half), middle, tex, (1, 1, 1), 1.0, float(rng.integers(2, 4)), 0.02, 0.0)
    insts, labels = [room], ["room"]
    box_of = lambda lo, hi, t: instance(0, np.diag((np.array(hi) - lo) / 2), (np.array(hi) + lo) / 2, [t] * 6, (1, 1, 1), 1.0, 1.0, 0.06)  # noqa: E731
    if table:
        top, w, d = -rng.uniform(0.68, 0.78), rng.uniform(0.52, 0.64), rng.uniform(0.36, 0.44)
        cover = pick("wood" if rng.random() < 0.7 else "cloth")
        insts.append(box_of([-w, top, -d], [w, top + 0.04, d], cover))
        for x in (-w + 0.05, w - 0.05):
            for z in (-d + 0.05, d - 0.05):
                insts.append(box_of([x - 0.03, top + 0.04, z - 0.03], [x + 0.03, 0.0, z + 0.03], cover))
        labels += ["table"] * 5
        names, ground, area, gap = TABLE, top, [[-w + 0.04, w - 0.04], [-d + 0.04, d - 0.04]], 0.02
    else:
        names, ground, area, gap = FLOOR, 0.0, [[-half[0] + 0.15, half[0] - 0.15], [-0.5, half[2] - 0.1]], 0.08
    count = int(rng.integers(4, 7)) if table else int(rng.integers(3, 6))
    placed, kept = [], []
    for thing in candidates(maker, rng, names):
        name = thing["name"]
        if len(kept) == count or any(name in near and k["name"] in near for near in NEAR for k in kept):
            continue
        size = SIZE[name] * rng.uniform(0.92, 1.08)
        for _ in range(400):
            yaw = FRONT.get(name, 0) + (rng.uniform(-180, 180) if table else rng.uniform(-50, 50))
            lo, hi = maker.extent(thing, size, yaw)
            sx, sz = (hi[0] - lo[0]) / 2, (hi[2] - lo[2]) / 2
            if area[0][1] - area[0][0] < 2 * sx or area[1][1] - area[1][0] < 2 * sz:
                continue
            x, z = rng.uniform(area[0][0] + sx, area[0][1] - sx), rng.uniform(area[1][0] + sz, area[1][1] - sz)
            # Tall things stand behind, so that the picture's middle sees all of them.
            tall = (hi[1] - lo[1]) > 1.5 * SIZE["bowl"] if table else (hi[1] - lo[1]) > 1.0
            if tall and z - sz < (area[1][0] + area[1][1]) / 2 - 0.3 * (area[1][1] - area[1][0]):
                continue
            if all(abs(x - p[0]) > sx + p[2] + gap or abs(z - p[1]) > sz + p[3] + gap for p in placed):
                placed.append((x, z, sx, sz))
                linear, centre = maker.place(thing, size, yaw, x, ground, z)
                insts.append(instance(thing["mesh"], linear, centre, spec=float(rng.uniform(0, 0.25))))
                labels.append(name)
                maker.used[name] = maker.used.get(name, 0) + 1
                kept.append({"name": name, "file": thing["file"], "instance": len(insts) - 1, "centre": centre.tolist(),
                             "box": upright_box(thing["points"] @ linear.T + centre),
                             "lower": [x - sx, ground - (hi[1] - lo[1]), z - sz], "upper": [x + sx, ground, z + sz]})
                break
    warm, k = rng.uniform(0.9, 1.0, 3), rng.uniform(0.42, 0.52)
    light = np.concatenate([[rng.uniform(-1, 1), -2 * half[1] + 0.1, rng.uniform(-1.4, -0.2)],
                            [rng.choice([-1, 1]) * half[0] * 0.9, -1.6, -half[2] * 0.8],
                            warm * k, np.array([0.95, 0.98, 1.0]) * 0.22, [0.42]])
    return np.stack(insts), labels, kept, light, rig(rng, table, ground, half)


def rig(rng, table, ground, half):
    """Twelve cameras on an arc before the scene, as a hand would walk it."""
    if table:
        aim = np.array([0.0, ground - 0.08, 0.02])
        reach, rise, span, focal = rng.uniform(1.05, 1.25), rng.uniform(0.5, 0.75), 58.0, rng.uniform(400, 470)
    else:
        aim = np.array([0.0, -0.55, half[2] * 0.4])
        reach, rise, span, focal = half[2] * 1.25, rng.uniform(0.75, 1.05), 44.0, rng.uniform(330, 390)
    start = rng.uniform(-8, 8) - span / 2
    cams = []
    for v in range(VIEWS):
        angle = math.radians(start + span * v / (VIEWS - 1) + rng.normal() * 0.5)
        wave = 0.06 * reach * math.sin(v * 1.9 + 0.5) + rng.normal() * 0.01
        eye = aim + np.array([math.sin(angle) * reach, -rise + wave, -math.cos(angle) * reach])
        eye[0] = np.clip(eye[0], -half[0] * 0.92, half[0] * 0.92)
        eye[2] = max(eye[2], -half[2] * 0.95)
        cams.append(look(eye, aim + rng.normal(0, 0.015, 3), focal, WIDTH, HEIGHT))
    return cams


def candidates(maker, rng, names):
    """A thing of each name; names that had few turns in earlier scenes come first."""
    for name in sorted(names, key=lambda n: (maker.used.get(n, 0), rng.random())):
        of_name = [t for t in maker.things if t["name"] == name]
        yield of_name[int(rng.integers(len(of_name)))]


def write(maker, number, out, threads):
    insts, labels, kept, light, cams = compose(maker, number)
    folder = os.path.join(out, f"scene_{number:02}")
    for sub in ("images", "masks", "instances"):
        os.makedirs(os.path.join(folder, sub), exist_ok=True)
    # Classes: the things' names, then what surrounds them. The room's box is wall or floor by normal.
    names = sorted({k["name"] for k in kept})
    around = ["table"] * ("table" in labels) + ["floor", "wall"]
    value = {n: i + 1 for i, n in enumerate(names + around)}
    frames, seen = [], np.zeros(len(insts), int)
    for v, cam in enumerate(cams):
        rgb, depth, ids = maker.caster.render(insts, light, cam, WIDTH, HEIGHT, threads)
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        p = cam[:12].reshape(3, 4)
        world_y = p[1, :3] @ np.stack([(x - cam[14]) / cam[12], (y - cam[15]) / cam[13], np.ones_like(x)]).reshape(3, -1) * depth.ravel() + p[1, 3]
        classes = np.array([value.get(n, 0) for n in labels], np.uint8)[ids]
        # The room's box has its floor at y = 0.
        classes = np.where(ids == 0, np.where(world_y.reshape(HEIGHT, WIDTH) > -1e-3, value["floor"], value["wall"]), classes)
        first = kept[0]["instance"] if kept else len(insts)
        seen += np.bincount(ids.ravel(), minlength=len(insts))
        file = f"{v:03}.png"
        Image.fromarray(rgb).save(os.path.join(folder, "images", file))
        Image.fromarray(classes.astype(np.uint8)).save(os.path.join(folder, "masks", file))
        Image.fromarray(np.maximum(ids - first + 1, 0).astype(np.uint8)).save(os.path.join(folder, "instances", file))
        pose = np.concatenate([p, [[0, 0, 0, 1]]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{file}", "transform_matrix": pose.tolist(), "mask_file": f"masks/{file}",
                       "instance_file": f"instances/{file}"})
    focal = float(cams[0][12])
    meta = {"camera_model": "PINHOLE", "coordinate_convention": "OpenGL camera-to-world", "w": WIDTH, "h": HEIGHT,
            "fl_x": focal, "fl_y": focal, "cx": WIDTH / 2, "cy": HEIGHT / 2, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
            "frames": frames}
    share = seen / (VIEWS * WIDTH * HEIGHT)
    objects = [{**k, "instance": k["instance"] - first + 1, "share": round(float(share[k["instance"]]), 5)} for k in kept]
    for name, data in (("transforms.json", meta), ("masks/classes.json", {str(i): n for n, i in value.items()}),
                       ("scene.json", {"surroundings": around, "objects": objects, "seed": [SEED, number]})):
        with open(os.path.join(folder, name), "w") as f:
            json.dump(data, f, indent=1)
    print(folder, ", ".join(f"{o['name']} {100 * o['share']:.1f} %" for o in objects), flush=True)
    return folder


def overview(out, path):
    """A grid of the first, middle and last picture and the middle's labels, one scene a row."""
    cells = []
    for scene in sorted(os.listdir(out)):
        if not scene.startswith("scene_"):
            continue
        row = [Image.open(os.path.join(out, scene, "images", f"{v:03}.png")) for v in (0, VIEWS // 2, VIEWS - 1)]
        mask = np.asarray(Image.open(os.path.join(out, scene, "masks", f"{VIEWS // 2:03}.png"))).astype(int)
        row.append(Image.fromarray(np.stack([mask * 67 % 256, mask * 151 % 256, mask * 29 % 256], -1).astype(np.uint8)))
        cells.append([c.resize((WIDTH // 3, HEIGHT // 3)) for c in row])
    w, h = WIDTH // 3, HEIGHT // 3
    out_img = Image.new("RGB", (w * 8, h * -(-len(cells) // 2)))
    for i, row in enumerate(cells):
        for j, c in enumerate(row):
            out_img.paste(c, ((i % 2 * 4 + j) * w, i // 2 * h))
    out_img.save(path)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--data", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--scenes", type=int, default=20)
    ap.add_argument("--threads", type=int, default=os.cpu_count())
    ap.add_argument("--sheet", help="a picture of every thing, and no scene")
    args = ap.parse_args()
    maker = Maker(args.data)
    if args.sheet:
        return sheet(maker, args.sheet, args.threads)
    for number in range(args.scenes):
        write(maker, number, args.out, args.threads)
    overview(args.out, os.path.join(args.out, "overview.png"))


if __name__ == "__main__":
    main()
