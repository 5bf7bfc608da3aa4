"""Views a second over HTTP: segsplat and the plain Python service, in turn on one machine, with as
many threads each. Appends one row for docs/benchmarks.md to the file that --out names."""

import argparse
import io
import json
import os
import pathlib
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.parse
import urllib.request

import numpy as np
from PIL import Image

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent.parent
sys.path.append(str(ROOT / "scripts"))
from form import form  # noqa: E402


def fetch(url, data=None, headers=None):
    request = urllib.request.Request(url, data=data, headers=headers or {})
    with urllib.request.urlopen(request, timeout=600) as answer:
        return answer.read()


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def until_up(url):
    for _ in range(600):
        try:
            return fetch(url)
        except (urllib.error.URLError, ConnectionError):
            time.sleep(0.1)
    sys.exit(f"{url} never answered")


def load(urls, callers, seconds):
    """Closed loop: answers a second, and the times of all in milliseconds, sorted."""
    end, times, lock = time.monotonic() + seconds, [], threading.Lock()

    def caller(seed):
        choose, own = random.Random(seed), []
        while time.monotonic() < end:
            begun = time.monotonic()
            fetch(choose.choice(urls))
            own.append(1e3 * (time.monotonic() - begun))
        with lock:
            times.extend(own)

    begun = time.monotonic()
    threads = [threading.Thread(target=caller, args=(i,)) for i in range(callers)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    times.sort()
    return len(times) / (time.monotonic() - begun), times


def picture(url):
    return np.asarray(Image.open(io.BytesIO(fetch(url))).convert("RGB"), float)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--segsplat", default=ROOT / "target/release/segsplat")
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--callers", type=int, default=8)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--machine", required=True, help="in words")
    parser.add_argument("--hashes", type=json.loads, default={}, help="of `report --hashes`")
    parser.add_argument("--out", type=pathlib.Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        sample = [args.segsplat, "sample", "-o", folder / "photos", "--photos", "2"]
        subprocess.run(sample, check=True, stdout=subprocess.DEVNULL)
        ours = subprocess.Popen(
            [args.segsplat, "serve", "--json", "--renderer", "cpu", "--listen", "127.0.0.1:0",
             "--threads", str(args.threads),
             "--data-dir", folder / "data"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        theirs = None
        try:
            base = json.loads(ours.stdout.readline())["listening"]
            names = {"transforms.json": "transforms"}
            body, kind = form([(names.get(path.name, "photo"), path.name, path.read_bytes())
                               for path in (folder / "photos").rglob("*.*")])
            made = fetch(f"{base}/v1/scenes?wait_ms=600000", body, {"Content-Type": kind})
            scene = json.loads(made)
            ply = folder / "scene.ply"
            ply.write_bytes(fetch(f"{base}/v1/scenes/{scene['id']}/export?format=ply"))
            first, second = (c["camera_to_world"] for c in scene["cameras"][:2])
            lens = scene["cameras"][0]["intrinsics"]
            scale = args.size / max(lens["width"], lens["height"])
            lens = {k: lens[k] * scale for k in ("fx", "fy", "cx", "cy")}
            size = {"width": args.size, "height": args.size}
            cameras = []
            for i in range(64):
                # Moved along the base line, turned as the first photo: both take it as it is.
                pose = list(first)
                for k in (3, 7, 11):
                    pose[k] += (second[k] - first[k]) * i / 63
                cameras.append({"camera_to_world": ",".join(map(repr, pose)), **lens, **size})
            query = [urllib.parse.urlencode(c) for c in cameras]
            # No backdrop: the Python service has none. No answer is kept by either side.
            urls = [f"{base}/v1/scenes/{scene['id']}/view?{q}&background=black" for q in query]
            port = free_port()
            theirs = subprocess.Popen(
                [sys.executable, HERE / "service.py", ply, "--port", str(port), "--threads",
                 str(args.threads)])
            gaussians = json.loads(until_up(f"http://127.0.0.1:{port}/healthz"))["gaussians"]
            plain = [f"http://127.0.0.1:{port}/view?{q}" for q in query]
            apart = [np.abs(picture(urls[i]) - picture(plain[i])) for i in (0, 31, 63)]
            git = ["git", "rev-parse", "--short", "HEAD"]
            commit = subprocess.run(git, cwd=ROOT, check=True, capture_output=True, text=True)
            result = {"table": "python", "command": f"compare.py --callers {args.callers} "
                      f"--seconds {args.seconds:g} --size {args.size} --threads {args.threads}",
                      "commit": commit.stdout.strip(), "machine": args.machine,
                      "hashes": args.hashes,
                      "error": {"levels_max": float(max(a.max() for a in apart)),
                                "levels_mean": float(max(a.mean() for a in apart))},
                      "gaussians": gaussians, "size": args.size, "callers": args.callers,
                      "threads": args.threads, "seconds": args.seconds}
            for name, all_urls in (("segsplat", urls), ("python", plain)):
                load(all_urls, args.callers, 2)
                rate, times = load(all_urls, args.callers, args.seconds)
                result[name] = {"views_per_s": round(rate, 2), "views": len(times),
                                "p50_ms": round(times[len(times) // 2], 1),
                                "p99_ms": round(times[int(len(times) * 0.99)], 1)}
            result["ratio"] = round(
                result["segsplat"]["views_per_s"] / result["python"]["views_per_s"], 1)
            print(json.dumps(result, indent=2))
            if args.out:
                with args.out.open("a") as file:
                    file.write(json.dumps(result) + "\n")
        finally:
            for server in (ours, theirs):
                if server:
                    server.kill()


if __name__ == "__main__":
    main()
