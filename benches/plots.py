"""Draws docs/plots/*.svg from the rows of a folder (needs matplotlib): `make plots`.

Every time stands beside its error: the oracle's for our renderers, ours for the peers."""

import json
import pathlib
import sys

import matplotlib

matplotlib.use("svg")
matplotlib.rcParams.update({"svg.hashsalt": "segsplat", "font.size": 8, "axes.grid": True,
                            "grid.alpha": 0.3, "svg.fonttype": "none"})
import matplotlib.pyplot as plt  # noqa: E402

runs, plots = (pathlib.Path(path) for path in sys.argv[1:3])
plots.mkdir(parents=True, exist_ok=True)
NAMES = {("gpu", "exact"): "one NVIDIA H200, exact", ("gpu", "fast"): "one NVIDIA H200, fast",
         ("cpu", "exact"): "2 CPU threads, exact"}
STYLE = {("gpu", "exact"): "C0o-", ("gpu", "fast"): "C2s--", ("cpu", "exact"): "C1^-"}


def rows(pattern):
    for path in sorted(runs.glob(pattern)):
        for line in path.read_text().splitlines():
            row = json.loads(line)
            if "error" in row and "report" not in row:  # a row of segsplat-lab frames
                error, labels = row["error"], row["labels"]
                found = {**error["picture"], "worst": error["picture"]["max"]}
                row = {"renderer": "cpu" if row["renderer"] == "cpu" else "gpu",
                       "quality": row["quality"],
                       "labels": labels and [labels["labels"], labels["bank"]],
                       "report": {**row, "size": row["height"], "compared": found}}
            yield row


def time_ms(row):
    device = row["report"]["device"]
    return device["total_ms"] if device else row["report"]["median_ms"]


def save(figure, name):
    figure.tight_layout()
    figure.savefig(plots / f"{name}.svg", metadata={"Date": None})
    plt.close(figure)


def lines(axes_time, axes_error, chosen, x):
    """Time above, error below, over the same x."""
    for key, name in NAMES.items():
        points = sorted({x(row): row for row in chosen
                         if (row["renderer"], row["quality"]) == key}.items())
        if not points:
            continue
        at = [value for value, _ in points]
        axes_time.loglog(at, [time_ms(row) for _, row in points], STYLE[key], ms=4, label=name)
        found = [row["report"]["compared"] for _, row in points]
        axes_error.loglog(at, [one["worst"] for one in found], STYLE[key], ms=4, label="largest")
        axes_error.loglog(at, [one["mean"] for one in found], STYLE[key][:2] + ":", ms=3,
                          label="mean")
    axes_time.set_ylabel("ms a frame")
    axes_error.set_ylabel("error to the f64 oracle")
    axes_time.legend()


frontier = list(rows("*-frontier.jsonl"))
plain = [row for row in frontier if not row["labels"]]
figure, axes = plt.subplots(2, 2, figsize=(8, 5.5), sharex="col")
wide = [r for r in plain if (r["report"]["width"], r["report"]["size"]) == (1920, 1080)]
lines(axes[0, 0], axes[1, 0], wide, lambda r: r["report"]["gaussians"])
axes[0, 0].set_title("1920 x 1080, colour")
axes[1, 0].set_xlabel("Gaussians")
million = [r for r in plain if r["report"]["gaussians"] == 999_698]
lines(axes[0, 1], axes[1, 1], million, lambda r: r["report"]["width"] * r["report"]["size"])
axes[0, 1].set_title("999,698 Gaussians, colour")
axes[1, 1].set_xlabel("pixels (points: largest of 4,096 pixels, dots: mean)")
save(figure, "frontier")

figure, axes = plt.subplots(figsize=(5.5, 4))
for key, name in NAMES.items():
    found = [(time_ms(r), r["report"]["compared"]["psnr_db"], r["report"]["gaussians"])
             for r in wide if (r["renderer"], r["quality"]) == key]
    if found:
        axes.semilogx([t for t, _, _ in found], [db for _, db, _ in found], STYLE[key][:3], ms=4,
                      label=name + ", to the oracle")
for file, peer, what, label, mark in [
    ("*-h200-gsplat.jsonl", "gsplat", "colour_ms", "gsplat 1.5.3, to ours", "C3x"),
    ("*-h200-wgpu-peer.jsonl", "wgpu_3dgs_viewer", "device_ms", "wgpu-3dgs-viewer, to ours", "C4+"),
]:
    found = [(row[peer][what], row["difference"]["psnr_db"]) for row in rows(file)
             if "psnr_db" in row["difference"]]
    if found:
        axes.semilogx([t for t, _ in found], [db for _, db in found], mark, ms=6, label=label)
axes.set_xlabel("ms a frame (device time; CPU: wall)")
axes.set_ylabel("PSNR, dB")
axes.legend()
save(figure, "error-and-time")

figure, axes = plt.subplots(figsize=(5.5, 3.5))
for renderer in ("gpu", "cpu"):
    # Older rows call the weights of all entries "entries".
    for names, marker in ((("blend",), "o-"), (("weights", "entries"), "s--")):
        found = sorted((r["labels"][1], r["report"]["labels"]["labels_ms"],
                        r["report"]["labels"]["color_ms"]) for r in frontier
                       if r["labels"] and r["labels"][0] in names and r["renderer"] == renderer)
        if found:
            what = "a text's mask" if names == ("blend",) else "all of E"
            where = "one NVIDIA H200" if renderer == "gpu" else "2 CPU threads"
            axes.loglog([m for m, _, _ in found], [ms / color for _, ms, color in found],
                        ("C0" if renderer == "gpu" else "C1") + marker, ms=4,
                        label=f"{what}, {where}")
axes.set_xlabel("entries of the bank, M")
axes.set_ylabel("time a call, over colour alone")
axes.legend()
save(figure, "bank")
