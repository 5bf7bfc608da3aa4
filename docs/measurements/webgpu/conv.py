"""ONNX Runtime's WebGPU provider (PyPI onnxruntime-webgpu 1.27.0): Conv with some numbers of channels is wrong.

    python conv.py          # needs numpy, onnx, onnxruntime-webgpu and a Vulkan driver

Prints the largest difference to the CPU as a share of the largest value, for each number of input
channels of one 3x3 convolution.
"""
import numpy as np
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

random = np.random.default_rng(1)


def model(channels):
    weight = random.standard_normal((64, channels, 3, 3)).astype(np.float32)
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        [helper.make_node("Conv", ["x", "w"], ["y"], pads=[1, 1, 1, 1])], "conv",
        [value("x", TensorProto.FLOAT, [2, channels, 16, 16])], [value("y", TensorProto.FLOAT, [2, 64, 16, 16])],
        [numpy_helper.from_array(weight, "w")],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


for channels in (3, 4, 5, 6, 8, 9, 12, 16, 17, 20, 21, 24, 33):
    data, image = model(channels), {"x": random.standard_normal((2, channels, 16, 16)).astype(np.float32)}
    wanted = ort.InferenceSession(data, providers=["CPUExecutionProvider"]).run(None, image)[0]
    found = ort.InferenceSession(data, providers=["WebGpuExecutionProvider"]).run(None, image)[0]
    print(f"{channels:3d} channels: {np.abs(found - wanted).max() / np.abs(wanted).max():.1e}", flush=True)
