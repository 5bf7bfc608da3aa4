"""A scene in viser (`pip install segsplat[viser]`): Gaussians, photos and boxes to fly around."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import viser
from viser.transforms import SE3

from .gaussians import Gaussians
from .types import Box, Floats, Photo


def draw(
    server: viser.ViserServer | None,
    gaussians: Gaussians,
    photos: Sequence[Photo],
    boxes: Iterable[Box],
    depth: float,
) -> viser.ViserServer:
    """Puts a scene into viser and gives its server.

    server: by default one of its own on http://127.0.0.1:8081 (or the next free port), for this
        machine alone.
    depth: how far things are from the photos, world units.
    """
    server = server or viser.ViserServer(host="127.0.0.1", port=8081, verbose=False)
    if photos:
        server.scene.set_up_direction(up_of([photo.camera.camera_to_world for photo in photos]))
    server.scene.add_gaussian_splats(
        "/scene",
        centers=gaussians.means,
        covariances=gaussians.covariances.astype(np.float32),
        rgbs=gaussians.colors,
        opacities=gaussians.opacities[:, None],
    )
    for i, photo in enumerate(photos):
        camera = photo.camera
        pose = SE3.from_matrix(camera.camera_to_world)
        server.scene.add_camera_frustum(
            f"/photos/{i}",
            fov=float(2 * np.arctan2(camera.height / 2, camera.K[1, 1])),
            aspect=camera.width / camera.height,
            scale=0.05 * depth,
            wxyz=pose.rotation().wxyz,
            position=pose.translation(),
        )
    for i, box in enumerate(boxes):
        server.scene.add_line_segments(
            f"/boxes/{i}", points=edges_of(box).astype(np.float32), colors=(255, 200, 0)
        )
    if photos:
        start = photos[0].camera
        server.initial_camera.position = start.camera_to_world[:3, 3]
        server.initial_camera.look_at = start.camera_to_world[:3] @ [0, 0, depth, 1]
    return server


def up_of(poses: Iterable[Floats]) -> Floats:
    """[3] mean of what is up in the pictures, world frame."""
    return np.asarray(-np.mean([pose[:3, 1] for pose in poses], axis=0))


def edges_of(box: Box) -> Floats:
    """[12, 2, 3] ends of the edges of a box, world units."""
    ends = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return np.asarray(box.corners[np.array(ends)])
