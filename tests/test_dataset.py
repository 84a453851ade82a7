"""Records of a capture."""

from splatax.cameras import rig
from training.test_training import capture


def test_the_size_of_a_scene_is_computed_once(monkeypatch):
    dataset = capture()
    extent = dataset.extent
    monkeypatch.setattr(rig, "extent_of", None)
    assert dataset.extent == extent > 0
