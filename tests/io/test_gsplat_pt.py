"""Checkpoints of gsplat's trainer are read without PyTorch, and nothing that they ask for is run."""

import os
import pickle
import zipfile

import jax
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import splatax as sx
from scenes import random_gaussians
from splatax.errors import FormatError
from torch_files import splats_of, torch_save, write_archive, write_checkpoint


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert_array_equal(x, y)


@pytest.mark.parametrize("degree", [0, 3])
def test_every_number_is_kept(degree, tmp_path):
    scene = random_gaussians(n=20, degree=degree)
    same(sx.load(write_checkpoint(tmp_path / "ckpt_29999_rank0.pt", scene)), scene)


def test_the_parts_of_several_gpus_are_one_scene(tmp_path):
    scene = random_gaussians(n=33)
    for rank in range(11):  # numbers of one and of two digits
        part = jax.tree.map(lambda leaf, rank=rank: leaf[3 * rank : 3 * rank + 3], scene)
        write_checkpoint(tmp_path / f"ckpt_29999_rank{rank}.pt", part)
    write_checkpoint(tmp_path / "ckpt_6999_rank0.pt", random_gaussians(n=7))
    same(sx.load(tmp_path / "ckpt_29999_rank0.pt"), scene)


class Attack:
    def __reduce__(self):
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_call_of_anything_else_is_refused_and_not_made(protocol, tmp_path):
    attack = Attack()
    attack.folder = str(tmp_path / "made")
    write_archive(tmp_path / "a.pt", pickle.dumps({"splats": attack}, protocol))
    with pytest.raises(FormatError, match=r"a\.pt: refused, because loading it would run \w+\.mkdir"):
        sx.load(tmp_path / "a.pt")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize("name", ["builtins eval", "torch load", "torch._utils _rebuild_tensor", "os system"])
def test_other_names_are_refused(name, tmp_path):
    write_archive(tmp_path / "a.pt", f"c{name.replace(' ', chr(10))}\n.".encode())
    with pytest.raises(FormatError, match="refused, because"):
        sx.load(tmp_path / "a.pt")


@pytest.mark.parametrize(
    "change", ["missing", "shape", "not an array", "transposed", "compressed", "legacy", "too few bytes"]
)
def test_what_is_not_a_checkpoint_is_refused(change, tmp_path):
    path = tmp_path / "ckpt_1.pt"
    splats = splats_of(random_gaussians(n=6, degree=1))
    if change == "missing":
        del splats["quats"]
    elif change == "shape":
        splats["scales"] = splats["scales"][:5]
    elif change == "not an array":
        splats["means"] = "means"
    elif change == "transposed":
        splats["means"] = np.zeros((3, 6), "<f4").T
    torch_save(path, {"step": 1, "splats": splats})
    if change == "legacy":
        path.write_bytes(pickle.dumps({"step": 1}, 2))
    elif change in ("compressed", "too few bytes"):
        with zipfile.ZipFile(path) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        if change == "too few bytes":
            files["archive/data/0"] = files["archive/data/0"][:-4]
        method = zipfile.ZIP_DEFLATED if change == "compressed" else zipfile.ZIP_STORED
        with zipfile.ZipFile(path, "w", method) as archive:
            for name, contents in files.items():
                archive.writestr(name, contents)
    with pytest.raises(FormatError, match=r"ckpt_1\.pt: "):
        sx.load(path)


def test_a_checkpoint_cannot_be_written(tmp_path):
    with pytest.raises(FormatError, match=r"it cannot be written|can only be read|unknown"):
        sx.save(tmp_path / "a.pt", random_gaussians(n=2))
