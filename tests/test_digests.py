"""Digests of arrays and files."""

from dataclasses import replace

from scenes import random_gaussians
from splatax.digests import contents, digest, file_digest
from splatax.low_pass import Antialiasing


def test_scenes_that_differ_only_in_how_they_are_drawn_have_different_digests():
    scene = random_gaussians(n=3)
    assert digest(*contents(scene)) == digest(*contents(replace(scene)))
    for other in (replace(scene, low_pass=Antialiasing()), replace(scene, order="distance")):
        assert digest(*contents(scene)) != digest(*contents(other))


def test_a_file_has_the_digest_of_its_bytes(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    assert file_digest(tmp_path / "file") == digest(b"a", b"bc") == "ba7816bf8f01cfea"  # FIPS 180-2, B.1
