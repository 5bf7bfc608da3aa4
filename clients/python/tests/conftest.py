"""A real server, photos for it, and scenes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from served import run, served

from segsplat import Client, Scene

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


@pytest.fixture(scope="session", params=["http", "grpc"])
def client(url: str, request: pytest.FixtureRequest) -> Iterator[Client]:
    """What is asked of it holds over both doors."""
    with Client(url.replace("http", request.param)) as client:
        yield client


@pytest.fixture(scope="session")
def scene(client: Client, photos: Path) -> Scene:
    """The scene that most tests look at. Nobody changes it."""
    return client.scene(photos, semantics="eager")
