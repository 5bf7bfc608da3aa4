"""Reads what `torch.save` wrote, with numpy alone: tensors, lists, dictionaries, texts and numbers.

Nothing else in the file is made or called."""

import collections
import pickle
import zipfile

import numpy as np

TYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ByteStorage": "u1",
    "UntypedStorage": "u1",
}


def tensor(storage, offset, size, stride, *_):
    step = [n * storage.itemsize for n in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, step, writeable=False)


class Reader(pickle.Unpickler):
    def __init__(self, archive, root):
        super().__init__(archive.open(f"{root}/data.pkl"))
        self.archive, self.root, self.read = archive, root, {}

    def find_class(self, module, name):
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return tensor
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if module in ("torch", "torch.storage") and name in TYPES:
            return name
        raise pickle.UnpicklingError(
            f"{module}.{name} is no tensor, list, dictionary, text or number"
        )

    def persistent_load(self, told):
        _, kind, key, _, count = told
        if key not in self.read:
            data = self.archive.read(f"{self.root}/data/{key}")
            self.read[key] = np.frombuffer(data, TYPES[kind], count)
        return self.read[key]


def load(path):
    """The value in a `.torch` or `.pt` file; tensors are numpy arrays."""
    with zipfile.ZipFile(path) as archive:
        (root,) = [
            name[: -len("/data.pkl")] for name in archive.namelist() if name.endswith("/data.pkl")
        ]
        return Reader(archive, root).load()
