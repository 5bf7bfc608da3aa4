"""The files of a capture that are worth sending: the page and this package send the same."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

from segsplat import calls
from served import ROOT

FOLDERS = ["", "images/", "depth/", "a/lowres_depth/", "highres_depth/b/", "confidence/",
           "sparse/0/", ".git/", "a/.cache/"]
STEMS = ["0001", "cameras", "images", "points3D", "rigs", "frames", "project", "._0001",
         "metadata", "a.b"]
# Endings of the page and of the package, and some that neither sends.
OTHERS = ["", ".PNG", ".JPG", ".obj", ".usdz", ".mp4", ".md", ".db", ".zip", ".tar"]


def rule(name: str) -> re.Pattern[str]:
    """A regular expression of the page: Python reads it as JavaScript does."""
    found = re.search(rf"\b{name} = /(.*)/i?[,;]$", (ROOT / "web/capture.js").read_text(), re.M)
    assert found, f"web/capture.js has no {name}"
    return re.compile(found[1], re.IGNORECASE)


def test_the_page_and_the_package_send_the_same_files() -> None:
    photo, cameras = map(rule, ["PHOTO", "CAMERAS"])
    left_out = [*map(rule, ["HIDDEN", "UNREAD_FILE", "UNREAD_FOLDER"])]
    endings = [*sorted(calls.PHOTOS | calls.CAMERAS), *calls.SPLATS, *OTHERS]
    sent = 0
    for folder, stem, ending in itertools.product(FOLDERS, STEMS, endings):
        name = folder + stem + ending
        page = bool(photo.search(name) or cameras.search(name))
        page = page and not any(one.search(name) for one in left_out)
        assert calls._belongs(Path(name)) == page, name
        sent += page
    assert sent > 100, sent
