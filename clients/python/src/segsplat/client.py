"""The clients: two drivers of the flows in `calls.py`, and the scenes that they give."""

from __future__ import annotations

import inspect
import os
import time
import typing
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import anyio
import httpx
from typing_extensions import Self, Unpack

from . import calls
from ._version import __version__
from .calls import Handle, Progress, Shown, Source
from .errors import ConnectionLost, unreachable
from .types import Event, Models, Photo, Report, SceneOptions, SceneStatus
from .view import View
from .wire import Answer, Flow, Item, Policy, Read, Reader, Request, Run, Sleep, Step

T = TypeVar("T")
P = ParamSpec("P")


class _Connection:
    """What both clients have: address, key, time limits."""

    def __init__(
        self,
        url: str | None = None,
        *,
        api_key: str | None = None,
        timeout: float = 300.0,
        retries: int = 5,
        retry_wait_max: float = 120.0,
        verify: bool | str = True,
        transport: Any = None,
    ) -> None:
        """
        url: address of the server; by default $SEGSPLAT_URL, else http://127.0.0.1:8080. With
            grpc:// or grpcs:// (TLS) the same calls go over gRPC: `pip install segsplat[grpc]`.
        api_key: key of the server's file of keys, where it has one; by default $SEGSPLAT_API_KEY.
        timeout: seconds without a byte from the server; over gRPC seconds of a call that is not a
            stream. A first text can take a minute.
        retries: times that a call is sent again, each after the time that the server names.
        retry_wait_max: longest such time, seconds; a longer one raises the error.
        verify: False, or a file of certificates, as in httpx.
        transport: an httpx transport to use instead of the network; not over gRPC.
        """
        headers = {"user-agent": f"segsplat-python/{__version__}"}
        if api_key := api_key or os.environ.get("SEGSPLAT_API_KEY"):
            headers["authorization"] = f"Bearer {api_key}"
        base_url = url or os.environ.get("SEGSPLAT_URL", "http://127.0.0.1:8080")
        self.policy = Policy(retries, retry_wait_max, server=base_url.rstrip("/"))
        self._rpc = _rpc() if base_url.startswith(("grpc://", "grpcs://")) else None
        self._settings: dict[str, Any] = {
            "base_url": base_url,
            "headers": headers,
            "timeout": httpx.Timeout(timeout, connect=10.0),
            "transport": transport,
            "verify": verify,
        }

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.policy.server}>"


def _rpc() -> Any:
    """The module for gRPC, which not everybody has installed."""
    try:
        from . import rpc
    except ImportError as missing:
        raise ImportError(f"{missing}: pip install 'segsplat[grpc]'") from missing
    return rpc


def _multipart(request: Request, stack: ExitStack) -> list[tuple[str, tuple[str, Any]]] | None:
    """The parts for httpx, which reads open files in pieces."""

    def content(source: Path | bytes) -> Any:
        return source if isinstance(source, bytes) else stack.enter_context(source.open("rb"))

    parts = [(part.field, (part.name, content(part.content))) for part in request.upload]
    return parts or None


def _built(
    http: httpx.Client | httpx.AsyncClient, step: Request, stack: ExitStack
) -> httpx.Request:
    return http.build_request(
        step.method,
        step.path,
        params={name: _text(value) for name, value in step.params.items()},
        json=step.json,
        files=_multipart(step, stack),
        headers=dict(step.headers),
    )


def _text(value: Any) -> Any:
    """Numbers joined by commas; lists of texts as they are, each under its name."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (list, tuple)) and not all(isinstance(one, str) for one in value):
        return ",".join(str(one) for one in value)
    return value


def _reader(step: Request, response: httpx.Response) -> Reader | None:
    """What reads the body as it comes; None: it is read at once, as that of an error is."""
    return step.stream(response.headers) if step.stream and not response.is_error else None


def _lost(error: httpx.TransportError) -> ConnectionLost:
    broken = httpx.NetworkError | httpx.RemoteProtocolError | httpx.ConnectTimeout
    message = f"{type(error).__name__}: {error}"
    if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout):
        url = error.request.url
        return unreachable(f"{url.scheme}://{url.netloc.decode()}", message)
    return ConnectionLost(message, retry=isinstance(error, broken))


class _Line:
    """Does the steps of a flow with blocking calls."""

    def __init__(self, http: httpx.Client) -> None:
        self._http = http
        self._response: httpx.Response | None = None
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
                with ExitStack() as files:
                    request = _built(self._http, step, files)
                    self._response = response = self._http.send(request, stream=True)
                if reader := _reader(step, response):
                    self._items = (
                        item for piece in response.iter_bytes() for item in reader.feed(piece)
                    )
                body = b"" if reader else response.read()
                return Answer(response.status_code, response.headers, body)
        except httpx.TransportError as error:
            return _lost(error)
        return None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._response:
            self._response.close()


class _AsyncLine:
    """Does the steps of a flow with `await`."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http
        self._response: httpx.Response | None = None
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
                with ExitStack() as files:
                    request = _built(self._http, step, files)
                    self._response = response = await self._http.send(request, stream=True)
                if reader := _reader(step, response):
                    self._items = (
                        item
                        async for piece in response.aiter_bytes()
                        for item in reader.feed(piece)
                    )
                body = b"" if reader else await response.aread()
                return Answer(response.status_code, response.headers, body)
        except httpx.TransportError as error:
            return _lost(error)
        return None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._response:
            await self._response.aclose()


class Client(_Connection):
    """Talks to a server.

    >>> client = Client("http://127.0.0.1:8080")
    >>> scene = client.scene("photos/")
    >>> scene.view(from_=0, to=1, t=0.5).save("view.png")
    """

    def scene(
        self,
        source: Source,
        *,
        masks: str | Path | None = None,
        wait: bool = True,
        progress: Progress = None,
        idempotency_key: str | None = None,
        **options: Unpack[SceneOptions],
    ) -> Scene:
        """Makes a scene of photos, and waits until it is made.

        source: a folder with photos, whose cameras the server finds; or with a capture:
            `transforms.json`, COLMAP, Polycam and others, which the server recognises; a zip or
            tar of one; `{"photo.jpg": Camera(...)}`; a video, where the program `ffmpeg` is
            installed: 16 to 64 sharp frames of it are sent; or a file of Gaussians
            (PLY, SPZ, SOG, GLB, .splat), which needs no photos.
        masks: a folder with masks, each named as its photo (`0001.png` or `0001.jpg.png`): what is
            black in them takes no part in the scene. Those that a `transforms.json` names, and
            those in a folder `masks` beside COLMAP's cameras, are found without it.
        wait: False gives the scene at once; `scene.wait()` waits for it.
        progress: True shows a bar; a function is told of each event; by default a bar on terminals.
        idempotency_key: calls with one key make one scene; by default a new key for each call.
        semantics, density, preset, max_views, bundle: how the scene is made, see `SceneOptions`.
        """
        made = calls.create(self.policy, source, options, idempotency_key, masks)
        scene = Scene(self, self._run(made))
        if wait:
            scene.wait(progress)
        return scene

    def get(self, id: str) -> Scene:
        """The scene of an id."""
        return Scene(self, self._run(calls.get(self.policy, id)))

    def scenes(self, *, page: int | None = None) -> Iterator[Scene]:
        """All scenes, newest first, asked page by page. They lack their photos: see `refresh`."""
        return (Scene(self, shown) for shown in self._iterate(calls.scenes(self.policy, page)))

    def models(self) -> Models:
        """What makes the scenes: networks, renderer, version."""
        return self._run(calls.models(self.policy))

    def close(self) -> None:
        """Closes the connections."""
        self._door.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @cached_property
    def _door(self) -> Any:
        return self._rpc.Door(**self._settings) if self._rpc else httpx.Client(**self._settings)

    def _line(self) -> Any:
        return self._rpc.Line(self._door) if self._rpc else _Line(self._door)

    def _run(self, flow: Flow[T]) -> T:
        run = Run(flow)
        with self._line() as line:
            while step := run.next():
                run.reply = line.do(step)
        return run.value

    def _iterate(self, flow: Flow[Any]) -> Iterator[Any]:
        run = Run(flow)
        with self._line() as line:
            while step := run.next():
                if isinstance(step, Item):
                    yield step.value
                else:
                    run.reply = line.do(step)


class AsyncClient(_Connection):
    """`Client` for `async with` and `await`; iterators are for `async for`."""

    async def scene(
        self,
        source: Source,
        *,
        masks: str | Path | None = None,
        wait: bool = True,
        progress: Progress = None,
        idempotency_key: str | None = None,
        **options: Unpack[SceneOptions],
    ) -> AsyncScene:
        """As `Client.scene`. Photos are read from disk in pieces between the network's turns."""
        made = calls.create(self.policy, source, options, idempotency_key, masks)
        scene = AsyncScene(self, await self._run(made))
        if wait:
            await scene.wait(progress)
        return scene

    async def get(self, id: str) -> AsyncScene:
        """The scene of an id."""
        return AsyncScene(self, await self._run(calls.get(self.policy, id)))

    async def scenes(self, *, page: int | None = None) -> AsyncIterator[AsyncScene]:
        """As `Client.scenes`."""
        async for shown in self._iterate(calls.scenes(self.policy, page)):
            yield AsyncScene(self, shown)

    async def models(self) -> Models:
        """What makes the scenes: networks, renderer, version."""
        return await self._run(calls.models(self.policy))

    async def close(self) -> None:
        """Closes the connections."""
        await self._door.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    @cached_property
    def _door(self) -> Any:
        if self._rpc:
            return self._rpc.Door(**self._settings, awaited=True)
        return httpx.AsyncClient(**self._settings)

    def _line(self) -> Any:
        return self._rpc.AsyncLine(self._door) if self._rpc else _AsyncLine(self._door)

    async def _run(self, flow: Flow[T]) -> T:
        run = Run(flow)
        async with self._line() as line:
            while step := run.next():
                run.reply = await line.do(step)
        return run.value

    async def _iterate(self, flow: Flow[Any]) -> AsyncIterator[Any]:
        run = Run(flow)
        async with self._line() as line:
            while step := run.next():
                if isinstance(step, Item):
                    yield step.value
                else:
                    run.reply = await line.do(step)


class _Scene(Handle):
    @property
    def status(self) -> SceneStatus:
        """State, progress, report and semantics when they were last asked for."""
        return self.shown[0]

    @property
    def photos(self) -> tuple[Photo, ...]:
        """The input photos and their cameras, once done."""
        return self.shown[1]

    @property
    def report(self) -> Report | None:
        """Counts, times and warnings of the making, once done."""
        return self.status.report

    def __repr__(self) -> str:
        made = f", {self.report.gaussians} Gaussians" if self.report else ""
        return f"<{type(self).__name__} {self.id}: {self.status.state}{made}>"


def _now(call: Callable[Concatenate[Handle, P], Flow[T]]) -> Callable[Concatenate[Scene, P], T]:
    def method(scene: Scene, /, *args: P.args, **options: P.kwargs) -> T:
        return scene.client._run(call(scene, *args, **options))

    return _described(method, call)


def _many(
    call: Callable[Concatenate[Handle, P], Flow[None]], item: type[T]
) -> Callable[Concatenate[Scene, P], Iterator[T]]:
    def method(scene: Scene, /, *args: P.args, **options: P.kwargs) -> Iterator[T]:
        return scene.client._iterate(call(scene, *args, **options))

    return _described(method, call)


def _later(
    call: Callable[Concatenate[Handle, P], Flow[T]],
) -> Callable[Concatenate[AsyncScene, P], Awaitable[T]]:
    def method(scene: AsyncScene, /, *args: P.args, **options: P.kwargs) -> Awaitable[T]:
        return scene.client._run(call(scene, *args, **options))

    return _described(method, call)


def _many_later(
    call: Callable[Concatenate[Handle, P], Flow[None]], item: type[T]
) -> Callable[Concatenate[AsyncScene, P], AsyncIterator[T]]:
    def method(scene: AsyncScene, /, *args: P.args, **options: P.kwargs) -> AsyncIterator[T]:
        return scene.client._iterate(call(scene, *args, **options))

    return _described(method, call)


def _described(method: Callable[P, T], call: Callable[..., Any]) -> Callable[P, T]:
    """The method with the call's name, words and parameters; a notebook completes the options."""
    known = inspect.signature(call)
    given = []
    for parameter in known.parameters.values():
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD:
            given.append(parameter)
            continue
        (options,) = typing.get_args(typing.get_type_hints(call)[parameter.name])
        given += [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None)
            for name in typing.get_type_hints(options)
        ]
    method.__name__ = method.__qualname__ = call.__name__
    method.__doc__ = call.__doc__
    method.__signature__ = known.replace(  # type: ignore[attr-defined]
        parameters=given, return_annotation=inspect.Signature.empty
    )
    return method


class Scene(_Scene):
    """A scene of a `Client`."""

    def __init__(self, client: Client, shown: Shown) -> None:
        super().__init__(client.policy, shown)
        self.client = client

    wait = _now(calls.wait)
    refresh = _now(calls.refresh)
    delete = _now(calls.delete)
    refine = _now(calls.refine)
    add = _now(calls.add)
    remove = _now(calls.remove)
    scale = _now(calls.scale)
    set_scale = _now(calls.set_scale)
    measure = _now(calls.measure)
    edits = _now(calls.edits)
    set_edits = _now(calls.set_edits)
    edit = _now(calls.edit)
    undo = _now(calls.undo)
    view = _now(calls.view)
    query = _now(calls.query)
    pick = _now(calls.pick)
    features = _now(calls.features)
    export = _now(calls.export)
    gaussians = _now(calls.gaussians)
    show = _now(calls.show)
    events = _many(calls.events, Event)
    views = _many(calls.views, View)

    def _repr_png_(self) -> bytes | None:
        return self.view()._repr_png_() if self.status.state == "done" else None


class AsyncScene(_Scene):
    """A scene of an `AsyncClient`."""

    def __init__(self, client: AsyncClient, shown: Shown) -> None:
        super().__init__(client.policy, shown)
        self.client = client

    wait = _later(calls.wait)
    refresh = _later(calls.refresh)
    delete = _later(calls.delete)
    refine = _later(calls.refine)
    add = _later(calls.add)
    remove = _later(calls.remove)
    scale = _later(calls.scale)
    set_scale = _later(calls.set_scale)
    measure = _later(calls.measure)
    edits = _later(calls.edits)
    set_edits = _later(calls.set_edits)
    edit = _later(calls.edit)
    undo = _later(calls.undo)
    view = _later(calls.view)
    query = _later(calls.query)
    pick = _later(calls.pick)
    features = _later(calls.features)
    export = _later(calls.export)
    gaussians = _later(calls.gaussians)
    show = _later(calls.show)
    events = _many_later(calls.events, Event)
    views = _many_later(calls.views, View)
