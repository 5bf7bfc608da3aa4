"""NVIDIA's client of the Open Inference Protocol (tritonclient) runs every network of the embedded
bundle over HTTP and gRPC, as it is. The truth is ONNX Runtime's own package with the same files.

SEGSPLAT_BIN=PROGRAM python3 judge_inference.py
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import onnxruntime
import tritonclient.grpc
import tritonclient.http
from served import ROOT, served
from tritonclient.utils import InferenceServerException

BUNDLE = ROOT / "models/embedded"
FILES = {
    "geometry": "geometry.onnx",
    "masks.encoder": "mask_encoder.onnx",
    "masks.decoder": "mask_decoder.onnx",
    "image_text.image": "image_tower.onnx",
    "image_text.text": "text_tower.onnx",
}
#: Largest difference, share of the root mean square. On a CPU the server computes the geometry in 8
#: bits, and the others in f32 with other kernels than the package's default.
TOLERANCE = {"geometry": 0.1}
faults: list[str] = []


def check(is_so: bool, what: str) -> None:
    """Notes what is not so."""
    if not is_so:
        faults.append(what)


def inputs(network: str, seen: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Tensors that a network takes. `seen`: what the encoder gave."""
    random = np.random.default_rng(7)
    if network == "geometry":
        views, side = 3, 256
        poses = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
        poses[:, 0, 3] = np.linspace(0, 1, views)
        x = np.arange(side, dtype=np.float32)[None, :] + 60 * poses[:, 0, 3, None]
        waves = np.sin(x[:, None, :] / 9 + np.arange(side)[None, :, None] / 14)
        images = np.repeat(0.5 + 0.4 * waves[:, None], 3, axis=1)
        lens = np.array([[1.1, 0, 0.5], [0, 1.1, 0.5], [0, 0, 1]], np.float32)
        return {
            "images": images.astype(np.float32),
            "intrinsics": np.tile(lens, (views, 1, 1)),
            "camera_to_world": poses,
            "near": np.full(views, 3, np.float32),
            "far": np.full(views, 15, np.float32),
            "neighbors": np.array([[1, 2], [0, 2], [1, 0]], np.int64),
        }
    if network == "masks.encoder":
        return {"images": random.normal(size=(1, 3, 512, 512)).astype(np.float32)}
    if network == "masks.decoder":
        points = random.uniform(0, 512, size=(5, 2, 2)).astype(np.float32)
        labels = np.tile(np.array([1, -1], np.float32), (5, 1))
        return {**seen, "point_coords": points, "point_labels": labels}
    if network == "image_text.image":
        return {"images": random.normal(size=(2, 3, 224, 224)).astype(np.float32)}
    return {"input_ids": random.integers(5, 900, size=(4, 7), dtype=np.int64)}


def ran(client, module, network: str, given: dict[str, np.ndarray], **how) -> dict[str, np.ndarray]:
    """What the server gives."""
    tensors = []
    for name, data in given.items():
        kind = "INT64" if data.dtype == np.int64 else "FP32"
        tensors.append(module.InferInput(name, list(data.shape), kind))
        tensors[-1].set_data_from_numpy(data, **how)
    wanted = None
    if how:
        wanted = [module.InferRequestedOutput(name, **how) for name in outputs_of(client, network)]
    answer = client.infer(network, tensors, outputs=wanted, request_id="a")
    told = answer.get_response()
    check((told["id"] if isinstance(told, dict) else told.id) == "a", f"{network}: no id")
    return {name: answer.as_numpy(name) for name in outputs_of(client, network)}


def outputs_of(client, network: str) -> list[str]:
    told = client.get_model_metadata(network)
    if isinstance(told, dict):
        return [output["name"] for output in told["outputs"]]
    return [output.name for output in told.outputs]


def truth(network: str, given: dict[str, np.ndarray], names: list[str]) -> list[np.ndarray]:
    """ONNX Runtime's own answer."""
    options = onnxruntime.SessionOptions()
    # In f32, as the server computes with weights that are stored in 8 bits.
    options.add_session_config_entry("session.disable_quant_qdq", "1")
    options.intra_op_num_threads = 2
    session = onnxruntime.InferenceSession(BUNDLE / FILES[network], options)
    whole = {one.name: given[one.name] for one in session.get_inputs() if one.name in given}
    # What a decoder takes for judging masks: one pixel of one level.
    for one in session.get_inputs():
        if one.name not in whole:
            shape = [size if isinstance(size, int) else 1 for size in one.shape]
            kind = np.int64 if "int64" in one.type else np.float32
            whole[one.name] = given[one.name] = np.zeros(shape, kind)
    return session.run(names, whole)


def judge(url: str) -> None:
    address = url.removeprefix("http://")
    http = tritonclient.http.InferenceServerClient(address)
    grpc = tritonclient.grpc.InferenceServerClient(address)
    for client, name in [(http, "http"), (grpc, "grpc")]:
        check(client.is_server_live(), f"{name}: not live")
        until = time.monotonic() + 120
        while not client.is_server_ready() and time.monotonic() < until:
            time.sleep(0.1)
        check(client.is_server_ready(), f"{name}: not ready")
    check(http.get_server_metadata()["extensions"] == ["binary_tensor_data"], "extensions")
    check(grpc.get_server_metadata().name == "segsplat", "name")
    seen: dict[str, np.ndarray] = {}
    for network, file in FILES.items():
        for client in (http, grpc):
            check(client.is_model_ready(network), f"{network}: not ready")
        given, names = inputs(network, seen), outputs_of(http, network)
        check(names == outputs_of(grpc, network), f"{network}: other outputs by gRPC")
        wanted = truth(network, given, names)
        begun = time.monotonic()
        answers = [
            ran(http, tritonclient.http, network, given),
            ran(grpc, tritonclient.grpc, network, given),
        ]
        ms = (time.monotonic() - begun) * 500
        if network == "image_text.text":
            answers.append(ran(http, tritonclient.http, network, given, binary_data=False))
        worst = 0.0
        for name, right in zip(names, wanted, strict=True):
            for answer in answers:
                same = np.array_equal(answer[name], answers[0][name], equal_nan=True)
                check(same, f"{network}: {name} differs between the transports")
            found = answers[0][name].astype(np.float64)
            check(found.shape == right.shape, f"{network}: {name} is {found.shape}")
            off = np.sqrt(np.mean((found - right) ** 2) / max(np.mean(right**2.0), 1e-12))
            worst = max(worst, off)
        check(worst <= TOLERANCE.get(network, 1e-3), f"{network}: {worst} off {file}")
        print(f"{network}: {len(names)} outputs, {worst:.1e} off ONNX Runtime, {ms:.0f} ms a call")
        if network == "masks.encoder":
            seen = {"image_embeddings": answers[0]["image_embeddings"]}
    for client, module in [(http, tritonclient.http), (grpc, tritonclient.grpc)]:
        given = {"input_ids": np.array([[10**9]], np.int64)}
        for network, why in [("image_text.text", "numbers must be 0 to"), ("none", "no network")]:
            try:
                tensors = [module.InferInput("input_ids", [1, 1], "INT64")]
                tensors[0].set_data_from_numpy(given["input_ids"])
                client.infer(network, tensors)
                faults.append(f"{network}: not refused")
            except InferenceServerException as error:
                check(why in error.message(), f"{network}: {error.message()!r} lacks {why!r}")
    http.close()
    grpc.close()


with tempfile.TemporaryDirectory() as folder, served(Path(folder) / "data") as url:
    judge(url)
sys.exit("\n".join(faults[:20]) or None)
