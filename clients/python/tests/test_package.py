"""The package as others meet it: README, notebook, installation, types, and the server's schema."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import httpx
import nbformat
import openapi_spec_validator
import pytest
from nbclient import NotebookClient

from segsplat import Scene

PACKAGE = Path(__file__).parents[1]


def checked(*command: str | Path, cwd: Path, **variables: str) -> str:
    """What a command writes; its errors are those of the test."""
    done = subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def readme() -> str:
    (code,) = re.findall(r"```python\n(.*?)```", (PACKAGE / "README.md").read_text(), re.DOTALL)
    return str(code)


@pytest.fixture(scope="session")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a new environment with this package alone."""
    folder = tmp_path_factory.mktemp("fresh")
    checked(sys.executable, "-m", "virtualenv", "--quiet", "venv", cwd=folder)
    python = folder / "venv/bin/python"
    checked(python, "-m", "pip", "install", "--quiet", str(PACKAGE), cwd=folder)
    return python


def test_the_readme_runs_as_written_in_a_fresh_environment(
    fresh: Path, url: str, photos: Path
) -> None:
    assert len([line for line in readme().splitlines() if line]) == 4, "an import and three lines"
    told = checked(fresh, "-c", readme(), cwd=photos.parent, SEGSPLAT_URL=url)
    assert told == "(1, 240, 320)\n", "no bar, no warning: this is no terminal"
    assert (photos.parent / "view.png").read_bytes().startswith(b"\x89PNG")
    told = checked(fresh, "-c", "import segsplat; print(segsplat.__file__)", cwd=photos.parent)
    assert (Path(told.strip()).parent / "py.typed").is_file()


def test_the_notebook_runs(url: str, photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEGSPLAT_URL", url)
    notebook = nbformat.read(PACKAGE / "examples/quickstart.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "it is kept without outputs"
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": photos.parent}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    assert len(pictures) == 3, "scene, view and masks show themselves"


def test_types_are_strict(tmp_path: Path) -> None:
    checked(sys.executable, "-m", "mypy", cwd=PACKAGE)
    wrong = tmp_path / "wrong.py"
    uses = readme() + 'scene.view(fron=0)\nscene.view("colour")\nscene.query("x").boxes[0].centre\n'
    wrong.write_text(uses + "depth: int = scene.view().depth\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", wrong], stdout=subprocess.PIPE, text=True
    )
    lines = readme().count("\n")
    found = {int(line.split(":")[1]) for line in done.stdout.splitlines() if " error: " in line}
    assert found == {lines + 1, lines + 2, lines + 3, lines + 4}, done.stdout


def test_the_server_keeps_to_its_schema(scene: Scene, url: str, tmp_path: Path) -> None:
    """The document is valid. Every call but `delete`, with many inputs: no fault of the server, no
    answer that is not in `/openapi.json`, and what the document does not allow is refused.
    """
    document = httpx.get(f"{url}/openapi.json").json()
    openapi_spec_validator.validate(document)
    # A deadline of a millisecond has 504 as its answer, and events of edits go on without an end.
    fixed = {"path.id": f'"{scene.id}"', "query.deadline_ms": "60000", "query.edits": "false"}
    lines = ["[parameters]", *(f'"{name}" = {value}' for name, value in fixed.items())]
    # 413 is the refusal of what is over a limit, which schemathesis does not know as one.
    refusals = [400, 401, 403, 404, 405, 406, 409, 413, 415, 422, 428, 429]
    lines += ["[checks.negative_data_rejection]", f"expected-statuses = {refusals}"]
    (tmp_path / "schemathesis.toml").write_text("\n".join(lines))
    checks = "not_a_server_error,status_code_conformance,content_type_conformance"
    checks += ",negative_data_rejection"
    checked(
        Path(sys.executable).with_name("schemathesis"),
        *("run", f"{url}/openapi.json", "--exclude-method", "DELETE", "--seed", "1"),
        *("--phases", "coverage,fuzzing", "--max-examples", "10", "--checks", checks),
        # As long as the deadline: the sample is made when it is first asked for.
        *("--request-timeout", "60"),
        # Its own generator: forms with photos and two headers are hard to make up.
        "--suppress-health-check=filter_too_much",
        cwd=tmp_path,
    )
