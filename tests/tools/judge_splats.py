"""splat-transform (PlayCanvas) reads the files of Gaussians that this program writes: the right
number of them, the right bounds, the right harmonics of each; and this program reads of its files
what it reads itself. Khronos' validator, which does not know the extension, finds
nothing wrong with a GLB but the names of its attributes. `make judge` gets Node and both.

python3 judge_splats.py SEGSPLAT NODE SPLAT_TRANSFORM_CLI SOURCE.ply
"""

import json
import math
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "page"))
from large import room  # noqa: E402

segsplat, node, cli, source = map(Path, sys.argv[1:])
LARGE = 300_000
# Largest differences of positions, logarithms of scales, opacities and colours.
STEPS = {
    "ply": (1e-6, 1e-5, 1e-5, 1e-6),
    "compressed.ply": (3e-3, 3e-3, 3e-3, 0.01),
    "spz": (1e-5, 0.032, 3e-3, 0.015),
    "v4.spz": (1e-5, 0.032, 3e-3, 0.015),
    "sog": (1e-3, 0.05, 3e-3, 0.02),
    "splat": (1e-6, 1e-5, 3e-3, 0.015),
}
COLUMNS = [["x", "y", "z"], ["scale_0", "scale_1", "scale_2"], ["opacity"],
           ["f_dc_0", "f_dc_1", "f_dc_2"]]
# It takes the numbers of an SPZ as those of a PLY. The format has y up and z back.
TURNED = {"spz": {"y", "z"}, "v4.spz": {"y", "z"}}
# What becomes of the coefficients of degree 1 there.
TURN = (-1.0, -1.0, 1.0)
# Largest differences of a coefficient over degree 0. A `.splat` has none; a SOG has a palette.
HARMONICS = {"ply": 1e-6, "compressed.ply": 0.032, "spz": 0.036, "v4.spz": 0.036, "sog": 0.01}


def seen(path: Path) -> tuple[int, dict[str, list[float]]]:
    """How many Gaussians it finds, and least and largest numbers of each column."""
    told = subprocess.run([node, cli, "-q", path, "null", "--stats", "json"],
                          stdout=subprocess.PIPE, check=True)
    stats = json.loads(told.stdout)
    lod = stats["stats"][0]
    ranges = zip(lod["data"]["min"], lod["data"]["max"], strict=True)
    return stats["numGaussians"], dict(zip(lod["columns"], map(list, ranges), strict=True))


KINDS = {"float": "f", "uchar": "B", "ushort": "H", "uint": "I"}


def rows_of(path: Path) -> list[dict[str, float]]:
    """The vertices of a PLY."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = [line.split() for line in head.decode().splitlines()]
    number = next(int(words[2]) for words in lines if words[:2] == ["element", "vertex"])
    columns = [words[1:] for words in lines if words[0] == "property"]
    row = struct.Struct("<" + "".join(KINDS[kind] for kind, _ in columns))
    names = [name for _, name in columns]
    found = row.iter_unpack(body[:number * row.size])
    return [dict(zip(names, values, strict=True)) for values in found]


def harmonics_off(want: list[dict], found: list[dict], turned: bool) -> float:
    """The largest difference of a coefficient of degree 1 of what lies at one place."""
    signs = dict.fromkeys("xyz", 1.0) | (dict.fromkeys("yz", -1.0) if turned else {})
    worst = 0.0
    for one in want:
        near = min(found, key=lambda row: sum((row[k] * signs[k] - one[k]) ** 2 for k in "xyz"))
        for i in range(9):
            sign = TURN[i % 3] if turned else 1.0
            worst = max(worst, abs(near[f"f_rest_{i}"] * sign - one[f"f_rest_{i}"]))
    return worst


def turned_into(path: Path, ply: Path) -> list[dict]:
    """What splat-transform reads of a file."""
    subprocess.run([node, cli, "-q", "-w", path, ply], check=True, stdout=subprocess.DEVNULL)
    return rows_of(ply)


VALIDATE = """
const file = new Uint8Array(require("fs").readFileSync(process.argv[1]));
require("gltf-validator").validateBytes(file).then((r) => console.log(JSON.stringify(r.issues)));
"""


def faults_of_glb(path: Path) -> list[str]:
    """What is wrong with a GLB."""
    told = subprocess.run([node, "-e", VALIDATE, path], stdout=subprocess.PIPE, check=True,
                          env={"NODE_PATH": str(cli.absolute().parents[3])})
    found = [one for one in json.loads(told.stdout)["messages"] if one["severity"] < 2]
    named = "attributes/KHR_gaussian_splatting:"
    return [f"glb: {one}" for one in found if named not in one["pointer"]]


def streamed(of: Path, folder: Path) -> tuple[list[int], int, list[tuple[float, float]]]:
    """What it finds in the levels of detail of a file: Gaussians of each, the files of all, and
    least and largest positions of the scene itself."""
    zipped = folder / f"{of.stem}.sog.zip"
    subprocess.run([segsplat, "export", of, "-o", zipped], check=True, stdout=subprocess.DEVNULL)
    with zipfile.ZipFile(zipped) as archive:
        archive.extractall(folder / of.stem)
    meta = folder / of.stem / "lod-meta.json"
    told = subprocess.run([node, cli, "-q", meta, "null", "--stats", "json"],
                          stdout=subprocess.PIPE, check=True)
    found = json.loads(told.stdout)
    data = found["stats"][0]["data"]
    bounds = list(zip(data["min"][:3], data["max"][:3], strict=True))
    return found["lodCounts"], len(json.loads(meta.read_text())["filenames"]), bounds


count, truth = seen(source)
faults = []
with tempfile.TemporaryDirectory() as folder:
    for ending, steps in STEPS.items():
        path = Path(folder) / f"ours.{ending}"
        subprocess.run([segsplat, "export", source, "-o", path], check=True,
                       stdout=subprocess.DEVNULL)
        found, columns = seen(path)
        worst = []
        for names, step in zip(COLUMNS, steps, strict=True):
            offs = []
            for name in names:
                want, got = truth[name], columns[name]
                if name in TURNED.get(ending, ()):
                    got = [-got[1], -got[0]]
                if name.startswith("scale"):
                    want, got = [[math.log(v) for v in pair] for pair in (want, got)]
                offs += [abs(a - b) for a, b in zip(want, got, strict=True)]
            worst.append(max(offs))
            if worst[-1] > step:
                faults.append(f"{ending}: {names}: {worst[-1]} over {step}")
        if found != count:
            faults.append(f"{ending}: {found} of {count} Gaussians")
        print(f"{ending}: {found} Gaussians, bounds within", *(f"{v:.2g}" for v in worst))
        if ending not in HARMONICS:
            continue
        turned = ending in TURNED
        off = harmonics_off(rows_of(source), turned_into(path, path.with_suffix(".ply.ply")),
                            turned)
        # And of a file that it wrote itself, what it reads and what we read.
        theirs = source.with_name(f"theirs.{ending}" if ending != "ply" else source.name)
        ply = Path(folder) / "read.ply"
        subprocess.run([segsplat, "export", theirs, "-o", ply], check=True,
                       stdout=subprocess.DEVNULL)
        back = harmonics_off(rows_of(ply), turned_into(theirs, path.with_suffix(".read.ply")),
                             turned)
        print(f"{ending}: harmonics of ours within {off:.2g}, of theirs within {back:.2g}")
        if off > HARMONICS[ending] or back > 1e-5:
            bound = HARMONICS[ending]
            faults.append(f"{ending}: harmonics: {off} over {bound}, or {back} over 1e-5")
    path = Path(folder) / "ours.glb"
    subprocess.run([segsplat, "export", source, "-o", path], check=True, stdout=subprocess.DEVNULL)
    faults += (wrong := faults_of_glb(path))
    print(f"glb: {len(wrong)} faults")
    # Levels of detail: of a small scene one, of a large one more, each at most a third as large.
    large = Path(folder) / "room.splat"
    large.write_bytes(room(LARGE))
    for path, want in ((source, count), (large, LARGE)):
        levels, files, bounds = streamed(path, Path(folder))
        print(f"sog_lod: {path.name}: {levels} Gaussians in {files} files, bounds {bounds}")
        steps = zip(levels, levels[1:], strict=False)
        if levels[0] != want or any(3 * b > a for a, b in steps) \
                or (len(levels) > 1) != (path == large):
            faults.append(f"sog_lod: {path.name}: levels of {levels}")
        of = [truth[name] for name in "xyz"] if path == source else [[-2, 2]] * 3
        off = max(abs(a - b) for one, two in zip(of, bounds, strict=True)
                  for a, b in zip(one, two, strict=True))
        if off > 2e-3:
            faults.append(f"sog_lod: {path.name}: bounds {off} off")
sys.exit("\n".join(faults) or None)
