"""A ROS 2 node: it takes photos with poses from a robot, has a scene made of them, and publishes
the boxes of what texts find. It needs ROS 2 with rclpy, tf2_ros, message_filters and vision_msgs,
and `pip install segsplat`.

python ros2_node.py --ros-args -p url:=http://127.0.0.1:8080 -p texts:='[chair, table]' \
    -r image:=/camera/image_rect -r camera_info:=/camera/camera_info

| topic | type | |
|---|---|---|
| `image` | `sensor_msgs/Image` | rectified; `rgb8`, `bgr8`, `rgba8`, `bgra8`, `mono8` |
| `camera_info` | `sensor_msgs/CameraInfo` | of the same stamp; `p` is the lens |
| `detections` | `vision_msgs/Detection3DArray` | published, in the frame `world` |

`tf` gives the pose: from the image's frame (optical: x right, y down, z forward) to `world`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from segsplat import Camera, Client, Match, Scene

#: Channels of an encoding, and their order as red, green, blue.
ENCODINGS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0],
             "mono8": [0, 0, 0]}


def pixels_of(image: Any) -> np.ndarray:
    """The pixels of a `sensor_msgs/Image`, `[H, W, 3]` uint8. Rows may be padded."""
    if image.encoding not in ENCODINGS:
        raise ValueError(f"image: encoding {image.encoding!r}; these are read: {[*ENCODINGS]}")
    channels = {"mono8": 1, "rgba8": 4, "bgra8": 4}.get(image.encoding, 3)
    rows = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.step)
    rows = rows[:, :image.width * channels].reshape(image.height, image.width, channels)
    return np.ascontiguousarray(rows[..., ENCODINGS[image.encoding]])


def rotation_of(q: Any) -> np.ndarray:
    """The matrix of a `geometry_msgs/Quaternion`."""
    w, v = q.w, np.array([q.x, q.y, q.z])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross


def camera_of(info: Any, transform: Any) -> Camera:
    """The camera of a `sensor_msgs/CameraInfo` and the `geometry_msgs/Transform` of its optical
    frame to the world. ROS has the centre of the first pixel at 0, the server at 0.5."""
    fx, cx, fy, cy = (float(info.p[i]) for i in (0, 2, 5, 6))
    pose, at = np.eye(4), transform.translation
    pose[:3, :3], pose[:3, 3] = rotation_of(transform.rotation), [at.x, at.y, at.z]
    k = np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]])
    return Camera(k, pose, int(info.width), int(info.height))


def quaternion_of(axes: np.ndarray) -> np.ndarray:
    """x, y, z, w of a matrix whose columns are orthonormal; a reflection is taken out of it."""
    m = axes * [1, 1, np.sign(np.linalg.det(axes))]
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000) is exact for every turn.
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
        [0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
        [0, 0, m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
        [0, 0, 0, m[0, 0] + m[1, 1] + m[2, 2]],
    ])
    return np.asarray(np.linalg.eigh(k, UPLO="U")[1][:, -1])


def detections(types: Any, header: Any, matches: list[Match]) -> Any:
    """A `vision_msgs/Detection3DArray` with a box for each part of each text. `types` gives the
    class of a message by its name."""
    found = []
    for match in matches:
        for i, part in enumerate(match.boxes):
            x, y, z = (float(v) for v in part.center)
            qx, qy, qz, qw = (float(v) for v in quaternion_of(part.axes.T))
            sx, sy, sz = (float(v) for v in part.size)
            pose = types("geometry_msgs/Pose")(
                position=types("geometry_msgs/Point")(x=x, y=y, z=z),
                orientation=types("geometry_msgs/Quaternion")(x=qx, y=qy, z=qz, w=qw))
            # Where its Gaussians lie, not how sure its pose is: the message has no other place.
            covariance = np.zeros((6, 6))
            covariance[:3, :3] = part.covariance
            guess = types("vision_msgs/ObjectHypothesisWithPose")(
                hypothesis=types("vision_msgs/ObjectHypothesis")(
                    class_id=match.text, score=match.score),
                pose=types("geometry_msgs/PoseWithCovariance")(
                    pose=pose, covariance=covariance.ravel()))
            box = types("vision_msgs/BoundingBox3D")(
                center=pose, size=types("geometry_msgs/Vector3")(x=sx, y=sy, z=sz))
            found.append(types("vision_msgs/Detection3D")(
                header=header, results=[guess], bbox=box, id=f"{match.text}/{i}"))
    return types("vision_msgs/Detection3DArray")(header=header, detections=found)


class Collector:
    """Photos of a robot that moves: one each time the camera is far enough from the last."""

    def __init__(self, photos: int = 8, distance: float = 0.15) -> None:
        self.photos, self.distance = photos, distance
        self.taken: list[tuple[np.ndarray, Camera]] = []

    def take(self, image: Any, info: Any, transform: Any) -> bool:
        """Takes a photo where it is new; whether there are enough."""
        camera = camera_of(info, transform)
        if self.taken:
            last = self.taken[-1][1].camera_to_world[:3, 3]
            if np.linalg.norm(camera.camera_to_world[:3, 3] - last) < self.distance:
                return False
        self.taken.append((pixels_of(image), camera))
        return len(self.taken) >= self.photos

    def scene(self, client: Client) -> Scene:
        """Has a scene made of what was taken, and begins anew."""
        taken, self.taken = self.taken, []
        with tempfile.TemporaryDirectory() as folder:
            source = {}
            for i, (pixels, camera) in enumerate(taken):
                path = Path(folder) / f"{i:04}.png"
                Image.fromarray(pixels).save(path)
                source[str(path)] = camera
            return client.scene(source)


def main() -> None:
    """Runs the node until it is stopped."""
    from concurrent.futures import ThreadPoolExecutor
    from importlib import import_module

    import message_filters  # type: ignore[import-not-found]
    import rclpy  # type: ignore[import-not-found]
    import tf2_ros  # type: ignore[import-not-found]

    def types(name: str) -> Any:
        package, message = name.split("/")
        return getattr(import_module(f"{package}.msg"), message)

    rclpy.init()
    node = rclpy.create_node("segsplat")
    defaults = {"url": "http://127.0.0.1:8080", "texts": ["object"], "world": "map", "photos": 8,
                "distance": 0.15}
    url, texts, world, photos, distance = (
        node.declare_parameter(name, value).value for name, value in defaults.items())
    collector, client = Collector(photos, distance), Client(url)
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer, node)
    to = node.create_publisher(types("vision_msgs/Detection3DArray"), "detections", 1)
    # One thread talks to the server; the node goes on taking photos.
    worker = ThreadPoolExecutor(1)

    def ask(taken: Collector, header: Any) -> None:
        try:
            matches = taken.scene(client).query(*texts, boxes="upright", masks=False)
            to.publish(detections(types, header, matches))
        except Exception as error:  # The node outlives a refused scene.
            node.get_logger().error(str(error))

    def arrived(image: Any, info: Any) -> None:
        nonlocal collector
        try:
            found = buffer.lookup_transform(world, image.header.frame_id, image.header.stamp)
            enough = collector.take(image, info, found.transform)
        except (tf2_ros.TransformException, ValueError) as error:
            node.get_logger().warning(str(error))
            return
        if enough:
            header = types("std_msgs/Header")(stamp=image.header.stamp, frame_id=world)
            worker.submit(ask, collector, header)
            collector = Collector(photos, distance)

    image = message_filters.Subscriber(node, types("sensor_msgs/Image"), "image")
    info = message_filters.Subscriber(node, types("sensor_msgs/CameraInfo"), "camera_info")
    message_filters.TimeSynchronizer([image, info], 10).registerCallback(arrived)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
