"""Scenes of parts in .glb files: names, places and visibility come back, and other readers see the same."""

import json
import struct
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.io.scenes import load_variants
from splatax.scene import ColorMap, Option, chosen
from splatax.transforms import Similarity

BODY, WHEEL = random_gaussians(0, n=50, degree=2), random_gaussians(1, n=30, degree=1)
AWAY = Similarity.of(degrees=(20.0, -50.0, 130.0), scale=0.6, move=(0.5, -0.3, 0.4))
BACK = Similarity.of(degrees=(0.0, 90.0, 0.0), move=(-0.5, 0.2, 0.0))
SCENE = sx.Scene(
    {
        "body": sx.Part(BODY),
        "front wheel": sx.Part(WHEEL, AWAY),
        "rear wheel": sx.Part(WHEEL, BACK),
        "roof": sx.Part(BODY, BACK, visible=False),
    }
)
CAMERA = camera_at((0.4, -0.5, -4.0))


def gltf_of(path) -> dict:
    contents = path.read_bytes()
    return json.loads(contents[20 : 20 + struct.unpack_from("<I", contents, 12)[0]])


def changed(path, change, to=None) -> None:
    """Rewrites the JSON of a .glb file."""
    contents, gltf = path.read_bytes(), gltf_of(path)
    rest = contents[20 + struct.unpack_from("<I", contents, 12)[0] :]
    change(gltf)
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    (to or path).write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text + rest)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "car.glb"
    sx.save_scene(path, SCENE)
    return path


def test_names_places_and_visibility_come_back(file):
    back = sx.load_scene(file)
    assert back.names == SCENE.names
    for name, part in SCENE.parts.items():
        assert back[name].visible == part.visible
        assert_allclose(back[name].pose.rotation, part.pose.rotation, atol=1e-7)
        assert_allclose(back[name].pose.translation, part.pose.translation, atol=1e-12)
        assert back[name].pose.scale == pytest.approx(part.pose.scale)
        assert_allclose(back[name].gaussians.means, part.gaussians.means, atol=1e-7)
    assert_allclose(sx.render(back, CAMERA).rgb, sx.render(SCENE, CAMERA).rgb, atol=1e-3)


def test_a_reader_without_parts_sees_the_visible_ones(file):
    flat = sx.load(file)
    assert len(flat) == 50 + 2 * 30
    assert_allclose(sx.render(flat, CAMERA).rgb, sx.render(SCENE, CAMERA).rgb, atol=2e-3)


def test_parts_that_share_gaussians_share_them_in_the_file_too(file):
    gltf = gltf_of(file)
    assert len(gltf["meshes"]) == 2
    assert gltf["extensionsUsed"] == ["KHR_gaussian_splatting", "KHR_node_visibility"]
    back = sx.load_scene(file)
    assert back["front wheel"].gaussians is back["rear wheel"].gaussians


def test_a_child_is_placed_and_hidden_by_its_parents(file, tmp_path):
    def nested(gltf):
        above = {"children": [1, 2], "translation": [1, 2, 3]}
        gltf["nodes"].append(above | {"extensions": {"KHR_node_visibility": {"visible": False}}})
        gltf["nodes"][2]["name"] = gltf["nodes"][1]["name"]
        gltf["scenes"][0]["nodes"] = [0, 4, 3]

    path = tmp_path / "tree.glb"
    changed(file, nested, to=path)
    back = sx.load_scene(path)
    assert back.names == ("body", "front wheel", "front wheel 2", "roof")
    assert [part.visible for part in back.parts.values()] == [1, 0, 0, 0]
    moved = np.asarray(AWAY.translation) + [-1, -2, 3]  # glTF is left-up-forward
    assert_allclose(back["front wheel"].pose.translation, moved, atol=1e-12)


RED = ColorMap.dye((0.9, 0.2, 0.1))
VARIANTS = {
    "paint": {"red": Option(colors={"body": RED}), "plain": Option()},
    "wheels": {"rear": Option(("rear wheel",)), "all": Option(("rear wheel", "front wheel"))},
}


def test_maps_of_colour_are_applied_in_the_file_and_come_back(tmp_path):
    colored = SCENE.colored({"body": RED})
    sx.save_scene(tmp_path / "red.glb", colored)
    back = sx.load_scene(tmp_path / "red.glb")
    assert_allclose(back["body"].color.matrix, RED.matrix, atol=1e-7)
    assert_allclose(back["body"].gaussians.sh, BODY.sh, atol=1e-6)
    for scene in (back, sx.load(tmp_path / "red.glb")):
        assert_allclose(sx.render(scene, CAMERA).rgb, sx.render(colored, CAMERA).rgb, atol=2e-3)


def test_variants_come_back_and_the_file_shows_the_first_options(tmp_path):
    path = tmp_path / "car.glb"
    sx.save_scene(path, SCENE, variants=VARIANTS)
    shown = sx.load_scene(path)
    assert [part.visible for part in shown.parts.values()] == [1, 0, 1, 0]
    back, variants = load_variants(path)
    assert back.names == SCENE.names
    assert [part.visible for part in back.parts.values()] == [1, 1, 1, 0]
    assert {name: list(options) for name, options in variants.items()} == {
        name: list(options) for name, options in VARIANTS.items()
    }
    assert variants["wheels"] == VARIANTS["wheels"]
    assert_allclose(variants["paint"]["red"].colors["body"].matrix, RED.matrix, atol=1e-7)
    for choice in ({}, {"paint": "plain"}, {"wheels": "all"}, {"paint": "plain", "wheels": "all"}):
        expected = sx.render(chosen(SCENE, VARIANTS, choice), CAMERA).rgb
        assert_allclose(sx.render(chosen(back, variants, choice), CAMERA).rgb, expected, atol=2e-3)
    for scene in (shown, sx.load(path)):
        assert_allclose(
            sx.render(scene, CAMERA).rgb, sx.render(chosen(SCENE, VARIANTS), CAMERA).rgb, atol=2e-3
        )


def test_a_file_whose_extras_another_program_has_dropped_keeps_the_colours_that_it_shows(tmp_path):
    sx.save_scene(tmp_path / "red.glb", SCENE.colored({"body": RED}))
    changed(tmp_path / "red.glb", lambda gltf: [node.pop("extras", None) for node in gltf["nodes"]])
    back, variants = load_variants(tmp_path / "red.glb")
    assert not variants
    assert back["body"].color is None
    assert_allclose(
        sx.render(back, CAMERA).rgb, sx.render(SCENE.colored({"body": RED}), CAMERA).rgb, atol=2e-3
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda gltf: gltf["nodes"][0]["extras"]["splatax"].update(color=[1, 2]),
        lambda gltf: gltf["scenes"][0]["extras"]["splatax"]["variants"][1]["options"][0].update(
            shows=["door"]
        ),
        lambda gltf: gltf["scenes"][0]["extras"]["splatax"].update(variants=[{"name": "paint"}]),
    ],
)
def test_variants_that_cannot_be_are_refused_with_the_file(tmp_path, change):
    sx.save_scene(tmp_path / "car.glb", SCENE, variants=VARIANTS)
    changed(tmp_path / "car.glb", change)
    with pytest.raises(sx.FormatError, match=r"car\.glb"):
        load_variants(tmp_path / "car.glb")


def test_filter_and_order_come_back_and_two_filters_are_refused(tmp_path):
    smooth = sx.Part(replace(WHEEL, low_pass=sx.Antialiasing(), order="distance"))
    path = tmp_path / "smooth.glb"
    sx.save_scene(path, sx.Scene({"wheel": smooth}))
    assert sx.load_scene(path)["wheel"].gaussians.low_pass == sx.Antialiasing()
    assert sx.load_scene(path)["wheel"].gaussians.order == "distance"
    for order, method in (("distance", b"cameraDistance"), ("depth", b"zDepth")):
        sx.save(path, replace(WHEEL, order=order))
        assert b'"sortingMethod":"' + method in path.read_bytes()
    mixed = {"wheel": sx.Part(replace(WHEEL, order="distance")), "body": sx.Part(BODY)}
    sx.save_scene(path, sx.Scene(mixed))
    assert path.read_bytes().count(b"zDepth") == 2
    assert {part.gaussians.order for part in sx.load_scene(path).parts.values()} == {"depth"}
    with pytest.raises(sx.FormatError, match="one low-pass filter"):
        sx.save_scene(path, sx.Scene({"wheel": smooth, "body": sx.Part(BODY)}))


def test_files_that_are_no_scenes_are_refused_with_their_name(tmp_path):
    with pytest.raises(sx.FormatError, match=r"car\.ply: scenes of parts"):
        sx.save_scene(tmp_path / "car.ply", SCENE)
    with pytest.raises(sx.FormatError, match="no such file"):
        sx.load_scene(tmp_path / "car.glb")
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    with pytest.raises(sx.FormatError, match=r"bad\.glb"):
        sx.load_scene(tmp_path / "bad.glb")
    hidden = tmp_path / "hidden.glb"
    sx.save_scene(hidden, sx.Scene({"body": sx.Part(BODY, visible=False)}))
    with pytest.raises(sx.FormatError, match="hidden"):
        sx.load(hidden)
    deep = sx.Part(random_gaussians(n=2, degree=4))
    with pytest.raises(sx.FormatError, match="part 'deep' has degree 4"):
        sx.save_scene(hidden, sx.Scene({"deep": deep}))


def test_empty_slots_and_broken_rows_stay_out(tmp_path):
    logits = WHEEL.opacity_logits.at[0].set(-jnp.inf)
    part = sx.Part(
        sx.Gaussians(WHEEL.means.at[1, 0].set(jnp.nan), WHEEL.quats, WHEEL.log_scales, logits, WHEEL.sh)
    )
    assert sx.save_scene(tmp_path / "some.glb", sx.Scene({"wheel": part})) == 28
    assert len(sx.load_scene(tmp_path / "some.glb")) == 28
