"""Rendered views as arrays."""

from __future__ import annotations

import io
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import BadAnswer
from .png import encode_png
from .types import Camera, Floats, Kind, intrinsics

#: The format in which one picture of a kind comes: samples without a codec, or numbers.
FORMATS: Mapping[Kind, str] = {"color": "rgb8", "mask": "grey8"}


class View:
    """Pictures of one camera. `image` and the others are there where their kind was asked for."""

    def __init__(self, camera: Camera, arrays: Mapping[Kind, NDArray[Any]]) -> None:
        #: The camera of all pictures. Of a crop, that of the part.
        self.camera = camera
        #: The arrays by kind, in the order asked for.
        self.arrays = dict(arrays)

    def _of(self, kind: Kind) -> NDArray[Any]:
        if kind not in self.arrays:
            has = ", ".join(self.arrays)
            raise AttributeError(f"the view was asked with kinds={has}, without {kind}")
        return self.arrays[kind]

    @property
    def _first(self) -> Kind:
        return next(iter(self.arrays))

    @property
    def image(self) -> NDArray[np.uint8]:
        """[H, W, 3] sRGB, kind "color"."""
        return self._of("color")

    @property
    def depth(self) -> NDArray[np.float32]:
        """[H, W] expected depth along the camera's axis, world units of the upload (metres where
        the cameras are in metres); 0 where nothing is.
        """
        return self._of("depth")

    @property
    def alpha(self) -> NDArray[np.float32]:
        """[H, W] accumulated opacity, 0 to 1."""
        return self._of("alpha")

    @property
    def holes(self) -> NDArray[np.float32]:
        """[H, W] what edits uncovered and nothing fills, 0 to 1."""
        return self._of("holes")

    @property
    def mask(self) -> NDArray[np.bool_]:
        """[H, W] where the relevancy of the text is 0.5 or more."""
        return self._of("mask")

    @property
    def relevancy(self) -> NDArray[np.float32]:
        """[H, W] how well each pixel fits the text, 0 to 1."""
        return self._of("relevancy")

    @property
    def semantics(self) -> NDArray[np.uint16]:
        """[H, W] entry of the scene's bank, counted from 1; 0 where there is none. The pixels of a
        match are those of its `entries`.
        """
        return self._of("semantics")

    @property
    def points(self) -> Floats:
        """[H, W, 3] world points of the depth; NaN where nothing is."""
        return self.camera.unproject(self.depth)

    def pixels(self, kind: Kind | None = None) -> NDArray[np.uint8]:
        """What a picture looks like: [H, W, 3], or [H, W] grey. Depth is bright where it is near.
        Without a kind, the first one.
        """
        kind = kind or self._first
        array = self._of(kind)
        if array.dtype == np.uint8:
            return typing.cast(NDArray[np.uint8], array)
        if kind == "semantics":
            colours = np.random.default_rng(1).integers(64, 256, (array.max() + 1, 3), np.uint8)
            colours[0] = 0
            return typing.cast(NDArray[np.uint8], colours[array])
        return _levels(_nearness(array) if kind == "depth" else array.astype(np.float32))

    def save(self, path: str | Path, kind: Kind | None = None) -> Path:
        """Writes a picture: `.png` as it looks, `.npy` the array. Without a kind, the first one."""
        path = Path(path)
        if path.suffix == ".npy":
            np.save(path, self._of(kind or self._first))
        elif path.suffix == ".png":
            path.write_bytes(encode_png(self.pixels(kind)))
        else:
            raise ValueError(f"{path.name}: a view can be saved as .png or .npy")
        return path

    def _repr_png_(self) -> bytes:
        return encode_png(self.pixels())

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height}"
        return f"<View {size} px: {', '.join(self.arrays)}>"


def _levels(values: NDArray[Any]) -> NDArray[np.uint8]:
    """0 to 255 of 0 to 1, as the server rounds."""
    return np.floor(255 * np.clip(values, 0, 1) + 0.5).astype(np.uint8)  # type: ignore


def _nearness(depth: NDArray[Any]) -> NDArray[Any]:
    seen = depth > 0
    inverse = np.where(seen, 1 / np.where(seen, depth, 1), 0)
    low, high = np.percentile(inverse[seen], [1, 99]) if seen.any() else (0.0, 1.0)
    return np.where(seen, 0.15 + 0.85 * (inverse - low) / max(high - low, 1e-12), 0)


def picture(kind: Kind, headers: Mapping[str, str], body: bytes) -> tuple[Camera, NDArray[Any]]:
    """The camera and the array of one answered picture."""
    if headers.get("content-type") == "application/x-npy":
        array: NDArray[Any] = np.load(io.BytesIO(body), allow_pickle=False)
        if kind == "color":
            array = _levels(array)
        elif kind == "semantics":
            array = array.astype(np.uint16)
    elif "x-shape" in headers:
        shape = [int(side) for side in headers["x-shape"].split(",")]
        array = np.frombuffer(body, np.uint8).reshape(shape)
    else:
        raise BadAnswer(f"a view came as {headers.get('content-type')!r}, not as an array")
    if kind == "mask":
        array = array > 0
    height, width = array.shape[:2]
    fx, fy, cx, cy = (float(number) for number in headers["x-intrinsics"].split(","))
    pose = np.array([float(number) for number in headers["x-camera-to-world"].split(",")])
    return Camera(intrinsics(fx, fy, cx, cy), pose.reshape(4, 4), width, height), array
