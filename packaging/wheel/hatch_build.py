"""Puts the program, its networks and its licences into the wheel. `SEGSPLAT_BIN` names a program
that is not `target/release/segsplat`. The page is in the program.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parents[2]
RELEASE = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/segsplat"


class CustomBuildHook(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        self.folder = tempfile.mkdtemp()
        program = Path(self.folder) / "segsplat"
        built = Path(os.environ.get("SEGSPLAT_BIN", RELEASE)).absolute()
        subprocess.run(["strip", "-o", program, built], check=True)
        program.chmod(0o755)
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{system(program)}"
        build_data["force_include"] |= {
            str(program): "segsplat_server/segsplat",
            str(ROOT / "models/embedded"): "segsplat_server/models/embedded",
            str(ROOT / "LICENSE-MIT"): "segsplat_server/LICENSE-MIT",
            str(ROOT / "LICENSE-APACHE"): "segsplat_server/LICENSE-APACHE",
        }

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        shutil.rmtree(self.folder)


def system(program: Path) -> str:
    """The platform tag: the newest glibc whose symbols the program asks for (PEP 600)."""
    minors = re.findall(rb"\0GLIBC_2\.(\d+)(?=[.\0])", program.read_bytes())
    assert minors, f"{program} asks for no glibc"
    return f"manylinux_2_{max(map(int, minors))}_{platform.machine()}"
