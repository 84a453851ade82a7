"""Goals of `--geometry`: one run of the commands on the demo, whose surfaces are known."""

import json

import numpy as np
import pytest
import trimesh

import splatax as sx
from splatax import cli
from splatax.demo.capture import write_capture
from splatax.demo.raycast import truth
from splatax.demo.scenes.still_life import STILL_LIFE
from splatax.geometry_scores import OF_PLANES
from splatax.mesh.record import Mesh

STEPS = "2000"  # of `splatax demo`
FINE, SPACING = 2, 0.01  # times the photos' size, and least distance of the true points


@pytest.mark.slow
def test_the_demo_has_accurate_depth_normals_and_mesh_and_a_good_picture(tmp_path):
    capture, run, out = tmp_path / "capture", tmp_path / "run", tmp_path / "mesh.ply"
    write_capture(capture)
    cli.main(["train", str(capture), "--out", str(run), "--geometry", "--steps", STEPS])
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["test"]["psnr"] >= 37.5
    geometry = metrics["geometry"]
    assert geometry["reference"] == "truth"
    for output in OF_PLANES:  # in a scene 3.2 wide
        assert geometry["depth"][output]["error"] <= 0.015
        assert abs(geometry["depth"][output]["bias"]) <= 0.005
    assert geometry["normal_error"] <= 8

    cli.main(["mesh", str(run), str(out)])
    found = trimesh.load(out, process=False)
    colors = np.zeros((len(found.vertices), 3), np.uint8)
    shape = Mesh(np.asarray(found.vertices), np.asarray(found.faces), colors)
    cameras = [view.camera for view in sx.load_dataset(capture).train]
    large = [camera.resized(FINE * camera.width, FINE * camera.height) for camera in cameras]
    seen = [(camera, np.asarray(truth(camera, STILL_LIFE).depth)) for camera in large]
    agreement = sx.mesh.compare(shape, sx.mesh.samples_of(seen, SPACING))
    assert agreement.median <= 0.012
    assert agreement.most <= 0.05  # of 90 % of the mesh
    assert agreement.tolerance == 0.05
    assert agreement.completeness >= 0.95
