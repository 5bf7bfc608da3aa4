"""More inputs of the kinds of `cases.py`, each another than those of the reviews, made here of the
generated room and run at both doors.

python3 more_cases.py [--only NAME]... [--door http|cli]

`SEGSPLAT_BIN` names the program. Pillow is needed. The right values are in `case(...)` above each
maker; a case that is no refusal has the room's four photos, depth and picture.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cases import LOST, Row, judged, options, whole
from PIL import Image, ImageDraw
from served import run

Maker = Callable[[Path, "Room"], None]
CASES: dict[str, tuple[Row, Maker]] = {}
#: Size of the room's photos, pixels; numbers of pixels below are of this size.
WIDTH, HEIGHT = 320, 240
#: A row of photos with a magenta thing that masks leave out.
MAGENTA = {"photos": 4, "fx": 320.0, "no_magenta": True, "warned": ("masks_used",)}


def case(name: str, row: Row) -> Callable[[Maker], Maker]:
    """A case of this name: its right values, and what makes its folder."""

    def add(maker: Maker) -> Maker:
        CASES[name] = (row, maker)
        return maker

    return add


def refused(kind: str, *words: str) -> Row:
    """A case that is refused with one of the words."""
    return Row(kind, refused=words)


def read(kind: str, *, psnr: float | None = 32.0, **values: Any) -> Row:
    """A case that is read right."""
    return whole(kind, psnr=psnr, **values)


def told(kind: str, *codes: str, **values: Any) -> Row:
    """A case that is read right with warnings of these codes."""
    return whole(kind, **{"psnr": None, "warned": codes, **values})


class Room:
    """The generated room: four photos, and a `transforms.json` of their cameras."""

    def __init__(self, folder: Path, width: int = WIDTH, quality: int = 95) -> None:
        self.width, self.height, self.quality = width, width * HEIGHT // WIDTH, quality
        run("sample", "-o", folder, "--photos", "4", "--size", f"{self.width}x{self.height}")
        said = json.loads((folder / "transforms.json").read_text())
        frames = sorted(said["frames"], key=lambda frame: frame["file_path"])
        self.poses = [frame["transform_matrix"] for frame in frames]
        names = [folder / frame["file_path"] for frame in frames]
        self.photos = [Image.open(name).convert("RGB") for name in names]

    def px(self, pixels: float) -> int:
        """Pixels of photos of the usual size as pixels of these."""
        return round(pixels * self.width / WIDTH)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """A size likewise."""
        return self.px(width), self.px(height)

    def camera(self, model: str, width: int, height: int, *numbers: float, rest: str = "") -> str:
        """A camera of COLMAP likewise; `rest` is not in pixels."""
        pixels = map(self.px, (width, height, *numbers))
        return " ".join(map(str, [model, *pixels, rest])).strip()

    def put(
        self,
        folder: Path,
        names: list[str] | None = None,
        photo: Callable[[Image.Image], Image.Image] = lambda photo: photo,
        **save: Any,
    ) -> list[str]:
        """Writes the photos; their names."""
        names = names or [f"{i:04}.jpg" for i in range(4)]
        for name, own in zip(names, self.photos, strict=True):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            kind = {"quality": self.quality} if path.suffix.lower() == ".jpg" else {}
            photo(own).save(path, **{**kind, **save})
        return names

    def json(
        self, names: list[str], *, frame: dict[str, Any] | None = None, **top: Any
    ) -> dict[str, Any]:
        """A `transforms.json`; `frame` is said of each frame, a function of its number."""
        w, h = self.width, self.height
        shared = {"fl_x": float(w), "fl_y": float(w), "cx": w / 2, "cy": h / 2, "w": w, "h": h}
        frames = [
            {
                "file_path": name,
                "transform_matrix": pose,
                **{
                    key: value(i) if callable(value) else value
                    for key, value in (frame or {}).items()
                },
            }
            for i, (name, pose) in enumerate(zip(names, self.poses, strict=True))
        ]
        return {**shared, **top, "frames": frames}

    def describe(self, folder: Path, names: list[str], **said: Any) -> None:
        """Writes a `transforms.json`."""
        text = json.dumps(self.json(names, **said), indent=1, ensure_ascii=False)
        (folder / "transforms.json").write_text(text, encoding="utf-8")

    def colmap(
        self,
        folder: Path,
        names: list[str],
        camera: str = "",
        change: Callable[[str], str] = lambda text: text,
        encoding: str = "utf-8",
    ) -> None:
        """Writes a model of COLMAP as text; `change` is done to `images.txt`."""
        folder.mkdir(parents=True, exist_ok=True)
        camera = camera or self.camera("PINHOLE", 320, 240, 320, 320, 160, 120)
        (folder / "cameras.txt").write_text(f"1 {camera}\n")
        lines = []
        for i, (name, pose) in enumerate(zip(names, self.poses, strict=True)):
            turn, place = to_camera(pose)
            numbers = " ".join(f"{value:.12f}" for value in [*quaternion(turn), *place])
            lines.append(f"{i + 1} {numbers} 1 {name}\n\n")
        (folder / "images.txt").write_bytes(change("".join(lines)).encode(encoding))
        (folder / "points3D.txt").write_text("")


def to_camera(pose: list[list[float]]) -> tuple[list[list[float]], list[float]]:
    """World-to-camera in OpenCV's axes of a pose in OpenGL's."""
    columns = [[row[0] for row in pose], [-row[1] for row in pose], [-row[2] for row in pose]]
    turn = [column[:3] for column in columns]
    centre = [row[3] for row in pose[:3]]
    place = [-sum(a * b for a, b in zip(row, centre, strict=True)) for row in turn]
    return turn, place


def quaternion(r: list[list[float]]) -> list[float]:
    """w x y z of a rotation that is turned by less than half a circle about x."""
    trace = r[0][0] + r[1][1] + r[2][2]
    if trace > 0:
        s = 2 * math.sqrt(1 + trace)
        w = s / 4
        rest = [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]]
        return [w, *(value / s for value in rest)]
    s = 2 * math.sqrt(1 + r[0][0] - r[1][1] - r[2][2])
    return [
        (r[2][1] - r[1][2]) / s,
        s / 4,
        (r[0][1] + r[1][0]) / s,
        (r[0][2] + r[2][0]) / s,
    ]


def exif(orientation: int) -> bytes:
    """EXIF with an orientation."""
    said = Image.Exif()
    said[0x0112] = orientation
    return said.tobytes()


# Names


def named(name: str, camera: Callable[[int], str], file: Callable[[int], str]) -> None:
    """A case in which cameras call photos otherwise than the folder does."""

    @case(name, read("names"))
    def make(folder: Path, room: Room) -> None:
        room.put(folder, [file(i) for i in range(4)])
        room.describe(folder, [camera(i) for i in range(4)])


named("file-url", lambda i: f"file:///C:/me/images/{i}.jpg", lambda i: f"images/{i}.jpg")
named("server-share", lambda i: f"\\\\nas\\share\\room\\{i}.jpg", lambda i: f"images/{i}.jpg")
named("percents", lambda i: f"images/IMG%20({i}).jpg", lambda i: f"images/IMG ({i}).jpg")
named(
    "two-unicode-forms",
    lambda i: f"images/K\u00fcche {i}.jpg",
    lambda i: unicodedata.normalize("NFD", f"images/K\u00fcche {i}.jpg"),
)
named("another-ending", lambda i: f"images/{i}.png", lambda i: f"images/{i}.jpg")
named("no-ending", lambda i: f"./images/{i}", lambda i: f"images/{i}.jpg")
named("through-dots", lambda i: f"../room/./images/../images/{i}.jpg", lambda i: f"images/{i}.jpg")
named(
    "rig-of-two",
    lambda i: f"D:\\rig\\{'left' if i < 2 else 'right'}\\{i % 2:06}.jpg",
    lambda i: f"images/{'left' if i < 2 else 'right'}/{i % 2:06}.jpg",
)


@case("case-in-colmap", read("names"))
def _(folder: Path, room: Room) -> None:
    room.put(folder / "images", [f"DSC_{i}.JPG" for i in range(4)], format="JPEG", quality=95)
    room.colmap(folder / "sparse/0", [f"dsc_{i}.jpg" for i in range(4)])


# What lies beside


@case("undistorted-in-dense", read("names", warned=("cameras_chosen",), silent=LOST))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "dense/images")
    room.colmap(folder / "dense/sparse", names)
    room.put(folder / "images", photo=lambda photo: photo.resize(room.size(334, 245)))
    lens = room.camera("OPENCV", 400, 300, 401, 401, 200, 150, rest="-0.1 0.01 0 0")
    room.colmap(folder / "sparse/0", names, lens)


@case("small-second-model", read("names", warned=("cameras_chosen",)))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "images")
    only = lambda text: "".join(text.splitlines(keepends=True)[:4])  # noqa: E731
    other = room.camera("PINHOLE", 320, 240, 500, 500, 160, 120)
    room.colmap(folder / "sparse/0", names, other, only)
    room.colmap(folder / "sparse/1", names)


@case("nested-training", read("names", warned=("cameras_chosen",)))
def _(folder: Path, room: Room) -> None:
    top = folder / "scans/room"
    names = room.put(top / "images")
    room.colmap(top / "sparse/0", names)
    training = top / "output/4f2a"
    training.mkdir(parents=True)
    lens = {"width": room.width, "height": room.height, "fx": 300, "fy": 300}
    pose = {"position": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
    listed = [{"id": i, "img_name": name[:-4], **lens, **pose} for i, name in enumerate(names)]
    (training / "cameras.json").write_text(json.dumps(listed))
    room.put(training / "train/ours_7000/renders", [f"{i:05}.jpg" for i in range(4)])


@case("smaller-and-depth", read("names"))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder, [f"images/{i}.png" for i in range(4)])
    for by in (2, 4):
        size = (room.width // by, room.height // by)
        small = lambda photo: photo.resize(size)  # noqa: B023, E731
        room.put(folder, [f"images_{by}/{i}.png" for i in range(4)], small)
    grey = lambda photo: photo.convert("L")  # noqa: E731
    room.put(folder, [f"depths/{i}.png" for i in range(4)], grey)
    room.describe(folder, names)


@case("blender-splits", read("names", photos=4, warned=()))
def _(folder: Path, room: Room) -> None:
    room.put(folder, [f"train/r_{i}.png" for i in range(4)])
    angle = 2 * math.atan(0.5)
    said = room.json([f"./train/r_{i}" for i in range(4)])
    frames = {"camera_angle_x": angle, "frames": said["frames"]}
    (folder / "transforms_train.json").write_text(json.dumps(frames))
    for split in ("test", "val"):
        (folder / f"transforms_{split}.json").write_text(json.dumps({**frames, "frames": []}))


# Cameras that contradict photos


PIXELS = {"fl_x", "fl_y", "cx", "cy", "w", "h", "fisheye_crop_radius"}


def said(name: str, row: Row, **json_said: Any) -> None:
    """A case of a key, at the top or (`frame`) in each frame."""

    @case(name, row)
    def make(folder: Path, room: Room) -> None:
        names = [f"images/{name}" for name in room.put(folder / "images")]
        pixels = {key: room.px(json_said[key]) for key in PIXELS & set(json_said)}
        room.describe(folder, names, **{**json_said, **pixels})


said("equirectangular-key", refused("lens", "equirectangular"), equirectangular=True)
said("lower-case-model", refused("lens", "equirectangular"), camera_model="equirectangular")
said("model-of-two-eyes", refused("lens", "VR180_L"), camera_model="VR180_L", fl_y=1)
said("ftheta", refused("lens", "ftheta_p0"), ftheta_p0=0.1, ftheta_p1=0.6)
said("orthographic", refused("lens", "orthographic"), frame={"orthographic": True})
said("mitsuba-axes", refused("lens", "from_mitsuba"), from_mitsuba=True)
said("false-keys", read("lens"), latlong=False, from_na=False, ftheta_p0=0, aabb_scale=32)
said("fisheye-circle", told("lens", "keys_unread", psnr=32.0), fisheye_crop_radius=150)
said("rolling-shutter", told("lens", "keys_unread", psnr=32.0), rolling_shutter=[0, 0, 0.02, 0])
said("wild-lens", Row("lens", photos=4, warned=("lens_doubtful",)), k1=50.0)
said("twice-the-size", told("lens", "intrinsics_scale", psnr=32.0), fl_x=640.0, fl_y=640.0,
     cx=320.0, cy=240.0, w=640, h=480)
said("another-aspect", refused("lens", "320x320"), w=320, h=320)
said("simple-pinhole", read("lens"), camera_model="simple_pinhole")


@case("keys-twice", refused("lens", "two values"))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{name}" for name in room.put(folder / "images")]
    room.describe(folder, names)
    file = folder / "transforms.json"
    file.write_text(file.read_text().replace('{\n "fl_x"', '{\n "fl_x": 200.0,\n "fl_x"', 1))


def scaled(pose: list[list[float]], scales: tuple[float, float, float]) -> list[list[float]]:
    """A pose whose columns are multiplied."""
    by = (*scales, 1.0)
    return [[value * by[i] for i, value in enumerate(row)] for row in pose[:3]] + [pose[3]]


@case("similarity", told("lens", "poses_scaled", psnr=32.0))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{name}" for name in room.put(folder / "images")]
    poses = [scaled(pose, (0.8, 0.8, 0.8)) for pose in room.poses]
    room.describe(folder, names, frame={"transform_matrix": lambda i: poses[i]})


@case("not-a-similarity", refused("lens", "not orthonormal"))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{name}" for name in room.put(folder / "images")]
    poses = [scaled(pose, (1.25, 1.0, 1.0)) for pose in room.poses]
    room.describe(folder, names, frame={"transform_matrix": lambda i: poses[i]})


@case("lens-undone-already", Row("lens", photos=4, warned=("lens_doubtful",)))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "images", photo=lambda photo: photo.resize(room.size(309, 232)))
    lens = room.camera("SIMPLE_RADIAL", 320, 240, 320, 160, 120, rest="0.08")
    room.colmap(folder / "distorted/sparse/0", names, lens)


def turned(
    name: str, row: Row, turn: Image.Transpose | None, orientation: int, colmap: bool = False
) -> None:
    """A case of photos that are stored turned, with an EXIF orientation, and upright cameras."""

    @case(name, row)
    def make(folder: Path, room: Room) -> None:
        turn_it = lambda photo: photo.transpose(turn) if turn is not None else photo  # noqa: E731
        more = {"exif": exif(orientation)} if orientation else {}
        names = room.put(folder / "images", photo=turn_it, **more)
        if colmap:
            room.colmap(folder / "sparse/0", names)
        else:
            room.describe(folder, [f"images/{name}" for name in names])


TURNS = Image.Transpose
turned("exif-8-by-size", told("lens", "photos_turned"), TURNS.ROTATE_270, 8)
turned("exif-3-in-colmap", told("lens", "photos_turned"), TURNS.ROTATE_180, 3, colmap=True)
turned("exif-2-mirrored", told("lens", "photos_turned"), TURNS.FLIP_LEFT_RIGHT, 2)
turned("exif-6-as-stored", read("lens", psnr=32.0, silent=(*LOST, "photos_turned")), None, 6)
turned("exif-3-as-stored", read("lens", psnr=32.0, silent=(*LOST, "photos_turned")), None, 3)
turned(
    "turned-without-exif", Row("lens", photos=4, warned=("photos_turned",)), TURNS.ROTATE_180, 0
)


# Masks: a magenta thing stands before each photo, and the masks leave it out.


def with_thing(photo: Image.Image, alpha: bool = False) -> Image.Image:
    """A photo with a magenta thing."""
    photo, by = photo.copy(), photo.width / WIDTH
    box = [by * at for at in (130, 90, 190, 150)]
    ImageDraw.Draw(photo).ellipse(box, fill=(255, 0, 255))
    if alpha:
        photo.putalpha(mask_of(photo.size))
    return photo


def mask_of(size: tuple[int, int], left_out: int = 0, kept: int = 255) -> Image.Image:
    """The mask of the thing, with some room around it."""
    mask = Image.new("L", (WIDTH, HEIGHT), kept)
    ImageDraw.Draw(mask).ellipse((122, 82, 198, 158), fill=left_out)
    return mask.resize(size, Image.Resampling.NEAREST)


def masked(
    name: str, mask_name: Callable[[int], str], colmap: bool = False, **mask: Any
) -> None:
    """A case of masks of these names."""

    @case(name, Row("masks", **MAGENTA))
    def make(folder: Path, room: Room) -> None:
        names = room.put(folder / "images", photo=with_thing)
        for i in range(4):
            path = folder / mask_name(i)
            path.parent.mkdir(parents=True, exist_ok=True)
            by = mask.get("by", 1)
            size = (room.width // by, room.height // by)
            mask_of(size, *mask.get("values", (0, 255))).save(path)
        if colmap:
            room.colmap(folder / "sparse/0", names)
        else:
            room.describe(folder, [f"images/{name}" for name in names])


masked("masks-of-colmap", lambda i: f"masks/{i:04}.jpg.png", colmap=True)
masked("masks-by-stem", lambda i: f"masks/{i:04}.png", colmap=True)
masked("masks-half-size", lambda i: f"masks/{i:04}.png", colmap=True, by=2)
masked("masks-of-ones", lambda i: f"mask/{i:04}.PNG", colmap=True, values=(0, 1))
masked("masks-of-instant-ngp", lambda i: f"images/dynamic_mask_{i:04}.png", values=(255, 0))


@case("mask-path-from-windows", Row("masks", **MAGENTA))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{name}" for name in room.put(folder / "images", photo=with_thing)]
    (folder / "alphas").mkdir()
    for i in range(4):
        mask_of((room.width, room.height)).save(folder / f"alphas/m{i}.png")
    room.describe(folder, names, frame={"mask_path": lambda i: f"C:\\x\\alphas\\m{i}.png"})


@case("one-mask-for-all", Row("masks", **MAGENTA))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{name}" for name in room.put(folder / "images", photo=with_thing)]
    mask_of((room.width, room.height)).save(folder / "ego.png")
    room.describe(folder, names, frame={"mask_path": "./ego.png"})


@case("labels-in-masks", read("masks", silent=("masks_used",)))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{name}" for name in room.put(folder / "images")]
    (folder / "masks").mkdir()
    for i in range(4):
        mask_of((room.width, room.height), 3, 0).save(folder / f"masks/{i:04}.png")
    room.describe(folder, names, frame={"mask_file": lambda i: f"masks/{i:04}.png"})


@case("alpha", Row("masks", photos=4, fx=320.0, no_magenta=True))
def _(folder: Path, room: Room) -> None:
    names = [f"images/{i}.png" for i in range(4)]
    room.put(folder, names, lambda photo: with_thing(photo, alpha=True))
    room.describe(folder, names)


@case("mask-of-another-aspect", refused("masks", "200x200"))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "images", photo=with_thing)
    (folder / "masks").mkdir()
    for i in range(4):
        mask_of((200, 200)).save(folder / f"masks/{i:04}.png")
    room.colmap(folder / "sparse/0", names)


# Texts


def text(name: str, row: Row, change: Callable[[str], str], encoding: str = "utf-8") -> None:
    """A case of an `images.txt`."""

    @case(name, row)
    def make(folder: Path, room: Room) -> None:
        names = room.put(folder / "images")
        room.colmap(folder / "sparse/0", names, change=change, encoding=encoding)


def with_commas(line: str) -> str:
    """A line with commas for the points of its numbers."""
    numbers, _, name = line.rpartition(" ")
    return f"{numbers.replace('.', ',')} {name}" if name.strip() else line


text("commas", read("text"), lambda text: "\n".join(map(with_commas, text.split("\n"))))
text(
    "commas-in-one-line",
    refused("text", "commas"),
    lambda text: "\n".join([with_commas(text.split("\n")[0]), *text.split("\n")[1:]]),
)
text("utf-16", read("text"), lambda text: text.replace("\n", "\r\n"), "utf-16")
text("minus-signs", read("text"), lambda text: text.replace("-", "\u2212"))


@case("3dgs-alone", read("text"))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "images")
    listed = []
    for i, (name, pose) in enumerate(zip(names, room.poses, strict=True)):
        turn, _ = to_camera(pose)
        rotation = [list(row) for row in zip(*turn, strict=True)]
        size = {"width": room.width, "height": room.height, "fx": room.width, "fy": room.width}
        place = {"position": [row[3] for row in pose[:3]], "rotation": rotation}
        listed.append({"id": i, "img_name": name[:-4], **size, **place})
    (folder / "cameras.json").write_text(json.dumps(listed))


@case("bundler", read("text"))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "images")
    lines = ["# Bundle file v0.3", "4 0"]
    for pose in room.poses:
        columns = [[row[i] for row in pose[:3]] for i in range(3)]
        centre = [row[3] for row in pose[:3]]
        place = [-sum(a * b for a, b in zip(row, centre, strict=True)) for row in columns]
        lines += [f"{room.width} 0 0", *(" ".join(map(str, row)) for row in [*columns, place])]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"images/{name}\n" for name in names))


@case("reality-capture-table", refused("text", "RealityCapture"))
def _(folder: Path, room: Room) -> None:
    names = room.put(folder / "images")
    head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
    lines = [f"{name},0,{i},0,0,0,0,36,0,0,0,0,0,0,0,0" for i, name in enumerate(names)]
    (folder / "cameras.csv").write_text("\n".join([head, *lines]))


# Photos


def kept_as(name: str, row: Row, ending: str, **save: Any) -> None:
    """A case of photos in a format, called by an ending."""

    @case(name, row)
    def make(folder: Path, room: Room) -> None:
        names = room.put(folder, [f"images/{i}{ending}" for i in range(4)], **save)
        room.describe(folder, names)


kept_as("tiff", read("photos"), ".tif", format="TIFF", compression="tiff_lzw")
kept_as("bmp", read("photos"), ".bmp", format="BMP")
kept_as("webp-called-jpg", read("photos"), ".jpg", format="WEBP", quality=95)
kept_as("jpeg-called-heic", read("photos"), ".HEIC", format="JPEG", quality=95)
kept_as("jpeg-without-ending", read("photos"), "", format="JPEG", quality=95)


def other_format(name: str, words: tuple[str, ...], ending: str, start: bytes) -> None:
    """A case of photos that are not read, by their first bytes."""

    @case(name, Row("photos", refused=words))
    def make(folder: Path, room: Room) -> None:
        names = [f"images/{i}{ending}" for i in range(4)]
        (folder / "images").mkdir()
        for file in names:
            (folder / file).write_bytes(start + bytes(200))
        room.describe(folder, names)


HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"
other_format("heic", ("Most Compatible",), ".heic", HEIC)
other_format("heic-called-jpg", ("HEIC",), ".jpg", HEIC)
other_format("avif", ("AVIF", "avif"), ".avif", b"\0\0\0\x1Cftypavif\0\0\0\0mif1avifmiaf")


@case("large-jpeg", told("photos", "photos_reduced", fx=320.0 * 2048 / 320))
def _(folder: Path, room: Room) -> None:
    large = lambda photo: photo.resize((8000, 6000), Image.Resampling.BICUBIC)  # noqa: E731
    names = [f"images/{name}" for name in room.put(folder / "images", photo=large)]
    lens = {"fl_x": 8000.0, "fl_y": 8000.0, "cx": 4000.0, "cy": 3000.0}
    room.describe(folder, names, **lens, w=8000, h=6000)


def main() -> int:
    """Makes the inputs and runs them; 1 where some value is not right."""
    asked = options(__doc__, None)
    with tempfile.TemporaryDirectory() as top:
        folder = Path(top)
        room = Room(folder / "room")
        for name, (row, maker) in CASES.items():
            if not asked.only or {name, row.kind} & set(asked.only):
                (folder / name).mkdir()
                maker(folder / name, room)
        rows = {name: row for name, (row, _) in CASES.items()}
        return judged(folder, rows, asked.only, asked.door)


if __name__ == "__main__":
    sys.exit(main())
