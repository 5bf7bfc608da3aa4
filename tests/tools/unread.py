"""Answers that nobody reads: memory, threads and views beside them. `make unread` runs it.

    unread.py PROGRAM [WHAT...]     WHAT: readers, pictures, exports (all by default)

readers: 600 connections ask for an export of 100,000 Gaussians and read nothing, while views
are asked one after another. pictures: 40 connections ask for 4096 x 4096 pictures as f32 and read
nothing. exports: 12 connections ask for SOG files of 4,000,000 Gaussians and read nothing. A line
for each says what came back; the program ends with 1 where a bar is missed.
"""

from __future__ import annotations

import json
import random
import socket
import statistics
import struct
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections import Counter
from pathlib import Path

from served import served

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts"))
from form import form  # noqa: E402

MIB = 1 << 20
VIEWS = 100
missed: list[str] = []


def splat_file(count: int) -> bytes:
    """A `.splat` file of Gaussians before the first camera."""
    random.seed(1)
    rows = []
    for _ in range(min(count, 50_000)):
        place = [random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(2, 4)]
        rows.append(struct.pack("<6f8B", *place, 0.01, 0.01, 0.01, 200, 80, 40, 255, 255, 128,
                                128, 128))
    one = b"".join(rows)
    return (one * (count * 32 // len(one) + 1))[:count * 32]


def made(url: str, count: int) -> str:
    body, kind = form([("splats", "a.splat", splat_file(count))])
    request = urllib.request.Request(f"{url}/v1/scenes?wait_ms=600000", body,
                                     {"content-type": kind})
    with urllib.request.urlopen(request) as answer:
        scene = json.load(answer)
    assert scene["state"] == "done", scene
    return str(scene["id"])


def status(pid: int, name: str) -> int:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1])
    raise ValueError(name)


def process(url: str) -> int:
    """The process that listens at this port, a child of this one."""
    port = int(url.rsplit(":", 1)[1])
    for row in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        cells = row.split()
        if int(cells[1].split(":")[1], 16) == port and cells[3] == "0A":
            inode = f"socket:[{cells[9]}]"
    for path in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if str(path.readlink()) == inode:
                return int(path.parts[2])
        except OSError:
            continue
    raise ValueError(url)


def unread(url: str, path: str, count: int) -> list[socket.socket]:
    """Connections that ask and read nothing but what comes by itself."""
    port = int(url.rsplit(":", 1)[1])
    asked = []
    for _ in range(count):
        one = socket.create_connection(("127.0.0.1", port))
        one.sendall(f"GET {path} HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n".encode())
        asked.append(one)
    return asked


def heads(asked: list[socket.socket]) -> Counter[str]:
    """What the first line of each answer says, without taking a byte of it."""
    seen: Counter[str] = Counter()
    for one in asked:
        one.settimeout(0.2)
        try:
            seen[one.recv(12, socket.MSG_PEEK)[9:].decode() or "closed"] += 1
        except (TimeoutError, ConnectionError) as error:
            seen[type(error).__name__] += 1
    return seen


def views(url: str, scene: str) -> list[float]:
    """Milliseconds of views, one after another."""
    took = []
    pose = "camera_to_world=1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1&fov=60"
    for _ in range(VIEWS):
        begun = time.monotonic()
        with urllib.request.urlopen(
                f"{url}/v1/scenes/{scene}/view?{pose}&width=256&height=256", timeout=60) as answer:
            answer.read()
        took.append(1e3 * (time.monotonic() - begun))
    return took


def quantile(took: list[float], share: float) -> float:
    return statistics.quantiles(took, n=100)[int(100 * share) - 1]


def bar(what: str, value: float, most: float) -> None:
    if value > most:
        missed.append(f"{what}: {value:.0f}, over {most:.0f}")


def readers(url: str, pid: int) -> None:
    scene = made(url, 100_000)
    views(url, scene)
    idle = views(url, scene)
    asked = unread(url, f"/v1/scenes/{scene}/export", 600)
    beside = views(url, scene)
    said, threads = heads(asked), status(pid, "Threads:")
    resident = status(pid, "VmRSS:") // 1024
    p95 = [quantile(took, 0.95) for took in (idle, beside)]
    print(f"600 idle readers: {dict(said)}, {threads} threads, {resident} MiB; views p50 "
          f"{statistics.median(idle):.1f} and {statistics.median(beside):.1f} ms, p95 "
          f"{p95[0]:.1f} and {p95[1]:.1f} ms idle and beside them")
    bar("p95 of views", p95[1], 2 * p95[0])
    bar("MiB", resident, 1024)
    begun = time.monotonic()
    while True:
        try:
            with urllib.request.urlopen(f"{url}/v1/scenes/{scene}/export") as answer:
                size = len(answer.read())
            break
        except urllib.error.HTTPError as error:
            assert error.code == 429 and error.headers["retry-after"], error
            time.sleep(1)
    print(f"  an export of {size} bytes came after {time.monotonic() - begun:.1f} s more")
    for one in asked:
        one.close()


def pictures(url: str, pid: int) -> None:
    scene = made(url, 1_000)
    pose = "camera_to_world=1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1&fov=60"
    path = f"/v1/scenes/{scene}/view?{pose}&width=4096&height=4096&format=npy"
    asked, peak = unread(url, path, 40), 0
    end = time.monotonic() + 60
    while time.monotonic() < end:
        peak = max(peak, status(pid, "VmRSS:") // 1024)
        time.sleep(0.2)
    print(f"40 unread pictures of 201 MB: {dict(heads(asked))}, at most {peak} MiB")
    bar("MiB", peak, 1536)
    for one in asked:
        one.close()


def exports(url: str, pid: int) -> None:
    scene = made(url, 4_000_000)
    time.sleep(15)
    before = status(pid, "VmRSS:") // 1024
    asked, peak = unread(url, f"/v1/scenes/{scene}/export?format=sog", 12), 0
    end = time.monotonic() + 60
    while time.monotonic() < end:
        peak = max(peak, status(pid, "VmRSS:") // 1024)
        time.sleep(0.2)
    print(f"12 SOG files of 4,000,000 Gaussians: {dict(heads(asked))}, {before} MiB before, at "
          f"most {peak} MiB")
    bar("MiB", peak, 1536)
    for one in asked:
        one.close()


def main() -> None:
    program = Path(sys.argv[1]).absolute()
    known = {"readers": readers, "pictures": pictures, "exports": exports}
    for name in sys.argv[2:] or known:
        with tempfile.TemporaryDirectory() as folder:
            data = Path(folder) / "data"
            flags = ["--renderer", "cpu", "--bundle", "tests/fixtures/plane"]
            with served(data, *flags, program=program) as url:
                known[name](url, process(url))
    for what in missed:
        print(f"missed: {what}")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
