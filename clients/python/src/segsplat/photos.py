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

from .types import CallerLimits
from .wire import Part

#: Photos of more bytes than these are made smaller before they are sent, though the server takes
#: more: its networks look no closer.
WHOLE_MAX = 256 << 20

#: Width and height of a photo before it was made smaller, by its name.
Sizes = dict[str, tuple[int, int]]


def fit(
    photos: Sequence[Part], limits: CallerLimits | None, may_shrink: bool = True
) -> tuple[list[Part], Sizes]:
    """The photos as they are sent. An upload over the limit has some of them, evenly chosen, and
    where that is not enough all are made smaller; so are photos of too many pixels. None gets
    smaller than the server keeps it. A warning tells what was done.

    limits: those of the server; None: the photos go as they are.
    may_shrink: whether the cameras say for which size of the photos they are.
    """
    sent, before = list(photos), _bytes(photos)
    if not limits:
        return sent, {}
    room, most = min(limits.upload_bytes_max, WHOLE_MAX), limits.photos_max
    if before > room and len(sent) > most:
        step = (len(photos) - 1) / max(most - 1, 1)
        sent = [photos[round(i * step)] for i in range(most)]
        _tell(
            f"{len(photos)} photos have {before / 1e6:.0f} MB; {most} are sent, evenly chosen: a "
            "scene takes no more"
        )
    if not may_shrink:
        return sent, {}
    every = _bytes(sent) > room
    count = max(len(sent), 1)
    # What the server keeps of those that networks see, and what fits: half a byte a pixel.
    pixels = min(
        limits.photos_pixels_kept_max / min(count, limits.network_photos_max),
        2 * room / count if every else math.inf,
    )
    sizes: Sizes = {}
    fitted: list[Part] = []
    for part in sent:
        path = part.content if isinstance(part.content, Path) else None
        if path and (small := _smaller(path, limits, every, pixels)):
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


def _smaller(
    path: Path, limits: CallerLimits, every: bool, pixels: float
) -> tuple[bytes, tuple[int, int]] | None:
    """A photo as small as the server keeps one, with so many pixels at most, and its size before;
    None where it goes as it is.
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
            side = limits.photo_side_kept_max / max(width, height)
            scale = min(1, side, math.sqrt(pixels / (width * height)))
            if scale == 1 or (not every and width * height <= limits.photo_pixels_max):
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
