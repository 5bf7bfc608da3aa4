"""One class for each code of the server's table of errors (docs/errors.md)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, ClassVar

__all__ = [
    "SegSplatError",
    "InvalidRequest",
    "PhotoUnreadable",
    "CamerasUnsolved",
    "LimitExceeded",
    "IdempotencyKeyReused",
    "SceneNotFound",
    "NotFound",
    "MethodNotAllowed",
    "NotAcceptable",
    "UnsupportedMediaType",
    "SceneNotReady",
    "SemanticsOff",
    "Unauthenticated",
    "PermissionDenied",
    "Overloaded",
    "Stopping",
    "DeadlineExceeded",
    "Cancelled",
    "ModelUnavailable",
    "StoreUnavailable",
    "GpuUnavailable",
    "SceneCorrupt",
    "OtherVersion",
    "Internal",
    "ConnectionLost",
    "BadAnswer",
    "ServerNotStarted",
    "VersionWarning",
]


class SegSplatError(Exception):
    """A call that did not succeed. The subclass tells which code the server gave."""

    #: Stable snake_case code.
    code: str = "internal"
    #: Whether the same call may succeed later.
    retry: bool = False

    #: What the caller can do about it; empty where the message says all.
    remedy: ClassVar[str] = ""
    #: The class of each code.
    of_code: ClassVar[dict[str, type[SegSplatError]]] = {}

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        request_id: str | None = None,
        retry: bool | None = None,
        retry_after: float | None = None,
        scene: str | None = None,
    ) -> None:
        super().__init__(message)
        #: A sentence that names input, value and bound.
        self.message = message
        #: Finds the call in the server's log.
        self.request_id = request_id
        #: Seconds from now after which the server takes the call again; None: it did not say.
        self.retry_after = retry_after
        #: Id of the scene it is about.
        self.scene = scene
        #: The call that failed: `GET http://127.0.0.1:8080/v1/scenes/0f3c`.
        self.call: str | None = None
        if code is not None:
            self.code = code
        if retry is not None:
            self.retry = retry

    def __init_subclass__(cls) -> None:
        SegSplatError.of_code[cls.code] = cls

    def __str__(self) -> str:
        of = [self.call, self.request_id and f"request {self.request_id}"]
        told = ", ".join(filter(None, of))
        said = f"{self.code}: {self.message}{told and f' ({told})'}"
        return f"{said}: {self.remedy}" if self.remedy else said


class InvalidRequest(SegSplatError):
    """The request itself is wrong: a missing part, a bad number, an impossible pose."""

    code = "invalid_request"


class PhotoUnreadable(SegSplatError):
    """A photo or archive cannot be read as what it claims to be."""

    code = "photo_unreadable"


class LimitExceeded(SegSplatError):
    """A stated limit is exceeded; the message names limit, value and maximum."""

    code = "limit_exceeded"


class CamerasUnsolved(SegSplatError):
    """The cameras of photos that came without could not be solved, or the photos do not confirm
    them."""

    code = "cameras_unsolved"


class IdempotencyKeyReused(SegSplatError):
    """An idempotency key was used again with other photos or options."""

    code = "idempotency_key_reused"


class SceneNotFound(SegSplatError):
    """No scene of this id."""

    code = "scene_not_found"
    remedy = "client.scenes() lists those that are there"


class NotFound(SegSplatError):
    """No such route or resource."""

    code = "not_found"


class MethodNotAllowed(SegSplatError):
    """The path is there, but not with this method."""

    code = "method_not_allowed"


class NotAcceptable(SegSplatError):
    """No encoding that ``Accept`` names fits what was asked."""

    code = "not_acceptable"


class UnsupportedMediaType(SegSplatError):
    """The content type of a call is not one that it takes."""

    code = "unsupported_media_type"


class SceneNotReady(SegSplatError):
    """The scene exists but is not done, or its semantics are still being made."""

    code = "scene_not_ready"
    retry = True


class SemanticsOff(SegSplatError):
    """A text was asked of a scene that was made with `semantics="off"`."""

    code = "semantics_off"
    remedy = 'make the scene anew with semantics="lazy"'


class Unauthenticated(SegSplatError):
    """No key was shown, or one that nobody knows."""

    code = "unauthenticated"
    remedy = "give Client(api_key=...), or set SEGSPLAT_API_KEY"


class PermissionDenied(SegSplatError):
    """The key may not do this: its scope is too narrow."""

    code = "permission_denied"
    remedy = "use a key of a wider scope"


class Overloaded(SegSplatError):
    """Too much work is queued; try again after the time given."""

    code = "overloaded"
    remedy = "ask again later, or wait longer with Client(retry_wait_max=...)"
    retry = True


class Stopping(SegSplatError):
    """The server is stopping; another one, or the next, takes the call."""

    code = "stopping"
    retry = True


class DeadlineExceeded(SegSplatError):
    """The deadline of the call passed."""

    code = "deadline_exceeded"
    retry = True


class Cancelled(SegSplatError):
    """The caller went away or asked to stop."""

    code = "cancelled"


class ModelUnavailable(SegSplatError):
    """The model bundle or ONNX Runtime is missing or does not match its manifest."""

    code = "model_unavailable"
    retry = True


class StoreUnavailable(SegSplatError):
    """The store cannot be read or written now."""

    code = "store_unavailable"
    retry = True


class GpuUnavailable(SegSplatError):
    """No usable GPU adapter where one was required."""

    code = "gpu_unavailable"
    retry = True


class SceneCorrupt(SegSplatError):
    """A stored scene fails its checksum or has an unknown version."""

    code = "scene_corrupt"


class OtherVersion(SegSplatError):
    """What is stored is whole, and another version of the server wrote it: that one can read it."""

    code = "other_version"


class Internal(SegSplatError):
    """A fault of the server."""

    code = "internal"


class ConnectionLost(SegSplatError):
    """The server was not reached, or the answer broke off."""

    code = "connection_lost"
    retry = True


class BadAnswer(SegSplatError):
    """An answer that is not the server's: that of a proxy, or of another program."""

    code = "bad_answer"
    remedy = "look whether the address is that of a SegSplat server"


class ServerNotStarted(SegSplatError):
    """`local()` found no program, or its server did not start."""

    code = "server_not_started"


class VersionWarning(UserWarning):
    """The server's version is not the one that this client was written for."""


def unreachable(url: str, why: str) -> ConnectionLost:
    """The error of a server that is not there."""
    return ConnectionLost(
        f"{url} cannot be reached ({why}): start the server with `segsplat serve`, or name another "
        "with Client(url) or SEGSPLAT_URL"
    )


def error_of(status: int, headers: Mapping[str, str], body: bytes) -> SegSplatError:
    """The error of an answer with a status of 400 or more, or of a part in a stream."""
    after = headers.get("retry-after", "")
    retry_after = float(after) if after.isdigit() else None
    request_id = headers.get("x-request-id")
    try:
        told: Any = json.loads(body)
        code, message, details = told["code"], told["message"], told.get("details", {})
        request_id = told.get("request_id", request_id)
        kind = SegSplatError.of_code.get(code, SegSplatError)
        return kind(
            message,
            code=code,
            request_id=request_id,
            retry=details.get("retry"),
            retry_after=details.get("retry_after_s", retry_after),
            scene=details.get("scene"),
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    # Not the server's own words: something between it and us.
    if HTTPStatus.BAD_GATEWAY <= status <= HTTPStatus.GATEWAY_TIMEOUT:
        return ConnectionLost(f"HTTP {status} of a proxy", retry_after=retry_after)
    return BadAnswer(
        f"HTTP {status} without an error of SegSplat Server: {body[:100]!r}",
        request_id=request_id,
        retry=retry_after is not None,
        retry_after=retry_after,
    )
