"""Errors, retries and versions. `Faulty` puts faults between the client and the real server."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from served import ROOT, run, served

import segsplat
from segsplat import Client, Scene, SegSplatError

Answering = Callable[[httpx.Request, httpx.Response], httpx.Response]


def refusal(status: int, code: str, retry_after: int | None = None) -> httpx.Response:
    """As the server refuses."""
    details = {"retry": True, "retry_after_s": retry_after}
    body = {"code": code, "message": "not now", "request_id": "r1", "details": details}
    headers = {} if retry_after is None else {"retry-after": str(retry_after)}
    return httpx.Response(status, json=body, headers=headers)


class Faulty(httpx.BaseTransport):
    """The network, with faults: calls to `path` are answered by `faults`, one after the other."""

    def __init__(self, path: str, *faults: httpx.Response | Answering) -> None:
        self.path = path
        self.faults = list(faults)
        self.seen: list[httpx.Request] = []
        self.network = httpx.HTTPTransport()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if self.path not in request.url.path or (
            self.path == "/v1/scenes" and request.method != "POST"
        ):
            return self.network.handle_request(request)
        self.seen.append(request)
        fault = self.faults.pop(0) if self.faults else None
        if isinstance(fault, httpx.Response):
            return fault
        answer = self.network.handle_request(request)
        return fault(request, answer) if fault else answer


def lose(_: httpx.Request, answer: httpx.Response) -> httpx.Response:
    """The server has done it, and its answer does not come."""
    answer.read()
    raise httpx.ReadError("the connection broke")


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The times that were waited; nothing waits."""
    times: list[float] = []
    monkeypatch.setattr("segsplat.client.time.sleep", times.append)
    return times


def test_every_code_has_its_class() -> None:
    table = (ROOT / "docs/errors.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \|.*\| (yes|no) \| (.+) \|$", table, re.MULTILINE)
    assert len(rows) > 15
    for code, _, retry, _ in rows:
        kind = SegSplatError.of_code[code]
        assert kind.__name__ == "".join(word.title() for word in code.split("_"))
        assert kind.retry == (retry == "yes"), code
        assert kind.__name__ in segsplat.__all__
    ours = {"connection_lost", "bad_answer", "server_not_started"}
    assert set(SegSplatError.of_code) == {row[0] for row in rows} | ours


def test_errors_carry_the_servers_words(client: Client, scene: Scene) -> None:
    with pytest.raises(segsplat.SceneNotFound) as gone:
        client.get("0" * 32)
    assert gone.value.code == "scene_not_found" and gone.value.request_id
    assert gone.value.message in str(gone.value) and not gone.value.retry
    with pytest.raises(segsplat.LimitExceeded, match="4097"):
        scene.view(width=4097)
    with pytest.raises(segsplat.InvalidRequest, match="text"):
        scene.view("mask")


def test_keys(tmp_path: Path, photos: Path) -> None:
    keys = tmp_path / "keys.toml"
    key = run("keys", "new", "reader", "--scope", "read", "--keys", keys).split()[0]
    with served(tmp_path / "data", "--keys", keys) as url:
        assert list(Client(url, api_key=key).scenes()) == []
        with pytest.raises(segsplat.PermissionDenied):
            Client(url, api_key=key).scene(photos)
        with pytest.raises(segsplat.Unauthenticated):
            list(Client(url).scenes())


def test_a_refused_call_comes_again_when_the_server_says(
    scene: Scene, url: str, slept: list[float]
) -> None:
    busy = [refusal(429, "overloaded", 3), refusal(503, "stopping", 7)]
    faulty = Faulty("/view", *busy)
    again = Client(url, transport=faulty).get(scene.id)
    assert np.array_equal(again.view(width=32).image, scene.view(width=32).image)
    assert slept == [3, 7] and len(faulty.seen) == 3


@pytest.mark.parametrize(
    ("answers", "error", "sent"),
    [
        # May succeed later, but the server does not say when: the caller decides.
        ([refusal(503, "model_unavailable")], segsplat.ModelUnavailable, 1),
        ([refusal(429, "overloaded", 1000)], segsplat.Overloaded, 1),
        ([refusal(429, "overloaded", 1) for _ in range(9)], segsplat.Overloaded, 3),
        ([httpx.Response(404, text="<html>nothing here")], segsplat.BadAnswer, 1),
        ([httpx.Response(502, text="<html>bad") for _ in range(9)], segsplat.ConnectionLost, 3),
        ([refusal(418, "of_a_newer_server")], SegSplatError, 1),
    ],
)
def test_a_call_is_not_sent_more_often_than_that(
    scene: Scene,
    url: str,
    slept: list[float],
    answers: list[httpx.Response],
    error: type[SegSplatError],
    sent: int,
) -> None:
    faulty = Faulty("/view", *answers)
    again = Client(url, transport=faulty, retries=2).get(scene.id)
    with pytest.raises(error):
        again.view(width=32)
    assert len(faulty.seen) == sent


def test_a_create_whose_answer_is_lost_makes_one_scene(
    client: Client, url: str, photos: Path, slept: list[float]
) -> None:
    def taken(request: httpx.Request, answer: httpx.Response) -> httpx.Response:
        assert answer.status_code == 202, "the server has taken it"
        return lose(request, answer)

    before = [scene.id for scene in client.scenes()]
    faulty = Faulty("/v1/scenes", refusal(429, "overloaded", 2), taken)
    scene = Client(url, transport=faulty).scene(photos, wait=False, semantics="off")
    assert len(faulty.seen) == 3 and slept == [2, 0.5]
    assert len({request.headers["idempotency-key"] for request in faulty.seen}) == 1
    assert [one.id for one in client.scenes()] == [scene.id, *before]
    scene.delete()


def test_a_delete_whose_answer_is_lost_is_done(
    client: Client, url: str, photos: Path, slept: list[float]
) -> None:
    scene = client.scene(photos, wait=False, semantics="off")
    faulty = Faulty(f"/v1/scenes/{scene.id}")
    again = Client(url, transport=faulty).get(scene.id)
    faulty.faults = [lose, refusal(503, "stopping", 1)]
    again.delete()
    assert [request.method for request in faulty.seen] == ["GET", *["DELETE"] * 3]
    faulty.faults = [refusal(429, "overloaded", 1)]
    with pytest.raises(segsplat.SceneNotFound) as gone:
        again.delete()
    assert gone.value.call == f"DELETE {url}/v1/scenes/{scene.id}"


def test_a_photo_leaves_though_the_answer_is_lost(
    url: str, tmp_path: Path, slept: list[float]
) -> None:
    run("sample", "--photos", "3", "-o", tmp_path / "photos")
    faulty = Faulty("/photos/", lose, refusal(503, "stopping", 1))
    scene = Client(url, transport=faulty).scene(tmp_path / "photos", semantics="off", refine="off")
    scene.remove(scene.photos[0])
    assert [request.method for request in faulty.seen] == ["DELETE"] * 3
    assert len(scene.photos) == 2 and scene.status.version == 2, "it was waited for"
    # A server that is overloaded has not done it.
    faulty.faults = [refusal(429, "overloaded", 1)]
    with pytest.raises(segsplat.NotFound, match="no photo"):
        scene.remove("absent.png")
    scene.delete()


@pytest.mark.parametrize(
    ("path", "ask"),
    [
        ("/views", lambda scene: [*scene.views([{"from_": 0}], width=32)]),
        ("/views", lambda scene: scene.view(["color", "depth"], width=32)),
        ("/events", lambda scene: [*scene.events()]),
        ("/events", lambda scene: scene.wait()),
        ("/export", lambda scene: scene.export()),
    ],
)
@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (refusal(429, "overloaded", 1), segsplat.Overloaded),
        (httpx.Response(502, text="<html>bad"), segsplat.ConnectionLost),
    ],
)
def test_a_stream_is_not_asked_for_more_often_than_that(
    scene: Scene,
    url: str,
    slept: list[float],
    path: str,
    ask: Callable[[Scene], Any],
    answer: httpx.Response,
    error: type[SegSplatError],
) -> None:
    faulty = Faulty(path, *[answer] * 99)
    again = Client(url, transport=faulty, retries=2).get(scene.id)
    with pytest.raises(error) as told:
        ask(again)
    assert len(faulty.seen) == 3 and told.value.call


class Broken(httpx.SyncByteStream):
    """The first bytes of a body, and then nothing more."""

    def __init__(self, answer: httpx.Response, length: int) -> None:
        self.answer, self.length = answer, length

    def __iter__(self) -> Iterator[bytes]:
        body = b"".join(self.answer.iter_raw())
        yield body[: self.length]
        self.answer.close()
        raise httpx.RemoteProtocolError("peer closed connection")


def cut(length: int) -> Answering:
    """Lets so many bytes of an answer through."""

    def broken(_: httpx.Request, answer: httpx.Response) -> httpx.Response:
        stream = Broken(answer, length)
        return httpx.Response(answer.status_code, headers=answer.headers, stream=stream)

    return broken


def test_views_go_on_where_a_stream_broke(scene: Scene, url: str, slept: list[float]) -> None:
    spots: list[Any] = [{"from_": 0, "to": 1, "t": i / 9} for i in range(10)]
    whole = [view.image for view in scene.views(spots, width=32)]
    line = {"content-type": "multipart/mixed; boundary=x"}
    ended = httpx.Response(200, headers=line, content=b"--x--\r\n")
    faulty = Faulty("/views", cut(0), cut(9_000), cut(9_000), ended)
    again = Client(url, transport=faulty).get(scene.id)
    views = [view.image for view in again.views(spots, width=32)]
    assert np.array_equal(views, whole)
    assert len(faulty.seen) == 5 and len(slept) == 4


def test_views_go_on_after_a_fault_in_the_stream(
    scene: Scene, url: str, slept: list[float]
) -> None:
    def overload(_: httpx.Request, answer: httpx.Response) -> httpx.Response:
        body = answer.read()
        line = b"--" + answer.headers["content-type"].split("=")[1].encode()
        first = body.split(line)[1]
        told = refusal(429, "overloaded", 2).content
        fault = b"\r\ncontent-type: application/json\r\n\r\n" + told
        del answer.headers["transfer-encoding"]
        content = line + first + line + fault + b"\r\n" + line + b"--\r\n"
        return httpx.Response(200, headers=answer.headers, content=content)

    spots: list[Any] = [{"from_": 0}, {"from_": 1}, {"from_": 0, "to": 1, "t": 0.5}]
    faulty = Faulty("/views", overload)
    again = Client(url, transport=faulty).get(scene.id)
    views = [view.image for view in again.views(spots, width=32)]
    assert np.array_equal(views, [view.image for view in scene.views(spots, width=32)])
    assert slept == [2] and len(faulty.seen) == 2


def test_events_and_exports_begin_again(
    scene: Scene, url: str, slept: list[float], tmp_path: Path
) -> None:
    faulty = Faulty("/events", cut(0), cut(11), httpx.Response(200, content=b""))
    again = Client(url, transport=faulty).get(scene.id)
    assert [event.event for event in again.events()] == ["done"] and len(slept) == 3
    faulty = Faulty("/export", cut(100_000))
    again = Client(url, transport=faulty).get(scene.id)
    whole = scene.export(path=tmp_path / "whole.ply").read_bytes()
    assert again.export(path=tmp_path / "again.ply").read_bytes() == whole
    faulty.faults = [cut(100_000) for _ in range(9)]
    with pytest.raises(segsplat.ConnectionLost):
        again.export(path=tmp_path / "never.ply")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["again.ply", "whole.ply"]


def test_a_scene_that_failed_raises_its_code(scene: Scene, url: str) -> None:
    told = b'data: {"event":"failed","code":"deadline_exceeded","message":"over 600 s"}\n\n'
    faulty = Faulty("/events", httpx.Response(200, content=b"event: failed\n" + told))
    with pytest.raises(segsplat.DeadlineExceeded, match="over 600 s") as failed:
        Client(url, transport=faulty).get(scene.id).wait()
    assert failed.value.scene == scene.id


def test_a_server_that_is_not_there(slept: list[float]) -> None:
    with pytest.raises(segsplat.ConnectionLost, match="ConnectError"):
        Client("http://127.0.0.1:9", retries=2).get("0" * 32)
    assert len(slept) == 2
    for url in ["http://127.0.0.1:9", "grpc://127.0.0.1:9"]:
        told = f"{url} cannot be reached.*segsplat serve"
        with pytest.raises(segsplat.ConnectionLost, match=told):
            Client(url, retries=0).get("0" * 32)


@pytest.mark.parametrize("version", ["0.2.0", "1.1.0"])
def test_a_server_of_another_version_is_warned_of_once(
    scene: Scene, url: str, version: str
) -> None:
    faulty = Faulty("/v1/models", httpx.Response(200, json={"server_version": version}))
    client = Client(url, transport=faulty)
    with pytest.warns(segsplat.VersionWarning, match=version):
        client.get(scene.id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        client.get(scene.id)
    assert len(faulty.seen) == 1


@pytest.mark.parametrize(
    "fault", [refusal(429, "overloaded", 1), httpx.Response(502, text="<html>bad"), lose]
)
def test_limits_are_asked_for_again(
    scene: Scene, url: str, slept: list[float], fault: httpx.Response | Answering
) -> None:
    faulty = Faulty("/v1/models", fault)
    client = Client(url, transport=faulty)
    client.get(scene.id)
    assert client.policy.limits and len(faulty.seen) == 2
    # Where no try succeeds the call does not, and the next asks again.
    faulty = Faulty("/v1/models", *[fault] * 3)
    client = Client(url, transport=faulty, retries=2)
    with pytest.raises(SegSplatError, match="GET .*/v1/models"):
        client.get(scene.id)
    client.get(scene.id)
    assert client.policy.limits and len(faulty.seen) == 4


@pytest.mark.parametrize(
    "answer",
    [
        httpx.Response(404, text="<html>nothing here"),
        httpx.Response(200, json={"server_version": segsplat.__version__}),
    ],
)
def test_a_server_that_says_no_limits_is_left_alone(
    scene: Scene, url: str, answer: httpx.Response
) -> None:
    faulty = Faulty("/v1/models", answer)
    client = Client(url, transport=faulty)
    client.get(scene.id)
    assert client.policy.limits is None and len(faulty.seen) == 1


def test_the_version_is_that_of_the_server(client: Client) -> None:
    assert client.models().server_version == segsplat.__version__


def test_the_server_says_which_words_it_knows(client: Client) -> None:
    words = {known.word: known for known in client.models().words}
    chair = words["chair"]
    assert isinstance(chair, segsplat.KnownWord) and chair.things > 0
    assert chair.things_found is not None and 0 < chair.things_found <= 1
    assert {known.trust for known in words.values()} == {"good", "fair", "poor", "unmeasured"}
