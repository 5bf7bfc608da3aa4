"""Writes a scene for Rerun (`pip install rerun-sdk`): its Gaussians, the cameras of its photos with
their views, and a box for each part that texts find.

python rerun_log.py PHOTOS OUT.rrd [TEXT ...]      then: rerun OUT.rrd
"""

from __future__ import annotations

import sys

import rerun as rr

from segsplat import Client, Scene


def log(scene: Scene, out: str, texts: list[str]) -> None:
    """Asks the texts and writes the file `out`."""
    with rr.RecordingStream("segsplat") as to:
        to.save(out)
        # The world of a capture in OpenCV axes: +x right, +y down, +z forward.
        to.log("scene", rr.ViewCoordinates.RDF, static=True)
        gaussians = scene.gaussians()
        radii = gaussians.scales.max(axis=1)
        points = rr.Points3D(gaussians.means, colors=gaussians.colors, radii=radii)
        to.log("scene/gaussians", points, static=True)
        for i, photo in enumerate(scene.photos):
            camera, place = photo.camera, f"scene/photos/{i}"
            pose, size = camera.camera_to_world, [camera.width, camera.height]
            turn = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
            lens = rr.Pinhole(image_from_camera=camera.K, resolution=size)
            to.log(place, turn, lens, rr.Image(scene.view(from_=i).image), static=True)
        for match in scene.query(*texts, boxes="upright", masks=False) if texts else ():
            for i, part in enumerate(match.boxes):
                turn = rr.Transform3D(translation=part.center, mat3x3=part.axes.T)
                label = f"{match.text}: best seen in photo {part.visibility.argmax()}"
                box = rr.Boxes3D(half_sizes=[part.size / 2], labels=[label])
                to.log(f"scene/parts/{match.text}/{i}", turn, box, static=True)


if __name__ == "__main__":
    with Client() as client:
        log(client.scene(sys.argv[1]), sys.argv[2], sys.argv[3:])
