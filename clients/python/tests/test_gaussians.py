"""The Gaussians as arrays, and in a file for Rerun."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from served import ROOT

from segsplat import BadAnswer, Gaussians, Scene


def test_gaussians_are_those_of_the_scene(scene: Scene) -> None:
    gaussians = scene.gaussians()
    report, bank = scene.report, scene.status.semantics.bank_size
    assert report and len(gaussians.means) == report.gaussians
    assert np.allclose(np.linalg.norm(gaussians.quats, axis=1), 1)
    assert gaussians.scales.min() > 0 and gaussians.semantic_index.max() == bank
    assert gaussians.opacities.min() > 1 / 256 and gaussians.opacities.max() <= 1
    # In front of the first photo, at about the depth that the server reports.
    camera = scene.photos[0].camera
    depth = (gaussians.means - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, 2]
    assert np.median(depth) == pytest.approx(report.median_depth, rel=0.1)
    # Eigenvalues of the covariance are the squared scales.
    sides = np.linalg.eigvalsh(gaussians.covariances[:100])
    assert np.allclose(np.sqrt(sides), np.sort(gaussians.scales[:100], axis=1), rtol=1e-3)
    found = scene.query("box", masks=False)[0]
    assert len(scene.gaussians(text="box").means) == found.gaussians
    assert np.isin(gaussians.semantic_index, found.entries).sum() == found.gaussians


def test_another_file_is_refused() -> None:
    with pytest.raises(BadAnswer):
        Gaussians.of_ply(b"ply\nformat ascii 1.0\nend_header\n")


def test_rerun_reads_what_the_example_writes(scene: Scene, tmp_path: Path) -> None:
    name = "rerun_log"
    path = ROOT / f"clients/python/examples/{name}.py"
    example = importlib.util.spec_from_file_location(name, path)
    assert example and example.loader
    module = importlib.util.module_from_spec(example)
    example.loader.exec_module(module)
    out = tmp_path / "scene.rrd"
    module.log(scene, str(out), ["floor", "box"])
    reader = [sys.executable, "-m", "rerun", "rrd", "print", str(out)]
    told = subprocess.run(reader, stdout=subprocess.PIPE, check=True, text=True).stdout
    matches = scene.query("floor", "box", masks=False)
    parts = [f"/scene/parts/{match.text}/0" for match in matches if match.boxes]
    assert parts, "no text finds a part"
    for entity in ["/scene/gaussians", "/scene/photos/0", "/scene/photos/1", *parts]:
        assert entity in told, f"{entity} is not in the file"
