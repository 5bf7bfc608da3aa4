"""Mends what cargo-sbom 0.10 writes: SPDX does not allow cargo's own name of a registry as the place
that a crate comes from, and no file may be listed twice.

cargo sbom … | python3 spdx.py
"""

import json
import sys

document = json.load(sys.stdin)
document["files"] = list({file["SPDXID"]: file for file in document["files"]}.values())
for crate in document["packages"]:
    if crate["downloadLocation"].startswith("registry+"):
        name, version = crate["name"], crate["versionInfo"]
        path = f"{name}/{name}-{version}.crate"
        crate["downloadLocation"] = f"https://static.crates.io/crates/{path}"
json.dump(document, sys.stdout, indent=1)
