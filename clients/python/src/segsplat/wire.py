"""What goes over the wire, without a socket.

A call is a *flow*: a generator that yields steps (send this, read on, sleep) and is sent what came
of each. The flow makes the requests, reads the answers and decides on retries. The drivers only do
the steps, with blocking calls or with `await`: those in `client.py` over HTTP, those in `rpc.py`
over gRPC.
"""

from __future__ import annotations

import itertools
import json
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

from ._version import __version__
from .errors import BadAnswer, ConnectionLost, SegSplatError, VersionWarning, error_of
from .types import CallerLimits, parse

#: Waiting times of a lost connection, seconds.
BACKOFF_S = (0.25, 0.5, 1.0, 2.0)


class Reader(Protocol):
    """Makes items of the pieces of a streamed body."""

    def feed(self, piece: bytes) -> Iterable[Any]:
        """The items that are whole by now."""


@dataclass(frozen=True)
class Part:
    """A part of an upload. Files are read while they are sent."""

    field: str
    name: str
    content: Path | bytes


@dataclass(frozen=True)
class Request:
    """Send this; the reply is an `Answer`."""

    method: str
    path: str
    params: Mapping[str, Any] = field(default_factory=dict)
    json: Any = None
    upload: Sequence[Part] = ()
    headers: Mapping[str, str] = field(default_factory=dict)
    #: Makes what reads the body, which then comes item by item, by `Read`; it is given the headers.
    stream: Callable[[Mapping[str, str]], Reader] | None = None


@dataclass(frozen=True)
class Answer:
    """Status, headers (lower case) and body; the body of a stream is empty."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class Read:
    """Give the next item of the streamed answer; the reply is None at its end."""


@dataclass(frozen=True)
class Sleep:
    """Do nothing for a while."""

    seconds: float


@dataclass(frozen=True)
class Item:
    """Hand this to the caller, who iterates."""

    value: Any


Step: TypeAlias = Request | Read | Sleep | Item
T = TypeVar("T")
Flow: TypeAlias = Generator[Step, Any, T]


class Run(Generic[T]):
    """A flow on its way."""

    def __init__(self, flow: Flow[T]) -> None:
        self._flow = flow
        #: What came of the last step; an exception is raised in the flow.
        self.reply: Any = None
        #: What the flow returned, once it has ended.
        self.value: T

    def next(self) -> Step | None:
        """The next step; None at the end."""
        reply, self.reply = self.reply, None
        try:
            if isinstance(reply, Exception):
                return self._flow.throw(reply)
            return self._flow.send(reply)
        except StopIteration as end:
            self.value = end.value
            return None


@dataclass
class Policy:
    """How long a client tries."""

    #: Times that a call is sent again.
    retries: int
    #: Longest time to wait before one of them, seconds.
    retry_wait_max: float
    #: Whether the server's version is yet to be looked at.
    version_unseen: bool = True
    #: What the server takes at once; None where it has not said.
    limits: CallerLimits | None = None
    #: Address of the server, for errors.
    server: str = ""


def send(policy: Policy, request: Request) -> Flow[Answer]:
    """Sends a request, again after the time that the server names, or when the connection broke."""
    if policy.version_unseen:
        yield from meet(policy)
    for again in itertools.count():
        try:
            answer: Answer = yield request
            if answer.status < 400:
                return answer
            error = error_of(answer.status, answer.headers, answer.body)
        except SegSplatError as refused:
            error = refused
        error.call = f"{request.method} {policy.server}{request.path}"
        yield from pause(policy, error, again)
    raise AssertionError("unreachable")


def pause(policy: Policy, error: SegSplatError, again: int) -> Flow[None]:
    """Waits as the error says; raises it where it does not say, or where it is too much."""
    wait = error.retry_after
    if wait is None and isinstance(error, ConnectionLost):
        wait = BACKOFF_S[min(again, len(BACKOFF_S) - 1)]
    if not error.retry or wait is None or wait > policy.retry_wait_max or again >= policy.retries:
        raise error
    yield Sleep(wait)


def meet(policy: Policy) -> Flow[None]:
    """Learns the limits of the server, and warns where it is of another version. A server that does
    not say is left alone. One that cannot say now is asked again, as in any call.
    """
    policy.version_unseen = False
    try:
        answer = yield from send(policy, Request("GET", "/v1/models"))
        told = json.loads(answer.body)
        server = str(told["server_version"])
        policy.limits = parse(CallerLimits, told["limits"]) if told.get("limits") else None
    except (SegSplatError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, ConnectionLost) or (isinstance(error, SegSplatError) and error.retry):
            policy.version_unseen = True
            raise
        return
    if server.split(".")[:2] != __version__.split(".")[:2]:
        warnings.warn(
            f"the server has version {server}, this client is {__version__}: "
            "install the client of the server's major and minor version",
            VersionWarning,
            stacklevel=2,
        )


class Multipart:
    """Reads `multipart/mixed` as it comes."""

    def __init__(self, headers: Mapping[str, str]) -> None:
        content_type = headers.get("content-type", "")
        _, found, boundary = content_type.partition("boundary=")
        if not found:
            raise BadAnswer(f"content-type {content_type!r} has no boundary")
        self._line = b"--" + boundary.strip().strip('"').encode()
        self._held = bytearray()
        self.ended = False

    def feed(self, piece: bytes) -> Iterable[tuple[Mapping[str, str], bytes]]:
        """The parts that are whole by now: headers (lower case) and body."""
        self._held += piece
        while not self.ended:
            if self._held.startswith(self._line + b"--"):
                self.ended = True
                return
            head_end = self._held.find(b"\r\n\r\n")
            if head_end < 0:
                return
            lines = self._held[:head_end].decode("latin-1").split("\r\n")[1:]
            pairs = (line.partition(":") for line in lines)
            headers = {name.strip().lower(): value.strip() for name, _, value in pairs}
            start = head_end + 4
            if "content-length" in headers:
                end = start + int(headers["content-length"])
            else:
                end = self._held.find(b"\r\n" + self._line, start)
            # The line break after the body belongs to the boundary.
            if end < 0 or len(self._held) < end + 2 + len(self._line) + 2:
                return
            if not self._held.startswith(self._line, end + 2):
                raise BadAnswer("a part of the answer is longer than it says")
            body = bytes(self._held[start:end])
            del self._held[: end + 2]
            yield headers, body


class ServerSentEvents:
    """Reads `text/event-stream` as it comes: the `data` of each event."""

    def __init__(self, _: Mapping[str, str]) -> None:
        self._held = b""

    def feed(self, piece: bytes) -> Iterable[str]:
        """The data of the events that are whole by now."""
        *events, self._held = (self._held + piece).split(b"\n\n")
        for event in events:
            lines = event.decode().split("\n")
            data = [line[5:].strip() for line in lines if line.startswith("data:")]
            if data:
                yield "\n".join(data)


class Pieces:
    """Reads a body as it comes, piece by piece."""

    def __init__(self, _: Mapping[str, str]) -> None:
        pass

    def feed(self, piece: bytes) -> Iterable[bytes]:
        """The piece."""
        return (piece,)
