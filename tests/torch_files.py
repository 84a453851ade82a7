"""Files as torch.save writes them since version 1.6, without PyTorch.

A zip file, not compressed: archive/data.pkl is a pickle of protocol 2 in which a tensor is a call of
torch._utils._rebuild_tensor_v2 and its storage is a persistent reference; archive/data/0 and so on are the
bytes of the storages.
"""

import io
import pickle
import sys
import types
import zipfile
from collections import OrderedDict

import numpy as np

STORAGES = {"<f4": "FloatStorage", "<f8": "DoubleStorage", "<i8": "LongStorage"}


class Stub:
    """A name of torch, which a pickle refers to."""

    def __init__(self, module, name):
        self.__module__, self.__qualname__, self.__name__ = module, name, name

    def __call__(self, *arguments):
        raise AssertionError("called")

    def __reduce__(self):
        return self.__name__


def torch_modules():
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
    utils._rebuild_tensor_v2 = Stub("torch._utils", "_rebuild_tensor_v2")
    for name in STORAGES.values():
        setattr(torch, name, Stub("torch", name))
    torch._utils = utils
    return {"torch": torch, "torch._utils": utils}


class Storage:
    def __init__(self, array, key):
        self.kind, self.key, self.bytes = STORAGES[array.dtype.str], key, array.tobytes()
        self.count = array.size


def torch_save(path, contents):
    """Writes contents in which arrays stand for tensors."""
    storages, modules = [], torch_modules()

    class Pickler(pickle._Pickler):
        def persistent_id(self, value):
            if isinstance(value, Storage):
                return "storage", getattr(modules["torch"], value.kind), value.key, "cuda:0", value.count
            return None

        def reducer_override(self, value):
            if isinstance(value, np.ndarray):
                storages.append(storage := Storage(value, str(len(storages))))
                strides = tuple(step // value.itemsize for step in value.strides)
                function = modules["torch._utils"]._rebuild_tensor_v2
                return function, (storage, 0, value.shape, strides, False, OrderedDict())
            return NotImplemented

    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        file = io.BytesIO()
        Pickler(file, 2).dump(contents)
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
    write_archive(path, file.getvalue(), [storage.bytes for storage in storages])


def write_archive(path, pickled, storages=()):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", pickled)
        archive.writestr("archive/byteorder", "little")
        for i, contents in enumerate(storages):
            archive.writestr(f"archive/data/{i}", contents)
        archive.writestr("archive/version", "3\n")


def splats_of(gaussians):
    """The parameters of a scene, named and shaped as gsplat's trainer stores them."""
    arrays = {
        "means": gaussians.means,
        "scales": gaussians.log_scales,
        "quats": gaussians.quats,
        "opacities": gaussians.opacity_logits,
        "sh0": gaussians.sh[:, :1],
        "shN": gaussians.sh[:, 1:],
    }
    splats = OrderedDict((name, np.array(array, "<f4")) for name, array in arrays.items())
    splats._metadata = OrderedDict({"": {"version": 1}})  # PyTorch's state dictionaries have this attribute
    return splats


def write_checkpoint(path, gaussians, step=29_999, **extra):
    path.parent.mkdir(parents=True, exist_ok=True)
    torch_save(path, {"step": step, "splats": splats_of(gaussians), **extra})
    return path
