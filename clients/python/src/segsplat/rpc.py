"""The steps of a flow over gRPC (`pip install segsplat[grpc]`).

A request of HTTP becomes a message, and an answer has the fields that HTTP gives, so that a flow
does not know which of the two it is on. Messages are made of the server's own descriptors
(`descriptors.bin`, which a test of the server keeps as its proto files are): there is no generated
code, and no version of a compiler that must fit that of the library.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import anyio
import grpc
import grpc.aio
import httpx
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import FieldDescriptor, MethodDescriptor
from google.protobuf.message import Message
from typing_extensions import Self

from .errors import (
    BadAnswer,
    ConnectionLost,
    InvalidRequest,
    SegSplatError,
    error_of,
    unreachable,
)
from .wire import Answer, Part, Read, Request, Sleep, Step

#: Bytes of a photo in one message; the largest answer, as the server has it.
PIECE_BYTES = 256 << 10
MESSAGE_BYTES_MAX = (256 << 20) + (1 << 20)
SCENES = "segsplat.v1.SceneService"
#: Methods by what HTTP calls them: the last part of the path, or the verb where there is none.
METHODS = {
    **{"events": "WatchScene", "view": "RenderView", "views": "RenderViews", "query": "Query"},
    **{"pick": "Pick", "export": "Export", "models": "Models"},
    **{"refine": "RefineScene", "features": "Features", "measure": "Measure"},
    **{"POST": "CreateScene", "GET": "GetScene", "DELETE": "DeleteScene"},
}
SCORING = ("canon", "tau", "cut", "unit_rows", "coverage_floor", "near_best", "margin", "rivals")
NAMED = {"black": "#000000", "white": "#ffffff"}


def _pool() -> descriptor_pool.DescriptorPool:
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(resources.files("segsplat").joinpath("descriptors.bin").read_bytes())
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return pool


_POOL = _pool()
_SERVICE = _POOL.FindServiceByName(SCENES)
#: Options of a scene that a message of their own holds.
METHOD = _POOL.FindMessageTypeByName("segsplat.v1.Method").fields_by_name.keys()


# Requests


def messages(step: Request) -> tuple[MethodDescriptor, Message | Iterator[Message]]:
    """The method of a request of HTTP, and what is sent to it."""
    if photos := re.fullmatch(r"/v1/scenes/(\w+)/photos(?:/(.+))?", step.path):
        return _photos(step, *photos.groups())
    *_, scenes, id, action = ["", "", *step.path.removeprefix("/v1/").split("/")][-3:]
    kept = {"edits": "Edits", "scale": "Scale"}.get(action)
    edits = {"GET": "Get", "PUT": "Set"}[step.method] + kept if kept else None
    if scenes != "scenes":
        id, action = action if id == "scenes" else "", "" if id == "scenes" else action
    name = "ListScenes" if action == "scenes" and step.method == "GET" else METHODS.get(action)
    method = _SERVICE.methods_by_name[edits or name or METHODS[step.method]]
    fields = {**step.params, **(step.json or {})}
    if method.name == "CreateScene":
        return method, _upload(method, step, fields)
    if id:
        fields["scene_id"] = id
    return method, _message(method, _nested(method.name, fields))


def _photos(
    step: Request, id: str, name: str | None
) -> tuple[MethodDescriptor, Message | Iterator[Message]]:
    """Photos that join a scene, or the one of a name that leaves it."""
    fields: dict[str, Any] = {"scene_id": id, **step.params}
    if name is not None:
        method = _SERVICE.methods_by_name["RemovePhoto"]
        return method, _message(method, {**fields, "name": unquote(name)})
    method = _SERVICE.methods_by_name["AddPhotos"]
    return method, _upload(method, step, fields)


def _message(method: MethodDescriptor, fields: Mapping[str, Any]) -> Message:
    try:
        made: Message = message_factory.GetMessageClass(method.input_type)(**fields)
        return made
    except (ValueError, TypeError) as wrong:
        raise InvalidRequest(f"{method.name}: {wrong}") from wrong


def _upload(
    method: MethodDescriptor, step: Request, fields: Mapping[str, Any]
) -> Iterator[Message]:
    """The header with options and cameras, then the files in pieces."""
    enums = ("preset", "density", "mask_level", "semantics", "cameras_mode", "camera")
    # The header has the cameras themselves under that name.
    if "cameras" in fields:
        fields = {**fields, "cameras_mode": fields["cameras"]}
        del fields["cameras"]
    fields = {name: _enum(name, v) if name in enums else v for name, v in fields.items()}
    how = {name: fields[name] for name in METHOD if name in fields}
    header = {name: value for name, value in fields.items() if name not in how}
    if "refine" in header:
        header["refine"] = str(header["refine"])
    header["idempotency_key"] = step.headers["idempotency-key"]
    if how:
        header["method"] = how
    described = [part for part in step.upload if part.field in ("transforms", "cameras")]
    header |= {f"{part.field}_json": b"".join(_pieces(part)) for part in described}
    yield _message(method, {"header": header})
    for part in step.upload:
        name = part.name
        for data in () if part in described else _pieces(part):
            piece = data if part.field == "archive" else {"name": name, "data": data}
            yield _message(method, {part.field: piece})
            name = ""


def _pieces(part: Part) -> Iterator[bytes]:
    """A file as it is read, one empty piece of an empty one."""
    if isinstance(part.content, bytes):
        yield part.content
        return
    with part.content.open("rb") as file:
        yield file.read(PIECE_BYTES)
        while data := file.read(PIECE_BYTES):
            yield data


def _nested(method: str, fields: dict[str, Any]) -> dict[str, Any]:
    """The flat fields of HTTP as the messages have them."""
    rest = dict(fields)
    taken: dict[str, Any] = {}
    if rest.get("text") == "":  # messages cannot tell it from none
        raise InvalidRequest("text is empty; say what to look for")
    if "wait_ms" in rest:
        rest["semantics_wait_ms"] = rest.pop("wait_ms")
    if scoring := {name: rest.pop(name) for name in SCORING if name in rest}:
        taken["scoring"] = scoring
    if method in ("SetScale", "Measure"):
        rest["points"] = [v for point in rest.get("points") or () for v in point]
    if "thing" in rest:
        thing = dict(rest.pop("thing"))
        side = {"side": _enum("box_side", thing.pop("side"))} if "side" in thing else {}
        taken["thing"] = {**thing, **side}
    if method == "SetEdits":
        rest["edits_json"] = json.dumps(rest.pop("edits")).encode()
    if method == "Export":
        rest["format"] = _enum("export_format", rest["format"])
        return {**rest, **taken, **{n: _enum(n, rest[n]) for n in ("preset",) if n in rest}}
    if method == "Features":
        taken["kind"] = _enum("feature_kind", rest.pop("kind"))
    if method == "Pick":
        taken["labels"] = rest.pop("label")
    for name in ("kind", "boxes"):
        if name in rest:
            taken[name] = _enum(name, rest.pop(name))
    if "mask" in rest:
        taken["mask"] = _enum("mask_format", rest.pop("mask"))
    if method == "RenderViews":
        taken["kinds"] = [_enum("kind", kind) for kind in rest.pop("kinds")]
        taken["cameras"] = [_camera(camera) for camera in rest.pop("cameras")]
    elif method == "Query" and "camera" in rest:
        taken["camera"] = _camera(rest.pop("camera"))
    elif method in ("RenderView", "Pick", "Features"):
        taken["camera"] = _camera(rest)
    own = message_factory.GetMessageClass(_SERVICE.methods_by_name[method].input_type).DESCRIPTOR
    taken |= {name: rest.pop(name) for name in own.fields_by_name if name in rest}
    return {**taken, "options": _options(rest)} if rest else taken


def _camera(fields: dict[str, Any]) -> dict[str, Any]:
    """Takes the fields of a camera out."""
    spec: dict[str, Any] = {}
    if "camera_to_world" in fields:
        spec["camera_to_world"] = {"values": fields.pop("camera_to_world")}
    points = {name: fields.pop(name) for name in ("eye", "target", "up") if name in fields}
    if points:
        spec["look_at"] = {name: _vec3(point) for name, point in points.items()}
    between = {name: fields.pop(name) for name in ("from", "to", "t") if name in fields}
    if between:
        spec["between"] = {"to": between.get("from"), **between}
    if focal := {name: fields.pop(name) for name in ("fx", "fy", "cx", "cy") if name in fields}:
        spec["focal"] = focal
    if "fov" in fields:
        spec["fov"] = fields.pop("fov")
    return spec


def _options(fields: dict[str, Any]) -> dict[str, Any]:
    """How a view is drawn."""
    if isinstance(fields.get("error"), str):
        fields["quality"] = fields.pop("error")
    fields |= {n: _enum(n, fields[n]) for n in ("format", "quality", "preset") if n in fields}
    if "crop" in fields:
        fields["crop"] = dict(zip(("x", "y", "width", "height"), fields["crop"], strict=True))
    background = fields.pop("background", "backdrop")
    if isinstance(background, str) and background != "backdrop":
        try:
            background = [v / 255 for v in bytes.fromhex(NAMED.get(background, background)[1:])]
        except ValueError as wrong:
            raise InvalidRequest(f"background is {background!r}: {wrong}") from wrong
    return fields if background == "backdrop" else {**fields, "background": _vec3(background)}


def _vec3(point: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", point, strict=True))


def _enum(kind: str, value: Any) -> str:
    """The name of a value in the messages."""
    return f"{kind}_{value}".upper()


# Answers


def plain(message: Message) -> dict[str, Any]:
    """The fields of a message as HTTP's JSON has them: null where nothing is said. Pictures in
    it are left out.
    """
    told: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        if field.has_presence and not message.HasField(field.name):
            told[field.name] = None
        elif isinstance(value, Iterable) and not isinstance(value, (str, bytes)):
            told[field.name] = [_value(field, one) for one in value]
        elif not isinstance(value, bytes):
            told[field.name] = _value(field, value)
    return told


def _value(field: FieldDescriptor, value: Any) -> Any:
    if isinstance(value, Message):
        return [value.x, value.y, value.z] if field.message_type.name == "Vec3" else plain(value)
    if field.type == FieldDescriptor.TYPE_FLOAT:
        return float(str(np.float32(value)))  # as JSON has it
    if field.enum_type is None:
        return value
    prefix = re.sub("(?<!^)(?=[A-Z])", "_", field.enum_type.name).upper() + "_"
    return field.enum_type.values_by_number[value].name.removeprefix(prefix).lower()


def _scene(fields: dict[str, Any]) -> dict[str, Any]:
    if report := fields["report"]:
        report["depth_range"] = [report["depth_near"], report["depth_far"]]
    return fields


def _page(fields: dict[str, Any]) -> dict[str, Any]:
    return {**fields, "scenes": [_scene(scene) for scene in fields["scenes"]]}


def _models(fields: dict[str, Any]) -> dict[str, Any]:
    for model in fields["models"]:
        model["sizes"] = [[size["height"], size["width"]] for size in model["sizes"]]
    return fields


def _event(fields: dict[str, Any]) -> dict[str, Any]:
    event = fields["state"] if fields["version"] is None else "version"
    event = event if fields["edits"] is None else "edited"
    return {**fields, **(fields["error"] or {}), "event": event}


def _edits(fields: dict[str, Any]) -> dict[str, Any]:
    return {**fields, "edits": json.loads(fields["edits_json"])}


def _found(fields: dict[str, Any]) -> dict[str, Any]:
    lens = fields["intrinsics"]
    if lens:
        fields["camera"] = {"intrinsics": lens, "camera_to_world": fields["camera_to_world"]}
    for result in fields["results"]:
        for part in result["parts"]:
            flat = part["covariance"]
            part["covariance"] = [flat[:3], flat[3:6], flat[6:]]
        view = result["view"] or {}
        if counts := view.pop("mask_rle", ""):
            view["mask_rle"] = {"size": [lens["height"], lens["width"]], "counts": counts}
    return fields


def _picture(view: Any) -> tuple[dict[str, str], bytes]:
    """Headers and body of one picture."""
    lens, format = view.intrinsics, plain(view)["format"]
    headers = {"content-type": "application/x-npy"}
    if format != "npy":
        headers = {"x-shape": f"{view.height},{view.width}{',3' if format == 'rgb8' else ''}"}
    headers["x-intrinsics"] = ",".join(map(repr, (lens.fx, lens.fy, lens.cx, lens.cy)))
    headers["x-camera-to-world"] = ",".join(map(repr, view.camera_to_world))
    return headers, view.data


SHAPES: Mapping[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    **{"CreateScene": _scene, "GetScene": _scene, "RefineScene": _scene, "ListScenes": _page},
    **{"AddPhotos": _scene, "RemovePhoto": _scene},
    **{"WatchScene": _event, "Query": _found, "Models": _models},
    **{"GetEdits": _edits, "SetEdits": _edits},
}


def item(method: str, message: Any) -> Any:
    """What the reader of a streamed body would make of it."""
    if method == "RenderViews":
        return _picture(message)
    return message.data if method in ("Export", "Features") else json.dumps(_told(method, message))


def answer(method: str, message: Any) -> Answer:
    """What HTTP would answer."""
    if method == "RenderView":
        return Answer(200, *_picture(message))
    return Answer(200, {}, json.dumps(_told(method, message)).encode())


def _told(method: str, message: Message) -> dict[str, Any]:
    return SHAPES.get(method, dict)(plain(message))


def fault(error: Any) -> SegSplatError:
    """The error of a call: by the server's code, or that of the network."""
    told = {key: value for key, value in error.trailing_metadata() or ()}
    if code := told.get("segsplat-code"):
        body = {"code": code, "message": error.details()}
        return error_of(400, told, json.dumps(body).encode())
    said = f"{error.code().name}: {error.details()}"
    if error.code() in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.INTERNAL):
        return ConnectionLost(said)
    if error.code() is grpc.StatusCode.DEADLINE_EXCEEDED:
        return ConnectionLost(said, retry=False)
    return BadAnswer(said)


# Drivers


class Door:
    """A channel to the server, whose calls block or are awaited."""

    def __init__(
        self,
        base_url: str,
        headers: Mapping[str, str],
        timeout: httpx.Timeout,
        verify: bool | str,
        transport: None = None,
        awaited: bool = False,
    ) -> None:
        """As `Client` has them. `timeout` is that of a whole call; one that streams has none, but
        its connection is asked every half a minute whether it lives.
        """
        self._url = base_url
        scheme, _, address = base_url.rstrip("/").partition("://")
        options = [
            ("grpc.max_receive_message_length", MESSAGE_BYTES_MAX),
            ("grpc.keepalive_time_ms", 30_000),
            ("grpc.primary_user_agent", headers["user-agent"]),
        ]
        kind = grpc.aio if awaited else grpc
        if scheme == "grpc":
            self._channel = kind.insecure_channel(address, options)
        elif verify is False:
            raise ValueError("gRPC always checks certificates: name a file of them as `verify`")
        else:
            roots = Path(verify).read_bytes() if isinstance(verify, str) else None
            told = grpc.ssl_channel_credentials(roots)
            self._channel = kind.secure_channel(address, told, options)
        self._timeout = timeout.read
        self._metadata = [(name, text) for name, text in headers.items() if name != "user-agent"]
        #: Why the last upload could not be read.
        self._unread: Exception | None = None

    def close(self) -> None:
        """Closes the channel."""
        self._channel.close()

    async def aclose(self) -> None:
        """The same with `await`."""
        await self._channel.close()

    def call(self, step: Request) -> tuple[MethodDescriptor, Any]:
        """Begins a call."""
        method, sent = messages(step)
        ways = (method.client_streaming, method.server_streaming)
        start = getattr(self._channel, "_".join("stream" if way else "unary" for way in ways))(
            f"/{SCENES}/{method.name}",
            request_serializer=lambda message: message.SerializeToString(),
            response_deserializer=message_factory.GetMessageClass(method.output_type).FromString,
        )
        self._unread = None
        sent = sent if isinstance(sent, Message) else self._read(sent)
        timeout = None if any(ways) else self._timeout
        return method, start(sent, timeout=timeout, metadata=self._metadata)

    def _read(self, sent: Iterator[Message]) -> Iterator[Message]:
        """gRPC hides what goes wrong in here from the caller."""
        try:
            yield from sent
        except Exception as error:
            self._unread = error
            raise

    def fault(self, error: Any) -> Exception:
        """What the caller is told of a call that did not succeed."""
        if self._unread:
            return self._unread
        told = fault(error)
        if isinstance(told, ConnectionLost) and "failed to connect" in told.message:
            return unreachable(self._url, told.message)
        return told


class Line:
    """Does the steps of a flow with blocking calls."""

    def __init__(self, door: Door) -> None:
        self._door = door
        self._call: Any = None
        self._items: Iterator[Any] = iter(())

    def do(self, step: Step) -> Any:
        """What came of a step."""
        try:
            if isinstance(step, Sleep):
                time.sleep(step.seconds)
            elif isinstance(step, Read):
                return next(self._items, None)
            elif isinstance(step, Request):
                self.__exit__()
                method, call = self._door.call(step)
                if not method.server_streaming:
                    return answer(method.name, call)
                self._call = call
                if not step.stream:
                    pieces = (item(method.name, message) for message in call)
                    return Answer(200, {}, b"".join(pieces))
                first = next(call, None)  # a refusal comes before it
                found = call if first is None else chain([first], call)
                self._items = (item(method.name, message) for message in found)
                return Answer(200, {}, b"")
        except grpc.RpcError as error:
            return self._door.fault(error)
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._call:
            self._call.cancel()


class AsyncLine:
    """Does the steps of a flow with `await`."""

    def __init__(self, door: Door) -> None:
        self._door = door
        self._call: Any = None
        self._items: AsyncIterator[Any]

    async def do(self, step: Step) -> Any:
        """What came of a step."""
        try:
            if isinstance(step, Sleep):
                await anyio.sleep(step.seconds)
            elif isinstance(step, Read):
                return await anext(self._items, None)
            elif isinstance(step, Request):
                await self.__aexit__()
                method, call = self._door.call(step)
                if not method.server_streaming:
                    return answer(method.name, await call)
                self._call, stream = call, aiter(call)
                if not step.stream:
                    pieces = [item(method.name, message) async for message in stream]
                    return Answer(200, {}, b"".join(pieces))
                first = await anext(stream, None)
                self._items = _items(method.name, first, stream)
                return Answer(200, {}, b"")
        except grpc.RpcError as error:
            return self._door.fault(error)
        return None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._call:
            self._call.cancel()


async def _items(method: str, first: Any, stream: AsyncIterator[Any]) -> AsyncIterator[Any]:
    message = first
    while message is not None:
        yield item(method, message)
        message = await anext(stream, None)
