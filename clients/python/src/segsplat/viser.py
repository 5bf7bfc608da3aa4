"""A scene in viser (`pip install segsplat[viser]`): Gaussians, photos and boxes to fly around."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import viser
from viser.transforms import SE3

from .client import Scene
from .types import Box, Floats


def show(
    scene: Scene, boxes: Iterable[Box] = (), server: viser.ViserServer | None = None
) -> viser.ViserServer:
    """Puts a scene into viser and gives its server; `scene.query("chair").boxes` are drawn too.

    server: by default one of its own on http://127.0.0.1:8081, for this machine alone.
    """
    server = server or viser.ViserServer(host="127.0.0.1", port=8081)
    if not scene.photos:
        scene.refresh()
    server.scene.set_up_direction(up_of([photo.camera.camera_to_world for photo in scene.photos]))
    gaussians = scene.gaussians()
    server.scene.add_gaussian_splats(
        "/scene",
        centers=gaussians.means,
        covariances=gaussians.covariances.astype(np.float32),
        rgbs=gaussians.colors,
        opacities=gaussians.opacities[:, None],
    )
    for i, photo in enumerate(scene.photos):
        camera = photo.camera
        pose = SE3.from_matrix(camera.camera_to_world)
        server.scene.add_camera_frustum(
            f"/photos/{i}",
            fov=float(2 * np.arctan2(camera.height / 2, camera.K[1, 1])),
            aspect=camera.width / camera.height,
            scale=0.05 * (scene.report.median_depth if scene.report else 1.0),
            wxyz=pose.rotation().wxyz,
            position=pose.translation(),
        )
    for i, box in enumerate(boxes):
        server.scene.add_line_segments(
            f"/boxes/{i}", points=edges_of(box).astype(np.float32), colors=(255, 200, 0)
        )
    return server


def up_of(poses: Iterable[Floats]) -> Floats:
    """[3] mean of what is up in the pictures, world frame."""
    return np.asarray(-np.mean([pose[:3, 1] for pose in poses], axis=0))


def edges_of(box: Box) -> Floats:
    """[12, 2, 3] ends of the edges of a box, world units."""
    ends = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]
    return np.asarray(box.corners[np.array(ends)])
