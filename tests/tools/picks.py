"""Picks and views of a large scene by some programs in turn: times, and whether they say the same.

    PYTHONPATH=clients/python/src:tests/page:scripts \\
        python tests/tools/picks.py --gaussians 5000000 OLD/segsplat NEW/segsplat

The scene is the room of `tests/page/large.py`. Each program has a server of its own (`--renderer
cpu`); a view of 1280 x 720 is drawn first. The first pick is told alone: it may make blocks.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import time
from pathlib import Path

import numpy as np
from large import room

import segsplat

SIZE = {"width": 1280, "height": 720}
PIXELS = [(x, y) for y in (0.5, 200.5, 360.5, 719.5) for x in (0.5, 400.5, 900.5)]


def timed(call):  # noqa: ANN001, ANN201
    begun = time.monotonic()
    answer = call()
    return answer, 1000 * (time.monotonic() - begun)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("programs", nargs="+", type=Path)
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    room_file = Path(os.environ.get("TMPDIR", "/tmp")) / f"room-{os.getpid()}.splat"
    room_file.write_bytes(room(given.gaussians))
    with contextlib.ExitStack() as stack:
        stack.callback(room_file.unlink)
        scenes = []
        for program in given.programs:
            client = stack.enter_context(segsplat.local(
                program=program, flags=["--renderer", "cpu"], env={"SEGSPLAT_REFINE": "off"}))
            scenes.append(client.scene(room_file, progress=False))
        times: list[dict[str, list[float]]] = [{"view": [], "pick": []} for _ in scenes]
        said: list[list] = [[] for _ in scenes]
        for scene, of in zip(scenes, times, strict=True):
            of["first pick"] = [timed(lambda s=scene: s.pick(640.5, 360.5, from_=0, **SIZE))[1]]
            scene.view(from_=0, **SIZE)
        for _ in range(given.rounds):
            for scene, of, answers in zip(scenes, times, said, strict=True):
                of["view"].append(timed(lambda s=scene: s.view(from_=0, **SIZE))[1])
                for x, y in PIXELS:
                    answer, ms = timed(lambda s=scene, x=x, y=y: s.pick(x, y, from_=0, **SIZE))
                    of["pick"].append(ms)
                    answers.append(repr(answer))
        for program, of in zip(given.programs, times, strict=True):
            medians = ", ".join(f"{what} {np.median(ms):.0f} ms" for what, ms in of.items())
            print(f"{program}: {medians} (medians; load {os.getloadavg()[0]:.0f})")
        same = all(answers == said[0] for answers in said)
        print(f"{len(said[0])} answers of each are {'the same' if same else 'DIFFERENT'}")


if __name__ == "__main__":
    main()
