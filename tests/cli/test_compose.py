"""`splatax compose`: a .toml file of parts becomes a page or a .glb file."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import cli, web
from splatax.demo.rigged import drawn_arm
from splatax.io import formats
from splatax.io.formats import glb_scene
from splatax.io.rigs import load_animated, save_rigged
from splatax.scene import RiggedScene, chosen
from splatax.scene.binding import covering
from splatax.web import composition, page

CAR = """
title = "Car & more"
background = "white"
[parts.body]
file = "body.ply"
[parts.front]
file = "wheel.ply"
degrees = [0, 90, 0]
scale = 0.5
move = [1, 0, 0.2]
[parts.rear]
file = "wheel.ply"
move = [-1, 0, 0.2]
tint = [1, 0.5, 0.5]
[variants.paint.plain]
[variants.paint.red]
dye.body = [0.9, 0.1, 0.1]
[variants.drive.front]
show = ["front"]
[variants.drive.all]
show = ["front", "rear"]
matrix.front = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
offset.front = [0.1, 0, 0]
[[hotspots]]
at = [1, 0, 0.2]
text = "Front"
part = "front"
[start]
position = [0, -1, -5]
target = [0, 0, 0]
[path]
file = "keyframes.json"
seconds = 5
[embed]
autoplay = true
"""
KEYS = [
    {"position": [x, 0, -4], "wxyz": [1, 0, 0, 0], "fov": 40} for x in (-1, 0, 1)
]  # three views from the front


def page_of(path) -> dict:
    """What a page is told about its scene."""
    return json.loads(re.search(r'id="page">(.*?)</script>', path.read_text())[1])


@pytest.fixture
def car(tmp_path, monkeypatch):
    for name, seed in (("body", 0), ("wheel", 1)):
        sx.save(tmp_path / f"{name}.ply", random_gaussians(seed, n=40, degree=1))
    (tmp_path / "keyframes.json").write_text(json.dumps({"keyframes": KEYS}))
    (tmp_path / "viewer.js").write_text("")
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    path = tmp_path / "car.toml"
    path.write_text(CAR)
    return path


def test_parts_are_placed_and_share_their_files(car):
    found = web.compose(car)
    assert found.title == "Car & more"
    assert found.background == (1, 1, 1)
    assert found.scene.names == ("body", "front", "rear")
    assert found.scene["front"].gaussians is found.scene["rear"].gaussians
    assert_allclose(found.scene["front"].pose.translation, [1, 0, 0.2])
    assert found.scene["front"].pose.scale == 0.5
    assert_allclose(found.scene["rear"].color.matrix, np.diag([1, 0.5, 0.5]))


def test_the_first_options_are_chosen_at_first_and_others_on_request(car):
    found = web.compose(car)
    assert [part.visible for part in found.at_first.parts.values()] == [1, 1, 0]
    variants = found.presentation.variants
    other = chosen(found.scene, variants, {"drive": "all", "paint": "red"})
    assert other["rear"].visible == 1
    assert_allclose(other["front"].color.matrix @ [0.1, 0.2, 0.3], [0.2, 0.3, 0.1], rtol=1e-6)
    assert_allclose(other["body"].color.matrix @ [1, 1, 1], [0.9, 0.1, 0.1], rtol=1e-5)
    with pytest.raises(ValueError, match="no option 'blue': choose from plain, red"):
        chosen(found.scene, variants, {"paint": "blue"})
    with pytest.raises(ValueError, match="no variant 'roof': choose from paint, drive"):
        chosen(found.scene, variants, {"roof": "open"})


def test_a_glb_file_keeps_the_parts_of_the_first_options(car, tmp_path, capsys):
    cli.main(["compose", str(car), "--out", str(tmp_path / "car.glb")])
    told = capsys.readouterr().out
    assert "3 parts, 120 Gaussians, 4 options of 2 variants" in told
    assert f"loses: {formats.FORMATS['.glb'].LOSES}" in told
    back, found = sx.load_scene(tmp_path / "car.glb"), web.compose(car).at_first
    camera = camera_at()
    assert_allclose(sx.render(back, camera).rgb, sx.render(found, camera).rgb, atol=1e-3)


def test_a_page_of_a_glb_file_offers_the_variants_in_it(car, tmp_path):
    cli.main(["compose", str(car), "--out", str(tmp_path / "car.glb")])
    cli.main(["compose", str(tmp_path / "car.glb"), "--out", str(tmp_path / "again.html")])
    told = page_of(tmp_path / "again.html")
    assert [[option["name"] for option in variant["options"]] for variant in told["variants"]] == [
        ["plain", "red"],
        ["front", "all"],
    ]
    assert told["variants"][1]["options"][1]["shows"] == [1, 2]


def test_a_page_is_told_everything(car, tmp_path):
    cli.main(["compose", str(car), "--out", str(tmp_path / "new" / "car.html")])
    assert "<h1>Car &amp; more</h1>" in (tmp_path / "new" / "car.html").read_text()
    told = page_of(tmp_path / "new" / "car.html")
    assert [variant["name"] for variant in told["variants"]] == ["paint", "drive"]
    assert told["variants"][1]["options"][1]["shows"] == [1, 2]
    assert [spot["text"] for spot in told["hotspots"]] == ["Front"]
    assert told["seconds"] == 5
    assert told["autoplay"] is True
    assert len(told["path"]) == 60
    first, last = (np.array(told["path"][i]["position"]) for i in (0, -1))
    assert_allclose(last - first, [np.linalg.norm(last - first), 0, 0], atol=1e-4)
    assert_array_equal(told["background"], [1, 1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("move = [1, 0, 0.2]", "moved = [1, 0, 0.2]"), "[parts.front] has 'moved'"),
        (("move = [1, 0, 0.2]", "move = [1, 0]"), "[parts.front] move is [1, 0], not 3 numbers"),
        (("scale = 0.5", "scale = 0"), "[parts.front] scale is 0, not above 0"),
        (('file = "body.ply"', 'file = "hood.ply"'), "hood.ply: no such file"),
        (('file = "body.ply"', ""), "[parts.body] needs 'file', which is missing"),
        (('show = ["front"]', 'show = ["hood"]'), "names part 'hood'"),
        (('part = "front"', 'part = "hood"'), "no part 'hood'"),
        (("tint = [1, 0.5, 0.5]", "tint = [1, 1, 1]\ndye = [1, 1, 1]"), "more than one colour"),
        (('background = "white"', 'background = "sky"'), "background is 'sky', not black, white"),
        (("[start]", "[start"), "not a TOML file"),
        (("seconds = 5", "seconds = nan"), "[path] seconds is nan, not a number"),
        (("seconds = 5", "seconds = 0"), "[path] seconds is 0.0, not a duration above 0"),
        (("target = [0, 0, 0]", "target = [0, -1, -5]"), "lie on a line"),
        (("autoplay = true", "autoplay = 1"), "[embed] autoplay is 1, not true or false"),
        (("autoplay = true", 'buttons = "no"'), "[embed] buttons is 'no', not true or false"),
        (('file = "body.ply"', "file = 3"), "[parts.body] file is 3, not text"),
        (
            ('file = "body.ply"', 'file = "two.glb"\nnode = "hood"'),
            "[parts.body] has node 'hood', and the nodes",
        ),
        (("[parts.body]", '[parts.""]'), "parts has an empty name"),
        (("scale = 0.5", 'scale = "big"'), "[parts.front] scale is 'big', not a number"),
        (("scale = 0.5", "scale = nan"), "[parts.front] scale is nan, not a number"),
        (("scale = 0.5", f"scale = 1{'0' * 400}"), "[parts.front] scale is 1000"),  # more than floats hold
        (("move = [1, 0, 0.2]", "move = [nan, 0, 0]"), "[parts.front] move is [nan, 0, 0], not 3 numbers"),
        (("tint = [1, 0.5, 0.5]", "tint = [-1, 0, 0]"), "no number below 0"),
        (
            ("tint = [1, 0.5, 0.5]", "matrix = [[1, 0, 0]]"),
            "[parts.rear] matrix is [[1, 0, 0]], not three rows",
        ),
        (("tint = [1, 0.5, 0.5]", "offset = [1, 0, 0]"), "[parts.rear] has an offset without a matrix"),
        (
            ("[variants.paint.plain]", '[variants]\nroof = ["open"]'),
            "[variants.roof] is ['open'], not a table",
        ),
        (("dye.body = [0.9, 0.1, 0.1]", "tint = [1, 0, 9]"), "tint names no part: write tint.PART"),
        (('show = ["front"]', "show = [1]"), "show is [1], not a list of names of parts"),
        (('text = "Front"', ""), "[[hotspots]] needs 'text', which is missing"),
        (("[[hotspots]]", "[hotspots]"), "Write [[hotspots]] above each note"),
        (("target = [0, 0, 0]", 'target = [0, 0, 0]\nfov = "wide"'), "[start] fov is 'wide', not a number"),
        (("target = [0, 0, 0]", ""), "[start] needs 'target', which is missing"),
        (('file = "keyframes.json"', "file = 3"), "[path] file is 3, not text"),
        (('file = "keyframes.json"', ""), "[path] needs 'file', which is missing"),
        (('background = "white"', "background = [9, 0, 0]"), "three numbers from 0 to 1"),
    ],
)
def test_what_cannot_be_is_refused_in_one_sentence_with_the_file(car, tmp_path, capsys, change, message):
    assert change[0] in CAR
    car.write_text(CAR.replace(*change))
    sx.save_scene(tmp_path / "two.glb", sx.Scene({"door": sx.Part(random_gaussians(2, n=4))}))
    with pytest.raises(SystemExit) as exit:
        cli.main(["compose", str(car), "--out", str(tmp_path / "car.glb")])
    assert exit.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert "car.toml" in error or "hood.ply" in error
    assert ".." not in error
    assert not (tmp_path / "car.glb").exists()


def test_nodes_of_a_file_are_read_once_and_share_what_they_share_in_it(tmp_path, monkeypatch):
    wheel = random_gaussians(1, n=4)
    scene = sx.Scene({name: sx.Part(wheel) for name in ("left", "right")})
    sx.io.scenes.save_scene(tmp_path / "car.glb", scene)
    path, opened = tmp_path / "car.toml", []
    monkeypatch.setattr(
        composition, "load_scene", lambda file: opened.append(file) or sx.io.scenes.load_scene(file)
    )
    rows = "".join(f'[parts.{name}]\nfile = "car.glb"\nnode = "{name}"\n' for name in scene.names)
    path.write_text('title = "\u8f66"\n' + rows, encoding="utf-8")
    found = web.compose(path)
    assert opened == [tmp_path / "car.glb"]
    assert found.title == "\u8f66"
    assert found.scene["left"].gaussians is found.scene["right"].gaussians


def test_other_suffixes_and_existing_files_are_refused(car, tmp_path, capsys):
    (tmp_path / "car.glb").write_text("mine")
    for name, way_out in (("car.ply", ".html or .glb"), ("car.glb", "--overwrite")):
        with pytest.raises(SystemExit):
            cli.main(["compose", str(car), "--out", str(tmp_path / name)])
        assert way_out in capsys.readouterr().err
    assert (tmp_path / "car.glb").read_text() == "mine"


HAND = """
[parts.arm]
file = "arm.glb"
clip = "Wave"
scale = 0.5
move = [0.2, 0, 0]
[parts.body]
file = "body.ply"
[variants.paint.plain]
[variants.paint.red]
dye.body = [0.9, 0.1, 0.1]
"""


@pytest.fixture
def moving(car):
    """A composition of an arm that plays a clip, and a body with variants."""
    body = drawn_arm()
    save_rigged(car.parent / "arm.glb", RiggedScene(*covering(body, 30), body.clips))
    path = car.parent / "moving.toml"
    path.write_text(HAND)
    return path


def test_a_part_plays_a_clip_on_the_page_beside_parts_that_stay(moving, tmp_path):
    out = tmp_path / "moving.html"
    cli.main(["compose", str(moving), "--out", str(out)])
    motion = page_of(out)["motion"]
    assert (motion["clip"], motion["seconds"]) == ("Wave", 2)
    assert [(part["part"], part["joints"]) for part in motion["parts"]] == [(0, 3)]


def test_a_composition_with_a_clip_keeps_it_in_a_glb_file_which_makes_the_same_page(moving, tmp_path, capsys):
    cli.main(["compose", str(moving), "--out", str(tmp_path / "moving.glb")])
    assert "1 parts that move" in " ".join(capsys.readouterr().out.split())
    again, first = load_animated(tmp_path / "moving.glb"), web.compose(moving)
    assert again.scene.names == ("arm", "body")
    motion = first.motions["arm"]
    rigged = RiggedScene(first.scene["arm"].gaussians, motion.rig, {"Wave": motion.clip})
    expected = first.scene["arm"].pose.transform(rigged.at("Wave", 0.4))
    assert_allclose(again.at("Wave", 0.4)["arm"].gaussians.means, expected.means, atol=3e-5)
    cli.main(["compose", str(tmp_path / "moving.glb"), "--out", str(tmp_path / "again.html")])
    page = page_of(tmp_path / "again.html")
    assert page["motion"]["clip"] == "Wave"
    assert [option["name"] for option in page["variants"][0]["options"]] == ["plain", "red"]


def test_glb_files_are_read_once_also_if_several_parts_play_clips_of_one(moving, tmp_path, monkeypatch):
    cli.main(["compose", str(moving), "--out", str(tmp_path / "moving.glb")])
    moving.write_text(HAND + '[parts.other]\nfile = "arm.glb"\nclip = "Wave"\n')
    read, opened = glb_scene.read, []
    monkeypatch.setattr(glb_scene, "read", lambda path: opened.append(path.name) or read(path))
    assert list(web.compose(moving).motions) == ["arm", "other"]
    assert list(web.compose(tmp_path / "moving.glb").motions) == ["arm"]
    assert opened == ["arm.glb", "moving.glb"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('clip = "Wave"', 'clip = "Jump"'), "has clip 'Jump', and the clips of arm.glb are Wave"),
        (
            ('file = "body.ply"', 'file = "plain.glb"\nclip = "Wave"'),
            "needs one part with a skin; plain.glb has none",
        ),
    ],
)
def test_clips_that_are_not_in_the_file_are_refused(moving, change, message):
    sx.save_scene(moving.parent / "plain.glb", sx.Scene({"a": sx.Part(random_gaussians(n=5, degree=0))}))
    moving.write_text(HAND.replace(*change))
    with pytest.raises(sx.FormatError, match=message):
        web.compose(moving)
