"""README.md as a newcomer follows it: its blocks as they are written, the page's first hour, photos
without cameras. Each step ends as a person expects, or the walk stops there. Prints the seconds of
each step.

    scripts/fresh newcomer                         in a bare Debian 12
    python3 tests/tools/newcomer.py [--program FILE] [--photos FOLDER]

--program  a program that is built already, in place of `make build`
--photos   photos whose cameras COLMAP is to find; generated ones where it is left out

It needs what README names, and the browser of `scripts/setup --ci` for the page. Where port 8080 is
taken, the blocks get another port.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
RELEASE = ROOT / "target/release/segsplat"
PORT = 8080


def blocks(section: str, kind: str = "sh") -> list[str]:
    """The blocks of a section of the README."""
    body = re.split(rf"^## {re.escape(section)}$", README, flags=re.M)[1]
    body = re.split(r"^## ", body, flags=re.M)[0]
    found = re.findall(rf"^```{kind}\n(.*?)^```$", body, flags=re.M | re.S)
    assert found, f"README has no {kind} in {section!r}"
    return [str(one) for one in found]


@contextmanager
def step(name: str) -> Iterator[None]:
    """Prints the time of a step."""
    begun = time.monotonic()
    yield
    print(f"newcomer: {name}: {time.monotonic() - begun:.1f} s", flush=True)


class Walk:
    """Where the newcomer is: the port of the server, and a folder for what is made."""

    def __init__(self, made: Path) -> None:
        self.made = made
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            port = PORT if probe.connect_ex(("127.0.0.1", PORT)) else 0
        if not port:
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = probe.getsockname()[1]
        self.host = f"127.0.0.1:{port}"
        self.env = {**os.environ, "SEGSPLAT_URL": f"http://{self.host}"}

    def shell(self, lines: str) -> str:
        """Runs lines of the README where they stand, in the root; what they print."""
        lines = lines.replace(f"127.0.0.1:{PORT}", self.host)
        lines = lines.replace("/tmp/photos", f"{self.made}/photos")
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", lines], cwd=ROOT, env=self.env,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            sys.exit(f"newcomer: rc {done.returncode} of\n{lines}\n{done.stdout}\n{done.stderr}")
        return done.stdout

    @contextmanager
    def server(self, program: Path, cwd: Path = ROOT) -> Iterator[None]:
        """`serve` until the block ends; its words where it does not answer."""
        command = [program, "serve", "--listen", self.host, "--data-dir", self.made / "data"]
        with (self.made / "server.log").open("w") as log:
            server = subprocess.Popen(command, cwd=cwd, stdout=log, stderr=log)
        try:
            for _ in range(600):
                assert server.poll() is None, (self.made / "server.log").read_text()
                try:
                    urllib.request.urlopen(f"http://{self.host}/readyz").close()
                    break
                except urllib.error.URLError:
                    time.sleep(0.1)
            yield
        finally:
            server.send_signal(signal.SIGTERM)
            assert server.wait(timeout=60) == 0


def size_of(png: Path) -> tuple[int, int]:
    """Width and height."""
    head = png.read_bytes()[:24]
    assert head.startswith(b"\x89PNG"), png
    return struct.unpack(">II", head[16:24])


def levels(png: Path) -> set[int]:
    """The bytes of the lines of a picture: many where it shows much."""
    data, at, packed = png.read_bytes(), 8, b""
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at:at + 4]), data[at + 4:at + 8]
        packed += data[at + 8:at + 8 + length] if kind == b"IDAT" else b""
        at += 12 + length
    return set(zlib.decompress(packed))


def in_python(walk: Walk) -> None:
    """The block for a shell ends with `python`, into which the other block is typed."""
    [lines], [code] = blocks("In Python"), blocks("In Python", "python")
    assert lines.endswith("\npython\n"), lines
    (walk.made / "typed.py").write_text(code)
    said = walk.shell(f"{lines.rstrip()} {walk.made}/typed.py")
    first = json.loads((ROOT / "sample/transforms.json").read_text())["frames"][0]
    width, height = size_of(ROOT / "sample" / first["file_path"])
    assert f"(1, {height}, {width})" in said, f"the mask is of another size: {said}"
    assert size_of(ROOT / "view.png")[0] > 300 and len(levels(ROOT / "view.png")) > 100


def objects_in(text: str) -> Iterator[dict]:
    """The JSON objects of an output, which `curl` prints one right after the other."""
    decoder, at = json.JSONDecoder(), text.find("{")
    while at >= 0:
        value, end = decoder.raw_decode(text, at)
        yield value
        at = text.find("{", end)


def over_http(walk: Walk) -> None:
    said = walk.shell(blocks("Over HTTP")[0])
    photos = walk.made / "photos"
    for name in ["view.png", "part.png", "there.png", "mask.png"]:
        assert len(levels(photos / name)) > 1, f"{name} shows nothing"
    assert size_of(photos / "part.png") == (64, 64)
    answers = list(objects_in(said))
    [found] = [one for one in answers if "results" in one]
    assert [one["text"] for one in found["results"]] == ["box", "ball"]
    assert all(one["gaussians"] > 0 for one in found["results"]), found
    masks = json.loads((photos / "masks.json").read_text())
    assert all(one["view"]["mask_rle"]["counts"] for one in masks["results"])
    assert any(one.get("state") == "done" for one in answers), "the file of Gaussians"
    assert "event: done" in said
    for name in ["box.ply", "scene.spz", "scene.colmap.zip", "openapi.json", "d.npy"]:
        assert (photos / name).stat().st_size > 1000, name


def networks(walk: Walk) -> None:
    said = walk.shell(blocks("Over gRPC")[1])
    assert '"outputs"' in said and '"FP32"' in said, said


def without_a_server(walk: Walk) -> None:
    [lines] = blocks("Without a server")
    named = lines.replace(" DIR ", " models/embedded ").replace(" SCENE ", " scene.segsplat ")
    said = walk.shell(f"export PATH=$PWD/target/release:$PATH\n{named}")
    assert "WRONG" not in said and len(levels(ROOT / "mask.png")) > 1


def without_cameras(walk: Walk, photos: Path | None) -> None:
    """README's lines make a scene of photos alone: the program's own, and those of COLMAP."""
    folder = walk.made / "alone"
    (folder / "photos").mkdir(parents=True)
    if photos:
        shutil.copytree(photos, folder / "photos/images")
    else:
        walk.shell(f"target/release/segsplat sample --photos 12 --size 640x480 -o {folder}/made")
        shutil.move(folder / "made/images", folder / "photos/images")
    for lines in blocks("Photos without cameras"):
        lines = lines.replace("target/release/segsplat", str(RELEASE))
        walk.shell(f"cd {folder}\n{lines}")
        told = json.loads(walk.shell(f"{RELEASE} inspect {folder}/scene.segsplat --json"))
        assert told["meta"]["report"]["views_used"] > 1 and told["gaussians"] > 1000, told
        (folder / "photos/transforms.json").unlink(missing_ok=True)


def the_page(walk: Walk) -> None:
    """A browser drops photos, asks words, clicks: `tests/page/test_first_hour.py`."""
    walk.shell(f"""python3 -m venv {walk.made}/page-venv
        {walk.made}/page-venv/bin/pip install --quiet -r tests/page/requirements.txt
        SEGSPLAT_BIN={RELEASE} {walk.made}/page-venv/bin/python -m pytest -q --durations=0 \
            tests/page/test_first_hour.py > {walk.made}/page.log 2>&1 || {{
            cat {walk.made}/page.log; exit 1; }}""")
    said = (walk.made / "page.log").read_text()
    times = re.findall(r"^([0-9.]+s) call .*::test_(\w+)", said, flags=re.M)
    assert times, said
    for seconds, name in times:
        print(f"newcomer:     {name.replace('_', ' ')}: {seconds}")


def the_wheel(walk: Walk) -> None:
    """A machine with the wheel alone serves the page, from any folder."""
    lines = next(one for one in blocks("Quickstart") if "server-venv" in one)
    walk.shell(f"make wheel SEGSPLAT_BIN={RELEASE}\n{lines.rsplit('server-venv/bin/segsplat')[0]}")
    with walk.server(ROOT / "server-venv/bin/segsplat", cwd=walk.made):
        page = urllib.request.urlopen(f"http://{walk.host}/").read()
    assert b"Photos in, a scene in 3D out." in page


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--program", type=Path)
    parser.add_argument("--photos", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        walk = Walk(Path(made))
        with step("build"):
            if given.program:
                walk.shell("scripts/setup")
                RELEASE.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(given.program, RELEASE)
            else:
                walk.shell("make build")
        with walk.server(RELEASE):
            for name, act in [("In Python", in_python), ("Over HTTP", over_http),
                              ("networks over HTTP", networks)]:
                with step(name):
                    act(walk)
        with step("Without a server"):
            without_a_server(walk)
        with step("Photos without cameras"):
            without_cameras(walk, given.photos)
        with step("the page"):
            the_page(walk)
        with step("the wheel"):
            the_wheel(walk)


if __name__ == "__main__":
    main()
