"""Cut-outs of the named shapes: each mesh alone, from several sides, in several lights, with exact outlines.

    python render_things.py --data ../../../../shared/data --furniture FOLDER --out things.npz

Shapes: assets3d.tar (less heldout_meshes.txt) and Debian's sweethome3d-furniture (CC0 and CC-BY 3.0; FOLDER holds
its .sh3f archives, each unpacked into a folder of its name). things.npz: `blob` (WebP with alpha, one after
another), `offsets`, `name` (index into `names`).
"""
import argparse
import io
import json
import os
import re
import tarfile
import warnings

import numpy as np
import trimesh
from PIL import Image

from eval_scenes import HERE, Caster, box, instance, look, mesh_triangles, rows_of, turn, upright
from names import plain_name, read_index

SEED, SIDE = 1700, 128
# Names that say more than what is seen, and the French ones of the source.
SAY = {
    "tv": "television", "wall flat tv": "television", "toilets unit": "toilet", "vw new beetle": "car", "peugeot 308 cc": "car", "smart car": "car",
    "car model": "toy car", "apple imac 1998": "computer", "children game": "toy", "female": "woman", "male": "man", "sitting male": "man",
    "cctv": "security camera", "mocassin": "shoe", "bootie": "shoe", "penbox": "pencil box", "cooker": "stove", "double hung window": "window",
    "table tennis": "table tennis table", "apples": "apple", "baby high chair": "high chair", "washbasin": "sink", "large pan": "pan",
    "double french window 3 panes": "window", "quadruple french window 3 panes": "window", "old jar": "jar", "little lamp": "lamp",
}
SKIP = re.compile(r"parking|plug|socket|switch|escalator|stair|rail|island|pallet|column|technical|slot|unit$|text|compass|arrow|step|wall$|floor|shutter|beam|roof|area|light source")
DROP = re.compile(r"\b(left|right|small|large|little|big|old|modern|simple|indoor|outdoor|decorative|single|double|triple|square|round|straight|corner|half|type|wall mounted|with .*|\d+)\b")


def furniture_name(name):
    name = re.sub(r"\(.*?\)|[^a-z ]", " ", name.lower().replace("-", " "))
    name = re.sub(r"\s+", " ", name).strip()
    if name in SAY:
        return SAY[name]
    kept = re.sub(r"\s+", " ", DROP.sub(" ", name)).strip() or name
    return SAY.get(kept, kept)


def read_assets(data, textures):
    """(name, rows of triangles, upright turn) of each mesh of assets3d that training may see."""
    with open(os.path.join(HERE, "heldout_meshes.txt")) as f:
        kept = set(f.read().split())
    with tarfile.open(os.path.join(data, "assets3d", "assets3d.tar")) as tar:
        for entry in read_index(data):
            if entry["file"] in kept:
                continue
            got = mesh_triangles(tar.extractfile(entry["file"]).read(), textures, 10000)
            if got is not None:
                yield plain_name(entry), got, upright(entry)


def read_furniture(data, folder, textures, faces, each):
    seen = {}
    for entry in json.load(open(os.path.join(data, "index", "sweethome3d.json"))):
        name = furniture_name(entry["name"])
        if SKIP.search(entry["name"].lower()) or int(entry["faces"]) > faces or seen.get(name, 0) == each:
            continue
        seen[name] = seen.get(name, 0) + 1
        try:
            shape = trimesh.load(os.path.join(folder, entry["model"]), force="scene")
            # By way of GLB, so that one reader serves both.
            got = mesh_triangles(shape.export(file_type="glb"), textures, 60000)
        except Exception as fault:  # a file that trimesh cannot read is left out, and said
            print("left out", entry["model"], str(fault)[:80], flush=True)
            continue
        if got is not None:
            yield name, got, np.diag([1.0, -1.0, -1.0])


def main():
    ap = argparse.ArgumentParser()
    for name in ["data", "furniture", "out"]:
        ap.add_argument("--" + name, required=True)
    ap.add_argument("--views", type=int, default=8)
    ap.add_argument("--faces", type=int, default=40000, help="of furniture: shapes with more are left out")
    ap.add_argument("--each", type=int, default=10**9, help="of furniture: shapes of one name")
    ap.add_argument("--most", type=int, default=10**9)
    ap.add_argument("--look", help="a picture of some")
    args = ap.parse_args()
    warnings.filterwarnings("ignore")
    rng = np.random.default_rng(SEED)
    names, blobs, of, cells, count = {}, [], [], [], 0
    for source in (lambda t: read_assets(args.data, t), lambda t: read_furniture(args.data, args.furniture, t, args.faces, args.each)):
        textures = {}
        shapes = []
        for i, shape in enumerate(source(textures)):
            if i >= args.most:
                break
            shapes.append(shape)
        images = [np.asarray(Image.open(io.BytesIO(v[1])).convert("RGB")) for v in sorted(textures.values())] or [np.full((256, 256, 3), 180, np.uint8)]
        meshes = [box()] + [rows_of(p.astype(np.float32), uv.astype(np.float32), rgb / 255.0, tex) for _, (p, uv, rgb, tex), _ in shapes]
        caster = Caster(meshes, images)
        for k, (name, (p, *_), up) in enumerate(shapes):
            for view in range(args.views):
                yaw, pitch = rng.uniform(-180, 180), np.deg2rad(rng.uniform(3, 50))
                linear = turn(yaw) @ up
                corners = p.astype(float).reshape(-1, 3) @ linear.T
                reach = np.linalg.norm(corners, axis=1).max()
                far = reach * rng.uniform(2.6, 4.5)
                eye = np.array([0, -np.sin(pitch), -np.cos(pitch)]) * far
                tint = rng.uniform(0.75, 1.1, 3) if rng.random() < 0.3 else (1, 1, 1)
                thing = instance(k + 1, linear, np.zeros(3), tint=tint, spec=float(rng.uniform(0, 0.3)), casts=1.0)
                key = rng.uniform([-4, -5, -5], [4, -1, -2])
                fill = rng.uniform([-4, -3, -5], [4, 0, -2])
                light = np.concatenate([key, fill, rng.uniform(0.9, 1, 3) * rng.uniform(0.35, 0.75), rng.uniform(0.9, 1, 3) * rng.uniform(0.1, 0.3), [rng.uniform(0.25, 0.55)]])
                cam = look(eye, [0, 0, 0], SIDE * 0.48 * far / reach, SIDE, SIDE)
                rgb, _, ids = caster.render([thing], light, cam, SIDE, SIDE, 1)
                mask = ids >= 0
                if mask.mean() < 0.01:
                    continue
                img = Image.fromarray(np.concatenate([rgb, (mask * 255).astype(np.uint8)[..., None]], -1))
                img = img.crop(img.getchannel("A").getbbox())
                if k % 11 == 0 and view == 0:
                    cells.append((name, img))
                buf = io.BytesIO()
                img.save(buf, "WEBP", quality=60, method=3)
                blobs.append(buf.getvalue())
                of.append(names.setdefault(name, len(names)))
            count += 1
            if count % 100 == 0:
                print(count, "shapes", sum(map(len, blobs)) >> 20, "MiB", flush=True)
    np.savez(args.out, blob=np.frombuffer(b"".join(blobs), np.uint8), offsets=np.cumsum([0] + [len(b) for b in blobs]), name=np.array(of), names=np.array(list(names)))
    print("shapes", count, "names", len(names), "pictures", len(blobs), os.path.getsize(args.out) >> 20, "MiB")
    if args.look:
        from PIL import ImageDraw
        out = Image.new("RGB", (16 * 100, -(-len(cells) // 16) * 100), (60, 60, 60))
        for i, (name, img) in enumerate(cells):
            img.thumbnail((96, 96))
            out.paste(img, (i % 16 * 100, i // 16 * 100), img)
            ImageDraw.Draw(out).text((i % 16 * 100, i // 16 * 100), name, fill=(255, 255, 0))
        out.save(args.look)


if __name__ == "__main__":
    main()
