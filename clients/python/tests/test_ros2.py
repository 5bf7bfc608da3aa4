"""The example node's own work, with ROS 2's message types and their bytes (CDR) by rosbags. Only
rclpy, which no package index has, is not run: topics, tf and the loop."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from served import ROOT, run

from segsplat import Camera, Client, Scene

STORE = get_typestore(Stores.ROS2_JAZZY)
# The definitions of vision_msgs 4 (ROS 2), without their comments.
VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose":
        "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\n"
                   "BoundingBox3D bbox\nstring id\n",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}
for name, text in VISION.items():
    STORE.register(get_types_from_msg(text, f"vision_msgs/msg/{name}"))


def types(name: str) -> Any:
    """The class of a message."""
    return STORE.types[name.replace("/", "/msg/")]


def sent(message: Any) -> Any:
    """A message after its way over the wire."""
    kind = message.__msgtype__
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)


def header(frame: str) -> Any:
    stamp = types("builtin_interfaces/Time")(sec=7, nanosec=5)
    return types("std_msgs/Header")(stamp=stamp, frame_id=frame)


@pytest.fixture(scope="module")
def node() -> ModuleType:
    path = ROOT / "clients/python/examples/ros2_node.py"
    example = importlib.util.spec_from_file_location("ros2_node", path)
    assert example and example.loader
    module = importlib.util.module_from_spec(example)
    example.loader.exec_module(module)
    return module


def messages(node: ModuleType, photos: Path) -> list[tuple[Any, Any, Any]]:
    """What a robot publishes of each photo of a folder: image, camera, transform."""
    told = json.loads((photos / "transforms.json").read_text())
    out = []
    for frame in told["frames"]:
        lens = {**told, **frame}
        rgb = np.asarray(Image.open(photos / frame["file_path"]).convert("RGB"))
        height, width = rgb.shape[:2]
        # bgr8 with rows that are padded, as drivers send it.
        rows = np.zeros((height, width * 3 + 8), np.uint8)
        rows[:, :width * 3] = rgb[..., ::-1].reshape(height, -1)
        image = types("sensor_msgs/Image")(
            header=header("camera_optical"), height=height, width=width, encoding="bgr8",
            is_bigendian=0, step=rows.shape[1], data=rows.ravel())
        fx, fy, cx, cy = (lens[key] for key in ("fl_x", "fl_y", "cx", "cy"))
        p = np.array([fx, 0, cx - 0.5, 0, 0, fy, cy - 0.5, 0, 0, 0, 1, 0], float)
        roi = types("sensor_msgs/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        info = types("sensor_msgs/CameraInfo")(
            header=header("camera_optical"), height=height, width=width,
            distortion_model="plumb_bob", d=np.zeros(5), k=p.reshape(3, 4)[:, :3].ravel(),
            r=np.eye(3).ravel(), p=p, binning_x=0, binning_y=0, roi=roi)
        pose = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        x, y, z, w = (float(v) for v in node.quaternion_of(pose[:3, :3]))
        at = [float(v) for v in pose[:3, 3]]
        transform = types("geometry_msgs/Transform")(
            translation=types("geometry_msgs/Vector3")(x=at[0], y=at[1], z=at[2]),
            rotation=types("geometry_msgs/Quaternion")(x=x, y=y, z=z, w=w))
        out.append((sent(image), sent(info), sent(transform)))
    return out


def test_a_robots_photos_become_a_scene_and_its_boxes_are_published(
    node: ModuleType, client: Client, photos: Path, scene: Scene
) -> None:
    stream = messages(node, photos)
    mapper = node.Mapper(client, photos=2, distance=0.05)
    assert mapper.take(*stream[0])
    assert not mapper.take(*stream[0]), "it has not moved"
    assert len(mapper.first) == 1 and not mapper.scene
    assert mapper.take(*stream[1])
    made = mapper.scene
    assert mapper.first == []
    # The same pixels and cameras as those of the folder.
    for ours, theirs in zip(made.photos, scene.photos, strict=True):
        assert np.abs(ours.camera.camera_to_world - theirs.camera.camera_to_world).max() < 1e-12
        assert np.abs(ours.camera.K - theirs.camera.K).max() < 1e-12
    assert np.abs(made.view(from_=0).image.astype(int) - scene.view(from_=0).image).max() <= 1
    matches = made.query("floor", "box", boxes="upright", masks=False)
    array = sent(node.detections(types, header("map"), matches))
    assert array.header.frame_id == "map" and array.header.stamp.sec == 7
    parts = [(match, part) for match in matches for part in match.boxes]
    assert len(array.detections) == len(parts) > 0
    for found, (match, part) in zip(array.detections, parts, strict=True):
        guess, box = found.results[0], found.bbox
        assert guess.hypothesis.class_id == match.text and guess.hypothesis.score == match.score
        assert found.id.startswith(f"{match.text}/")
        assert np.array_equal(guess.pose.covariance.reshape(6, 6)[:3, :3], part.covariance)
        # The corners of the box are those of the part.
        size = np.array([box.size.x, box.size.y, box.size.z])
        at = np.array([box.center.position.x, box.center.position.y, box.center.position.z])
        ends = (np.indices((2, 2, 2)).reshape(3, 8).T - 0.5) * size
        corners = at + ends @ node.rotation_of(box.center.orientation).T
        far = np.linalg.norm(corners[:, None] - part.corners[None], axis=2).min(axis=1)
        assert far.max() < 1e-9 * size.max(), match.text


def test_photos_join_where_the_scene_lacks_what_they_show(
    node: ModuleType, client: Client, tmp_path: Path
) -> None:
    run("sample", "--photos", "9", "--size", "160x120", "-o", tmp_path / "walk")
    stream = messages(node, tmp_path / "walk")
    mapper = node.Mapper(client, photos=3, distance=1e-6, most=4)
    assert all(mapper.take(*photo) for photo in stream[:3])
    scene = mapper.scene
    assert (scene.status.version, len(scene.photos)) == (1, 3)
    assert scene.status.refinement.state == "none", "it would begin anew with each photo"
    # Most of it is there: nothing is sent, and it is not looked at again.
    assert not mapper.take(*stream[4])
    assert len(mapper.known) == 1 and not mapper.take(*stream[4])
    assert (scene.status.version, len(mapper.known)) == (1, 1)
    # Turned about, the robot sees nothing that the scene has: no network could place it.
    image, info, transform = stream[8]
    q = transform.rotation
    turned = types("geometry_msgs/Quaternion")(x=-q.z, y=q.w, z=q.x, w=-q.y)
    back = types("geometry_msgs/Transform")(
        translation=transform.translation, rotation=turned)
    assert node.lacking(scene.view("alpha", camera=node.camera_of(info, back)).alpha) > 0.9
    assert not mapper.take(image, info, back)
    assert (scene.status.version, len(mapper.known)) == (1, 1)
    # What shows more joins.
    assert mapper.take(image, info, transform)
    assert (scene.status.version, len(scene.photos), mapper.joined) == (2, 4, 1)
    alpha = scene.view("alpha", camera=node.camera_of(info, transform), width=160).alpha
    assert node.lacking(alpha) < 0.1
    # However many come, the scene has no more than it may: one of the first three is replaced.
    mapper.new = 0.0
    assert mapper.take(*stream[6])
    assert (mapper.joined, len(scene.photos)) == (2, 4)
    names = [photo.file for photo in scene.photos]
    assert names[2:] == ["000001-0000.png", "000002-0000.png"]
    scene.delete()


def test_photos_are_chosen_by_place_turn_and_what_is_lacking(node: ModuleType) -> None:
    def camera(x: float, degrees: float = 0.0) -> Camera:
        turn, pose = np.radians(degrees), np.eye(4)
        pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0],
                        [-np.sin(turn), 0, np.cos(turn)]]
        pose[0, 3] = x
        return Camera(np.eye(3), pose, 8, 6)

    there = [camera(0.0), camera(1.0, 90)]
    for x, degrees, want in [(0.1, 5, False), (0.2, 5, True), (0.1, 20, True),
                             (0.95, 85, False), (0.95, 5, True), (0.0, 0, False)]:
        apart = node.stands_apart(camera(x, degrees), there, 0.15, 15)
        assert apart == want, (x, degrees)
    assert node.stands_apart(camera(0), [], 0.15, 15)
    alpha = np.ones((4, 5), np.float32)
    assert node.lacking(alpha) == 0
    alpha[0], alpha[1] = 0.49, 0.5
    assert node.lacking(alpha) == 0.25
    # 2 and 3 are nearest to each other, and 4 is nearer to 3.
    walk = [camera(x) for x in (0.0, 1.0, 2.0, 2.2, 2.9)]
    assert node.replaceable(walk, 0.15, 15) == 3
    # The same places, but 3 looks elsewhere: 2 and 4 are nearest, and 2 is nearer to 1.
    walk[3] = camera(2.2, 120)
    assert node.replaceable(walk, 0.15, 15) == 2


def test_turns_and_images_are_read_as_ros_defines_them(node: ModuleType) -> None:
    quaternion = types("geometry_msgs/Quaternion")
    half = np.sqrt(0.5)
    # A quarter turn about z takes x to y.
    turned = node.rotation_of(quaternion(x=0, y=0, z=half, w=half)) @ [1, 0, 0]
    assert np.allclose(turned, [0, 1, 0])
    random = np.random.default_rng(3)
    for _ in range(100):
        axes = np.linalg.qr(random.normal(size=(3, 3)))[0]
        x, y, z, w = node.quaternion_of(axes)
        back = node.rotation_of(quaternion(x=x, y=y, z=z, w=w))
        assert np.allclose(back[:, :2], axes[:, :2]) and np.isclose(np.linalg.det(back), 1)
    pixel = np.array([10, 20, 30, 255], np.uint8)

    def image(encoding: str, data: NDArray[np.uint8]) -> Any:
        return types("sensor_msgs/Image")(
            header=header("c"), height=1, width=1, encoding=encoding, is_bigendian=0,
            step=len(data), data=data)

    for encoding, data, want in [
        ("rgb8", pixel[:3], [10, 20, 30]), ("bgr8", pixel[:3], [30, 20, 10]),
        ("rgba8", pixel, [10, 20, 30]), ("bgra8", pixel, [30, 20, 10]),
        ("mono8", pixel[:1], [10, 10, 10]),
    ]:
        assert node.pixels_of(image(encoding, data)).ravel().tolist() == want, encoding
    with pytest.raises(ValueError, match="encoding '32FC1'"):
        node.pixels_of(image("32FC1", pixel))
