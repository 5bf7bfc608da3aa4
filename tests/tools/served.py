"""The program and a server of it, for the tests of the client and of the page. `SEGSPLAT_BIN` names
the program. It is run in the root of the repository, where it finds its networks.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
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
    """The address of a server of its own, which refines where a test asks for it. Its log is
    beside its data."""
    command = [program, "serve", "--listen", "127.0.0.1:0", "--data-dir", data, *flags]
    env = {"SEGSPLAT_REFINE": "off", **(os.environ if env is None else env)}
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
