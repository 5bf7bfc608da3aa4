"""A server that a client starts for itself."""

from __future__ import annotations

import asyncio
import stat
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest
from served import PROGRAM, ROOT

import segsplat
from segsplat.server import command

QUIET = {"SEGSPLAT_REFINE": "off"}


@pytest.fixture(autouse=True)
def where_the_networks_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("SEGSPLAT_BIN", str(PROGRAM))


def gone(url: str) -> bool:
    try:
        httpx.get(url)
    except httpx.ConnectError:
        return True
    return False


def test_a_server_starts_and_stops_with_its_client() -> None:
    with segsplat.local(env=QUIET) as client:
        url = client.policy.server
        assert repr(client) == f"<LocalClient {url}>"
        assert list(client.scenes()) == [] and not gone(url)
        folder = client._server.data
        assert folder.is_dir()
    assert gone(url), "the server goes on"
    assert not folder.exists(), "its folder is still there"


def test_scenes_are_kept_in_a_folder_that_is_named(tmp_path: Path) -> None:
    source = ROOT / "tests/fixtures/splats/source.ply"
    for scenes in [1, 2]:
        with segsplat.local(tmp_path / "scenes", env=QUIET) as client:
            client.scene(source)
            assert len(list(client.scenes())) == scenes


def test_an_async_client_has_one_too() -> None:
    async def ask() -> str:
        async with segsplat.local_async(env=QUIET) as client:
            assert (await client.models()).server_version
            return client.policy.server

    assert gone(asyncio.run(ask()))


def test_a_server_stops_with_python_and_with_the_last_name_of_it() -> None:
    client = segsplat.local(env=QUIET)
    url = client.policy.server
    del client
    assert gone(url)
    told = subprocess.run(
        [sys.executable, "-c", "import segsplat; print(segsplat.local().policy.server)"],
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    assert gone(told.stdout.strip())


def test_the_program_is_the_named_one_that_of_the_path_or_that_of_the_wheel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ["named", "segsplat"]:
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert command(tmp_path / "named") == [str(tmp_path / "named")]
    assert command() == [str(PROGRAM)]
    monkeypatch.delenv("SEGSPLAT_BIN")
    assert command() == [str(tmp_path / "segsplat")]
    (tmp_path / "segsplat").unlink()
    with pytest.raises(segsplat.ServerNotStarted, match=r"pip install 'segsplat\[server\]'"):
        command()
    (tmp_path / "segsplat_server").mkdir()
    (tmp_path / "segsplat_server/__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    assert command() == [sys.executable, "-m", "segsplat_server"]
    with pytest.raises(segsplat.ServerNotStarted, match="nothing is not a program"):
        segsplat.local(program="nothing")


def test_a_server_that_does_not_start_says_why() -> None:
    with pytest.raises(segsplat.ServerNotStarted, match="--no-such-flag"):
        segsplat.local(flags=["--no-such-flag"])


@pytest.mark.parametrize(
    ("first", "start_s", "why"),
    [("", 0.5, "said nothing for 0.5 s"), ("echo hello; ", 120, "said:\nhello$")],
)
def test_a_server_that_never_listens_is_not_waited_for(
    tmp_path: Path, first: str, start_s: float, why: str
) -> None:
    slow = tmp_path / "slow"
    slow.write_text(f"#!/bin/sh\n{first}exec sleep 600\n")
    slow.chmod(stat.S_IRWXU)
    begun = time.monotonic()
    with pytest.raises(segsplat.ServerNotStarted, match=why):
        segsplat.local(program=slow, start_s=start_s)
    assert time.monotonic() - begun < 300, "it was waited for"


def test_errors_name_the_call_and_what_can_be_done() -> None:
    with segsplat.local(env=QUIET) as client, pytest.raises(segsplat.SceneNotFound) as missing:
        client.get("0" * 32)
    assert f"GET {client.policy.server}/v1/scenes/{'0' * 32}" in str(missing.value)
    assert str(missing.value).endswith("client.scenes() lists those that are there")
