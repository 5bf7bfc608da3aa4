"""Many Gaussians as a `.splat` file: a room with walls, floor and ceiling of small ones."""

from __future__ import annotations

import numpy as np

SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def room(count: int) -> bytes:
    """`count` Gaussians on the inside of a box of 4 units; 32 bytes each."""
    random = np.random.default_rng(18)
    splats = np.zeros(count, SPLAT)
    places = random.uniform(-2, 2, (count, 3)).astype("f4")
    side = random.integers(0, 6, count)
    places[np.arange(count), side // 2] = np.where(side % 2, 2, -2)
    splats["mean"] = places
    size = 3 * 4 / np.sqrt(count)
    splats["scale"] = size * random.uniform(0.3, 1.0, (count, 3))
    checks = (np.floor(places * 2).sum(axis=1) % 2 * 80).astype("u1")
    colors = np.array([[200, 60, 60], [60, 160, 60], [60, 60, 200], [200, 200, 60], [60, 180, 180],
                       [180, 60, 180]], "u1")[side]
    splats["rgba"][:, :3] = np.maximum(colors, checks[:, None]) - checks[:, None] // 2
    splats["rgba"][:, 3] = 230
    splats["quat"] = [255, 128, 128, 128]
    return splats.tobytes()
