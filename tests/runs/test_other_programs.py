"""Run folders of INRIA's 3DGS and of gsplat, and the options in their files."""

import pytest

import splatax as sx
from scenes import random_gaussians
from splatax.errors import InputError
from splatax.runs.scene_files import scene_at
from torch_files import write_checkpoint

CFG_ARGS = (
    "Namespace(data_device='cuda', depths='', eval=True, images='images_4', model_path='./output/garden', "
    "resolution=-1, sh_degree=3, source_path='{source}', train_test_exp=False, white_background=True{more})"
)
CFG_YML = """antialiased: true
camera_model: pinhole
data_dir: {source}
data_factor: 4
eval_steps:
- 7000
normalize_world_space: {normalized}
strategy: !!python/object:gsplat.strategy.default.DefaultStrategy
  verbose: true
"""


def inria(folder, more="", source="/data/garden"):
    for i, step in enumerate((7000, 30_000, 500)):
        path = folder / "point_cloud" / f"iteration_{step}" / "point_cloud.ply"
        path.parent.mkdir(parents=True)
        sx.save(path, random_gaussians(n=5 + i))
    (folder / "cfg_args").write_text(CFG_ARGS.format(source=source, more=more))
    return folder


def gsplat(folder, normalized="false"):
    for i, step in enumerate((6999, 29_999)):
        write_checkpoint(folder / "ckpts" / f"ckpt_{step}_rank0.pt", random_gaussians(n=5 + i))
    (folder / "cfg.yml").write_text(CFG_YML.format(source="/data/garden", normalized=normalized))
    return folder


def test_inria_the_highest_iteration_and_its_arguments(tmp_path):
    found = scene_at(inria(tmp_path / "garden"))
    assert found.path.parent.name == "iteration_30000"
    assert found.name == "garden"
    assert found.options == {"scene": "/data/garden", "background": "white", "downscale": 4}
    assert (found.low_pass, found.notes) == (None, ())
    assert len(sx.load(found.path)) == 6


def test_inria_antialiasing_and_training_on_all_photos_are_known(tmp_path):
    run = inria(tmp_path / "garden", more=", antialiasing=True")
    path = run / "cfg_args"
    path.write_text(
        path.read_text().replace("eval=True", "eval=False").replace("resolution=-1", "resolution=2")
    )
    found = scene_at(run)
    assert found.low_pass == "antialiasing"
    assert found.notes == ("trained on all photos: no photo was held out",)
    assert found.options["downscale"] == 8  # half of images_4


def test_inria_without_arguments_is_still_a_scene(tmp_path):
    run = inria(tmp_path / "garden")
    (run / "cfg_args").unlink()
    assert scene_at(run).options == {}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "print('x')",
        "Namespace(a=open('/etc/passwd'))",
        "Namespace(1)",
        "Namespace(a=b)",
        "(" * 300,
        "a\0",
    ],
)
def test_arguments_are_constants_and_nothing_is_run(text, tmp_path):
    run = inria(tmp_path / "garden")
    (run / "cfg_args").write_text(text)
    with pytest.raises(InputError, match=r"cfg_args: damaged .*Put it back as it was"):
        scene_at(run)


def test_gsplat_the_last_step_and_its_options(tmp_path):
    found = scene_at(gsplat(tmp_path / "garden"))
    assert found.path.name == "ckpt_29999_rank0.pt"
    assert found.options == {"scene": "/data/garden", "background": "black", "downscale": 4}
    assert (found.name, found.low_pass, found.notes) == ("garden", "antialiasing", ())
    assert len(sx.load(found.path)) == 6


def test_gsplat_in_a_normalized_world_does_not_fit_the_cameras_of_its_capture(tmp_path):
    found = scene_at(gsplat(tmp_path / "garden", normalized="true"))
    assert "scene" not in found.options
    assert "--no-normalize-world-space" in found.notes[0]


def test_a_scene_of_splatax_comes_first(tmp_path):
    run = inria(tmp_path / "garden")
    sx.save(run / "scene.ply", random_gaussians(n=3))
    assert scene_at(run).path == run / "scene.ply"


def test_a_folder_of_no_run_is_refused_with_what_was_looked_for(tmp_path):
    with pytest.raises(InputError, match=r"no scene.ply.*point_cloud/iteration_\*.*ckpts/ckpt_\*.pt"):
        scene_at(tmp_path)
