"""Sends folders as people have them, each with a fault or an oddity that was reported in public,
over HTTP (a tar as archive) and through the command line, and compares with the right values.

python3 cases.py [FOLDER] [--only NAME]... [--door http|cli]

FOLDER holds the folders by the names of ROWS. `SEGSPLAT_BIN` names the program (`served.py`). A
table is written, and the exit code is 1 where a value is not right. PSNR needs Pillow; without it,
PSNR is left out.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import subprocess
import sys
import tarfile
import tempfile
import urllib.error
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path

from served import PROGRAM, ROOT, served

try:
    from PIL import Image, ImageChops, ImageStat
except ImportError:
    Image = None

# Of the generated room, whose pictures most cases have.
DEPTH = 3.93


@dataclass
class Row:
    """The right values of a case. What is `None` or empty is not looked at."""

    # Whose work the kind is: names, masks, lens, splats, photos.
    kind: str
    photos: int | None = None
    fx: float | None = None
    depth: float | None = None
    # Least PSNR of a view from the first camera against its photo, dB.
    psnr: float | None = None
    # Words of the refusal, any of which will do; empty: it is read.
    refused: tuple[str, ...] = ()
    # Codes of warnings that must come, and that must not.
    warned: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()
    # Whether some warning must come.
    alarmed: bool = False
    # Whether nothing magenta may be seen from the first camera.
    no_magenta: bool = False
    gaussians: int | None = None
    # The files that are sent one by one, where the folder is no capture.
    files: tuple[str, ...] = field(default=())


LOST = ("photos_missing", "photos_unused")


def whole(kind: str = "names", **values: object) -> Row:
    """The room's four photos."""
    right = {"photos": 4, "fx": 320.0, "depth": DEPTH, "psnr": 32.0, "silent": LOST}
    return Row(kind, **{**right, **values})


ROWS = {
    "absolute-path-same-names": whole(),
    "dataset-with-3dgs-output": whole(warned=("cameras_chosen",)),
    "dotdot-backslash": whole(),
    "dotnet-multipart-names": Row("names", photos=4, depth=DEPTH, files=("body.bin",)),
    "images-txt-one-line-each": whole(),
    "inria-convert": whole(silent=(*LOST, "intrinsics_scale"), warned=("cameras_chosen",)),
    "inria-convert-phone": whole(silent=(*LOST, "intrinsics_scale"), warned=("cameras_chosen",)),
    "mixed-separators": whole(),
    "name-case": whole(),
    "only-downscaled-copies": Row(
        "names", photos=4, fx=160.0, depth=DEPTH, warned=("intrinsics_scale",)
    ),
    # The file at the top is what the converter made for training: the capture 1.2 times as large,
    # its middle at the origin. `metadata` and `arkit_transforms` have its metres.
    "record3d-with-transforms": whole(warned=("cameras_chosen",), depth=1.2 * DEPTH),
    "windows-absolute-path": whole(),
    "exif-square-quarter-turn": Row("lens", photos=4, depth=3.82, warned=("photos_turned",)),
    "exif-upside-down": Row("lens", photos=4, depth=DEPTH, warned=("photos_turned",)),
    "instant-ngp-latlong": Row("lens", refused=("latlong", "EQUIRECTANGULAR")),
    "jfif-extension": whole("photos"),
    "mask-path": Row("masks", photos=4, fx=320.0, no_magenta=True, warned=("masks_used",)),
    "utm-coordinates": whole("splats"),
    "2dgs-ply": Row("splats", gaussians=1500, files=("2dgs-ply.ply",)),
    "rgb-ply": Row("splats", gaussians=1500, files=("rgb-ply.ply",)),
    "antialiased-splats": Row("splats", files=("mip.ply", "postshot.ply", "flag.spz")),
    "glb-with-spz": Row("splats", files=("a.glb",)),
}


def psnr(view: bytes, case: Path, name: str) -> float | None:
    """Of a view against the photo of this name of its size, dB."""
    view_of = Image.open(io.BytesIO(view)).convert("RGB")
    found = [path for path in case.rglob("*") if path.name == Path(name).name]
    photos = [photo for photo in map(Image.open, found) if photo.size == view_of.size]
    if not photos:
        return None
    # Several folders may hold it: the scene was made of the one that it is like.
    of_each = []
    for photo in photos:
        channels = ImageStat.Stat(ImageChops.difference(view_of, photo.convert("RGB"))).rms
        mse = sum(rms * rms for rms in channels) / len(channels)
        of_each.append(10 * math.log10(255**2 / max(mse, 1e-9)))
    return max(of_each)


def judge(row: Row, status: dict, view: object, case: Path) -> list[str]:
    """What is not right of an answer; `view(width, height)` draws from the first camera."""
    is_read = "report" in status
    message = "" if is_read else (status.get("error") or status).get("message", json.dumps(status))
    if row.refused:
        is_right = any(word in message for word in row.refused)
        return [] if is_right else [message or "read, not refused"]
    if not is_read:
        return [message]
    report, cameras, faults = status["report"], status["cameras"], []
    codes = [warning["code"] for warning in report["warnings"]]

    def is_near(what: str, got: float, want: float | None, off: float) -> None:
        if want is not None and abs(got - want) > off:
            faults.append(f"{what} {got:g}, not {want:g}")

    is_near("photos", len(cameras), row.photos, 0)
    is_near("gaussians", report["gaussians"], row.gaussians, 0)
    is_near("depth", report["median_depth"], row.depth, 0.1)
    if cameras:
        is_near("fx", cameras[0]["intrinsics"]["fx"], row.fx, 0.5)
    faults += [f"no {code}" for code in row.warned if code not in codes]
    faults += [code for code in row.silent if code in codes]
    if row.alarmed and not codes:
        faults.append("no warning")
    if not cameras or Image is None or not (row.psnr or row.no_magenta):
        return faults
    size = cameras[0]["intrinsics"]
    drawn = view(size["width"], size["height"])
    got = psnr(drawn, case, cameras[0]["file"])
    if row.psnr and (got is None or got < row.psnr):
        faults.append(f"{got or 0:.1f} dB, not {row.psnr:g}")
    if row.no_magenta:
        picture = Image.open(io.BytesIO(drawn)).convert("RGB")
        colors = picture.getcolors(picture.width * picture.height)
        magenta = sum(n for n, (r, g, b) in colors if r > 180 and b > 180 and g < 90)
        share = magenta / (picture.width * picture.height)
        faults += [f"{share:.1%} magenta"] if share > 0.001 else []
    return faults


def fetched(request: urllib.request.Request | str) -> bytes:
    """The body of an answer, of an error too."""
    try:
        with urllib.request.urlopen(request, timeout=600) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        return error.read()


def body_of(case: Path, file: str | None) -> tuple[bytes, str]:
    """What is posted, and its content type."""
    if file is None:
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w", format=tarfile.USTAR_FORMAT) as tar:
            tar.add(case, arcname=".")
        return packed.getvalue(), "application/x-tar"
    sent = (case / file).read_bytes()
    kind = case / "content-type.txt"
    if kind.exists():
        return sent, kind.read_text().strip()
    head = f'--cut\r\nContent-Disposition: form-data; name="splats"; filename="{file}"\r\n\r\n'
    return head.encode() + sent + b"\r\n--cut--\r\n", "multipart/form-data; boundary=cut"


def over_http(address: str, case: Path, file: str | None, row: Row) -> list[str]:
    """What is not right over HTTP."""
    body, kind = body_of(case, file)
    request = urllib.request.Request(
        f"{address}/v1/scenes?wait_ms=600000&semantics=off", body, {"content-type": kind}
    )
    status = json.loads(fetched(request))
    view = f"{address}/v1/scenes/{status.get('id')}/view?from=0&format=png"
    return judge(row, status, lambda w, h: fetched(f"{view}&width={w}&height={h}"), case)


def by_command(top: Path, case: Path, file: str | None, row: Row) -> list[str]:
    """What is not right on the command line."""
    scene, picture = top / "scene.segsplat", top / "view.png"

    def run(*words: object) -> subprocess.CompletedProcess[bytes]:
        command = [PROGRAM, *map(str, words), "--json"]
        return subprocess.run(command, cwd=ROOT, capture_output=True, check=False)

    def view(width: int, height: int) -> bytes:
        size = ["--width", width, "--height", height]
        run("render", scene, "-o", picture, "--from", 0, *size)
        return picture.read_bytes()

    done = run("reconstruct", case / file if file else case, "-o", scene)
    told = done.stdout if done.returncode == 0 else done.stderr.splitlines()[-1]
    return judge(row, json.loads(told), view, case)


def judged(folder: Path, rows: dict[str, Row], only: list[str] | None, door: str | None) -> int:
    """Runs the rows whose folders are there, and says how many are wrong at a door."""
    wrong = dict.fromkeys(["http", "cli"], 0)
    asked = dict(wrong)
    with tempfile.TemporaryDirectory() as top, served(Path(top) / "data") as address:
        doors = {
            "http": lambda *of: over_http(address, *of),
            "cli": lambda *of: by_command(Path(top), *of),
        }
        for name, row in rows.items():
            case = folder / name
            if only and not {name, row.kind} & set(only) or not case.is_dir():
                continue
            for at, ask in doors.items():
                # A body of a form is no folder.
                if door not in (None, at) or at == "cli" and "body.bin" in row.files:
                    continue
                faults = [
                    fault for file in row.files or (None,) for fault in ask(case, file, row)
                ]
                asked[at] += 1
                wrong[at] += bool(faults)
                verdict = "; ".join(faults)[:200] or "right"
                print(f"{row.kind:7} {name:26} {at:5} {verdict}", flush=True)
    for at, count in asked.items():
        print(f"{at}: {count - wrong[at]} of {count} right")
    return int(any(wrong.values()))


def options(description: str | None, folder: Path | None) -> argparse.Namespace:
    """What a run is asked for; without a default folder none is an argument."""
    parser = argparse.ArgumentParser(description=description)
    if folder:
        parser.add_argument("folder", nargs="?", type=Path, default=folder)
    parser.add_argument("--only", action="append", help="a case or a kind")
    parser.add_argument("--door", choices=["http", "cli"], help="one door alone")
    return parser.parse_args()


def main() -> int:
    """Runs the rows; 1 where some value is not right."""
    asked = options(__doc__, ROOT.parent / "shared/review/cases")
    unknown = sorted(
        path.name for path in asked.folder.iterdir() if path.is_dir() and path.name not in ROWS
    )
    if unknown:
        print("no row for:", ", ".join(unknown))
    return judged(asked.folder, ROWS, asked.only, asked.door)


if __name__ == "__main__":
    sys.exit(main())
