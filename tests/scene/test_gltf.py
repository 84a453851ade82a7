"""Bodies and rigged scenes in .glb files: values that other programs compute, and damaged files."""

import json
import struct
import time
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatax as sx
from scene.skeletons import arm, bent, blended
from scenes import random_gaussians
from splatax.demo.rigged import drawn_arm, moves_of
from splatax.io.formats.glb_scene import Glb
from splatax.io.rigs import load_animated, load_rigged, read_body, save_animated, save_rigged
from splatax.io.rigs.following import check_following
from splatax.io.rigs.nodes import _moving_nodes
from splatax.io.rigs.poses import Posing, read_poses, write_poses
from splatax.io.rigs.writing import joints_attributes, save_body
from splatax.io.scenes import load_variants
from splatax.scene.binding import bind, covering
from splatax.scene.clips import Channel, Clip
from splatax.scene.colors import ColorMap
from splatax.scene.rigged import AnimatedScene, RiggedScene
from splatax.transforms import Similarity

TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # glTF's world to ours


def json_of(path) -> dict:
    contents = path.read_bytes()
    return json.loads(contents[20 : 20 + struct.unpack("<I", contents[12:16])[0]])


def changed(path, change) -> None:
    """Rewrites the JSON of a .glb file."""
    contents = path.read_bytes()
    length = struct.unpack("<I", contents[12:16])[0]
    gltf = json_of(path)
    change(gltf)
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    rest = contents[20 + length :]
    head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
    path.write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text + rest)


def worlds_by_hand(gltf) -> np.ndarray:
    """World transforms of all nodes, from the JSON alone."""
    nodes, worlds = gltf["nodes"], {}
    parents = {child: i for i, node in enumerate(nodes) for child in node.get("children", ())}

    def world(i):
        local = np.eye(4)
        local[:3, :3] = Rotation.from_quat(nodes[i].get("rotation", [0, 0, 0, 1])).as_matrix()
        local[:3, :3] *= np.array(nodes[i].get("scale", [1, 1, 1]))
        local[:3, 3] = nodes[i].get("translation", [0, 0, 0])
        if i not in worlds:
            worlds[i] = world(parents[i]) @ local if i in parents else local
        return worlds[i]

    return np.stack([world(i) for i in range(len(nodes))])


@pytest.fixture
def body_file(tmp_path):
    save_body(tmp_path / "body.glb", drawn_arm())
    return tmp_path / "body.glb"


@pytest.fixture
def rigged_file(tmp_path):
    body = drawn_arm()
    save_rigged(tmp_path / "rigged.glb", RiggedScene(*covering(body, 50), body.clips))
    return tmp_path / "rigged.glb"


def test_joints_are_where_the_nodes_of_the_file_are(body_file):
    skeleton = read_body(body_file).skeleton
    by_hand = TURN @ worlds_by_hand(json_of(body_file))[: len(skeleton)]
    np.testing.assert_allclose(skeleton.worlds(skeleton.rest), by_hand, atol=1e-6)


def test_a_body_comes_back_as_it_was_saved(body_file):
    body, again = drawn_arm(), read_body(body_file)
    assert again.skeleton.names == body.skeleton.names
    assert again.skeleton.parents == body.skeleton.parents
    np.testing.assert_allclose(again.surface.vertices, body.surface.vertices, atol=1e-6)
    np.testing.assert_array_equal(again.surface.triangles, body.surface.triangles)
    pose, other = (b.clips["Wave"].pose(b.skeleton.rest, 0.7) for b in (body, again))
    np.testing.assert_allclose(other.quats, pose.quats, atol=1e-6)
    posed = again.surface.posed(moves_of(again, other))
    np.testing.assert_allclose(posed, body.surface.posed(moves_of(body, pose)), atol=1e-5)


def test_a_body_keeps_the_colors_of_its_vertices(tmp_path):
    body = drawn_arm()
    colors = np.random.default_rng(0).uniform(size=body.surface.colors.shape)
    save_body(tmp_path / "body.glb", replace(body, surface=replace(body.surface, colors=colors)))
    np.testing.assert_allclose(read_body(tmp_path / "body.glb").surface.colors, colors, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("turned", [True, False], ids=["the frame of glTF", "a frame of its own"])
def test_a_rigged_scene_moves_alike_after_saving_and_loading(tmp_path, turned):
    gaussians, rig = blended(n=20, degree=1)
    if turned:
        body = drawn_arm()
        gaussians, rig = covering(body, 60, sh_degree=1)
    save_rigged(tmp_path / "a.glb", RiggedScene(gaussians, rig))
    again = load_rigged(tmp_path / "a.glb")
    bends = {name: jnp.array([0.1, 0.5, -0.3]) for name in rig.skeleton.names}
    expected = RiggedScene(gaussians, rig).posed(rig.skeleton.turned(bends))
    found = again.posed(again.rig.skeleton.turned(bends))
    np.testing.assert_allclose(found.means, expected.means, atol=2e-5)
    np.testing.assert_allclose(found.covariances, expected.covariances, atol=1e-5)
    np.testing.assert_allclose(found.sh, expected.sh, atol=1e-5)


def test_parts_beside_a_skinned_one_come_back_and_leave_its_skeleton_alone(tmp_path):
    body = drawn_arm()
    scene = RiggedScene(*covering(body, 60, sh_degree=1), body.clips)
    wheel, table = random_gaussians(1, n=9, degree=2), random_gaussians(2, n=5, degree=0)
    away = Similarity.of(degrees=(20.0, -50.0, 130.0), scale=0.6, move=(0.5, -0.3, 0.4))
    tint = ColorMap.tint((1.0, 0.5, 0.2))
    parts = {
        "wheel": sx.Part(wheel, away, color=tint),
        "spare wheel": sx.Part(wheel, visible=False),
        "table": sx.Part(table),
    }
    save_rigged(tmp_path / "a.glb", scene, name="arm", beside=sx.Scene(parts))
    found = sx.load_scene(tmp_path / "a.glb")
    assert found.names == ("arm", "wheel", "spare wheel", "table")
    np.testing.assert_allclose(found["arm"].gaussians.means, scene.gaussians.means, atol=1e-6)
    for name, part in parts.items():
        again = found[name]
        assert bool(again.visible) == bool(part.visible)
        np.testing.assert_allclose(again.gaussians.means, part.gaussians.means, atol=1e-6)
        np.testing.assert_allclose(again.gaussians.sh, part.gaussians.sh, atol=1e-5)
        np.testing.assert_allclose(again.pose.rotation, part.pose.rotation, atol=1e-6)
        np.testing.assert_allclose(again.pose.translation, part.pose.translation, atol=1e-6)
    np.testing.assert_allclose(found["wheel"].color.matrix, tint.matrix, atol=1e-6)

    rigged = load_rigged(tmp_path / "a.glb")
    assert rigged.rig.skeleton.names == scene.rig.skeleton.names
    assert rigged.clips.keys() == scene.clips.keys()
    (clip,) = scene.clips
    np.testing.assert_allclose(rigged.at(clip, 0.3).means, scene.at(clip, 0.3).means, atol=2e-5)
    with pytest.raises(sx.FormatError, match="two parts are called 'table'"):
        save_rigged(tmp_path / "b.glb", scene, name="table", beside=sx.Scene(parts))
    other = replace(table, low_pass=sx.Antialiasing(0.3))
    with pytest.raises(sx.FormatError, match="different ones"):
        save_rigged(tmp_path / "b.glb", scene, beside=sx.Scene({"table": sx.Part(other)}))


def moving_arms() -> AnimatedScene:
    """Two parts that follow one skeleton, of one pose, and a wheel that shares the Gaussians of neither."""
    body, place = drawn_arm(), Similarity.of(degrees=(10.0, 80.0, -30.0), scale=1.4, move=(0.3, -0.2, 1.0))
    skin, rig = covering(body, 60, sh_degree=1)
    sleeve, other = covering(body, 40, sh_degree=1, seed=1)
    parts = {
        "wheel": sx.Part(random_gaussians(1, n=9, degree=1), Similarity.of(move=(1.0, 0.0, 0.0))),
        "arm": sx.Part(skin, place, color=ColorMap.tint((1.0, 0.5, 0.2))),
        "sleeve": sx.Part(sleeve, place, visible=False),
    }
    return AnimatedScene(
        sx.Scene(parts), {"arm": rig, "sleeve": replace(other, skeleton=rig.skeleton)}, body.clips
    )


@pytest.mark.slow
def test_parts_skins_and_clips_come_back_together_from_one_reader(tmp_path):
    animated, path = moving_arms(), tmp_path / "a.glb"
    blue = sx.scene.Option(colors={"arm": ColorMap.dye((0.0, 0.0, 1.0))})
    variants = {"paint": {"plain": sx.scene.Option(), "blue": blue}}
    save_animated(path, animated, variants=variants)
    again = load_animated(path)
    assert again.scene.names == ("wheel", "arm", "sleeve")
    assert again.rigs.keys() == {"arm", "sleeve"}
    assert again.clips.keys() == {"Wave"}
    assert [bool(part.visible) for part in again.scene.parts.values()] == [True, True, False]
    for at in (0.0, 0.3, 1.1):
        expected, found = animated.at("Wave", at), again.at("Wave", at)
        for name in expected.names:  # the pose of skinned parts is in their Gaussians and the skeleton now
            a, b = expected[name].in_world(), found[name].in_world()
            np.testing.assert_allclose(b.means, a.means, atol=3e-5)
            np.testing.assert_allclose(b.covariances, a.covariances, atol=2e-5)
            np.testing.assert_allclose(b.sh, a.sh, atol=2e-5)
    _, listed = load_variants(path)
    assert listed["paint"].keys() == {"plain", "blue"}
    assert list(listed["paint"]["blue"].colors) == ["arm"]


def test_a_file_without_skins_is_parts_that_stay(tmp_path):
    sx.save_scene(tmp_path / "a.glb", sx.Scene({"wheel": sx.Part(random_gaussians(n=5))}))
    still = load_animated(tmp_path / "a.glb")
    assert still.scene.names == ("wheel",)
    assert (still.rigs, still.clips) == ({}, {})
    with pytest.raises(ValueError, match="no part follows a skeleton: wheel stay"):
        still.posed(arm().rest)


def test_skins_that_do_not_fit_together_are_refused(tmp_path):
    animated = moving_arms()
    apart = animated.scene.posed({"sleeve": Similarity.of()})
    with pytest.raises(sx.FormatError, match=r"different poses\. Give arm, sleeve one pose"):
        save_animated(tmp_path / "a.glb", replace(animated, scene=apart))
    with pytest.raises(sx.FormatError, match="no part follows a skeleton"):
        save_animated(tmp_path / "a.glb", replace(animated, rigs={}))
    with pytest.raises(ValueError, match="part 'wheel' has 9 Gaussians, and its rig 60"):
        replace(animated, rigs={"wheel": animated.rigs["arm"]})
    _, other = blended(n=9)
    other = replace(
        other, skeleton=replace(other.skeleton, names=("root", "knee", "foot")[: len(other.skeleton)])
    )
    with pytest.raises(ValueError, match="part 'wheel' follows another skeleton than 'arm'"):
        replace(animated, rigs={"arm": animated.rigs["arm"], "wheel": other})
    save_animated(tmp_path / "two.glb", animated)
    with pytest.raises(sx.FormatError, match="2 meshes of splats with a skin, where one is needed"):
        load_rigged(tmp_path / "two.glb")


def test_a_rigged_file_is_also_a_splat_file_in_the_bound_pose(rigged_file):
    flat, rigged = sx.load(rigged_file), load_rigged(rigged_file).gaussians
    np.testing.assert_array_equal(flat.means, rigged.means)


def test_a_rigged_file_keeps_how_its_scene_is_drawn_and_leaves_out_broken_gaussians(tmp_path):
    gaussians, rig = blended(n=6)
    logits = gaussians.opacity_logits.at[2].set(-jnp.inf)
    broken = replace(
        gaussians,
        means=gaussians.means.at[4].set(jnp.nan),
        opacity_logits=logits,
        low_pass=sx.Antialiasing(),
        order="distance",
    )
    with pytest.warns(UserWarning, match="left out 1 Gaussians"):
        save_rigged(tmp_path / "a.glb", RiggedScene(broken, rig))
    again, kept = load_rigged(tmp_path / "a.glb"), np.array([0, 1, 3, 5])
    assert again.gaussians.low_pass == sx.Antialiasing()
    assert sx.load(tmp_path / "a.glb").low_pass == sx.Antialiasing()
    assert again.gaussians.order == sx.load(tmp_path / "a.glb").order == "distance"
    np.testing.assert_array_equal(again.gaussians.means, gaussians.means[kept])
    np.testing.assert_allclose(
        np.max(again.rig.weights, axis=1), np.max(rig.weights[kept], axis=1), atol=1e-6
    )


def test_nodes_with_meshes_move_rigidly(body_file):
    def without_skin(gltf):
        del gltf["skins"], gltf["nodes"][3]["skin"]
        gltf["nodes"][2]["children"] = [3]
        gltf["scenes"][0]["nodes"] = [0]

    rigid = body_file.with_name("rigid.glb")
    rigid.write_bytes(body_file.read_bytes())
    changed(rigid, without_skin)
    body = read_body(rigid)
    own = body.skeleton.index("skinned")
    assert (body.surface.weights[:, 0] == 1).all()
    assert (body.surface.indices[:, 0] == own).all()
    place = TURN @ worlds_by_hand(json_of(rigid))[3]
    vertices = read_body(body_file).surface.vertices @ TURN[:3, :3]  # as the file has them
    np.testing.assert_allclose(body.surface.vertices, vertices @ place[:3, :3].T + place[:3, 3], atol=1e-5)


def test_the_robot_stands_where_its_file_says(data):
    path = data / "rigs" / "RobotExpressive.glb"
    if not path.exists():
        pytest.skip("no robot")
    body = read_body(path)
    assert len(body.clips) == 14
    by_hand = worlds_by_hand(json_of(path))
    nodes = {node.get("name"): i for i, node in enumerate(json_of(path)["nodes"])}
    for name in ("Head", "Palm1L", "FootR", "HandR_1"):
        if name in body.skeleton.names:
            found = np.asarray(body.skeleton.worlds(body.skeleton.rest))[body.skeleton.index(name)]
            np.testing.assert_allclose(found, TURN @ by_hand[nodes[name]], atol=2e-4)


def test_a_scan_follows_the_nearest_surface(body_file):
    body = read_body(body_file)
    gaussians, exact = covering(body, 200, seed=5)
    rig = bind(gaussians, body)
    dense = np.zeros((2, 200, 3))
    for row, other in zip(dense, (rig, exact), strict=True):
        np.add.at(row, (np.arange(200)[:, None], np.asarray(other.indices)), np.asarray(other.weights))
    assert np.abs(dense[0] - dense[1]).max() < 0.05
    holed = bind(replace(gaussians, means=gaussians.means.at[3].set(jnp.nan)), body)
    np.testing.assert_array_equal(holed.indices[4:], rig.indices[4:])
    away = replace(gaussians, means=gaussians.means + 5)
    with pytest.raises(sx.InputError, match="do not fit together"):
        bind(away, body)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda g: g["animations"][0]["samplers"][0].update(interpolation="SINE"),
            "clip Wave moves a rotation",
        ),
        (lambda g: g["accessors"][g["skins"][0]["inverseBindMatrices"]].update(count=2), "inverse bind"),
        (lambda g: g["nodes"][1].update(children=[0]), "circle"),
        (lambda g: g["nodes"][0].update(scale=[0, 1, 1]), "sheared, mirrored or scaled to zero"),
        (lambda g: (g.pop("skins"), g["nodes"].pop()), "nothing in it can move"),
        (lambda g: g["accessors"][0].update(count=10**6), "truncated"),
        (lambda g: g["nodes"].extend([{"mesh": 0}] * 50_000), "its nodes ask for .* vertices, far more"),
    ],
)
def test_files_that_cannot_be_right_are_refused_by_name(body_file, change, message):
    changed(body_file, change)
    with pytest.raises(sx.FormatError, match=message) as caught:
        read_body(body_file)
    assert str(body_file) in str(caught.value)


def test_a_clip_with_a_rotation_of_zeros_is_refused(tmp_path):
    still = Channel(0, "rotation", np.array([0.0, 1.0]), np.zeros((2, 1, 4)), "LINEAR")
    save_body(tmp_path / "body.glb", replace(drawn_arm(), clips={"Wave": Clip("Wave", (still,))}))
    with pytest.raises(sx.FormatError, match="clip Wave has a rotation of zeros"):
        read_body(tmp_path / "body.glb")


def test_a_clip_that_would_last_for_years_is_refused(tmp_path):
    turns = np.tile([1.0, 0, 0, 0], (2, 1, 1))
    endless = Channel(0, "rotation", np.array([0.0, 1e30]), turns, "LINEAR")
    save_body(tmp_path / "body.glb", replace(drawn_arm(), clips={"Wave": Clip("Wave", (endless,))}))
    with pytest.raises(sx.FormatError, match=r"clip Wave has times from 0 to 1e\+30 seconds"):
        read_body(tmp_path / "body.glb")


def signed(gltf) -> None:
    """Stores joints as signed bytes, so that 255 is -1."""
    joints = gltf["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"]
    gltf["accessors"][joints]["componentType"] = 5120


def test_joints_and_weights_that_cannot_be_are_refused(tmp_path):
    body, path = drawn_arm(), tmp_path / "body.glb"
    surface, negative = body.surface, body.surface.indices.copy()
    negative[0, 0] = -1
    save_body(path, replace(body, surface=replace(surface, indices=negative)))
    changed(path, signed)
    with pytest.raises(sx.FormatError, match="joints that its skin does not have, whose joints are 0 to 2"):
        read_body(path)
    weights = np.where(np.arange(len(surface.weights))[:, None] == 3, [1.5, -0.5], surface.weights)
    with pytest.raises(sx.FormatError, match="weights are negative or not finite"):
        check_following(path, surface.indices.astype(float), weights, 3)


def test_a_joint_that_occurs_twice_is_stored_once_with_the_sum_of_its_weights():
    indices = np.array([[2, 1, 2, 0], [1, 1, 1, 1]])
    weights = np.array([[0.2, 0.3, 0.5, 0.0], [0.25, 0.25, 0.25, 0.25]])
    stored = joints_attributes(indices, weights, 3)
    np.testing.assert_array_equal(stored["JOINTS_0"], [[2, 1, 0, 0], [1, 0, 0, 0]])
    np.testing.assert_allclose(stored["WEIGHTS_0"], [[0.7, 0.3, 0, 0], [1, 0, 0, 0]], atol=1e-7)


def test_splats_that_follow_negative_joints_are_refused(tmp_path):
    gaussians, rig = covering(drawn_arm(), 20)
    negative = replace(rig, indices=rig.indices.at[0, 0].set(-1))
    save_rigged(tmp_path / "a.glb", RiggedScene(gaussians, negative))
    changed(tmp_path / "a.glb", signed)
    with pytest.raises(sx.FormatError, match="joints that its skin does not have"):
        load_rigged(tmp_path / "a.glb")


def test_many_nodes_of_one_name_in_one_long_chain_are_read_in_linear_time():
    count = 20_000
    nodes = [{"name": "bone", "mesh": 0, "children": [i + 1]} for i in range(count)]
    nodes[-1]["children"] = []
    began = time.process_time()
    found = _moving_nodes(Glb(Path("chain.glb"), {"nodes": nodes}, b""))
    assert time.process_time() - began < 5  # each of the quadratic searches took longer than that
    assert found.parents == list(range(-1, count - 1))
    assert len(set(found.names)) == count


def test_names_stay_unique_when_one_looks_like_a_numbered_one():
    nodes = [{"name": "a", "mesh": 0}, {"name": "a (2)", "mesh": 0}, {"name": "a", "mesh": 0}]
    assert len(set(_moving_nodes(Glb(Path("a.glb"), {"nodes": nodes}, b"")).names)) == 3


def test_splats_without_a_skin_are_refused(tmp_path):
    gaussians, _ = blended(n=5)
    sx.save(tmp_path / "plain.glb", gaussians)
    with pytest.raises(sx.FormatError, match=r"plain\.glb: 0 meshes of splats with a skin"):
        load_rigged(tmp_path / "plain.glb")


def test_poses_come_back_from_their_file(tmp_path):
    skeleton = arm()
    posing = Posing({"a": bent(skeleton), "b": skeleton.rest}, {"0.png": "a", "1.png": "b"})
    write_poses(tmp_path / "poses.json", posing, skeleton)
    again = read_poses(tmp_path / "poses.json", skeleton, {})
    assert again.pose_of == posing.pose_of
    for name, pose in posing.poses.items():
        np.testing.assert_allclose(skeleton.worlds(again.poses[name]), skeleton.worlds(pose), atol=1e-6)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ({"poses": {}}, "needs"),
        ({"poses": {"a": {"rotations": {"tail": [0, 0, 0, 1]}}}, "photos": {}}, "tail, which is no joint"),
        ({"poses": {"a": {"rotations": {"bone 0": [0, 0, 0, 0]}}}, "photos": {}}, "not all zero"),
        ({"poses": {"a": {"clip": "Jump"}}, "photos": {}}, "clip Jump"),
        ({"poses": {}, "photos": {"0.png": "a"}}, "has the pose a, which is not in it"),
        ({"poses": {"a": {"clip": ["Wave"]}}, "photos": {}}, "not a valid poses file"),
        ({"poses": {"a": {"rotations": [0, 0, 0, 1]}}, "photos": {}}, "not a valid poses file"),
        ({"poses": {"a": {"rotations": {"bone 0": "up"}}}, "photos": {}}, "not a valid poses file"),
        (
            {"poses": {"a": {"rotation": {"bone 0": [0, 0, 0, 1]}}}, "photos": {}},
            "has rotation, which is not",
        ),
    ],
)
def test_poses_that_cannot_be_are_refused(tmp_path, written, message):
    (tmp_path / "poses.json").write_text(json.dumps(written))
    with pytest.raises(sx.FormatError, match=message):
        read_poses(tmp_path / "poses.json", arm(), {})


@pytest.mark.parametrize("time", [float("nan"), float("inf"), "soon", True])
def test_a_pose_at_a_time_that_is_no_number_is_refused(tmp_path, time):
    body = drawn_arm()
    written = {"poses": {"a": {"clip": "Wave", "time": time}}, "photos": {}}
    (tmp_path / "poses.json").write_text(json.dumps(written))
    with pytest.raises(sx.FormatError, match=r"time of the pose a is .*, not a number of seconds"):
        read_poses(tmp_path / "poses.json", body.skeleton, body.clips)
