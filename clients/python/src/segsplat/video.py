"""Photos of a video, by the program `ffmpeg` where it is there: sharp frames, spread over the
motion of the camera. The command line does the same (`src/cli/video.rs`).
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidRequest
from .wire import Part

#: Endings of the names of videos.
VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".webm", ".mkv", ".avi", ".mpg", ".3gp"})
#: Frames a second that are looked at, and their width, height and side of a square, pixels.
RATE, WIDTH, HEIGHT, SQUARE = 10, 320, 240, 16
#: Frames that are chosen for each second, at least and at most.
A_SECOND, CHOSEN_MIN, CHOSEN_MAX = 2, 16, 64
#: Longest side of a photo, pixels: a scene keeps no larger ones.
SIDE_MAX = 2_048
#: Motion that a frame has at least, grey levels: one of a camera that stands still counts too.
MOTION_MIN = 0.05


def frames_of(video: Path) -> list[Part]:
    """Frames as parts of an upload, named by their times."""
    looks = _looked_at(video)
    if not looks:
        raise InvalidRequest(f"{video}: ffmpeg finds no frame in it")
    count = min(max(len(looks) * A_SECOND // RATE, CHOSEN_MIN), CHOSEN_MAX)
    places = chosen(looks, count)
    each = "+".join(f"eq(n\\,{place})" for place in places)
    # Numbered anew, so that no frame is repeated to fill a gap.
    numbered = f"fps={RATE},select={each},setpts=N/{RATE}/TB"
    small = f"w='min({SIDE_MAX},iw)':h='min({SIDE_MAX},ih)':force_original_aspect_ratio=decrease"
    jpeg = ["-pix_fmt", "yuvj420p", "-q:v", "2", "-c:v", "mjpeg", "-f", "image2pipe"]
    with _ffmpeg(video, f"{numbered},scale={small}", ["-r", f"{RATE}", *jpeg]) as ffmpeg:
        assert ffmpeg.stdout
        # Inside of a JPEG its end marker does not occur.
        frames = [one + b"\xff\xd9" for one in ffmpeg.stdout.read().split(b"\xff\xd9")[:-1]]
    if ffmpeg.returncode or len(frames) != len(places):
        raise InvalidRequest(f"{video}: ffmpeg gave {len(frames)} of {len(places)} frames")
    named = zip(places, frames, strict=True)
    return [Part("photo", f"{place / RATE:08.2f}s.jpg", frame) for place, frame in named]


def _looked_at(video: Path) -> list[tuple[float, float]]:
    """Sharpness of each frame, and how far it is from the one before, grey levels."""
    looks: list[tuple[float, float]] = []
    before: NDArray[np.float64] | None = None
    raw = ["-f", "rawvideo"]
    with _ffmpeg(video, f"fps={RATE},scale={WIDTH}:{HEIGHT},format=gray", raw) as ffmpeg:
        assert ffmpeg.stdout
        while len(pixels := ffmpeg.stdout.read(WIDTH * HEIGHT)) == WIDTH * HEIGHT:
            frame = np.frombuffer(pixels, np.uint8).reshape(HEIGHT, WIDTH).astype(np.float64)
            around = frame[:-2, 1:-1] + frame[2:, 1:-1] + frame[1:-1, :-2] + frame[1:-1, 2:]
            sharpness = float(np.square(frame[1:-1, 1:-1] - around / 4).mean())
            shape = (HEIGHT // SQUARE, SQUARE, WIDTH // SQUARE, SQUARE)
            squares = frame.reshape(shape).mean((1, 3))
            # Other light is no motion.
            squares = squares - squares.mean()
            motion = 0.0 if before is None else float(np.abs(squares - before).mean())
            looks.append((sharpness, motion))
            before = squares
    if ffmpeg.returncode:
        raise InvalidRequest(f"{video}: ffmpeg does not read it")
    return looks


def chosen(looks: Sequence[tuple[float, float]], count: int) -> list[int]:
    """Places of `count` frames at most: the motion is cut into equal parts, and the sharpest frame
    of each is taken.

    looks: sharpness and motion of each frame.
    """
    motions = np.maximum([motion for _, motion in looks], MOTION_MIN)
    # The middle of a frame's own motion says in which part it is.
    middles = np.cumsum(motions) - motions / 2
    parts = (middles / motions.sum() * count).astype(int)
    best: dict[int, int] = {}
    for place, part in enumerate(parts.tolist()):
        if part not in best or looks[place][0] > looks[best[part]][0]:
            best[part] = place
    return sorted(best.values())


def _ffmpeg(video: Path, frames: str, kind: list[str]) -> subprocess.Popen[bytes]:
    program = shutil.which("ffmpeg")
    if program is None:
        raise InvalidRequest(
            f"{video}: it is a video, and there is no ffmpeg; install it (apt install ffmpeg, brew "
            "install ffmpeg), or make photos of the video elsewhere and give their folder"
        )
    read = [program, "-nostdin", "-v", "error", "-i", str(video), "-an", "-sn", "-vf", frames]
    return subprocess.Popen([*read, *kind, "-"], stdout=subprocess.PIPE)
