"""Runs the commands of docs/reference-bundle.md as they are written, with random weights.

    reference_bundle.py SOURCES [--program FILE] [--python FILE] [--model vit_b]

SOURCES   a folder with the checkouts `depthsplat` and `dinov2`, in place of those that are cloned
--program a program that is built already, in place of `make build`
--python  the interpreter of an environment that has `models/export/requirements.txt`; without it
          the environment of the page is made
--model   another SAM than the page's

It takes some 20 GB of memory with the page's SAM, half an hour on two cores, and 3 GB on the disk,
in a copy of the repository's files that is removed again. The last command, `segsplat serve`, must
become ready and make a scene of the sample with these networks.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SERVE = "segsplat serve"


def commands() -> list[str]:
    """The lines of the page's block."""
    page = (ROOT / "docs/reference-bundle.md").read_text()
    block = re.search(r"^```sh\n(.*?)^```$", page, re.M | re.S)
    assert block, "the page has no block of commands"
    lines = [line for line in block[1].splitlines() if not line.startswith("#")]
    assert lines[-1].startswith(SERVE) and any("models check" in line for line in lines), lines
    return lines


def prepared(line: str, given: argparse.Namespace) -> str | None:
    """A line as it runs here; `None` where what it makes is given."""
    if line.startswith("git clone"):
        repository, folder = line.split()[2:]
        source = given.sources.absolute() / Path(repository).name
        return f"ln -s {source} {folder}"
    if given.python and line.startswith(("python3 -m venv", "pip install")):
        return None
    if line.startswith("make build") and given.program:
        line = line.replace("make build", f"install -D {given.program.absolute()} "
                                          "target/release/segsplat")
    if given.model:
        line = re.sub(r"--model vit_\w+", f"--model {given.model}", line)
    return re.sub(r"--checkpoint \S+", "--random 0", line)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("sources", type=Path)
    parser.add_argument("--program", type=Path)
    parser.add_argument("--python", type=Path)
    parser.add_argument("--model")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=ROOT / "target") as place:
        copy, bin = Path(place) / "segsplat-server", Path(place) / "bin"
        copy.mkdir()
        bin.mkdir()
        (Path(place) / "weights").mkdir()
        files = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, stdout=subprocess.PIPE,
                               check=True).stdout
        subprocess.run(["tar", "x"], cwd=copy, input=files, check=True)
        if given.program:
            (copy / "target").mkdir()
            shutil.copytree(ROOT / "target/ort", copy / "target/ort")
        if given.python:
            (bin / "python").write_text(f'#!/bin/sh\nexec {given.python.absolute()} "$@"\n')
            (bin / "python").chmod(0o755)
        # One shell for all, as on the page; each line is printed with its seconds.
        script = [f"cd {copy}", f"export PATH={bin}:$PATH", "set -e"]
        for line in commands()[:-1]:
            if run := prepared(line, given):
                script += [f"echo '$ {run}'", "begun=$SECONDS", run,
                           'echo "  $((SECONDS - begun)) s"']
        serve = commands()[-1] + " --listen 127.0.0.1:0 --data-dir ../data"
        script += ["segsplat sample --photos 2 --size 256x256 -o ../photos",
                   f"{serve} > ../listening & server=$!", "trap 'kill $server' EXIT",
                   "until [ -s ../listening ]; do sleep 1; kill -0 $server; done",
                   "curl -sf -F transforms=@../photos/transforms.json "
                   "$(for f in ../photos/images/*; do echo \"-F photo=@$f\"; done) "
                   "\"$(sed -n 's/^listening on //p' ../listening)/v1/scenes?wait_ms=600000\" "
                   "> ../scene.json",
                   "grep -q '\"state\":\"done\"' ../scene.json || { cat ../scene.json; exit 1; }"]
        begun = time.monotonic()
        done = subprocess.run(["bash", "-c", "\n".join(script)], env={**os.environ})
        print(f"reference bundle: rc {done.returncode} after {time.monotonic() - begun:.0f} s")
        sys.exit(done.returncode)


main()
