"""Callers that take more than their part: memory, threads and views beside them. `make unread` runs
it.

    unread.py PROGRAM [WHAT...]     WHAT: readers, pictures, exports, crowd (all by default)

readers: 600 connections ask for an export of 100,000 Gaussians and read nothing, while views
are asked one after another. pictures: 40 connections ask for 4096 x 4096 pictures as f32 and read
nothing. exports: 12 connections ask for SOG files of 4,000,000 Gaussians and read nothing. crowd:
300 callers of one key and two of another ask for views, each for the next one when it has one. A
line for each says what came back; the program ends with 1 where a bar is missed.
"""

from __future__ import annotations

import asyncio
import json
import random
import socket
import statistics
import struct
import subprocess
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
POSE = "camera_to_world=1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1&fov=60"
#: Seconds of the crowd, and callers of its two keys.
CROWD_S = 20
CROWD = {"many": 300, "few": 2}
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


def made(url: str, count: int, key: str = "") -> str:
    body, kind = form([("splats", "a.splat", splat_file(count))])
    headers = {"content-type": kind, **({"authorization": f"Bearer {key}"} if key else {})}
    request = urllib.request.Request(f"{url}/v1/scenes?wait_ms=600000", body, headers)
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
    for _ in range(VIEWS):
        begun = time.monotonic()
        with urllib.request.urlopen(
                f"{url}/v1/scenes/{scene}/view?{POSE}&width=256&height=256", timeout=60) as answer:
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
    path = f"/v1/scenes/{scene}/view?{POSE}&width=4096&height=4096&format=npy"
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


async def caller(port: int, head: bytes, end: float, said: Counter[str],
                 took: list[float]) -> None:
    """Asks for a view again and again on one connection, and comes back when it is told to."""
    read, write = await asyncio.open_connection("127.0.0.1", port)
    while time.monotonic() < end:
        begun = time.monotonic()
        write.write(head)
        lines = (await read.readuntil(b"\r\n\r\n")).decode().lower().split("\r\n")
        headers = dict(line.split(": ", 1) for line in lines[1:] if line)
        await read.readexactly(int(headers["content-length"]))
        if time.monotonic() >= end:
            break
        said[lines[0].split()[1]] += 1
        if lines[0].split()[1] == "200":
            took.append(1e3 * (time.monotonic() - begun))
        await asyncio.sleep(float(headers.get("retry-after", 0)))
    write.close()


def crowd(url: str, keys: dict[str, str]) -> None:
    port = int(url.rsplit(":", 1)[1])
    said = {name: Counter[str]() for name in CROWD}
    took: dict[str, list[float]] = {name: [] for name in CROWD}
    heads = {
        name: (f"GET /v1/scenes/{made(url, 100_000, keys[name])}/view?{POSE}&width=256&height=256 "
               f"HTTP/1.1\r\nhost: 127.0.0.1\r\nauthorization: Bearer {keys[name]}\r\n\r\n")
        for name in CROWD
    }

    async def all_call() -> None:
        end = time.monotonic() + CROWD_S
        await asyncio.gather(*(
            caller(port, heads[name].encode(), end, said[name], took[name])
            for name, count in CROWD.items() for _ in range(count)))

    asyncio.run(all_call())
    views = {name: said[name]["200"] for name in CROWD}
    share = 100 * views["few"] / max(sum(views.values()), 1)
    print(f"{CROWD['many']} callers of one key: {dict(said['many'])}, p50 "
          f"{statistics.median(took['many']):.0f} ms; {CROWD['few']} of another: "
          f"{dict(said['few'])}, p50 {statistics.median(took['few']):.0f} ms; the few have "
          f"{share:.0f} % of the views")
    bar("% of the views for the many", 100 - share, 70)


def keys_of(program: Path, file: Path) -> dict[str, str]:
    """Secrets of the crowd's owners, which the program puts into a file of keys."""
    def new(name: str) -> str:
        line = [program, "keys", "new", name, "--scope", "write", "--keys", file]
        done = subprocess.run(line, stdout=subprocess.PIPE, check=True, text=True)
        return done.stdout.strip().splitlines()[-1]

    return {name: new(name) for name in CROWD}


def main() -> None:
    program = Path(sys.argv[1]).absolute()
    known = {"readers": readers, "pictures": pictures, "exports": exports}
    for name in sys.argv[2:] or [*known, "crowd"]:
        with tempfile.TemporaryDirectory() as folder:
            data, file = Path(folder) / "data", Path(folder) / "keys.toml"
            flags: list[str | Path] = ["--renderer", "cpu", "--bundle", "tests/fixtures/plane"]
            keys = keys_of(program, file) if name == "crowd" else {}
            flags += ["--keys", file] if keys else []
            with served(data, *flags, program=program) as url:
                crowd(url, keys) if keys else known[name](url, process(url))
    for what in missed:
        print(f"missed: {what}")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
