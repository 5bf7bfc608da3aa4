"""Time against error: runs `segsplat-lab frames` over counts, sizes, qualities and banks.

    python frontier.py LAB OUT.jsonl --renderer gpu|cpu [--adapter NAME --threads N --quick]

Each line of OUT is one row of it with the error against the f64 oracle at 4,096 pixels
(for labels: against the CPU renderer), and what was asked. `make plots` draws them."""

import argparse
import json
import subprocess

parser = argparse.ArgumentParser()
parser.add_argument("lab")
parser.add_argument("out")
parser.add_argument("--renderer", required=True, choices=["gpu", "cpu"])
parser.add_argument("--adapter")
parser.add_argument("--threads", type=int)
parser.add_argument("--quick", action="store_true", help="small scenes alone")
args = parser.parse_args()

SMALL, WIDE = (256, 256), (1920, 1080)
counts = [10_082, 131_072, 524_288, 999_698, 1_964_162, 3_931_208, 5_896_178]
sizes = [(256, 256), (512, 512), (1280, 720), (1920, 1080), (2560, 1440), (3840, 2160)]
banks = [1, 8, 24, 128, 512, 2048, 4096]
if args.quick:
    counts, sizes, banks = counts[:2], sizes[:2], banks[:3]
runs = [(n, *WIDE, quality, None) for n in counts for quality in ("exact", "fast")]
runs += [(131_072, *SMALL, quality, None) for quality in ("exact", "fast")]
runs += [(999_698, *size, quality, None) for size in sizes for quality in ("exact", "fast")]
runs += [(131_072, *SMALL, "exact", (labels, m)) for labels in ("blend", "weights") for m in banks]

with open(args.out, "w") as out:
    for gaussians, width, height, quality, labels in runs:
        if args.renderer == "cpu" and quality == "fast":
            continue  # the same as exact
        frames = 5 if args.renderer == "cpu" and gaussians > 200_000 else 30
        command = [
            args.lab, "--table", "frontier", "frames", "--renderer", args.renderer,
            "--gaussians", str(gaussians), "--width", str(width), "--size", str(height),
            "--frames", str(frames), "--quality", quality,
            "--compare", "cpu" if labels else "oracle",
        ]
        if labels:
            command += ["--labels", labels[0], "--bank", str(labels[1])]
        if args.adapter:
            command += ["--adapter", args.adapter]
        if args.threads:
            command += ["--threads", str(args.threads)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}: {done.stderr}")
        report = json.loads(done.stdout)
        out.write(done.stdout)
        out.flush()
        found = report["error"]["labels" if labels else "picture"]
        device = report["device"]
        print(gaussians, width, height, quality, labels, f"{report['median_ms']:.3f} ms",
              f"device {device['total_ms']:.3f} ms" if device else "", found, flush=True)
