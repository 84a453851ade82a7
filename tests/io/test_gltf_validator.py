"""The validator of Khronos (npm, Apache-2.0) finds nothing wrong with the .glb files that we write.

It does not know KHR_gaussian_splatting and KHR_node_visibility yet, so it names these extensions, and the
attributes of the first, as unknown.
"""

import json
import subprocess

import numpy as np
import pytest

import splatax as sx
from npm import installed
from scenes import random_gaussians
from splatax.demo.rigged import drawn_arm
from splatax.io.rigs import save_body, save_rigged
from splatax.mesh import files as meshes
from splatax.mesh.record import Mesh
from splatax.scene import ColorMap, Option, RiggedScene
from splatax.scene.binding import covering
from splatax.transforms import Similarity

pytestmark = pytest.mark.slow

PACKAGE = "gltf-validator@2.0.0-dev.3.10"
PROGRAM = """
const fs = require("fs"), validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), { maxIssues: 0 })
  .then((report) => console.log(JSON.stringify(report)));
"""
UNKNOWN = ("'KHR_gaussian_splatting'", "'KHR_node_visibility'")  # extensions that it cannot validate


@pytest.fixture(scope="module")
def messages_about(tmp_path_factory):
    """A function that returns what the validator says about a file, as (code, pointer, message)."""
    folder = installed(PACKAGE, tmp_path_factory.mktemp("validator"))

    def validate(path):
        command = ["node", "-e", PROGRAM, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=folder)
        assert done.stdout, done.stderr
        report = json.loads(done.stdout)
        assert report["info"]["totalVertexCount"] > 0
        return [(each["code"], each["pointer"], each["message"]) for each in report["issues"]["messages"]]

    return validate


def of_an_extension(found) -> bool:
    code, pointer, message = found
    if code == "UNSUPPORTED_EXTENSION":
        return any(name in message for name in UNKNOWN)
    return code == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "/KHR_gaussian_splatting:" in pointer


def write_splats(path):
    sx.save(path, random_gaussians(n=10, degree=3))


def write_parts(path):
    body, wheel = random_gaussians(0, n=10, degree=2), random_gaussians(1, n=7, degree=0)
    parts = {
        "body": sx.Part(body, color=ColorMap.tint((1.0, 0.5, 0.2))),
        "wheel": sx.Part(wheel, Similarity.of(degrees=(20.0, -50.0, 130.0), scale=0.6)),
        "other wheel": sx.Part(wheel, visible=False),
    }
    paint = {"plain": Option(), "red": Option(colors={"body": ColorMap.dye((0.9, 0.1, 0.1))})}
    drive = {"front": Option(("wheel",)), "all": Option(("wheel", "other wheel"))}
    sx.save_scene(path, sx.Scene(parts), variants={"paint": paint, "drive": drive})


def write_rigged(path):
    arm = drawn_arm()
    save_rigged(path, RiggedScene(*covering(arm, 50, sh_degree=1), arm.clips))


def write_rigged_parts(path):
    arm = drawn_arm()
    wheel = sx.Part(random_gaussians(1, n=7, degree=1), color=ColorMap.tint((1.0, 0.5, 0.2)), visible=False)
    scene = RiggedScene(*covering(arm, 50, sh_degree=1), arm.clips)
    save_rigged(path, scene, name="arm", beside=sx.Scene({"wheel": wheel}))


def write_body(path):
    save_body(path, drawn_arm())


def write_mesh(path):
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    meshes.save(path, Mesh(corners, faces, np.full((4, 3), 128, np.uint8)))


@pytest.mark.parametrize(
    "write", [write_splats, write_parts, write_rigged, write_rigged_parts, write_body, write_mesh]
)
def test_the_validator_finds_nothing_but_the_extensions_that_it_does_not_know(
    messages_about, tmp_path, write
):
    write(tmp_path / "a.glb")
    messages = messages_about(tmp_path / "a.glb")
    assert [found for found in messages if not of_an_extension(found)] == []
    assert bool(messages) == (write in (write_splats, write_parts, write_rigged, write_rigged_parts))


def test_the_validator_finds_a_defect(messages_about, tmp_path):
    """So that the tests above cannot pass because it looks at nothing."""
    write_body(tmp_path / "a.glb")
    contents = (tmp_path / "a.glb").read_bytes().replace(b'"translation"', b'"transl4tion"', 1)
    (tmp_path / "a.glb").write_bytes(contents)
    assert "UNEXPECTED_PROPERTY" in {code for code, *_ in messages_about(tmp_path / "a.glb")}
