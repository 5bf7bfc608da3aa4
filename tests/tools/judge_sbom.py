"""The list of crates (SBOM) of a program: spdx-tools finds no fault in the SPDX file. It has every
crate, with its version, that cargo-auditable wrote into the program's section .dep-v0. Cargo.lock
has each of them, too.

python3 judge_sbom.py PROGRAM SPDX CARGO_LOCK
"""

import json
import subprocess
import sys
import tempfile
import tomllib
import zlib
from pathlib import Path

from spdx_tools.spdx.parser.parse_anything import parse_file
from spdx_tools.spdx.validation.document_validator import validate_full_spdx_document

program, spdx, lock = sys.argv[1:]
with tempfile.TemporaryDirectory() as folder:
    section = Path(folder) / "section"
    subprocess.run(["objcopy", "-O", "binary", "--only-section=.dep-v0",
                    "--set-section-flags=.dep-v0=alloc", program, section], check=True)
    inside = json.loads(zlib.decompress(section.read_bytes()))["packages"]

document = parse_file(spdx)
faults = [message.validation_message for message in validate_full_spdx_document(document)]
built = {(crate["name"], crate["version"]) for crate in inside if crate.get("kind") != "build"}
listed = {(package.name, package.version) for package in document.packages}
crates = tomllib.loads(Path(lock).read_text())["package"]
locked = {(crate["name"], crate["version"]) for crate in crates}
faults += [f"{crate} is in the program and not in {spdx}" for crate in sorted(built - listed)]
faults += [f"{crate} is in the program and not in Cargo.lock" for crate in sorted(built - locked)]
if len(built) < 100:
    faults.append(f"only {len(built)} crates in the program")
for fault in faults:
    print(f"FAILED {fault}")
print(f"crates: {len(built)} in the program, {len(listed)} in the SPDX file, {len(faults)} faults")
sys.exit(bool(faults))
