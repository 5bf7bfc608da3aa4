"""A ROS 2 node: it takes photos with poses from a robot, has a scene made of the first ones, lets
others join it where they show what it lacks, and publishes the boxes of what texts find. It needs
ROS 2 with rclpy, tf2_ros, message_filters and vision_msgs, and `pip install segsplat`.

python ros2_node.py --ros-args -p url:=http://127.0.0.1:8080 -p texts:='[chair, table]' \
    -r image:=/camera/image_rect -r camera_info:=/camera/camera_info

| parameter | | |
|---|---|---|
| `url` | `http://127.0.0.1:8080` | the server |
| `texts` | `[object]` | what is looked for |
| `world` | `map` | the frame of the scene |
| `photos` | 8 | of the first scene; after so many more, texts are asked again |
| `distance` | 0.15 | metres from all photos that were looked at, or |
| `degrees` | 15.0 | the turn from them, for a photo to be looked at |
| `new` | 0.1 | the share of it that the scene must lack for it to join |
| `most` | 48 | photos of the scene; then the one that others replace best leaves |

| topic | type | |
|---|---|---|
| `image` | `sensor_msgs/Image` | rectified; `rgb8`, `bgr8`, `rgba8`, `bgra8`, `mono8` |
| `camera_info` | `sensor_msgs/CameraInfo` | of the same stamp; `p` is the lens |
| `detections` | `vision_msgs/Detection3DArray` | published, in the frame `world` |

`tf` gives the pose: from the image's frame (optical: x right, y down, z forward) to `world`.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from segsplat import Camera, Client, Match, Scene

#: Channels of an encoding, and their order as red, green, blue.
ENCODINGS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0],
             "mono8": [0, 0, 0]}

#: Most that a photo may show of what its scene lacks, as a share of it: the networks see depth
#: where photos see the same.
LACKS_MAX = 0.8


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


def stands_apart(
    camera: Camera, others: Sequence[Camera], distance: float, degrees: float
) -> bool:
    """Whether a camera is so far from each of the others, or looks so much elsewhere."""
    pose = camera.camera_to_world
    for other in others:
        step = np.linalg.norm(pose[:3, 3] - other.camera_to_world[:3, 3])
        between = np.clip(pose[:3, 2] @ other.camera_to_world[:3, 2], -1, 1)
        if step < distance and np.degrees(np.arccos(between)) < degrees:
            return False
    return True


def lacking(alpha: np.ndarray) -> float:
    """The share of a picture of a scene, of which this is the opacity, where it shows nothing."""
    return float(np.mean(alpha < 0.5))


def replaceable(cameras: Sequence[Camera], distance: float, degrees: float) -> int:
    """The camera whose nearest neighbour is nearest; of two that are each other's, the one that has
    the nearer second one. Ways count by `distance`, turns by `degrees`."""
    poses = np.array([camera.camera_to_world for camera in cameras])
    ways = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    turns = np.degrees(np.arccos(np.clip(poses[:, :3, 2] @ poses[:, :3, 2].T, -1, 1)))
    apart = ways / distance + turns / degrees
    np.fill_diagonal(apart, np.inf)
    return min(range(len(cameras)), key=lambda i: np.sort(apart[i])[:2].tolist())


class Mapper:
    """Makes a scene of a robot's first photos, and lets others join it that show what it lacks.

    The scene never has more than `most` photos, so its memory and the time of a call are bounded,
    however long the robot drives."""

    def __init__(
        self, client: Client, photos: int = 8, distance: float = 0.15, degrees: float = 15.0,
        new: float = 0.1, most: int = 48,
    ) -> None:
        self.client, self.photos, self.new, self.most = client, photos, new, most
        self.apart = (distance, degrees)
        self.scene: Scene | None = None
        #: What the first scene is made of.
        self.first: list[tuple[np.ndarray, Camera]] = []
        #: Photos that joined.
        self.joined = 0
        #: Cameras that were looked at and show nothing new, the newest ones.
        self.known: deque[Camera] = deque(maxlen=most)

    def take(self, image: Any, info: Any, transform: Any) -> bool:
        """Looks at a photo; whether it is in the scene now, or waits for the first one."""
        camera = camera_of(info, transform)
        there = [photo.camera for photo in self.scene.photos] if self.scene else []
        known = [*there, *(camera for _, camera in self.first), *self.known]
        if not stands_apart(camera, known, *self.apart):
            return False
        if self.scene is None:
            self.first.append((pixels_of(image), camera))
            if len(self.first) >= self.photos:
                taken, self.first = self.first, []
                with uploaded(taken) as source:
                    # Each change would begin a refinement anew: it is asked for at the end.
                    self.scene = self.client.scene(source, refine="off")
            return True
        lacks = lacking(self.scene.view("alpha", camera=camera, width=160).alpha)
        if lacks < self.new:
            self.known.append(camera)
        if not self.new <= lacks <= LACKS_MAX:
            return False
        if len(there) >= self.most:
            self.scene.remove(self.scene.photos[replaceable(there, *self.apart)])
        self.joined += 1
        with uploaded([(pixels_of(image), camera)], f"{self.joined:06}-") as source:
            self.scene.add(source)
        return True


@contextmanager
def uploaded(
    taken: Sequence[tuple[np.ndarray, Camera]], name: str = "first-"
) -> Iterator[dict[str, Camera]]:
    """Photos as a client takes them: files, which are gone at the end, and their cameras."""
    with tempfile.TemporaryDirectory() as folder:
        source = {}
        for i, (pixels, camera) in enumerate(taken):
            path = Path(folder) / f"{name}{i:04}.png"
            Image.fromarray(pixels).save(path)
            source[str(path)] = camera
        yield source


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
                "distance": 0.15, "degrees": 15.0, "new": 0.1, "most": 48}
    url, texts, world, photos, *how = (
        node.declare_parameter(name, value).value for name, value in defaults.items())
    mapper = Mapper(Client(url), photos, *how)
    buffer = tf2_ros.Buffer()
    tf2_ros.TransformListener(buffer, node)
    to = node.create_publisher(types("vision_msgs/Detection3DArray"), "detections", 1)
    # One thread talks to the server. Photos that come meanwhile are not taken: a robot sends more.
    worker, work = ThreadPoolExecutor(1), None

    def look(*photo: Any, header: Any) -> None:
        try:
            if not mapper.take(*photo) or mapper.scene is None or mapper.joined % photos:
                return
            matches = mapper.scene.query(*texts, boxes="upright", masks=False)
            to.publish(detections(types, header, matches))
        except Exception as error:  # The node outlives a refused photo.
            node.get_logger().error(str(error))

    def arrived(image: Any, info: Any) -> None:
        nonlocal work
        if work and not work.done():
            return
        try:
            found = buffer.lookup_transform(world, image.header.frame_id, image.header.stamp)
        except tf2_ros.TransformException as error:
            node.get_logger().warning(str(error))
            return
        header = types("std_msgs/Header")(stamp=image.header.stamp, frame_id=world)
        work = worker.submit(look, image, info, found.transform, header=header)

    image = message_filters.Subscriber(node, types("sensor_msgs/Image"), "image")
    info = message_filters.Subscriber(node, types("sensor_msgs/CameraInfo"), "camera_info")
    message_filters.TimeSynchronizer([image, info], 10).registerCallback(arrived)
    try:
        rclpy.spin(node)
    finally:
        if mapper.scene:
            mapper.scene.refine()


if __name__ == "__main__":
    main()
