"""The Gaussians themselves, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import BadAnswer
from .types import Floats

_TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2", "uint": "<u4"}
#: The constant of spherical harmonics of degree 0.
_SH0 = 0.28209479177387814


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians in the world frame and units of the upload."""

    #: [N, 3] centres.
    means: NDArray[np.float32]
    #: [N, 4] rotations, w x y z, unit.
    quats: NDArray[np.float32]
    #: [N, 3] standard deviations along the rotated axes, linear.
    scales: NDArray[np.float32]
    #: [N] 0 to 1.
    opacities: NDArray[np.float32]
    #: [N, 3] sRGB, 0 to 1: spherical harmonics of degree 0.
    colors: NDArray[np.float32]
    #: [N] entry of the scene's bank, counted from 1; 0 where there is none.
    semantic_index: NDArray[np.uint16]

    @property
    def covariances(self) -> Floats:
        """[N, 3, 3] R diag(scales²) Rᵀ."""
        w, x, y, z = self.quats.T.astype(np.float64)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        sides = np.moveaxis(np.array(rows), 2, 0) * self.scales[:, None, :]
        return np.asarray(sides @ sides.swapaxes(1, 2))

    @staticmethod
    def of_ply(data: bytes) -> Gaussians:
        """From a PLY of 3DGS, as `Scene.export` writes it."""
        head, found, body = data.partition(b"end_header\n")
        lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
        if not found or ["format", "binary_little_endian", "1.0"] not in lines:
            raise BadAnswer("the export is no little-endian PLY")
        kinds = [(line[2], _TYPES[line[1]]) for line in lines if line[:1] == ["property"]]
        (count,) = (int(line[2]) for line in lines if line[:2] == ["element", "vertex"])
        rows = np.frombuffer(body, np.dtype(kinds), count)

        def columns(*names: str) -> NDArray[np.float32]:
            return np.stack([rows[name] for name in names], axis=-1).astype(np.float32)

        quats = columns("rot_0", "rot_1", "rot_2", "rot_3")
        colors = 0.5 + _SH0 * columns("f_dc_0", "f_dc_1", "f_dc_2")
        return Gaussians(
            means=columns("x", "y", "z"),
            quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            scales=np.exp(columns("scale_0", "scale_1", "scale_2")),
            opacities=(1 / (1 + np.exp(-columns("opacity")[:, 0]))).astype(np.float32),
            colors=np.clip(colors, 0, 1),
            semantic_index=rows["semantic_index"].astype(np.uint16),
        )
