"""Packs what a training run needs into three files small enough to travel.

    python prepare.py --data ../../../../shared/data --out /tmp/pack

meshes.npz   named GLB assets as triangles (float16 corners and uv, colours, texture index)
textures.npz JPEG bytes: photographs (BSDS500, COCO, Flickr8k, CamVid, people) and mesh textures
Never packs a photo of `scenes/`, nor a labelled photograph that is held out: those are under evaluation.
"""
import argparse
import hashlib
import io
import json
import os
import sys
import tarfile

import numpy as np
import trimesh
from PIL import Image

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "semantics"))
from heldout import heldout  # noqa: E402

TEX = 256


def jpeg(img, quality=88):
    buf = io.BytesIO()
    img.convert("RGB").save(buf, "JPEG", quality=quality)
    return buf.getvalue()


def square(img, rng):
    w, h = img.size
    s = min(w, h)
    x, y = rng.integers(0, w - s + 1), rng.integers(0, h - s + 1)
    return img.crop((x, y, x + s, y + s)).resize((TEX, TEX), Image.BICUBIC)


def photographs(data, rng, per_set):
    for name in ["bsds500.tar", "coco_panoptic_200.tar", "human_seg.tar", "camvid.tar", "flickr8k_1000.tar"]:
        with tarfile.open(os.path.join(data, "images", name)) as tar:
            files = sorted(n for n in tar.getnames() if "images/" in n and n.endswith(".jpg"))
            files = [f for i, f in enumerate(files) if not heldout(i)]
            rng.shuffle(files)
            for f in files[: per_set.get(name, 10**9)]:
                yield square(Image.open(tar.extractfile(f)).convert("RGB"), rng)


def mesh_triangles(blob, textures, limit):
    """Triangles of one GLB in its own frame, scaled to [-1, 1] about its centre."""
    scene = trimesh.load(io.BytesIO(blob), file_type="glb", force="scene")
    rows, cols, texs, uvs = [], [], [], []
    for name in scene.graph.nodes_geometry:
        matrix, geom_name = scene.graph[name]
        g = scene.geometry[geom_name]
        if not hasattr(g, "faces") or len(g.faces) == 0:
            continue
        v = trimesh.transform_points(g.vertices, matrix)
        f = g.faces
        mat = getattr(g.visual, "material", None)
        uv = getattr(g.visual, "uv", None)
        tex, rgb = -1, np.array([0.7, 0.7, 0.7])
        if mat is not None:
            factor = getattr(mat, "baseColorFactor", None)
            if factor is not None:
                rgb = np.asarray(factor, float)[:3]
                rgb = rgb / 255.0 if rgb.max() > 1.0 else rgb
            img = getattr(mat, "baseColorTexture", None)
            if img is not None and uv is not None:
                key = hashlib.sha256(img.tobytes() + bytes(str(img.size), "ascii")).digest()
                if key not in textures:
                    textures[key] = (len(textures), jpeg(img.convert("RGB").resize((TEX, TEX), Image.BICUBIC)))
                tex = textures[key][0]
        rows.append(v[f])
        uvs.append(uv[f] if uv is not None and len(uv) == len(v) else np.zeros((len(f), 3, 2)))
        cols.append(np.repeat(rgb[None], len(f), 0))
        texs.append(np.full(len(f), tex))
    if not rows:
        return None
    p, uv, c, t = np.concatenate(rows), np.concatenate(uvs), np.concatenate(cols), np.concatenate(texs)
    if len(p) > limit or not np.isfinite(p).all():
        return None
    lo, hi = p.reshape(-1, 3).min(0), p.reshape(-1, 3).max(0)
    p = (p - (lo + hi) / 2) / max((hi - lo).max() / 2, 1e-9)
    uv = uv * [1, -1]  # trimesh counts v from the bottom, the ray caster from the picture's first row
    uv = np.nan_to_num(uv - np.floor(uv.reshape(-1, 2).min(0)))
    return p.astype(np.float16), uv.astype(np.float16), (c * 255).clip(0, 255).astype(np.uint8), t.astype(np.int16)


def main():
    ap = argparse.ArgumentParser()
    ap.add_argument("--data", required=True)
    ap.add_argument("--out", required=True)
    ap.add_argument("--triangles", type=int, default=3200)
    ap.add_argument("--flickr", type=int, default=500, help="photographs of Flickr8k among the textures")
    args = ap.parse_args()
    os.makedirs(args.out, exist_ok=True)
    rng = np.random.default_rng(7)

    textures, parts, counts, names = {}, [], [], []
    with tarfile.open(os.path.join(args.data, "assets3d", "assets3d.tar")) as tar:
        index = json.load(tar.extractfile("index.json"))
        for item in index:
            got = mesh_triangles(tar.extractfile(item["file"]).read(), textures, args.triangles)
            if got is not None:
                parts.append(got)
                counts.append(len(got[0]))
                names.append(item["file"])
        extra = [jpeg(Image.open(tar.extractfile(n)).resize((TEX, TEX))) for n in tar.getnames() if n.startswith("textures/")]
    np.savez_compressed(
        os.path.join(args.out, "meshes.npz"),
        p=np.concatenate([x[0] for x in parts]), uv=np.concatenate([x[1] for x in parts]),
        rgb=np.concatenate([x[2] for x in parts]), tex=np.concatenate([x[3] for x in parts]),
        counts=np.array(counts), names=np.array(names),
    )
    asset = [v[1] for v in sorted(textures.values())]
    photos = [jpeg(p) for p in photographs(args.data, rng, {"flickr8k_1000.tar": args.flickr})]
    blobs = asset + extra + photos
    np.savez(
        os.path.join(args.out, "textures.npz"),
        blob=np.frombuffer(b"".join(blobs), np.uint8),
        offsets=np.cumsum([0] + [len(b) for b in blobs]), assets=len(asset),
    )
    for f in os.listdir(args.out):
        print(f, os.path.getsize(os.path.join(args.out, f)) >> 10, "KiB")
    print("meshes", len(counts), "triangles", sum(counts), "asset textures", len(asset), "photos", len(photos) + len(extra))


if __name__ == "__main__":
    main()
