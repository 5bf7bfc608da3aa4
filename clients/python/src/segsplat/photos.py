"""Photos that are too many or too large for one upload are chosen and made smaller before they are
sent. The page does the same (`web/capture.js`).
"""

from __future__ import annotations

import dataclasses
import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

from .wire import Part

#: The server's limits as it ships: photos of a scene, bytes of an upload, pixels of a photo.
PHOTOS_MAX = 64
UPLOAD_BYTES_MAX = 256 << 20
PHOTO_PIXELS_MAX = 24_000_000
#: What it keeps: a photo's longer side, and pixels of all photos together.
SIDE_KEPT = 2_048
PIXELS_KEPT = 50_000_000

#: Width and height of a photo before it was made smaller, by its name.
Sizes = dict[str, tuple[int, int]]


def fit(photos: Sequence[Part], may_shrink: bool = True) -> tuple[list[Part], Sizes]:
    """The photos as they are sent. An upload over the limit has some of them, evenly chosen, and
    where that is not enough all are made smaller; so are photos of too many pixels. None gets
    smaller than the server keeps it. A warning tells what was done.

    may_shrink: whether the cameras say for which size of the photos they are.
    """
    sent, before = list(photos), _bytes(photos)
    if before > UPLOAD_BYTES_MAX and len(sent) > PHOTOS_MAX:
        step = (len(photos) - 1) / (PHOTOS_MAX - 1)
        sent = [photos[round(i * step)] for i in range(PHOTOS_MAX)]
        _tell(
            f"{len(photos)} photos have {before / 1e6:.0f} MB; {PHOTOS_MAX} are sent, evenly "
            "chosen: a scene takes no more"
        )
    if not may_shrink:
        return sent, {}
    every = _bytes(sent) > UPLOAD_BYTES_MAX
    sizes: Sizes = {}
    fitted: list[Part] = []
    for part in sent:
        small = _smaller(part.content, every, len(sent)) if isinstance(part.content, Path) else None
        if small:
            part, sizes[part.name] = dataclasses.replace(part, content=small[0]), small[1]
        fitted.append(part)
    if sizes:
        became = f"{_bytes(sent) / 1e6:.1f} MB became {_bytes(fitted) / 1e6:.1f} MB"
        _tell(
            f"{len(sizes)} photos were made smaller before sending, to what the server keeps of a "
            f"photo: {became}"
        )
    return fitted, sizes


def _bytes(parts: Sequence[Part]) -> int:
    contents = (part.content for part in parts)
    return sum(one.stat().st_size if isinstance(one, Path) else len(one) for one in contents)


def _tell(what: str) -> None:
    warnings.warn(what, stacklevel=2)


def _smaller(path: Path, every: bool, count: int) -> tuple[bytes, tuple[int, int]] | None:
    """A photo as small as the server keeps one of so many, and its size before; None where it goes
    as it is.
    """
    try:
        from PIL import Image
    except ImportError:
        if every:
            _tell("the photos are over the limit of one upload; with Pillow they are made smaller")
        return None
    try:
        with Image.open(path) as image:
            width, height = image.size
            kept = PIXELS_KEPT / min(count, PHOTOS_MAX)
            scale = min(1, SIDE_KEPT / max(width, height), math.sqrt(kept / (width * height)))
            if scale == 1 or (not every and width * height <= PHOTO_PIXELS_MAX):
                return None
            size = (round(width * scale), round(height * scale))
            kind, exif = image.format, image.info.get("exif", b"")
            image.draft("RGB", size)  # a JPEG is read at reduced scale
            whole = image.convert("RGBA") if image.mode == "P" else image
            file = io.BytesIO()
            # Not turned by its EXIF, which it keeps: cameras are of the picture as stored.
            whole.resize(size, Image.Resampling.LANCZOS).save(file, kind, quality=95, exif=exif)
            return file.getvalue(), (width, height)
    except (OSError, ValueError, Image.DecompressionBombError):
        return None  # the server says what is wrong with it
