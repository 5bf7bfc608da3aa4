"""A server of one's own: started for a client, and stopped with it."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import weakref
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from .client import AsyncClient, Client
from .errors import ServerNotStarted

#: Seconds that a server has to stop by itself.
STOP_S = 10.0
#: Lines of the log that an error repeats.
LOG_LINES = 8


def command(program: str | Path | None = None) -> list[str]:
    """What starts the program: the one that is named, that of $SEGSPLAT_BIN, `segsplat` of $PATH,
    or that of the package `segsplat-server`.
    """
    if named := program or os.environ.get("SEGSPLAT_BIN"):
        found = shutil.which(named)
        if found is None:
            raise ServerNotStarted(f"{named} is not a program that can be run")
        return [str(Path(found).absolute())]
    if found := shutil.which("segsplat"):
        return [found]
    if find_spec("segsplat_server"):
        return [sys.executable, "-m", "segsplat_server"]
    raise ServerNotStarted(
        "no server is installed: pip install 'segsplat[server]', or name the program with "
        "local(program=...) or SEGSPLAT_BIN"
    )


class _Process:
    """A server on a free port of this machine."""

    def __init__(
        self,
        data: str | Path | None,
        program: str | Path | None,
        flags: Sequence[str],
        env: Mapping[str, str],
        start_s: float,
    ) -> None:
        start = command(program)
        self._program = " ".join(start)
        self._held = contextlib.ExitStack()
        scratch = self._held.enter_context(tempfile.TemporaryDirectory(prefix="segsplat-"))
        self.log = Path(scratch) / "server.log"
        self.data = Path(data or Path(scratch) / "data")
        args = ["serve", "--listen", "127.0.0.1:0", "--data-dir", str(self.data), *flags]
        with self.log.open("wb") as log:
            # A session of its own: an interrupt of a notebook is not for the server.
            self._child = subprocess.Popen(
                [*start, *args],
                stdout=subprocess.PIPE,
                stderr=log,
                env={**os.environ, **env},
                start_new_session=True,
            )
        self.stop = weakref.finalize(self, _stop, self._child, self._held)
        self.url = self._listening(start_s)

    def _listening(self, start_s: float) -> str:
        """Its address, once it says so."""
        late = threading.Timer(start_s, self._child.kill)
        late.start()
        try:
            assert self._child.stdout
            first = self._child.stdout.readline().decode()
        finally:
            late.cancel()
        if first.startswith("listening on "):
            return first.split()[2]
        # One that says something else may live on.
        self._child.kill()
        self._child.wait()
        told = self.log.read_text(errors="replace").splitlines()[-LOG_LINES:]
        self.stop()
        said = "\n".join([first.strip(), *told]).strip()
        why = f"it said:\n{said}" if said else f"it said nothing for {start_s:g} s"
        raise ServerNotStarted(f"{self._program} did not start; {why}")


def _stop(child: subprocess.Popen[bytes], held: contextlib.ExitStack) -> None:
    child.terminate()
    try:
        child.wait(STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
    if child.stdout:
        child.stdout.close()
    held.close()


class LocalClient(Client):
    """A `Client` with a server of its own, which stops with it."""

    def __init__(self, server: _Process, **settings: Any) -> None:
        super().__init__(server.url, **settings)
        self._server = server

    def close(self) -> None:
        """Closes the connections and stops the server."""
        super().close()
        self._server.stop()


class AsyncLocalClient(AsyncClient):
    """An `AsyncClient` with a server of its own, which stops with it."""

    def __init__(self, server: _Process, **settings: Any) -> None:
        super().__init__(server.url, **settings)
        self._server = server

    async def close(self) -> None:
        """Closes the connections and stops the server."""
        await super().close()
        self._server.stop()


def local(
    data: str | Path | None = None,
    *,
    program: str | Path | None = None,
    flags: Sequence[str] = (),
    env: Mapping[str, str] | None = None,
    start_s: float = 120.0,
    **settings: Any,
) -> LocalClient:
    """Starts a server on this machine and gives its client. It stops with the client: at the end of
    `with`, at `close()`, or with Python.

    >>> with segsplat.local() as client:
    ...     client.scene("photos/").view().save("view.png")

    data: folder in which scenes are kept; by default one that is removed at the end.
    program: the server's program; by default $SEGSPLAT_BIN, `segsplat` of $PATH, or that of
        `pip install segsplat[server]`.
    flags: more flags of `segsplat serve`.
    env: more variables of its environment.
    start_s: seconds until it must listen.
    settings: as `Client` takes them.
    """
    return LocalClient(_Process(data, program, flags, env or {}, start_s), **settings)


def local_async(
    data: str | Path | None = None,
    *,
    program: str | Path | None = None,
    flags: Sequence[str] = (),
    env: Mapping[str, str] | None = None,
    start_s: float = 120.0,
    **settings: Any,
) -> AsyncLocalClient:
    """As `local`, for `async with` and `await`."""
    return AsyncLocalClient(_Process(data, program, flags, env or {}, start_s), **settings)
