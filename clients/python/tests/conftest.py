"""A real server, photos for it, and scenes. `SEGSPLAT_BIN` names the program. It is run in the
root of the repository, where it finds its networks.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from segsplat import Client, Scene

ROOT = Path(__file__).parents[3]
PROGRAM = Path(os.environ.get("SEGSPLAT_BIN", ROOT / "target/debug/segsplat")).absolute()


def run(*args: str | Path) -> str:
    """What the program writes."""
    done = subprocess.run([PROGRAM, *args], cwd=ROOT, stdout=subprocess.PIPE, check=True)
    return done.stdout.decode()


@contextmanager
def served(
    data: Path,
    *flags: str | Path,
    program: Path = PROGRAM,
    cwd: Path = ROOT,
    env: dict[str, str] | None = None,
) -> Iterator[str]:
    """The address of a server of its own."""
    command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", data, *flags]
    with (
        (data.parent / f"{data.name}.log").open("w") as log,
        subprocess.Popen(
            command, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=log
        ) as server,
    ):
        assert server.stdout
        try:
            first = server.stdout.readline().decode()
            assert first.startswith("listening on "), first
            yield first.split()[-1]
        finally:
            server.terminate()


@pytest.fixture(scope="session")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of the server that most tests share."""
    with served(tmp_path_factory.mktemp("server") / "data") as address:
        yield address


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two photos and a transforms.json."""
    folder = tmp_path_factory.mktemp("sample") / "photos"
    run("sample", "--photos", "2", "-o", folder)
    return folder


@pytest.fixture(scope="session")
def client(url: str) -> Iterator[Client]:
    with Client(url) as client:
        yield client


@pytest.fixture(scope="session")
def scene(client: Client, photos: Path) -> Scene:
    """The scene that most tests look at. Nobody changes it."""
    return client.scene(photos, semantics="eager")
