"""`splatax mesh`, from a run to a file."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import captures
import splatax as sx
from splatax.cli import main

REFUSED = 2


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """A capture, and the splat file of a wall behind its points, which all cameras see."""
    folder = tmp_path_factory.mktemp("wall")
    capture = captures.write_capture(folder / "capture", count=5)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-6, 6, 41), np.linspace(-6, 6, 41)))
    n = len(x)
    scene = sx.Gaussians(
        means=jnp.asarray(np.stack([x, y, np.full(n, 5.0)], axis=1), jnp.float32),
        log_scales=jnp.broadcast_to(jnp.log(jnp.array([0.25, 0.25, 1e-3])), (n, 3)),
        quats=jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (n, 4)),
        opacity_logits=jnp.full(n, 4.0),
        sh=jnp.zeros((n, 1, 3)),
    )
    sx.save(folder / "wall.ply", scene)
    return folder / "wall.ply", capture


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    assert end.value.code == REFUSED
    return capsys.readouterr().err


def test_a_wall_becomes_a_mesh_and_a_file_is_not_replaced_unless_told(wall, tmp_path, capsys):
    scene, capture = wall
    out = tmp_path / "new" / "wall.ply"
    command = ["mesh", str(scene), str(out), "--scene", str(capture), "--faces", "300"]
    main(command)
    said = capsys.readouterr().out
    assert "voxels of 0.0" in said
    assert "depth   " in said
    found = trimesh.load(out)
    assert np.abs(found.vertices[:, 2] - 5).max() < 0.05
    assert 0 < len(found.faces) <= 300
    assert f"{len(found.faces):,} faces" in said
    assert "asked for" not in said
    before = out.read_bytes()
    assert "exists" in refused(capsys, *command)
    assert out.read_bytes() == before
    main([*command[:3], "--scene", str(capture), "--voxel", "0.3", "--overwrite"])
    assert out.read_bytes() != before


def test_a_mesh_that_cannot_have_so_few_faces_says_so(wall, tmp_path, capsys, monkeypatch):
    scene, capture = wall
    monkeypatch.setattr("splatax.mesh.extraction.simplified", lambda found, faces: found)
    out = tmp_path / "wall.ply"
    main(["mesh", str(scene), str(out), "--scene", str(capture), "--faces", "4"])
    assert len(trimesh.load(out).faces) > 4
    assert "more than the 4 faces asked for" in capsys.readouterr().out


def test_a_collision_mesh_is_small_and_has_a_volume(wall, tmp_path):
    scene, capture = wall
    out = tmp_path / "hull.obj"
    main(["mesh", str(scene), str(out), "--scene", str(capture), "--collision", "--faces", "500"])
    found = trimesh.load(out, force="mesh")
    assert len(found.faces) <= 500
    assert found.volume > 0
    assert np.isfinite(found.vertices).all()


def test_mistakes_are_refused_before_anything_is_rendered(wall, tmp_path, capsys):
    lonely, _ = wall
    assert "no format of meshes. Write .ply" in refused(capsys, "mesh", lonely, tmp_path / "scene.stl")
    out = tmp_path / "scene.ply"
    assert "must be above 0, not -1.0. See --voxel." in refused(capsys, "mesh", lonely, out, "--voxel", "-1")
    assert "See --faces." in refused(capsys, "mesh", lonely, out, "--faces", "2")
    assert "--scene CAPTURE" in refused(capsys, "mesh", lonely, out)
    assert not out.exists()
