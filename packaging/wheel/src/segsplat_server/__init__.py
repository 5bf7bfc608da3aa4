"""The program `segsplat` with its networks. ONNX Runtime is that of the package `onnxruntime`."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path

PROGRAM = Path(__file__).with_name("segsplat")


def library() -> Path | None:
    """ONNX Runtime's library in its package, which is not imported."""
    package = find_spec("onnxruntime")
    if package is None or package.origin is None:
        return None
    folder = Path(package.origin).parent / "capi"
    return next(iter(sorted(folder.glob("libonnxruntime.so*"))), None)


def main() -> None:
    """Becomes the program. A library that the environment or a flag names is used instead."""
    found = library()
    if found is not None:
        os.environ.setdefault("ORT_DYLIB_PATH", str(found))
    os.execv(PROGRAM, [str(PROGRAM), *sys.argv[1:]])
