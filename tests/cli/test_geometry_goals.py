"""Goals of `--geometry`: runs on the demo, whose surfaces are known, and on real captures."""

import itertools
import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import splatax as sx
from splatax import cli
from splatax.demo.capture import write_capture
from splatax.demo.raycast import truth
from splatax.demo.scenes.still_life import STILL_LIFE
from splatax.geometry_scores import OF_PLANES, against_landmarks
from splatax.mesh.record import Mesh

SCRIPT = Path(__file__).parents[2] / "docs" / "measure_geometry.py"
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


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seeds"), [("fern", 3), ("fox", 1)])
def test_surfaces_of_a_real_capture_are_better_at_points_that_were_held_out_and_cost_little(
    data, name, seeds
):
    """The penalties cost 0.03 dB on fern and 0.16 dB on fox when this was written.

    They divided the error of surface_depth by 3.9 and 2.5, and that of median_surface_depth by 1.2 and 1.3.
    The figures of fern are means of three seeds, because one run says little about the cost: with or without
    penalties, the pillar at the right edge is misplaced with some seeds, which costs 0.4 dB, and which seeds
    these are depends on how the CPU rounds.
    """
    capture = data / name
    if not capture.is_dir():
        pytest.skip(f"no capture {name} in {data}: SPLATAX_DATA names the folder of test data")
    script = runpy.run_path(str(SCRIPT))
    dataset = script["parted"](sx.load_dataset(capture, downscale=4))
    psnr, errors = [], []
    for seed, variant in itertools.product(range(seeds), ("default", "--geometry")):
        recipe = script["VARIANTS"][variant](int(STEPS), script["room_for"](dataset))
        scene = sx.fit(dataset, replace(recipe, seed=seed))
        psnr.append(sx.evaluate(scene, dataset.test).psnr)
        depths = against_landmarks(scene, dataset.test).mean.depths
        errors.append([depths[output].relative for output in OF_PLANES])
    plain, penalized = np.reshape(psnr, (seeds, 2)).mean(0)
    assert penalized >= plain - 0.4
    surface, median = np.divide(*np.reshape(errors, (seeds, 2, 2)).mean(0))
    assert surface >= 2
    assert median >= 0.9
