"""Every call, written once: what is sent and what the answer means. `client.py` runs them."""

from __future__ import annotations

import io
import itertools
import json
import os
import posixpath
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias
from urllib.parse import quote
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Unpack

from .errors import (
    BadAnswer,
    ConnectionLost,
    InvalidRequest,
    NotFound,
    Overloaded,
    SceneNotFound,
    SegSplatError,
    error_of,
)
from .formats import ENDINGS, SPLATS, ExportFormat
from .gaussians import Gaussians
from .photos import fit
from .progress import show_bar
from .types import (
    Box,
    CallerLimits,
    Camera,
    Event,
    ExportCall,
    Kind,
    Matches,
    Measured,
    Models,
    Photo,
    Picked,
    QueryCall,
    Scale,
    SceneOptions,
    SceneStatus,
    ViewCall,
    Viewpoint,
    ViewsCall,
    parse,
)
from .video import VIDEOS, frames_of
from .view import FORMATS, View, picture
from .wire import (
    Answer,
    Flow,
    Item,
    Multipart,
    Part,
    Pieces,
    Policy,
    Read,
    Request,
    ServerSentEvents,
    meet,
    pause,
    send,
)

if TYPE_CHECKING:
    from viser import ViserServer

#: Endings of photos and of files of cameras; files of COLMAP and folders of phones that are not
#: read.
PHOTOS = frozenset({".png", ".jpg", ".jpeg", ".jfif", ".webp", ".tif", ".tiff", ".bmp"})
CAMERAS = frozenset({".json", ".txt", ".bin", ".npy", ".traj", ".pincam"})
#: Photos of formats that are not read, and what to do.
OTHER_PHOTOS = frozenset({".heic", ".heif", ".avif", ".dng", ".jxl"})
#: Folders of masks.
MASKS = re.compile(r"masks?(_\d+)?", re.IGNORECASE)
AS_JPEG = (
    "export it as JPEG (iPhone: Settings, Camera, Formats, Most Compatible; a Mac: Preview, Export)"
)
NOT_READ = frozenset({"points3D", "rigs", "frames", "project"})
DEPTHS = frozenset({"depth", "confidence", "lowres_depth", "highres_depth"})

#: A folder with photos, or a capture of any layout that the server knows; an archive of one; a
#: file of Gaussians (PLY, SPZ, SOG, GLB, .splat); or photos and their cameras.
Source: TypeAlias = str | Path | Mapping[str | Path, Camera]
#: A scene as the server shows it.
Shown: TypeAlias = tuple[SceneStatus, tuple[Photo, ...]]
#: Who is told of each event; True for a bar on standard error; None for a bar on terminals alone.
Progress: TypeAlias = Callable[[Event], None] | bool | None
Kinds: TypeAlias = Kind | Sequence[Kind]


class Handle:
    """A scene as calls know it."""

    def __init__(self, policy: Policy, shown: Shown) -> None:
        self.policy = policy
        self.shown = shown

    @property
    def id(self) -> str:
        """32 hex digits."""
        return self.shown[0].id


# Scenes


def create(
    policy: Policy,
    source: Source,
    options: SceneOptions,
    idempotency_key: str | None,
    masks: str | Path | None = None,
) -> Flow[Shown]:
    """Uploads photos. A second try never makes a second scene: both carry one key."""
    if not policy.limits:
        _check(source, options.get("cameras") == "solve")
        yield from meet(policy)
    params = {name.removesuffix("_"): value for name, value in options.items()}
    if isinstance(words := params.get("ignore"), str):
        params["ignore"] = [words]
    request = Request(
        "POST",
        "/v1/scenes",
        params=params,
        upload=parts_of(source, policy.limits, options.get("cameras") == "solve")
        + masks_in(masks),
        headers={"idempotency-key": idempotency_key or str(uuid4())},
    )
    answer = yield from send(policy, request)
    return parse(SceneStatus, _json(answer.body)), ()


def parts_of(
    source: Source, limits: CallerLimits | None = None, solve: bool = False
) -> list[Part]:
    """The parts of an upload. Photos are read while they are sent.

    limits: those of the server, for which photos are chosen and made smaller; None: all go as they
        are.
    solve: whether the server finds the cameras: files of cameras in a folder are not sent.
    """
    if isinstance(source, Mapping):
        if not source:
            raise InvalidRequest("there are no photos")
        files = [Path(file).absolute() for file in source]
        top = os.path.commonpath([file.parent for file in files])
        names = [file.relative_to(top).as_posix() for file in files]
        told = zip(names, source.values(), strict=True)
        cameras = [{"file": name, **camera.to_json()} for name, camera in told]
        parts = [Part("cameras", "cameras.json", json.dumps({"cameras": cameras}).encode())]
        photos = [Part("photo", *one) for one in zip(names, files, strict=True)]
        return parts + fit(photos, limits)[0]
    path = Path(source)
    if path.suffix.lower() in SPLATS and not path.is_dir():
        return [Part("splats", path.name, path)]
    if path.suffix.lower() in VIDEOS and path.is_file():
        return frames_of(path)
    if path.is_file():
        return [Part("archive", path.name, path)]
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file or folder")
    for field in () if solve else ("transforms", "cameras"):
        if (path / f"{field}.json").is_file():
            return _described(path, field, limits)
    files = sorted(file for file in path.rglob("*") if _belongs(file.relative_to(path)))
    parts = [Part("photo", file.relative_to(path).as_posix(), file) for file in files]
    photos = [part for part in parts if Path(part.name).suffix.lower() in PHOTOS]
    if not photos:
        raise FileNotFoundError(
            f"{path}: no archive, no file of Gaussians and no folder with photos{_unread(path)}"
        )
    cameras_of = [part for part in parts if part not in photos and not solve]
    if not cameras_of:
        # The server finds them.
        return fit(photos, limits)[0]
    # COLMAP says the size of its photos, so they may be made smaller. Not all layouts do.
    is_colmap = any(Path(part.name).name in ("cameras.bin", "cameras.txt") for part in cameras_of)
    return [*fit(photos, limits, is_colmap)[0], *cameras_of]


def _check(source: Source, solve: bool = False) -> None:
    """Says what is wrong with a source before a server is asked. Not of a video, whose frames take
    long."""
    if isinstance(source, Mapping) or Path(source).suffix.lower() not in VIDEOS:
        with warnings.catch_warnings():
            # They come with the parts that are sent.
            warnings.simplefilter("ignore")
            parts_of(source, None, solve)


def masks_in(folder: str | Path | None) -> list[Part]:
    """The parts of a folder with masks, each named as its photo."""
    if folder is None:
        return []
    top = Path(folder)
    files = sorted(file for file in top.rglob("*") if file.suffix.lower() in PHOTOS)
    if not files:
        raise FileNotFoundError(f"{top}: no folder with masks of photos")
    return [Part("photo", f"masks/{file.relative_to(top).as_posix()}", file) for file in files]


def _described(folder: Path, field: str, limits: CallerLimits | None) -> list[Part]:
    """The parts of a folder with one file of cameras, and those of its photos that are there."""
    file = folder / f"{field}.json"
    read, entries, names = _entries_of(file)
    found = _matched(folder, names)
    lost = [name for name, photo in zip(names, found, strict=True) if photo is None]
    told = f"{file}: {len(lost)} of {len(names)} cameras have no photo in the folder"
    if len(lost) == len(names):
        raise InvalidRequest(f"{told}; the first is {lost[0]!r}{_unread(folder)}")
    if lost:
        why = f"{told}, as {lost[0]!r}: they are left out{_unread(folder)}"
        warnings.warn(why, stacklevel=2)
    there = [
        (entry, Part("photo", photo.relative_to(folder).as_posix(), photo))
        for entry, photo in zip(entries, found, strict=True)
        if photo
    ]
    photos, sizes = fit([part for _, part in there], limits)
    photos += _masks_of(folder, entries, {part.name for _, part in there})
    if not sizes or field == "cameras":
        return [Part(field, file.name, file), *photos]
    for entry, part in there:
        # The lens is of the size that the photo had.
        for side, length in zip("wh", sizes.get(part.name, ()), strict=False):
            entry.setdefault(side, read.get(side, length))
    return [Part(field, file.name, json.dumps(read).encode()), *photos]


def _matched(folder: Path, names: Sequence[str]) -> list[Path | None]:
    """The photo of each name: by its path, else by the end of its path, with or without the ending,
    as the server finds it. All lie in the folder: a description from elsewhere sends no others.
    """
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in PHOTOS)
    wanted = [re.sub(r"^(\.\.?/)+", "", name.replace("\\", "/")) for name in names]
    found: list[Path | None] = [None] * len(names)
    free = {file: file.relative_to(folder).as_posix() for file in files}
    free = {file: path for file, path in free.items() if not _is_mask(path)} or free
    # Whole paths are settled first for all, so that a shared file name never takes a photo.
    for level in (str, _stem, posixpath.basename, lambda path: _stem(posixpath.basename(path))):
        places = {level(path): file for file, path in free.items()}
        for i, name in enumerate(wanted):
            key = name if level in (str, _stem) else posixpath.basename(name)
            if found[i] is None and places.get(key) in free:
                found[i] = places[key]
                del free[places[key]]
    return found


def _masks_of(folder: Path, entries: Sequence[Mapping[str, Any]], photos: Set[str]) -> list[Part]:
    """The masks that a description names: the server knows whose they are."""
    said = (str(entry.get("mask_path") or "") for entry in entries)
    named = {name.replace("\\", "/") for name in said if name}
    ends = tuple("/" + re.sub(r"^(\.\.?/)+", "", name) for name in named)
    parts = []
    for file in sorted(file for file in folder.rglob("*") if file.suffix.lower() in PHOTOS):
        path = file.relative_to(folder).as_posix()
        if path not in photos and f"/{path}".endswith(ends):
            parts.append(Part("photo", path, file))
    return parts


def _is_mask(path: str) -> bool:
    """Whether a file lies in a folder of masks."""
    return any(MASKS.fullmatch(part) for part in path.split("/")[:-1])


def _stem(path: str) -> str:
    """A path without the ending."""
    return posixpath.splitext(path)[0]


def _unread(folder: Path) -> str:
    """Names a photo of a format that is not read; empty where there is none."""
    others = sorted(file for file in folder.rglob("*") if file.suffix.lower() in OTHER_PHOTOS)
    if not others:
        return ""
    kind = others[0].suffix[1:].upper()
    return f"; {others[0].name}: {kind} is a format that is not read; {AS_JPEG}"


def _belongs(file: Path) -> bool:
    """Whether the server could read a file of a capture: it says itself which it takes."""
    hidden = any(part.startswith(".") or part in DEPTHS for part in file.parts)
    known = file.suffix.lower() in PHOTOS | CAMERAS or file.name == "metadata"
    return known and not hidden and file.stem not in NOT_READ


def _entries_of(described: Path) -> tuple[dict[str, Any], list[dict[str, Any]], list[str]]:
    """A camera description, its entries, and the photo that each names."""
    try:
        cameras = json.loads(described.read_bytes())
        key, name = ("frames", "file_path") if "frames" in cameras else ("cameras", "file")
        names = [str(entry[name]) for entry in cameras[key]]
        if not names:
            raise ValueError("it names no photos")
        return cameras, cameras[key], names
    except (ValueError, KeyError, TypeError) as wrong:
        raise InvalidRequest(f"{described.name}: {type(wrong).__name__}: {wrong}") from wrong


def scenes(policy: Policy, page: int | None) -> Flow[None]:
    """Items: each scene as shown, newest first, page by page."""
    params: dict[str, Any] = {} if page is None else {"limit": page}
    while True:
        data = _json((yield from send(policy, Request("GET", "/v1/scenes", params=params))).body)
        for scene in data["scenes"]:
            yield Item((parse(SceneStatus, scene), ()))
        if not data.get("next"):
            return
        params["after"] = data["next"]


def models(policy: Policy) -> Flow[Models]:
    """What makes the scenes: networks, renderer, version."""
    answer = yield from send(policy, Request("GET", "/v1/models"))
    return parse(Models, _json(answer.body))


def get(policy: Policy, id: str) -> Flow[Shown]:
    """The scene of an id: its status and its photos."""
    data = _json((yield from send(policy, Request("GET", f"/v1/scenes/{id}"))).body)
    photos = (Photo(camera["file"], Camera.of_json(camera)) for camera in data.get("cameras", []))
    return parse(SceneStatus, data), tuple(photos)


def refresh(scene: Handle) -> Flow[None]:
    """Asks the server for the present status, report and photos."""
    scene.shown = yield from get(scene.policy, scene.id)


def delete(scene: Handle) -> Flow[None]:
    """Deletes the scene, and stops it where it is being made."""
    yield from _deleted(scene, Request("DELETE", f"/v1/scenes/{scene.id}"))


def _deleted(scene: Handle, request: Request) -> Flow[Answer | None]:
    """Deletes something; None where an earlier try has done so, whose answer was lost."""
    once = Policy(0, 0, False, server=scene.policy.server)
    maybe_done = False
    for again in itertools.count():
        try:
            return (yield from send(once, request))
        except (SceneNotFound, NotFound):
            if maybe_done:
                return None
            raise
        except SegSplatError as error:
            # One that is overloaded has not begun. Others may have failed after the deletion.
            maybe_done = maybe_done or not isinstance(error, Overloaded)
            yield from pause(scene.policy, error, again)
    raise AssertionError("unreachable")


def events(
    scene: Handle,
    tell: Callable[[Event], None] | None = None,
    *,
    semantics: bool = False,
    edits: bool = False,
) -> Flow[None]:
    """Items: what happens to the scene, from its present state to its last event. While it is
    refined, each better version is one more.

    semantics: go on after the scene is made until its semantics are; the first text makes them.
    edits: go on until the scene is deleted; an "edited" tells that its list of edits is another
        one, whoever changed it. The first tells the list as it is.
    """
    asked = {name: True for name, is_asked in
             (("semantics", semantics), ("edits", edits)) if is_asked}
    again = 0
    while True:
        path = f"/v1/scenes/{scene.id}/events"
        request = Request("GET", path, params=asked, stream=ServerSentEvents)
        # Outside of `try`: it has its own tries.
        yield from send(scene.policy, request)
        try:
            made = False
            while (data := (yield Read())) is not None:
                again, event = 0, parse(Event, _json(data))
                made = made or event.is_last or event.event == "version"
                if edits:
                    made = event.event in ("failed", "cancelled")
                if not tell:
                    yield Item(event)
                    continue
                tell(event)
                if event.is_last:
                    return
            if made:
                return
            raise ConnectionLost("the events broke off")
        except ConnectionLost as lost:
            yield from pause(scene.policy, lost, again)
            again += 1


def wait(scene: Handle, progress: Progress = None) -> Flow[None]:
    """Waits until the scene is made; raises why it was not.

    progress: True shows a bar; a function is told of each event; by default a bar on terminals.
    """
    if progress is None:
        progress = sys.stderr.isatty()
    show = show_bar if progress is True else progress or None
    last: list[Event] = []

    def tell(event: Event) -> None:
        last[:] = [event]
        if show:
            show(event)

    yield from events(scene, tell)
    if last[0].event != "done":
        code = last[0].code or "cancelled"
        kind = SegSplatError.of_code.get(code, SegSplatError)
        raise kind(last[0].message or "the scene was stopped", code=code, scene=scene.id)
    yield from refresh(scene)


def refine(scene: Handle, refine: Literal["auto", "off"] | int = "auto") -> Flow[None]:
    """Brings a finished scene closer to its photos while it is served. Returns at once:
    `scene.refresh()` and `scene.status.refinement` say how far it is, `scene.events()` tells each
    version.

    refine: milliseconds of work; "auto": as long as the server finds right; "off" ends it.
    """
    path = f"/v1/scenes/{scene.id}/refine"
    answer = yield from send(scene.policy, Request("POST", path, params={"refine": str(refine)}))
    scene.shown = parse(SceneStatus, _json(answer.body)), scene.shown[1]


# Photos that join, or leave


def add(
    scene: Handle,
    source: Source,
    progress: Progress = None,
    *,
    masks: str | Path | None = None,
    idempotency_key: str | None = None,
) -> Flow[None]:
    """Adds photos to a finished scene and waits until they have joined it; raises why they did not.
    The version before is served meanwhile. Only the new photos go through the networks.

    source: as a scene is made of: a folder or an archive of a capture, or photos and their cameras.
        The poses are in the frame of the scene's own cameras (`scene.photos`).
    progress: as `wait` takes it.
    """
    if not scene.policy.limits:
        _check(source)
        yield from meet(scene.policy)
    request = Request(
        "POST",
        f"/v1/scenes/{scene.id}/photos",
        upload=parts_of(source, scene.policy.limits) + masks_in(masks),
        headers={"idempotency-key": idempotency_key or str(uuid4())},
    )
    yield from _changed(scene, (yield from send(scene.policy, request)), progress)


def remove(scene: Handle, photo: str | Photo, progress: Progress = None) -> Flow[None]:
    """Takes a photo out of a finished scene and waits until the scene is without it. Its file stays
    on the server as long as a photo that came with it is in the scene.

    photo: one of `scene.photos`, or its file name.
    progress: as `wait` takes it.
    """
    name = quote(photo if isinstance(photo, str) else photo.file, safe="")
    request = Request("DELETE", f"/v1/scenes/{scene.id}/photos/{name}")
    yield from _changed(scene, (yield from _deleted(scene, request)), progress)


def _changed(scene: Handle, answer: Answer | None, progress: Progress) -> Flow[None]:
    """Waits for the version with a change of the photos of a scene. None: its answer was lost."""
    if answer:
        scene.shown = parse(SceneStatus, _json(answer.body)), scene.shown[1]
    yield from wait(scene, progress)
    fault = scene.shown[0].growth.error
    if fault:
        kind = SegSplatError.of_code.get(fault.code, SegSplatError)
        raise kind(fault.message, code=fault.code, scene=scene.id)


# Size


def scale(scene: Handle) -> Flow[Scale]:
    """What is known of how large the scene is: metres, up and the ground."""
    answer = yield from send(scene.policy, Request("GET", f"/v1/scenes/{scene.id}/scale"))
    return parse(Scale, _json(answer.body))


def set_scale(
    scene: Handle,
    metres: float | None = None,
    *,
    points: Iterable[Sequence[float]] | None = None,
    thing: str | Mapping[str, Any] | None = None,
    metres_per_unit: float | None = None,
) -> Flow[Scale]:
    """Says how large the scene is; without anything it is again what the capture says.

    metres: a length, of what `points` or `thing` says.
    points: the two points of the world that it is between.
    thing: what it is a side of: a text, or `{"text": "door", "part": 0, "side": "height"}`; a side
        is height, width, depth or longest.
    metres_per_unit: in place of all of these.
    """
    named = {"text": thing} if isinstance(thing, str) else thing
    ends = None if points is None else [[float(v) for v in point] for point in points]
    said = dict(metres=metres, points=ends, thing=named, metres_per_unit=metres_per_unit)
    body = {name: value for name, value in said.items() if value is not None}
    request = Request("PUT", f"/v1/scenes/{scene.id}/scale", json=body)
    answer = yield from send(scene.policy, request)
    return parse(Scale, _json(answer.body))


def measure(scene: Handle, points: Iterable[Sequence[float]]) -> Flow[Measured]:
    """Lengths, area and heights over the ground of points of the world, joined in their order: in
    metres where `scale` knows them."""
    body = {"points": [[float(v) for v in point] for point in points]}
    request = Request("POST", f"/v1/scenes/{scene.id}/measure", json=body)
    answer = yield from send(scene.policy, request)
    return parse(Measured, _json(answer.body))


# Edits


def edits(scene: Handle) -> Flow[list[dict[str, Any]]]:
    """The edits of the scene, in the order in which they are applied."""
    answer = yield from send(scene.policy, Request("GET", f"/v1/scenes/{scene.id}/edits"))
    listed: list[dict[str, Any]] = _json(answer.body)["edits"]
    return listed


def set_edits(scene: Handle, edits: Iterable[Mapping[str, Any]]) -> Flow[list[int]]:
    """Puts a list of edits in place of the one before; an empty one brings every bit back. Gives
    how many Gaussians each took. Views, answers and files show the edited scene.

    edits: as `edit` takes them.
    """
    path, body = f"/v1/scenes/{scene.id}/edits", {"edits": [dict(edit) for edit in edits]}
    answer = yield from send(scene.policy, Request("PUT", path, json=body))
    counts: list[int] = _json(answer.body)["counts"]
    return counts


def edit(scene: Handle, *more: Mapping[str, Any]) -> Flow[list[int]]:
    """Adds edits at the end of the list; gives how many Gaussians each of the list took.

    more: `{"op": "delete", "select": {"text": "chair"}}`. The operations: delete, keep; move and
        copy with translation, rotation (wxyz), scale and center; recolor with color and amount. A
        selection is a text (and parts of it), a box, a sphere, or a pick.
    """
    return (yield from set_edits(scene, [*(yield from edits(scene)), *more]))


def undo(scene: Handle) -> Flow[list[int]]:
    """Takes the last edit back; gives how many Gaussians each of the others took."""
    return (yield from set_edits(scene, (yield from edits(scene))[:-1]))


# Views


def view(
    scene: Handle, kinds: Kinds = "color", *, text: str | None = None, **options: Unpack[ViewCall]
) -> Flow[View]:
    """Draws the scene from one camera.

    kinds: "color", "depth", "alpha", "holes" (what edits uncovered and nothing fills), "semantics",
        and with a `text` "relevancy" and "mask"; one or several, which are drawn once.
    from_, to, t: between two photos; by default at the first photo.
    eye, target, up: at a point (world units), looking at another.
    camera_to_world: [4, 4] pose, OpenCV (x right, y down, z forward), world of the upload.
    K, fov, camera: the lens: [3, 3] in pixels; or vertical degrees; or a whole `Camera`.
    width, height: pixels.
    """
    asked = _kinds(kinds)
    spot, rest = _split(dict(options))
    if len(asked) > 1:
        found: list[View] = []
        yield from _views(scene, [_camera(spot)], asked, text, rest, found.append)
        return found[0]
    fields = {**_camera(spot), **_drawing(rest), "text": text, "kind": asked[0]}
    fields["format"] = FORMATS.get(asked[0], "npy")
    request = Request("GET", f"/v1/scenes/{scene.id}/view", params=_given(fields))
    answer = yield from send(scene.policy, request)
    camera, array = picture(asked[0], answer.headers, answer.body)
    return View(camera, {asked[0]: array})


def views(
    scene: Handle,
    viewpoints: Iterable[Viewpoint],
    kinds: Kinds = "color",
    *,
    text: str | None = None,
    **options: Unpack[ViewsCall],
) -> Flow[None]:
    """Iterates over the views from many cameras, in their order, as they are made.

    viewpoints: any number of `{"from_": 0, "to": 1, "t": 0.5}`, `{"eye": …, "target": …}` and so
        on: the camera's options of `view`.
    """
    cameras = [_camera(dict(spot)) for spot in viewpoints]
    if not scene.policy.limits:
        yield from meet(scene.policy)
    limits = scene.policy.limits
    # More go as more calls.
    most = limits.cameras_max if limits else len(cameras)
    for start in range(0, len(cameras), most or 1):
        batch = cameras[start : start + most]
        yield from _views(scene, batch, _kinds(kinds), text, _drawing(dict(options)), None)


def _views(
    scene: Handle,
    cameras: list[dict[str, Any]],
    kinds: list[Kind],
    text: str | None,
    options: dict[str, Any],
    take: Callable[[View], None] | None,
) -> Flow[None]:
    """Items: a view for each camera. What a fault leaves undone is asked for again."""
    path = f"/v1/scenes/{scene.id}/views"
    formats = {FORMATS.get(kind, "npy") for kind in kinds}
    body = {**_drawing(options), "kinds": kinds, "text": text}
    body["format"] = formats.pop() if len(formats) == 1 else "npy"
    done = again = 0
    while done < len(cameras):
        request = Request(
            "POST", path, json=_given({**body, "cameras": cameras[done:]}), stream=Multipart
        )
        # Outside of `try`: it has its own tries.
        yield from send(scene.policy, request)
        try:
            arrays: dict[Kind, NDArray[Any]] = {}
            while (part := (yield Read())) is not None:
                headers, content = part
                if headers.get("content-type") == "application/json":
                    raise error_of(200, headers, content)
                kind = kinds[len(arrays)]
                camera, arrays[kind] = picture(kind, headers, content)
                if len(arrays) < len(kinds):
                    continue
                done, again = done + 1, 0
                drawn, arrays = View(camera, arrays), {}
                if take:
                    take(drawn)
                else:
                    yield Item(drawn)
            if done < len(cameras):
                raise ConnectionLost(f"the answer broke off before view {done}")
        except SegSplatError as error:
            yield from pause(scene.policy, error, again)
            again += 1


# Texts


def query(
    scene: Handle,
    *texts: str | Sequence[str],
    masks: bool = True,
    boxes: Literal["oriented", "upright", "aligned", "none"] = "upright",
    **options: Unpack[QueryCall],
) -> Flow[Matches]:
    """Asks where things are: boxes and Gaussians in 3D, and masks in one view.

    texts: 1 to 128, one by one or as lists.
    masks: False asks in 3D alone, which draws nothing.
    boxes: along the part's own axes, the same with the last axis up, along the axes of the world,
        or none.
    from_, eye, camera, width and so on: the view of the masks, as in `view`; by default that of the
        first photo. Of a photo, here or by `from_`, the masks have the photo's size unless `width`
        or `height` says another.
    """
    spot, rest = _split(dict(options))
    asked = [one for text in texts for one in ([text] if isinstance(text, str) else text)]
    fields = {**_drawing(rest), "texts": asked, "boxes": boxes, "mask": "rle" if masks else "none"}
    if masks:
        camera = _camera(spot)
        # The size belongs to the drawing.
        fields.update({side: camera.pop(side) for side in ("width", "height") if side in camera})
        fields["camera"] = camera
        fields.update((yield from _size_of_photo(scene, spot, rest)))
    request = Request("POST", f"/v1/scenes/{scene.id}/query", json=_given(fields))
    answer = _json((yield from send(scene.policy, request)).body)
    return Matches(answer, getattr(scene, "edit", None))


def pick(
    scene: Handle, x: float, y: float, *, labels: Sequence[str] = (), **options: Unpack[QueryCall]
) -> Flow[Picked]:
    """Says what is under a pixel of a view: depth, point, Gaussian, and which label names it best.

    x, y: pixels of the view; the centre of the first is (0.5, 0.5).
    labels: texts that may name it.
    from_, eye, camera, width and so on: the view, as in `query`: a pixel of a photo, or of a mask
        of it, is that of the view.
    """
    spot, rest = _split(dict(options))
    fields = {**_camera(spot), **_drawing(rest), "x": x, "y": y, "label": list(labels)}
    fields.update((yield from _size_of_photo(scene, spot, rest)))
    params = _given(fields)
    request = Request("GET", f"/v1/scenes/{scene.id}/pick", params=params)
    return parse(Picked, _json((yield from send(scene.policy, request)).body))


def features(
    scene: Handle,
    kind: Literal["weights", "features"] = "weights",
    **options: Unpack[QueryCall],
) -> Flow[dict[str, NDArray[Any]]]:
    """The pixels of a view over the bank, as arrays.

    kind: "weights", E: `size` (height, width), `offsets`, `entries` and `weights`; the entries of
        pixel i are those from `offsets[i]` to `offsets[i + 1]`. "features", F: `features`
        [H, W, D] of length 1, zeros where nothing is.
    from_, eye, camera, width and so on: the view, as in `view`; by default that of the first photo,
        at most 384 pixels wide or high: the features of a whole photo take gigabytes.
    """
    spot, rest = _split(dict(options))
    params = _given({**_camera(spot), **_drawing(rest), "kind": kind})
    request = Request("GET", f"/v1/scenes/{scene.id}/features", params=params)
    file = io.BytesIO((yield from send(scene.policy, request)).body)
    with np.load(file) as arrays:
        return dict(arrays)


def _size_of_photo(
    scene: Handle, spot: Mapping[str, Any], rest: Mapping[str, Any]
) -> Flow[dict[str, int]]:
    """Width and height of the photo that a view is of, where it is of one and no size is given."""
    if spot.keys() - {"from_"} or rest.keys() & {"width", "height"}:
        return {}
    if not scene.shown[1]:
        yield from refresh(scene)
    photos, which = scene.shown[1], spot.get("from_", 0)
    if which not in range(len(photos)):
        return {}
    camera = photos[which].camera
    return {"width": camera.width, "height": camera.height}


# Files


def gaussians(
    scene: Handle, text: str | None = None, **options: Unpack[ExportCall]
) -> Flow[Gaussians]:
    """The Gaussians of the scene, or those that a text selects, as arrays."""
    params = _given({**_drawing(options), "format": "ply", "text": text})
    request = Request("GET", f"/v1/scenes/{scene.id}/export", params=params)
    return Gaussians.of_ply((yield from send(scene.policy, request)).body)


def export(
    scene: Handle,
    format: ExportFormat = "ply",
    path: str | Path | None = None,
    *,
    text: str | Sequence[str] | None = None,
    **options: Unpack[ExportCall],
) -> Flow[Path]:
    """Writes the scene, or what a text selects of it, to a file as it comes, and tells its path.

    format: Gaussians for other programs, a zip of a folder, arrays or the page: `segsplat.formats`
        says what each is.
    path: by default the scene's id with the ending of the format, in the current folder.
    text: several texts for "html", "coco" and "labelme", one for the formats of Gaussians.
    """
    target = Path(path) if path is not None else Path(f"{scene.id}.{ENDINGS.get(format, format)}")
    part = target.with_name(target.name + ".part")
    lines = text if text is None or isinstance(text, str) else "\n".join(text)
    params = _given({**_drawing(options), "format": format, "text": lines})
    request = Request("GET", f"/v1/scenes/{scene.id}/export", params=params, stream=Pieces)
    for again in range(scene.policy.retries + 1):
        # Outside of `try`: it has its own tries.
        yield from send(scene.policy, request)
        try:
            with part.open("wb") as file:
                while (piece := (yield Read())) is not None:
                    file.write(piece)
            return part.replace(target)
        except ConnectionLost as lost:
            yield from pause(scene.policy, lost, again)
        finally:
            part.unlink(missing_ok=True)
    raise AssertionError("unreachable")


def show(
    scene: Handle, boxes: Iterable[Box] = (), server: ViserServer | None = None
) -> Flow[ViserServer]:
    """Shows the scene in viser and gives viser's server: `pip install segsplat[viser]`.

    boxes: drawn too, as those of `scene.query("chair").boxes`.
    server: by default one of its own on http://127.0.0.1:8081 (or the next free port), for this
        machine alone.
    """
    try:
        from .viser import draw
    except ImportError as missing:
        raise ImportError(f"{missing}: pip install 'segsplat[viser]'") from missing
    if not scene.shown[1]:
        yield from refresh(scene)
    found = yield from gaussians(scene)
    status, photos = scene.shown
    return draw(server, found, photos, boxes, status.report)


# Fields of requests


def _json(data: str | bytes) -> Any:
    try:
        return json.loads(data)
    except ValueError as wrong:
        raise BadAnswer(f"the answer is no JSON: {data[:100]!r}") from wrong


def _given(fields: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that are not None."""
    return {name: value for name, value in fields.items() if value is not None}


def _kinds(kinds: Kinds) -> list[Kind]:
    asked: list[Kind] = [kinds] if isinstance(kinds, str) else list(dict.fromkeys(kinds))
    if not asked:
        raise ValueError("kinds is empty")
    return asked


def _split(options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The camera's options, and the others."""
    spot = {name: options.pop(name) for name in Viewpoint.__optional_keys__ if name in options}
    return spot, options


def _camera(spot: Mapping[str, Any]) -> dict[str, Any]:
    """The server's fields of a camera."""
    fields: dict[str, Any] = {}
    rest = dict(spot)
    if camera := rest.pop("camera", None):
        fields.update(width=camera.width, height=camera.height)
        rest = {"K": camera.K, "camera_to_world": camera.camera_to_world, **rest}
    if (k := rest.pop("K", None)) is not None:
        k = _numbers("K", k, (3, 3))
        fields.update(fx=k[0][0], fy=k[1][1], cx=k[0][2], cy=k[1][2])
    if (pose := rest.pop("camera_to_world", None)) is not None:
        fields["camera_to_world"] = sum(_numbers("camera_to_world", pose, (4, 4)), [])
    for name in ("eye", "target", "up"):
        if (point := rest.pop(name, None)) is not None:
            fields[name] = _numbers(name, point, (3,))
    if not fields.keys() & {"camera_to_world", "eye"}:
        fields["from"] = rest.pop("from_", 0)
    elif "from_" in rest:
        fields["from"] = rest.pop("from_")
    return {**fields, **rest}


def _numbers(name: str, value: Any, shape: tuple[int, ...]) -> Any:
    array = np.asarray(value, np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {list(array.shape)}, not {list(shape)}")
    return array.tolist()


def _drawing(options: Mapping[str, Any]) -> dict[str, Any]:
    """The server's fields of how a view is drawn and a text is scored."""
    fields = dict(options)
    if (seconds := fields.pop("wait", None)) is not None:
        fields["wait_ms"] = round(1000 * seconds)
    return fields
