"""README's pictures of the sample: words that find things, and what its lines give.

    PYTHONPATH=clients/python/src SEGSPLAT_BIN=target/release/segsplat \\
        python tests/tools/readme_pictures.py docs/pictures

Writes `words.webp` (animated), `curl.jpg` and `python.jpg`. The masks are the server's answers as
they are, drawn over its views.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import segsplat

WORDS = [
    ("box", (30, 130, 215)),
    ("ball", (245, 150, 20)),
    ("elephant", None),
]
FRAMES, FRAME_MS, SIDE = 14, 110, (480, 360)
PANEL, GAP, BAR = (320, 240), 6, 22


def font(size: int) -> ImageFont.ImageFont:
    try:
        return ImageFont.truetype("DejaVuSans.ttf", size)
    except OSError:
        return ImageFont.load_default(size)


def over(color: np.ndarray, mask: np.ndarray, tint: tuple[int, int, int]) -> np.ndarray:
    """A view with a mask of `tint` over it."""
    out = color[..., :3].astype(float)
    out[mask] = 0.4 * out[mask] + 0.6 * np.array(tint)
    return out.astype(np.uint8)


def labelled(picture: np.ndarray, text: str) -> Image.Image:
    """A panel with a line of text at its lower left."""
    panel = Image.fromarray(picture).convert("RGB").resize(PANEL)
    draw, height = ImageDraw.Draw(panel), PANEL[1]
    right = draw.textbbox((5, 0), text, font=font(13))[2]
    draw.rectangle((0, height - BAR, right + 5, height), fill=(17, 17, 17))
    draw.text((5, height - BAR + 2), text, fill="white", font=font(13))
    return panel


def row(panels: list[Image.Image], to: Path) -> None:
    width, height = PANEL
    out = Image.new("RGB", (len(panels) * (width + GAP) - GAP, height), "white")
    for i, panel in enumerate(panels):
        out.paste(panel, (i * (width + GAP), 0))
    out.save(to, quality=85)


def words(scene: segsplat.Scene, to: Path) -> None:
    """The camera goes from photo to photo; a word after the other is asked."""
    frames = []
    path = np.sin(np.linspace(0, 2 * np.pi, FRAMES * len(WORDS), endpoint=False)) * 0.5 + 0.5
    for i, t in enumerate(path):
        word, tint = WORDS[i // FRAMES]
        at = {"from_": 0, "to": 3, "t": float(t), "width": SIDE[0], "height": SIDE[1]}
        color = scene.view(**at).image
        answer = scene.query(word, **at)[0]
        said = f"{word}   score {answer.score:.2f}" if answer.found else f"{word}   not found"
        if answer.found:
            color = over(color, answer.mask, tint)
        frame = Image.fromarray(color[..., :3])
        draw = ImageDraw.Draw(frame)
        draw.rounded_rectangle((12, 12, 252, 44), 16, fill=(255, 255, 255))
        draw.text((26, 19), said, fill=(17, 17, 17), font=font(15))
        frames.append(frame)
    kept = {"duration": FRAME_MS, "loop": 0, "quality": 55, "method": 6}
    frames[0].save(to, save_all=True, append_images=frames[1:], **kept)


def main(to: Path) -> None:
    flags = ["--renderer", "cpu"]
    with segsplat.local(flags=flags) as client, tempfile.TemporaryDirectory() as made:
        subprocess.run([os.environ["SEGSPLAT_BIN"], "sample", "-o", f"{made}/room"], check=True)
        scene = client.scene(f"{made}/room", semantics="eager", progress=False)
        words(scene, to / "words.webp")
        between = {"from_": 0, "to": 1, "t": 0.5}
        there = scene.view(eye=(0, -1.6, -3.4), target=(0, -0.6, 0), fov=50).image
        depth = scene.view("depth", **between).depth
        near, far = np.percentile(depth[depth > 0], [1, 99])
        grey = (np.clip((depth - near) / (far - near), 0, 1) * 255).astype(np.uint8)
        mask = scene.query("box", **between)[0].mask
        view = scene.view(**between).image
        given = [(view, "view.png"), (there, "there.png"), (grey, "d.npy, as grey")]
        row([labelled(*one) for one in [*given, (mask, "mask.png")]], to / "curl.jpg")
        first = scene.view(from_=0).image
        given = [(first, "scene.view(from_=0)")]
        for word, tint in WORDS[:2]:
            masked = over(first, scene.query(word).masks[0], tint)
            given.append((masked, f'scene.query("{word}").masks'))
        row([labelled(*one) for one in given], to / "python.jpg")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
