"""The wheel `segsplat-server` of the program under test, installed in a fresh environment."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import httpx
import pytest
from served import PROGRAM, ROOT, served
from test_package import checked

from segsplat import Client

# Nothing but the package may say where the library and the networks are.
CLEAN = {
    name: value
    for name, value in os.environ.items()
    if not name.startswith("SEGSPLAT_") and name != "ORT_DYLIB_PATH"
}


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command `segsplat` of the installed wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    build = (*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, ROOT / "packaging/wheel")
    checked(*build, cwd=folder, SEGSPLAT_BIN=str(PROGRAM))
    (wheel,) = folder.glob("segsplat_server-*-py3-none-manylinux_2_*.whl")
    checked(sys.executable, "-m", "virtualenv", "--quiet", "venv", cwd=folder)
    checked(folder / "venv/bin/python", *pip[1:], "install", "--quiet", wheel, cwd=folder)
    return folder / "venv/bin/segsplat"


def test_the_installed_command_serves_a_scene(command: Path, photos: Path, tmp_path: Path) -> None:
    """In an empty folder: networks, library and page come out of the environment alone."""
    with served(tmp_path / "data", program=command, cwd=tmp_path, env=CLEAN) as url:
        with Client(url) as client:
            view = client.scene(photos).view()
        assert view.image.shape == (240, 320, 3)
        assert view.image.std() > 10, "something is drawn"
        page = httpx.get(url)
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    log = (tmp_path / "data.log").read_text()
    assert str(command.parents[1]) in log, log


def test_the_installed_command_passes_errors_on(command: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [command, "inspect", tmp_path / "none"], cwd=tmp_path, env=CLEAN, capture_output=True
    )
    assert done.returncode == 2, done
    assert b"none" in done.stderr
