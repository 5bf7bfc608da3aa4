"""A scene in viser (`pip install segsplat[viser]`): Gaussians, photos and boxes to fly around."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import viser
from viser.transforms import SE3

from .gaussians import Gaussians
from .types import Box, Floats, Photo, Report


def draw(
    server: viser.ViserServer | None,
    gaussians: Gaussians,
    photos: Sequence[Photo],
    boxes: Iterable[Box],
    report: Report | None,
) -> viser.ViserServer:
    """Puts a scene into viser and gives its server.

    server: by default one of its own on http://127.0.0.1:8081 (or the next free port), for this
        machine alone.
    """
    depth = report.median_depth if report else 1.0
    server = server or viser.ViserServer(host="127.0.0.1", port=8081, verbose=False)
    if photos:
        server.scene.set_up_direction(up_of([photo.camera.camera_to_world for photo in photos]))
    # viser keeps covariances in 16 bits: they are sent in units in which they are near 1.
    size = float(np.median(gaussians.scales)) or 1.0
    server.scene.add_gaussian_splats(
        "/scene",
        centers=gaussians.means / size,
        covariances=(blurred(gaussians, photos, report) / size**2).astype(np.float32),
        rgbs=gaussians.colors,
        opacities=gaussians.opacities[:, None],
        scale=size,
    )
    for i, photo in enumerate(photos):
        camera = photo.camera
        placed = SE3.from_matrix(camera.camera_to_world)
        server.scene.add_camera_frustum(
            f"/photos/{i}",
            fov=float(2 * np.arctan2(camera.height / 2, camera.K[1, 1])),
            aspect=camera.width / camera.height,
            scale=0.05 * depth,
            thickness=0.001 * depth,
            wxyz=placed.rotation().wxyz,
            position=placed.translation(),
        )
    for i, box in enumerate(boxes):
        server.scene.add_line_segments(
            f"/boxes/{i}",
            points=edges_of(box).astype(np.float32),
            colors=(255, 200, 0),
            thickness=0.003 * depth,
        )
    if photos:
        pose = photos[0].camera.camera_to_world[:3]
        server.initial_camera.position = pose @ [0, 0, -0.3 * depth, 1]
        server.initial_camera.look_at = pose @ [0, 0, depth, 1]
    return server


def blurred(gaussians: Gaussians, photos: Sequence[Photo], report: Report | None) -> Floats:
    """[N, 3, 3] covariances with the blur that the network learnt with: 0.3 squared pixels of the
    photo that it saw nearest (docs/adr/0010). Without it a view that magnifies has holes.
    """
    width = np.full(len(gaussians.means), np.inf)
    for photo, focal in zip(photos, report.network_focal_px if report else (), strict=False):
        pose = photo.camera.camera_to_world
        away = (gaussians.means - pose[:3, 3]) @ pose[:3, 2]
        if focal > 0:
            width = np.where(away > 0, np.minimum(width, away / focal), width)
    added = 0.3 * np.where(np.isfinite(width), width, 0) ** 2
    return np.asarray(gaussians.covariances + added[:, None, None] * np.eye(3))


def up_of(poses: Iterable[Floats]) -> Floats:
    """[3] mean of what is up in the pictures, world frame."""
    return np.asarray(-np.mean([pose[:3, 1] for pose in poses], axis=0))


def edges_of(box: Box) -> Floats:
    """[12, 2, 3] ends of the edges of a box, world units."""
    ends = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return np.asarray(box.corners[np.array(ends)])
