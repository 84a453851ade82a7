"""`splatax mesh`, from a run to a file."""

import numpy as np
import pytest
import trimesh

from splatax.cli import main

REFUSED = 2


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
