"""Other programs read the folders that this program writes of a scene of generated photos: COLMAP
(pycolmap) its model and its depth maps, pycocotools the masks of texts, labelme the polygons. The
truth is the capture itself, `segsplat render` and `segsplat query`. And it reads what others write:
a rig of pycolmap, and captures of Polycam and Record3D as nerfstudio's own converters read them.

python3 judge_folders.py SEGSPLAT
"""

import json
import shutil
import struct
import subprocess
import sys
import tempfile
import types
import zipfile
from pathlib import Path

import numpy as np
import pycolmap
import shapely
from PIL import Image
from pycocotools.coco import COCO
from scipy.spatial.transform import Rotation

# nerfstudio imports them to copy and crop pictures, which is not asked of it here.
for pictures in ("cv2", "imageio", "newrawpy"):
    sys.modules.setdefault(pictures, types.ModuleType(pictures))
from nerfstudio.process_data import polycam_utils, record3d_utils

try:
    import labelme.utils
    from labelme._label_file import read_label_file
except ImportError as lacking:
    # It needs a library for windows that not every machine has.
    labelme = None
    print(f"skipped: labelme does not start here ({lacking}); shapely judges its polygons alone")

segsplat = Path(sys.argv[1]).absolute()
TEXTS = ["carpet", "wall", "box"]
faults: list[str] = []


def check(is_so: bool, what: str) -> None:
    """Notes what is not so."""
    if not is_so:
        faults.append(what)


def run(*words: object) -> dict:
    """The program's answer."""
    line = [segsplat, *map(str, words), "--json"]
    told = subprocess.run(line, stdout=subprocess.PIPE, check=True)
    return json.loads(told.stdout)


def unpacked(top: Path, scene: Path, format: str, *words: object) -> Path:
    """The folder of a format."""
    path = top / f"scene.{format}.zip"
    run("export", scene, "-o", path, "--photos", top / "capture", *words)
    with zipfile.ZipFile(path) as zipped:
        check(zipped.testzip() is None, f"{path.name} is damaged")
        zipped.extractall(top / format)
    return top / format


def of_camera(camera: dict) -> list[object]:
    """A photo's camera as flags."""
    k = camera["intrinsics"]
    pose = ",".join(repr(v) for v in camera["camera_to_world"])
    flags = [["--camera-to-world", pose]]
    flags += [[f"--{name}", repr(k[name])] for name in ("fx", "fy", "cx", "cy", "width", "height")]
    return [word for pair in flags for word in pair]


def truth_of(frames: dict) -> list[np.ndarray]:
    """World-to-camera of the capture, OpenCV axes, rows."""
    poses = [np.array(frame["transform_matrix"]) for frame in frames]
    return [np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))[:3] for pose in poses]


def depths(top: Path, scene: Path, cameras: list[dict]) -> list[np.ndarray]:
    """The depth of each photo's camera."""
    found = []
    for camera in cameras:
        path = top / "depth.npy"
        run("render", scene, "-o", path, "--kind", "depth", *of_camera(camera))
        found.append(np.load(path))
    return found


def judge_colmap(folder: Path, frames: list[dict], truth: list[np.ndarray]) -> None:
    """COLMAP's own reader against the capture."""
    model = pycolmap.Reconstruction(folder / "sparse/0")
    check(len(model.images) == len(frames), f"colmap: {len(model.images)} images")
    worst = 0.0
    by_name = {image.name: image for image in model.images.values()}
    for frame, pose, depth in zip(frames, truth_of(frames), truth, strict=True):
        name = Path(frame["file_path"]).name
        image = by_name[name]
        found = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        worst = max(worst, np.abs(found.matrix() - pose).max())
        camera = model.cameras[image.camera_id]
        check(camera.model.name == "PINHOLE", f"colmap: {camera.model}")
        want = [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")]
        check(list(camera.params) == want, f"colmap: {name}: {camera.params}, not {want}")
        size = Image.open(folder / "images" / name).size
        check(size == (camera.width, camera.height), f"colmap: {name}: {size}")
        # Each point of the image is where the point in space is seen.
        for point in image.points2D[:200]:
            at = camera.img_from_cam(found * model.points3D[point.point3D_id].xyz)
            check(np.abs(at - point.xy).max() < 1e-6, f"colmap: {name}: {at}, not {point.xy}")
        map_file = folder / f"stereo/depth_maps/{name}.geometric.bin"
        theirs = pycolmap.DepthMap()
        theirs.read(map_file)
        check(np.array_equal(theirs.to_array(), depth), f"colmap: the depth of {name}")
        # The same by the documented format.
        head, numbers = map_file.read_bytes().split(b"&", 3)[:3], map_file.read_bytes()
        check([int(v) for v in head] == [*size, 1], f"colmap: {head}")
        data = np.frombuffer(numbers[-4 * size[0] * size[1]:], "<f4").reshape(size[1], size[0])
        check(np.array_equal(data, depth), f"colmap: the bytes of the depth of {name}")
    check(worst < 1e-12, f"colmap: poses are {worst} off")
    check(len(model.points3D) > 1000, f"colmap: {len(model.points3D)} points")
    seen = sum(point.track.length() for point in model.points3D.values())
    check(seen > 0.9 * len(model.points3D), f"colmap: {seen} points have an image")
    print(f"colmap: {len(model.images)} images, {len(model.points3D)} points, poses within {worst}")


def cameras_of(capture: Path, *words: object) -> list[dict]:
    """The cameras that this program reads of a capture."""
    made = run("reconstruct", capture, "-o", capture.parent / "again.segsplat", *words)
    check(made["report"].get("warnings", []) == [], f"{capture.name}: {made['report']}")
    return made["cameras"]


def poses_of(cameras: list[dict]) -> np.ndarray:
    """Camera-to-world, OpenCV axes."""
    return np.array([camera["camera_to_world"] for camera in cameras]).reshape(-1, 4, 4)


def lenses_of(cameras: list[dict]) -> list[list[float]]:
    """Numbers of the lens of each."""
    names = ("fx", "fy", "cx", "cy", "width", "height")
    return [[camera["intrinsics"][name] for name in names] for camera in cameras]


def judge_rig(capture: Path, top: Path, cameras: list[dict]) -> None:
    """A rig of as many cameras as there are photos, in one frame, as pycolmap writes it."""
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    images = []
    for i, (camera, pose) in enumerate(zip(cameras, poses_of(cameras), strict=True), 1):
        *k, width, height = lenses_of([camera])[0]
        lens = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=k, camera_id=i)
        model.add_camera(lens)
        seen = pycolmap.Rigid3d(np.linalg.inv(pose)[:3])
        if i == 1:
            # The rig is where its first camera is.
            rig_from_world = frame.rig_from_world = seen
            rig.add_ref_sensor(lens.sensor_id)
        else:
            rig.add_sensor(lens.sensor_id, seen * rig_from_world.inverse())
        name = Path(camera["file"]).name
        images.append(pycolmap.Image(name=name, camera_id=i, image_id=i, frame_id=1))
        frame.add_data_id(images[-1].data_id)
    model.add_rig(rig)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    model.register_frame(1)
    for binary in (True, False):
        folder = top / ("rig_bin" if binary else "rig_txt")
        (folder / "sparse/0").mkdir(parents=True)
        shutil.copytree(capture / "images", folder / "images")
        (model.write_binary if binary else model.write_text)(folder / "sparse/0")
        files = {path.stem for path in (folder / "sparse/0").iterdir()}
        check({"rigs", "frames"} <= files, f"{folder.name}: {files}")
        sensors = pycolmap.Reconstruction(folder / "sparse/0").rigs[1].num_sensors()
        check(sensors == len(cameras), f"{folder.name}: {sensors} sensors")
        again = cameras_of(folder)
        check(lenses_of(again) == lenses_of(cameras), f"{folder.name}: {lenses_of(again)}")
        off = np.abs(poses_of(again) - poses_of(cameras)).max()
        check(off < 1e-12, f"{folder.name}: a pose is {off} off")
        print(f"{folder.name}: a rig of {sensors} cameras, {len(again)} images, poses within {off}")


def judge_converters(capture: Path, top: Path, frames: list[dict]) -> None:
    """The same cameras of a capture of Polycam and of Record3D as nerfstudio finds."""
    photos = [capture / frame["file_path"] for frame in frames]
    poses = [np.array(frame["transform_matrix"]) for frame in frames]

    polycam = top / "polycam"
    for part in ("cameras", "images"):
        (polycam / "keyframes" / part).mkdir(parents=True)
    images = []
    for i, (frame, pose, photo) in enumerate(zip(frames, poses, photos, strict=True)):
        told = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        # Each photo has a lens of its own.
        told |= {"fx": frame["fl_x"] + i, "fy": frame["fl_y"] + 2 * i, "cx": frame["cx"] + 3 * i,
                 "cy": frame["cy"] - i, "width": frame["w"], "height": frame["h"]}
        stem = str(17_000 + 40 * i)
        (polycam / f"keyframes/cameras/{stem}.json").write_text(json.dumps(told))
        images.append(polycam / f"keyframes/images/{stem}{photo.suffix}")
        shutil.copy(photo, images[-1])
    (top / "of_polycam").mkdir()
    polycam_utils.polycam_to_json(images, [], None, polycam / "keyframes/cameras",
                                  top / "of_polycam")

    record3d = top / "record3d/EXR_RGBD"
    (record3d / "rgb").mkdir(parents=True)
    first, turned = frames[0], []
    for i, (pose, photo) in enumerate(zip(poses, photos, strict=True)):
        turned.append([*Rotation.from_matrix(pose[:3, :3]).as_quat(), *pose[:3, 3]])
        shutil.copy(photo, record3d / f"rgb/{i}{photo.suffix}")
    # nerfstudio takes one focal length and the middle of the picture.
    k = [first["fl_x"], 0, 0, 0, first["fl_x"], 0, first["w"] / 2, first["h"] / 2, 1]
    told = {"w": first["w"], "h": first["h"], "K": k, "poses": turned}
    (record3d / "metadata.json").write_text(json.dumps(told))
    (top / "of_record3d").mkdir()
    images = sorted((record3d / "rgb").iterdir(), key=lambda path: int(path.stem))
    record3d_utils.record3d_to_json(images, record3d / "metadata.json", top / "of_record3d",
                                    np.arange(len(images)))

    # nerfstudio turns Polycam's world: z is up there. Its poses of Record3D are of 32 bits.
    turn = {"polycam": np.eye(4)[[2, 0, 1, 3]], "record3d": np.eye(4)}
    for name, folder, most in (("polycam", polycam, 1e-12), ("record3d", record3d.parent, 1e-6)):
        ours = cameras_of(folder)
        theirs = json.loads((top / f"of_{name}/transforms.json").read_text())
        check(len(ours) == len(theirs["frames"]) == len(frames), f"{name}: {len(ours)} photos")
        found = [[{**theirs, **frame}[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")]
                 for frame in theirs["frames"]]
        check(lenses_of(ours) == found, f"{name}: {lenses_of(ours)}, not {found}")
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        want = np.array([frame["transform_matrix"] for frame in theirs["frames"]]) @ flip
        off = np.abs(turn[name] @ poses_of(ours) - want).max()
        check(off <= most, f"{name}: a pose is {off} off")
        print(f"{name}: nerfstudio's converter finds the same cameras, poses within {off}")


def judge_nerfstudio(
    folder: Path, frames: list[dict], truth: list[np.ndarray], points: int
) -> None:
    """The capture against what the documentation of nerfstudio says."""
    told = json.loads((folder / "transforms.json").read_text())
    for frame, found, depth in zip(frames, told["frames"], truth, strict=True):
        off = np.abs(np.array(frame["transform_matrix"]) - found["transform_matrix"]).max()
        check(off < 1e-12, f"nerfstudio: a pose is {off} off")
        check((folder / found["file_path"]).is_file(), f"nerfstudio: no {found['file_path']}")
        map = np.load(folder / found["depth_file_path"]) * told["depth_unit_scale_factor"]
        check(np.allclose(map, depth, rtol=1e-6, atol=0), "nerfstudio: a depth map")
    head, body = (folder / told["ply_file_path"]).read_bytes().split(b"end_header\n", 1)
    check(f"element vertex {points}\n".encode() in head, f"nerfstudio: {head}")
    check(len(body) == points * struct.calcsize("<dddBBB"), f"nerfstudio: {len(body)} bytes")
    print(f"nerfstudio: {len(told['frames'])} frames, {points} points")


def shapes_of(path: Path) -> tuple[list[dict], str]:
    """The shapes of a photo, and its name, as labelme reads them."""
    told = json.loads(path.read_text())
    if not labelme:
        return told["shapes"], told["imagePath"]
    label = read_label_file(str(path))
    check(len(label.shapes) == len(told["shapes"]), f"labelme: {len(label.shapes)} shapes")
    return label.shapes, label.image_path


def judge_masks(coco_folder: Path, labelme_folder: Path, scene: Path, cameras: list[dict]) -> None:
    """The masks by pycocotools and by labelme against those of a query."""
    coco = COCO(coco_folder / "annotations.json")
    names = [one["name"] for one in coco.loadCats(coco.getCatIds())]
    check(names == TEXTS, f"coco: {names}")
    masks, least = 0, 1.0
    for image_id, camera in zip(sorted(coco.getImgIds()), cameras, strict=True):
        image = coco.loadImgs(image_id)[0]
        name = Path(image["file_name"])
        check((coco_folder / "images" / name).is_file(), f"coco: no photo {name}")
        shapes, of_photo = shapes_of(labelme_folder / "images" / f"{name.stem}.json")
        check(of_photo == name.name, f"labelme: {of_photo} is not {name}")
        answer = run("query", scene, *TEXTS, *of_camera(camera))
        for category, (text, result) in enumerate(zip(TEXTS, answer["results"], strict=True), 1):
            view = result["view"]
            whole = COCO()
            rle = {"size": view["mask_rle"]["size"], "counts": view["mask_rle"]["counts"]}
            whole.imgs = {1: {"height": rle["size"][0], "width": rle["size"][1]}}
            truth = whole.annToMask({"image_id": 1, "segmentation": rle}).astype(bool)
            found = coco.loadAnns(coco.getAnnIds(imgIds=image_id, catIds=category))
            check(len(found) == (view["area"] > 0), f"coco: {len(found)} of {text!r} in {name}")
            for one in found:
                mask = coco.annToMask(one).astype(bool)
                check(np.array_equal(mask, truth), f"coco: the mask of {text!r} in {name}")
                y, x = np.nonzero(mask)
                box = [x.min(), y.min(), x.max() - x.min() + 1, y.max() - y.min() + 1]
                check(one["bbox"] == box and one["area"] == mask.sum(), f"coco: {one}")
                masks += 1
            drawn = np.zeros_like(truth)
            inside = np.zeros_like(truth)
            rows, columns = np.indices(truth.shape) + 0.5
            for shape in (one for one in shapes if one["label"] == text):
                if labelme:
                    drawn |= labelme.utils.shape_to_mask(truth.shape, shape["points"], "polygon")
                part = shapely.make_valid(shapely.Polygon(shape["points"]))
                inside |= shapely.contains_xy(part, columns, rows)
            for by, mask in [("labelme", drawn)] * bool(labelme) + [("shapely", inside)]:
                union = (mask | truth).sum()
                share = 1.0 if union == 0 else (mask & truth).sum() / union
                least = min(least, share)
                check(share >= 0.99, f"{by}: {text!r} in {name} has an IoU of {share}")
    check(masks >= len(cameras), f"coco: only {masks} masks")
    print(f"coco: {masks} masks, pixel by pixel; labelme and shapely: least IoU {least}")


with tempfile.TemporaryDirectory() as name:
    top = Path(name)
    run("sample", "-o", top / "capture", "--photos", 3)
    made = run("reconstruct", top / "capture", "-o", top / "scene.segsplat", "--semantics", "eager")
    frames = json.loads((top / "capture/transforms.json").read_text())
    lens = {key: frames[key] for key in ("fl_x", "fl_y", "cx", "cy") if key in frames}
    frames = [{**lens, **frame} for frame in frames["frames"]]
    scene, cameras = top / "scene.segsplat", made["cameras"]
    truth = depths(top, scene, cameras)
    folder = unpacked(top, scene, "colmap")
    judge_colmap(folder, frames, truth)
    points = len(pycolmap.Reconstruction(folder / "sparse/0").points3D)
    judge_nerfstudio(unpacked(top, scene, "nerfstudio"), frames, truth, points)
    words = [word for text in TEXTS for word in ("--text", text)]
    judge_masks(unpacked(top, scene, "coco", *words), unpacked(top, scene, "labelme", *words),
                scene, cameras)
    judge_rig(top / "capture", top, cameras)
    judge_converters(top / "capture", top, frames)
    # The program reads its own folders: the same cameras.
    for format in ("colmap", "nerfstudio"):
        again = run("reconstruct", top / format, "-o", top / "again.segsplat")
        for one, other in zip(cameras, again["cameras"], strict=True):
            check(one["intrinsics"] == other["intrinsics"], f"{format}: {other['intrinsics']}")
            off = np.abs(np.subtract(one["camera_to_world"], other["camera_to_world"])).max()
            check(off < 1e-12, f"{format}: a pose is {off} off")
        print(f"{format}: a scene of the folder has the same cameras")
sys.exit("\n".join(faults[:20]) or None)
