"""Streamed SOG: levels of detail in cells of space, and no unit is left behind or lost."""

import json

import numpy as np
import pytest

import splatax as sx
from scenes import random_gaussians
from splatax import editing
from splatax.errors import FormatError
from splatax.io.formats import sog, sog_streamed

SCENE = random_gaussians(n=600, degree=1, scale=(0.02, 0.1))


@pytest.fixture
def small_units(monkeypatch):
    monkeypatch.setattr(sog_streamed, "UNIT", 150)


def leaves_of(node):
    children = node.get("children", ())
    return [leaf for child in children for leaf in leaves_of(child)] if children else [node]


def meta_of(path):
    return json.loads(path.read_text())


@pytest.mark.slow
def test_each_level_is_whole_and_each_cell_holds_its_own_gaussians(tmp_path, small_units):
    path = tmp_path / "lod-meta.json"
    levels = editing.levels_of(SCENE, 3)
    sx.save(path, SCENE, coarser=levels[1:])
    meta = meta_of(path)
    assert meta["counts"] == [600, 150, 38]
    assert meta["count"] == sum(meta["counts"])
    leaves = leaves_of(meta["tree"])
    assert len(leaves) >= 4
    units = {name: sog.load(tmp_path / name) for name in meta["filenames"]}
    seen = {level: [] for level in range(3)}
    for leaf in leaves:
        low, high = (np.array(leaf["bound"][end]) for end in ("min", "max"))
        for level, part in leaf["lods"].items():
            name = meta["filenames"][part["file"]]
            assert name.startswith(f"{level}_")
            means = np.asarray(units[name].means)[part["offset"] : part["offset"] + part["count"]]
            assert len(means) == part["count"]
            assert ((low <= means) & (means <= high)).all()
            seen[int(level)].append(means)
    for level, gaussians in enumerate(levels):
        found, expected = np.concatenate(seen[level]), np.asarray(gaussians.means)
        found, expected = (of[np.lexsort(np.round(of, 2).T)] for of in (found, expected))
        np.testing.assert_allclose(np.sort(found[:, 0]), np.sort(expected[:, 0]), atol=1e-3)
        assert len(found) == len(expected)


@pytest.mark.slow
def test_the_scene_is_read_back_from_all_units_of_level_0(tmp_path, small_units):
    path = tmp_path / "lod-meta.json"
    sx.save(path, SCENE, coarser=editing.levels_of(SCENE, 2)[1:])
    assert len(sx.load(path)) == 600
    assert len([name for name in meta_of(path)["filenames"] if name.startswith("0_")]) > 1


def test_a_new_scene_removes_the_units_of_the_old_one_and_nothing_else(tmp_path):
    path, other = tmp_path / "lod-meta.json", tmp_path / "notes" / "meta.json"
    sx.save(path, SCENE)
    other.parent.mkdir()
    other.write_text("mine")
    meta = meta_of(path)
    path.write_text(json.dumps({**meta, "filenames": [*meta["filenames"], "notes/meta.json"]}))
    sx.save(path, random_gaussians(1, n=50, degree=0))
    assert other.read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 3, "lod-meta.json, one unit, and notes"
    assert len(sx.load(path)) == 50


@pytest.mark.parametrize("name", ["../meta.json", "/tmp/meta.json", "missing/meta.json"])
def test_units_outside_the_folder_or_missing_are_refused(tmp_path, name):
    path = tmp_path / "lod-meta.json"
    sx.save(path, SCENE)
    path.write_text(json.dumps({**meta_of(path), "filenames": [name]}))
    with pytest.raises(FormatError, match="meta"):
        sx.load(path)


def test_a_tree_that_is_too_deep_is_refused(tmp_path):
    path = tmp_path / "lod-meta.json"
    sx.save(path, SCENE)
    meta = meta_of(path)
    for _ in range(100):
        meta["tree"] = {"bound": meta["tree"]["bound"], "children": [meta["tree"]]}
    path.write_text(json.dumps(meta))
    with pytest.raises(FormatError, match="damaged"):
        sx.load(path)
