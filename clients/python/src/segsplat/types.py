"""What the server tells, as plain typed data. Unknown fields of newer servers are left out."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, TypeAlias, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import TypedDict

from .png import encode_png

Floats: TypeAlias = NDArray[np.float64]
Kind = Literal["color", "depth", "alpha", "holes", "semantics", "relevancy", "mask"]
Preset = Literal["default", "paper"]
#: Options of a scene by name.
Method: TypeAlias = dict[str, Any]
State = Literal["queued", "running", "done", "failed", "cancelled"]

T = TypeVar("T")


def parse(kind: type[T], data: Mapping[str, Any]) -> T:
    """A dataclass of this kind from the JSON object of the same field names."""
    hints = _hints(typing.cast(Any, kind))
    return kind(**{name: _value(hints[name], data[name]) for name in hints if name in data})


@cache
def _hints(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in dataclasses.fields(kind)}


def _value(hint: Any, value: Any) -> Any:
    if isinstance(hint, types.UnionType):  # X | None, which is empty in a message of gRPC
        return None if value is None or value == "" else _value(hint.__args__[0], value)
    if typing.get_origin(hint) is tuple:
        return tuple(_value(hint.__args__[0], one) for one in value)
    if hint == Method:  # in an order of its own on each wire
        return dict(sorted(value.items()))
    if hint == Floats:
        return np.asarray(value, np.float64)
    if hint is Camera:
        return Camera.of_json(value)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return parse(hint, value)
    return value


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera. OpenCV: x right, y down, z forward; world frame of the upload."""

    #: [3, 3] intrinsics in pixels; the centre of the first pixel is (0.5, 0.5).
    K: Floats
    #: [4, 4] rigid pose.
    camera_to_world: Floats
    #: Pixels.
    width: int
    #: Pixels.
    height: int

    @staticmethod
    def of_json(data: Mapping[str, Any]) -> Camera:
        """From the server's `{"intrinsics", "camera_to_world"}`."""
        lens = data["intrinsics"]
        return Camera(
            intrinsics(lens["fx"], lens["fy"], lens["cx"], lens["cy"]),
            np.reshape(np.asarray(data["camera_to_world"], np.float64), (4, 4)),
            lens["width"],
            lens["height"],
        )

    def to_json(self) -> dict[str, Any]:
        """As `cameras.json` has it."""
        k = np.asarray(self.K, np.float64)
        lens = {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        pose = np.asarray(self.camera_to_world, np.float64)
        return {
            "intrinsics": {**lens, "width": self.width, "height": self.height},
            "camera_to_world": pose.reshape(16).tolist(),
        }

    def project(self, points: ArrayLike) -> Floats:
        """[N, 2] pixels of [N, 3] world points; NaN where a point is not in front."""
        world = np.asarray(points, np.float64).reshape(-1, 3)
        rotation, centre = self.camera_to_world[:3, :3], self.camera_to_world[:3, 3]
        seen = (world - centre) @ rotation @ self.K.T
        depth = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
        return np.asarray(seen[:, :2] / depth)

    def unproject(self, depth: ArrayLike) -> Floats:
        """[H, W, 3] world points of [H, W] depths along the axis; NaN where the depth is 0."""
        z = np.asarray(depth, np.float64)
        v, u = np.indices(z.shape) + 0.5
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(self.K).T
        there = rays * np.where(z > 0, z, np.nan)[..., None]
        return np.asarray(
            there @ self.camera_to_world[:3, :3].T + self.camera_to_world[:3, 3], np.float64
        )


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Floats:
    """The [3, 3] matrix."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


class Viewpoint(TypedDict, total=False):
    """Where to look from. One pose: `camera`, `camera_to_world`, `eye` or `from_`; without any, the
    first photo's. One lens: `camera`, `K` or `fov`; without any, the photos'.
    """

    #: Pose, lens and size in one.
    camera: Camera
    #: [4, 4], OpenCV, world frame of the upload.
    camera_to_world: ArrayLike
    #: [3, 3] in pixels of the picture asked for.
    K: ArrayLike
    #: Vertical field of view, degrees.
    fov: float
    #: [3] camera centre, world units; goes with `target`.
    eye: ArrayLike
    #: [3] point in the middle of the picture.
    target: ArrayLike
    #: [3] up in the picture; as in the photos by default.
    up: ArrayLike
    #: Index of a photo.
    from_: int
    #: Index of another photo.
    to: int
    #: 0 at `from_`, 1 at `to`.
    t: float


class Drawing(TypedDict, total=False):
    """How a view is drawn."""

    #: Pixels; by default at most 384, in the photos' shape.
    width: int
    #: Pixels.
    height: int
    #: Opacity compensated for the blur of small Gaussians; as the scene's file says by default.
    antialiased: bool
    #: Near plane, world units.
    near: float
    #: Largest difference to the exact picture that is accepted for less time, levels of 255: 0 to
    #: 32, "exact" (0) or "fast" (2). Views with depth are exact.
    error: float | Literal["exact", "fast"]
    #: Permission to draw one merged Gaussian for many that are far away, pixels: how far one may be
    #: from the one that stands for it, 0 (none is merged) to 16. `error` does not count what they
    #: change.
    detail: float
    #: "paper" draws and scores as the paper does; that of the scene by default.
    preset: Preset
    #: Photos whose Gaussians are in front, the nearest ones; 0: those of all. That of the preset by
    #: default.
    front_photos: int
    #: Whether magnified Gaussians are blurred as the network learnt them; that of the preset by
    #: default.
    magnify: bool


class ViewOptions(Drawing, total=False):
    """How a view is drawn, and over what."""

    #: "backdrop", "black", "white", "#rrggbb" or [3] of 0 to 1.
    background: str | Sequence[float]
    #: First column, first row, width, height of the part that is drawn, pixels.
    crop: tuple[int, int, int, int]


class TextOptions(TypedDict, total=False):
    """How a text is scored; by default as the preset says."""

    #: Canonical texts that a text is compared with.
    canon: Sequence[str]
    #: Sharpness of the comparison.
    tau: float
    #: Relevancy from which a text selects, 0 to 1.
    cut: float
    #: Whether the bank's rows are brought to length 1 before they are blended.
    unit_rows: bool
    #: Coverage under which a pixel has no relevancy, 0 to 1.
    coverage_floor: float
    #: An entry that fits a text by so much less than the best one (cosine, 0 to 2) is not selected.
    near_best: float
    #: Difference of cosines to the canonical texts at which the relevancy is 0.5, -2 to 2.
    margin: float
    #: Share of the bundle's list of words that may fit an entry better than the text, 0 to 1; 1:
    #: the list does not count.
    rivals: float
    #: Seconds to wait for semantics that are being made; the server's limit by default.
    wait: float


class ViewCall(Viewpoint, ViewOptions, TextOptions, total=False):
    """Options of one view."""


class ViewsCall(ViewOptions, TextOptions, total=False):
    """Options of many views."""


class QueryCall(Viewpoint, Drawing, TextOptions, total=False):
    """Options of a query, a pick, or features."""


class ExportCall(TextOptions, total=False):
    """Options of a file."""

    #: How texts are scored, and views of a folder drawn; that of the scene by default.
    preset: Preset


class SceneOptions(TypedDict, total=False):
    """How a scene is made."""

    #: "solve" has the server find the cameras from the photos, also where the source has some.
    cameras: Literal["auto", "solve"]
    #: When texts can be asked: "lazy" from the first one on, "eager" at once, "off" never.
    semantics: Literal["lazy", "eager", "off"]
    #: "paper" makes, understands, draws and scores the scene as the paper does. The options from
    #: `density` on change single fields of the preset.
    preset: Preset
    #: Photos that the network takes at once.
    max_views: int
    #: Name of the bundle of networks; the loaded one by default.
    bundle: str
    #: Whether the finished scene is refined: "auto", "off" or milliseconds; as the server is set by
    #: default.
    refine: str | int
    #: Words whose things take no part in the scene, as "person": what is found of them in the
    #: photos is left out, as by a mask.
    ignore: str | Sequence[str]
    #: "full" keeps one Gaussian a pixel, "thinned" fewer where photos are flat.
    density: Literal["thinned", "full"]
    #: Whether Gaussians that add nothing are dropped.
    prune: bool
    #: Photos that may keep Gaussians of one surface; 0 keeps those of all.
    fuse_layers: int
    #: Whether views have the photos' colours by direction behind them.
    backdrop: bool
    #: Masks of a prompt: the widest that passes, or one size alone.
    mask_level: Literal["widest", "whole", "part", "subpart"]
    #: Whether prompts are skipped where a mask lies already.
    skip_covered: bool
    #: Whether a photo is asked first where masks of earlier photos reappear.
    seeds: bool
    #: Whether masks are judged at the photo's own pixels.
    full_resolution: bool
    #: Whether masks are also held to each other's pixels and to bounds on their area.
    mask_filters: bool
    #: Whether the crop of a mask shows all of it, also where another mask lies on it.
    crop_whole: bool
    #: Whether the crop of a mask has the bundle's margin.
    crop_margin: bool
    #: Whether the embedding of a mask is also that of its place in the whole photo.
    context: bool
    #: Whether masks of different photos on the same Gaussians share a row of the bank; else K-Means
    #: makes the rows, with `lambda_`, `bank_rows` and `merge_cosine`.
    tracks: bool
    #: Without tracks: rows of the bank over the mean number of masks of a photo.
    lambda_: float
    #: Without tracks: rows of the bank (M); 0: by `lambda_`.
    bank_rows: int
    #: Whether all photos that show a Gaussian vote for its entry.
    votes: bool
    #: Without tracks: least cosine of two entries that become one; 0: no two do.
    merge_cosine: float
    #: Photos whose Gaussians are in front in a view; 0: those of all.
    front_photos: int
    #: Whether a view that magnifies the photos blurs the Gaussians as the network learnt them.
    magnify: bool
    #: What refinement does with the photos' cameras: "mended" learns them, where photos that are
    #: held out show that they are wrong; "given" leaves them.
    camera: Literal["mended", "given"]


@dataclass(frozen=True)
class StageTime:
    """Time of one stage."""

    stage: str
    #: Milliseconds.
    ms: float


@dataclass(frozen=True)
class Doubt:
    """Something that looks wrong: with a capture, or with a text."""

    #: Stable snake_case code.
    code: str
    #: A sentence.
    message: str
    #: The measured figure; None of a text.
    value: float | None = None


@dataclass(frozen=True)
class SceneFault:
    """Why a scene failed."""

    #: Code of the table of errors.
    code: str
    #: Names input, value and bound.
    message: str


@dataclass(frozen=True)
class DropCount:
    """Gaussians that were dropped or clamped."""

    #: Stable snake_case reason.
    reason: str
    count: int


@dataclass(frozen=True)
class MovedCamera:
    """How far a camera is from where it was given."""

    #: Angle of its turn.
    degrees: float
    #: Way of its centre, as a share of the scene's median depth.
    share: float


@dataclass(frozen=True)
class RefineReport:
    """What a refinement made of a scene."""

    steps: int
    #: Seconds of work.
    seconds: float
    #: Indices of the photos that it did not learn from.
    held_out: tuple[int, ...]
    #: PSNR of these photos before and after, dB; None where none was held out.
    psnr_before: float | None = None
    psnr_after: float | None = None
    gaussians_before: int = 0
    gaussians_after: int = 0
    #: How far the camera of each photo moved; empty where they stay as they were given.
    cameras: tuple[MovedCamera, ...] = ()
    #: Photos that took no part: their cameras cannot be right.
    left_out: tuple[str, ...] = ()
    #: Photos that were learnt beside those of the scene: the networks did not see them.
    more_photos: int = 0


@dataclass(frozen=True, eq=False)
class Ground:
    """A plane that things stand on."""

    #: Up, a unit vector.
    normal: Floats
    #: A point of it, in the middle of what was seen of it; world units.
    point: Floats
    #: Share of the scene's Gaussians that lie on it, 0 to 1.
    share: float


@dataclass(frozen=True, eq=False)
class Scale:
    """What is known of how large a scene is and how it stands."""

    #: Where the metres come from: none, capture, given.
    source: str
    #: Up, a unit vector of the world.
    up: Floats
    #: Metres of a unit of the world, where they are known.
    metres_per_unit: float | None = None
    #: The ground, where one was found.
    ground: Ground | None = None


@dataclass(frozen=True)
class Measured:
    """Lengths between points of a scene."""

    #: Unit of the lengths: metre; unknown: that of the world. Areas are in its square.
    unit: str
    #: From the first point to the last, by way of all others.
    length: float
    #: From each point to the next one.
    legs: tuple[float, ...] = ()
    #: Area of the polygon of the points; of three and more.
    area: float | None = None
    #: Of each point over the ground; empty where none was found.
    heights: tuple[float, ...] = ()


@dataclass(frozen=True)
class PlacedPhoto:
    """A photo whose camera the server found."""

    #: File name.
    file: str
    #: Keypoints that agree with the points of the scene.
    inliers: int
    #: Root of the mean squared distance of these to their points, pixels of the photo.
    error_px: float
    #: Radial distortion that was taken out of the photo: k1 of OpenCV's model.
    k1: float


@dataclass(frozen=True)
class LeftOutPhoto:
    """A photo whose camera the server did not find."""

    #: File name.
    file: str
    #: Why, a sentence.
    reason: str


@dataclass(frozen=True)
class CamerasReport:
    """What is known of the cameras of a scene."""

    #: Whether they came with the photos, or were computed from them.
    source: Literal["given", "solved"] = "given"
    #: How likely solved cameras are right, 0 to 1; None of given ones.
    confidence: float | None = None
    #: Solved cameras: their photos, in the order of the scene's cameras.
    placed: tuple[PlacedPhoto, ...] = ()
    #: Photos that are no part of the scene.
    left_out: tuple[LeftOutPhoto, ...] = ()
    #: What a unit of the world is, as far as the capture says: metre, unknown.
    unit: str = "unknown"


@dataclass(frozen=True, eq=False)
class Report:
    """How the making of a scene went."""

    photos: int
    views_used: int
    gaussians: int
    #: [2] nearest and farthest depth searched, world units.
    depth_range: Floats
    #: Median depth of the Gaussians from the cameras, world units.
    median_depth: float
    #: Mean share of a photo's pixels found in its best partner, 0 to 1.
    overlap: float
    stages: tuple[StageTime, ...]
    execution_provider: str
    #: What looks wrong with the capture.
    warnings: tuple[Doubt, ...] = ()
    #: [V] focal length of each photo in the network's picture of it, pixels; 0 where it was not
    #: used.
    network_focal_px: tuple[float, ...] = ()
    #: Format of the file of Gaussians that the scene is; None where it was made of photos.
    file_format: str | None = None
    #: Whether that file was made for antialiased views, which are then the default.
    antialiased: bool = False
    #: How it was made: the options of the scene, by name.
    method: Method = dataclasses.field(default_factory=dict)
    #: Gaussians dropped or clamped.
    dropped: tuple[DropCount, ...] = ()
    #: What refinement made of it; None where it was not refined.
    refinement: RefineReport | None = None
    #: Where the cameras come from.
    cameras: CamerasReport = CamerasReport()


@dataclass(frozen=True)
class SemanticsReport:
    """How the making of a scene's semantics went."""

    #: [V] masks of each photo.
    masks: tuple[int, ...]
    #: Entries of the bank (M).
    bank_size: int
    #: Gaussians with an entry.
    labelled: int
    #: sha256 of the bundle that made them, hex.
    bundle_sha256: str
    stages: tuple[StageTime, ...]
    execution_provider: str
    #: How they were made: the options of the scene, by name.
    method: Method = dataclasses.field(default_factory=dict)


@dataclass(frozen=True)
class Semantics:
    """What can be asked of a scene by text."""

    available: bool
    state: Literal["off", "none", "running", "ready", "failed"]
    #: Share of their making that is done, 0 to 1.
    fraction: float
    stage: str | None = None
    reason: str | None = None
    #: Entries of the bank (M).
    bank_size: int | None = None
    error: SceneFault | None = None
    #: Counts and times, once ready.
    report: SemanticsReport | None = None


@dataclass(frozen=True)
class Refinement:
    """How far the refinement of a scene is."""

    state: Literal["none", "running", "done", "failed"] = "none"
    #: Share of its time that is spent, 0 to 1.
    fraction: float = 0.0
    #: Why it failed; the scene is served as it was.
    error: SceneFault | None = None


@dataclass(frozen=True)
class Growth:
    """How far photos are that join a scene, or leave it."""

    state: Literal["none", "running", "done", "failed"] = "none"
    #: Calls whose photos are not in the served version yet.
    waiting: int = 0
    #: Stage at work while running.
    stage: str | None = None
    #: Share of that work that is done, 0 to 1.
    fraction: float = 0.0
    #: Why the last one was given up; the scene is served as it was.
    error: SceneFault | None = None


@dataclass(frozen=True)
class SceneStatus:
    """A scene at one moment."""

    #: 32 hex digits.
    id: str
    state: State
    #: Share of the work that is done, 0 to 1.
    fraction: float
    #: Milliseconds since 1970.
    created_ms: int
    #: Milliseconds since 1970.
    updated_ms: int
    semantics: Semantics
    stage: str | None = None
    error: SceneFault | None = None
    report: Report | None = None
    #: Counts what was served under this id: 0 until it is done, then 1, and one more with each
    #: better version that refinement publishes, and with each change of its photos.
    version: int = 0
    refinement: Refinement = Refinement()
    growth: Growth = Growth()


@dataclass(frozen=True)
class Photo:
    """An input photo."""

    #: File name.
    file: str
    #: Camera of the undistorted photo.
    camera: Camera


@dataclass(frozen=True)
class Event:
    """What happens to a scene."""

    #: "done", "failed" and "cancelled" are last; of a scene that is being refined a "version" each
    #: follows "done". "edited" is told to who asks for edits.
    event: State | Literal["version", "edited"]
    #: Stage at work while running.
    stage: str | None = None
    #: Share of the work that is done, 0 to 1.
    fraction: float = 0.0
    #: Jobs that go first while queued.
    ahead: int = 0
    #: Code of the table of errors, when failed.
    code: str | None = None
    #: Why it failed.
    message: str | None = None
    #: The version that is served, of a "version".
    version: int | None = None
    #: How many edits the scene has, of an "edited".
    edits: int | None = None

    @property
    def is_last(self) -> bool:
        """Whether the scene is made, or will not be. Only versions and edits follow."""
        return self.event in ("done", "failed", "cancelled")


@dataclass(frozen=True)
class KnownWord:
    """How well the server knows a word, on photographs that no training saw."""

    word: str
    #: What to expect of it; "unmeasured" where too few photographs show it.
    trust: Literal["good", "fair", "poor", "unmeasured"]
    #: Cut things and whole photographs that it may be said of, and the share of each that it
    #: selects.
    things: int
    things_found: float | None
    photographs: int
    photographs_found: float | None
    #: Share of all others that it selects.
    absent: float


@dataclass(frozen=True)
class Network:
    """A network of the bundle."""

    #: What it does: "geometry", "masks.encoder" and so on.
    name: str
    #: File in the bundle.
    file: str
    #: Of the file, hex.
    sha256: str
    size_bytes: int
    #: Licence of the weights.
    licence: str
    #: Photos it takes at once; 0 where it takes none.
    views_max: int
    #: Working sizes, [height, width].
    sizes: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class CallerLimits:
    """What a caller may send and ask for."""

    #: Photos of a scene.
    photos_max: int
    #: Bytes of an upload.
    upload_bytes_max: int
    #: Pixels of a photo as it is sent.
    photo_pixels_max: int
    #: Longer side of a photo as the server keeps it, pixels.
    photo_side_kept_max: int
    #: Pixels of all photos that the networks see, as the server keeps them.
    photos_pixels_kept_max: int
    #: Cameras of one call for views.
    cameras_max: int
    #: Those of the photos of a scene that the networks see.
    network_photos_max: int = 64


@dataclass(frozen=True)
class Models:
    """What makes the scenes."""

    bundle: str
    bundle_sha256: str
    execution_provider: str
    renderer: str
    server_version: str
    #: What was measured of everyday words; empty where the bundle does not say.
    words: tuple[KnownWord, ...] = ()
    #: Networks of the bundle.
    models: tuple[Network, ...] = ()
    #: What a caller may send and ask for; None of a server that does not say.
    limits: CallerLimits | None = None


@dataclass(frozen=True, eq=False)
class Box:
    """A connected part of what a text found, and its box in the world frame of the upload."""

    #: Gaussians in it.
    gaussians: int
    #: Relevancy of its best entry, 0 to 1; of those that a tenth of its Gaussians have.
    score: float
    #: [3] centre, world units.
    center: Floats
    #: [3, 3] unit axes, one a row.
    axes: Floats
    #: [3] full lengths along the axes, world units.
    size: Floats
    #: [3] mean centre of its Gaussians, world units.
    centroid: Floats
    #: [3, 3] covariance of its Gaussians, each counted once, world units squared.
    covariance: Floats
    #: [V] share of its Gaussians that each photo of the scene shows, 0 to 1.
    visibility: Floats

    @property
    def corners(self) -> Floats:
        """[8, 3] world points; corner 4a + 2b + c is at the far end of axis 0 where a is 1, of
        axis 1 where b is 1, of axis 2 where c is 1.
        """
        ends = np.indices((2, 2, 2)).reshape(3, 8).T - 0.5
        return np.asarray(self.center + (ends * self.size) @ self.axes)


@dataclass(frozen=True)
class Peak:
    """The pixel of the highest relevancy."""

    x: int
    y: int
    #: 0 to 1.
    relevancy: float


@dataclass(frozen=True, eq=False)
class Match:
    """What one text found."""

    text: str
    #: [M] relevancy of each entry of the scene's bank, 0 to 1; `scores[m - 1]` is of entry m.
    scores: Floats
    #: Entries selected, counted from 1.
    entries: tuple[int, ...]
    #: Whether the scene has what the text names: some Gaussian is selected.
    found: bool
    #: Gaussians selected.
    gaussians: int
    #: One box for each connected part, the one with the best score first.
    boxes: tuple[Box, ...]
    #: The measured word that the text is about, one of `Models.words`; None where there is none.
    word: str | None
    #: What to expect of that word: good, fair, poor or unmeasured.
    trust: str | None
    #: What makes the answer doubtful.
    warnings: tuple[Doubt, ...]
    #: [H, W] bool, the pixels of the view.
    mask: NDArray[np.bool_]
    #: Where the relevancy is highest in the view.
    peak: Peak | None

    def __repr__(self) -> str:
        return f"<Match {self}>"

    @property
    def score(self) -> float:
        """The best relevancy of any entry, 0 to 1; from 0.5 on the text is found."""
        return float(self.scores.max(initial=0.0))

    @staticmethod
    def of_json(data: Mapping[str, Any]) -> Match:
        """From a result of the server's query."""
        view = data.get("view") or {}
        return Match(
            text=data["text"],
            scores=np.asarray(data["scores"], np.float64),
            entries=tuple(data["entries"]),
            found=data["found"],
            gaussians=data["gaussians"],
            boxes=tuple(parse(Box, part) for part in data["parts"]),
            word=data.get("word") or None,
            trust=data.get("trust") or None,
            warnings=tuple(parse(Doubt, one) for one in data["warnings"]),
            mask=decode_rle(view["mask_rle"]) if "mask_rle" in view else np.zeros((0, 0), bool),
            peak=parse(Peak, view["peak"]) if view.get("peak") else None,
        )

    def __str__(self) -> str:
        """`fox: 8,120 Gaussians in 1 part, score 0.86 (good)`, or `fox: not found (good)`."""
        parts = f"{len(self.boxes)} part{'s' * (len(self.boxes) != 1)}"
        found = f"{self.gaussians:,} Gaussians in {parts}, score {self.score:.2f}"
        trust = self.trust or "no word that was measured"
        return f"{self.text}: {found if self.found else 'not found'} ({trust})"

    def _repr_png_(self) -> bytes | None:
        return encode_png(self.mask.astype(np.uint8) * 255) if self.mask.size else None


@dataclass(frozen=True)
class Scoring:
    """How texts were scored."""

    #: Whether the bank's rows were brought to length 1 before they were blended.
    unit_rows: bool
    #: Canonical texts that a text is compared with.
    canon: tuple[str, ...]
    #: Sharpness of the comparison.
    tau: float
    #: Coverage under which a pixel has no relevancy, 0 to 1.
    coverage_floor: float
    #: Relevancy from which a text selects, 0 to 1.
    cut: float
    #: An entry that fits a text by so much less than the best one (cosine) was not selected.
    near_best: float
    #: Difference of cosines to the canonical texts at which the relevancy is 0.5.
    margin: float
    #: Share of the bundle's list of words that may fit an entry better than the text, 0 to 1.
    rivals: float


def _no_scene(*_: Any) -> Any:
    raise ValueError("these matches are of no scene")


class Matches(Sequence[Match]):
    """What the texts of a query found, in their order; also by text: `found["chair"]`."""

    def __init__(self, data: Mapping[str, Any], edit: Callable[..., Any] | None = None) -> None:
        self._edit = edit or _no_scene
        self._all = tuple(Match.of_json(result) for result in data["results"])
        #: Camera of the masks; None where none were asked for.
        self.camera: Camera | None = Camera.of_json(data["camera"]) if "camera" in data else None
        #: Entries of the scene's bank (M).
        self.bank_size: int = data["bank_size"]
        #: How texts were scored.
        self.scoring = parse(Scoring, data["scoring"])

    @property
    def masks(self) -> NDArray[np.bool_]:
        """[T, H, W], one mask for each text."""
        return np.stack([match.mask for match in self._all])

    @property
    def boxes(self) -> tuple[Box, ...]:
        """The boxes of all texts."""
        return tuple(box for match in self._all for box in match.boxes)

    @overload
    def __getitem__(self, which: int | str) -> Match: ...
    @overload
    def __getitem__(self, which: slice) -> Sequence[Match]: ...
    def __getitem__(self, which: int | str | slice) -> Match | Sequence[Match]:
        if isinstance(which, str):
            for match in self._all:
                if match.text == which.strip():
                    return match
            raise KeyError(which)
        return self._all[which]

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Iterator[Match]:
        return iter(self._all)

    def __repr__(self) -> str:
        told = (f"{m.text!r}: {m.score:.2f}, {len(m.boxes)} boxes" for m in self._all)
        return f"<Matches {'; '.join(told)}>"

    def hide(self) -> Any:
        """Takes what the texts found out of the scene's views, answers and files: an edit for each
        text that was found. `scene.undo()` takes the last one back. Gives how many Gaussians each
        edit of the scene took; of an `AsyncScene` with `await`.
        """
        found = (match.text for match in self._all if match.found)
        return self._edit(*({"op": "delete", "select": {"text": text}} for text in found))

    def keep(self) -> Any:
        """Takes all else out of the scene, as `hide`: of a query with one text."""
        if len(self._all) != 1:
            raise ValueError(f"keep is for one text; the query has {len(self._all)}")
        return self._edit({"op": "keep", "select": {"text": self._all[0].text}})

    def _repr_png_(self) -> bytes | None:
        masks = self.masks.astype(np.uint8) * 255
        return encode_png(np.hstack(list(masks))) if masks.size else None


@dataclass(frozen=True)
class Label:
    """A text and how well it names what is under a pixel."""

    text: str
    #: 0 to 1; under 0.5 it does not name it.
    relevancy: float


@dataclass(frozen=True, eq=False)
class Picked:
    """What is under a pixel."""

    #: Accumulated opacity, 0 to 1.
    alpha: float
    #: Depth of the surface along the camera's axis, world units; None where nothing is. The depth
    #: that a view blends is up to a percent less where a surface leans.
    depth: float | None = None
    #: [3] point at that depth, world frame of the upload; on the ground where it is the ground's.
    point: Floats | None = None
    #: The Gaussian that adds most, counted from 0.
    gaussian: int | None = None
    #: Its entry of the bank, counted from 1.
    entry: int | None = None
    #: The labels asked for, the best first.
    labels: tuple[Label, ...] = ()


def decode_rle(rle: Mapping[str, Any]) -> NDArray[np.bool_]:
    """The [H, W] mask of COCO's compressed run lengths."""
    height, width = rle["size"]
    runs: list[int] = []
    value = shift = 0
    for char in rle["counts"].encode():
        bits = char - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= 1 << shift
        runs.append(value + runs[-2] if len(runs) > 2 else value)
        value = shift = 0
    on = np.arange(len(runs)) % 2 == 1
    return np.repeat(on, runs).reshape(width, height).T
