"""The client has what `/openapi.json` has: each call, option, format of an export and field of a
status, or it stands here with its reason.
"""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest

from segsplat import AsyncClient, AsyncScene, Client, Event, Models, Scene, SceneStatus
from segsplat.formats import ExportFormat
from segsplat.types import SceneOptions

#: Methods of a client or a scene by the calls of the document.
METHODS = {
    "create_scene": (Client, AsyncClient, "scene"),
    "list_scenes": (Client, AsyncClient, "scenes"),
    "get_scene": (Client, AsyncClient, "get"),
    "models": (Client, AsyncClient, "models"),
    "delete_scene": (Scene, AsyncScene, "delete"),
    "watch_scene": (Scene, AsyncScene, "events"),
    "refine_scene": (Scene, AsyncScene, "refine"),
    "add_photos": (Scene, AsyncScene, "add"),
    "remove_photo": (Scene, AsyncScene, "remove"),
    "get_scale": (Scene, AsyncScene, "scale"),
    "set_scale": (Scene, AsyncScene, "set_scale"),
    "measure": (Scene, AsyncScene, "measure"),
    "get_edits": (Scene, AsyncScene, "edits"),
    "set_edits": (Scene, AsyncScene, "set_edits"),
    "render_view": (Scene, AsyncScene, "view"),
    "render_views": (Scene, AsyncScene, "views"),
    "query": (Scene, AsyncScene, "query"),
    "pick": (Scene, AsyncScene, "pick"),
    "features": (Scene, AsyncScene, "features"),
    "export": (Scene, AsyncScene, "export"),
}
#: What the client does not have, and why.
ABSENT = {
    "*.deadline_ms": "`timeout` of the client",
    "*.wait_ms": "`wait`",
    "create_scene.photo": "`source`",
    "create_scene.archive": "`source`",
    "create_scene.splats": "`source`",
    "create_scene.transforms": "`source`",
    "add_photos.photo": "`source`",
    "add_photos.archive": "`source`",
    "add_photos.cameras": "`source`",
    "add_photos.splats": "a file of Gaussians is a scene of its own",
    "add_photos.transforms": "`source`",
    "list_scenes.limit": "`page`",
    "list_scenes.after": "it iterates",
    "render_view.format": "it gives arrays",
    "render_views.format": "it gives arrays",
    "render_view.kind": "`kinds`",
    "render_views.cameras": "`viewpoints`",
    "render_views.container": "it iterates",
    "query.mask": "`masks`",
    "query.relevancy": '`view("relevancy")`',
    "pick.label": "`labels`",
    "*.fx": "`K`",
    "*.fy": "`K`",
    "*.cx": "`K`",
    "*.cy": "`K`",
    "Scene.intrinsics": "`K` of a camera",
    "Scene.camera_to_world": "that of a camera",
    "Scene.width": "that of a camera",
    "Scene.height": "that of a camera",
    "Scene.network": "the lens of pixels that only a PLY names",
}


@pytest.fixture(scope="module")
def document(url: str) -> Any:
    return httpx.get(f"{url}/openapi.json").json()


def calls(document: Any) -> dict[str, dict[str, Any]]:
    """The calls of `/v1` by name."""
    return {
        operation["operationId"]: operation
        for path, item in document["paths"].items()
        for operation in item.values()
        if path.startswith("/v1/")
    }


def resolved(document: Any, schema: Any) -> Any:
    while "$ref" in schema:
        schema = document["components"]["schemas"][schema["$ref"].rsplit("/", 1)[1]]
    return schema


def options(document: Any, operation: Any) -> set[str]:
    found = {one["name"] for one in operation.get("parameters", []) if one["in"] == "query"}
    for body in operation.get("requestBody", {}).get("content", {}).values():
        found |= resolved(document, body["schema"]).get("properties", {}).keys()
    return found


def fields(document: Any, schema: Any) -> Iterator[str]:
    """Names of all fields of a schema and of the schemas in it."""
    schema = resolved(document, schema)
    for name, field in schema.get("properties", {}).items():
        yield name
        # The options of a scene are a dictionary here.
        if name != "method":
            yield from fields(document, field)
    inner = [one for kind in ("oneOf", "anyOf", "allOf") for one in schema.get(kind, [])]
    for one in inner + [schema[key] for key in ("items",) if key in schema]:
        yield from fields(document, one)


def names(kind: Any) -> Iterator[str]:
    """Names of all fields of a dataclass and of those in it."""
    if dataclasses.is_dataclass(kind):
        for name, hint in typing.get_type_hints(kind).items():
            yield name
            yield from names(hint)
    for part in typing.get_args(kind):
        yield from names(part)


def parameters(method: Callable[..., Any]) -> set[str]:
    found = inspect.signature(method).parameters
    given = {name.removesuffix("_") for name in found}
    if any(one.kind is one.VAR_KEYWORD for one in found.values()):
        given |= {name.removesuffix("_") for name in typing.get_type_hints(SceneOptions)}
    return given


def test_it_has_every_call_option_format_and_field(document: Any) -> None:
    wanted, given = {}, {}
    for name, operation in calls(document).items():
        assert name in METHODS, f"the client lacks the call {name}"
        now, later, method = METHODS[name]
        wanted[name] = options(document, operation)
        given[name] = parameters(getattr(now, method))
        assert parameters(getattr(later, method)) == given[name], method
    export = {one["name"]: one for one in calls(document)["export"]["parameters"]}
    wanted["export"] |= {f"format={name}" for name in export["format"]["schema"]["enum"]}
    given["export"] |= {f"format={name}" for name in typing.get_args(ExportFormat)}
    for kind, schema in ((SceneStatus, "Scene"), (Event, "Event"), (Models, "Models")):
        wanted[schema] = {*fields(document, document["components"]["schemas"][schema])}
        given[schema] = {*names(kind)}
        assert len(wanted[schema]) > 4
    lacks = {f"{one}.{name}" for one in wanted for name in wanted[one] - given[one]}
    excused = {one if one in ABSENT else "*." + one.split(".")[1] for one in lacks}
    assert sorted(excused - ABSENT.keys()) == [], "the client lacks them"
    assert sorted(ABSENT.keys() - excused) == [], "the client has them"
