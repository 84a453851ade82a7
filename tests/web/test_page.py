"""The contents of a page, without a browser."""

import base64
import gzip
import json
import re
import warnings
from dataclasses import replace
from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import web
from splatax.metrics import psnr, to_8bit
from splatax.web import page
from splatax.web.staging import stage

NASTY = '</script><script>alert(1)</script> & "quoted" {{ title }} <b>\''
EYES = ((0.4, -0.6, -4.0), (3.0, -1.0, 1.5), (-2.5, 0.8, 2.5))
CAMERAS = {f"{NASTY} {i}": camera_at(eye) for i, eye in enumerate(EYES)}
SCENE = random_gaussians()
HALF_TURN = np.diag([1, -1, -1])


class Parsed(HTMLParser):
    """Tags with their attributes, and the text inside each kind of tag."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self._open = [], {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._open.append(tag)

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        self.text.setdefault(self._open[-1] if self._open else "", []).append(data)


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A viewer that is none."""
    path = tmp_path / "viewer.js"
    path.write_text("window.viewer = 'stub'")
    monkeypatch.setattr(page, "VIEWER", path)


def write(path, scene=SCENE, **options) -> str:
    web.save(path, scene, **{"title": NASTY, "cameras": CAMERAS} | options)
    return path.read_text()


def embedded(text, name) -> bytes:
    return b"".join(base64.b64decode(chunk) for chunk in re.findall(rf'part\("{name}", "([^"]*)"\)', text))


def test_names_are_text_not_markup(tmp_path, stub):
    parsed = Parsed(write(tmp_path / "page.html"))
    assert parsed.text["h1"] == parsed.text["title"] == [NASTY]
    assert [name for name in parsed.text["option"] if name.startswith("</")] == list(CAMERAS)
    scripts = [attributes.get("id") for tag, attributes in parsed.tags if tag == "script"]
    assert scripts == ["page", None, None, None, None]  # data, boot, viewer, scene, start
    assert not any(name.startswith("on") for _, attributes in parsed.tags for name in attributes)


def test_it_refers_to_nothing_outside(tmp_path, stub):
    text = write(tmp_path / "page.html", title="page")
    links = [v for _, attributes in Parsed(text).tags for k, v in attributes.items() if k in ("src", "href")]
    assert links == ["data:,"]
    assert "://" not in text
    assert "@import" not in text
    assert "default-src 'none'" in text


def test_it_holds_the_viewer_and_the_scene(tmp_path, stub):
    text = write(tmp_path / "page.html")
    assert gzip.decompress(embedded(text, "viewer")) == b"window.viewer = 'stub'"
    (tmp_path / "scene.spz").write_bytes(embedded(text, "scene"))
    found = sx.load(tmp_path / "scene.spz")
    expected = stage(SCENE, CAMERAS).place.transform(SCENE)
    nearest = np.linalg.norm(np.asarray(found.means)[:, None] - np.asarray(expected.means), axis=2).argmin(
        axis=1
    )
    assert sorted(nearest) == list(range(len(SCENE)))
    assert_allclose(found.means, np.asarray(expected.means)[nearest], atol=2e-4)
    error = np.abs(np.clip(np.asarray(expected.sh)[nearest, 1:], -1, 0.97) - np.asarray(found.sh)[:, 1:])
    assert np.all(error < 1.5 / 128 + 0.03 * (np.abs(np.asarray(expected.sh)[nearest, 1:]) > 0.9))


def test_the_embedded_scene_costs_a_good_scene_less_than_a_third_of_a_decibel(tmp_path, stub):
    """A scene whose test photos have 38 dB keeps 37.7 dB if the embedded one differs by 49.5 dB from it:
    squared errors add up, and 10 log10(1 + 10^((38 - 49.5) / 10)) = 0.3."""
    scene = random_gaussians(n=400, scale=(0.03, 0.12))
    scene = replace(scene, sh=scene.sh * jnp.float32(0.4))
    web.save(tmp_path / "page.html", scene, title="page", cameras=CAMERAS)
    (tmp_path / "scene.spz").write_bytes(embedded((tmp_path / "page.html").read_text(), "scene"))
    place, found = stage(scene, CAMERAS).place, sx.load(tmp_path / "scene.spz")
    pictures = [
        to_8bit(np.asarray(sx.render(gaussians, place.transform_camera(camera)).rgb))
        for gaussians in (place.transform(scene), found)
        for camera in CAMERAS.values()
    ]
    for original, shown in zip(pictures[:3], pictures[3:], strict=True):
        assert psnr(shown, original) > 49.5


def test_discs_are_shown_as_thin_gaussians_with_a_small_dilation(tmp_path, stub):
    flat = SCENE.log_scales.at[:, 2].set(-jnp.inf)
    scene = replace(SCENE, log_scales=flat, low_pass=sx.AlongRays())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = write(tmp_path / "page.html", scene, title="page")
    told = json.loads(re.search(r'id="page">(.*?)</script>', text)[1])
    assert told["lowPass"] == {"dilation": 0.06, "antialiasing": 0}


@pytest.mark.parametrize(
    ("low_pass", "order"), [(sx.Dilation(0.2), "distance"), (sx.Antialiasing(0.4), "depth")]
)
def test_it_tells_how_the_scene_was_trained(tmp_path, stub, low_pass, order):
    scene = replace(SCENE, low_pass=low_pass, order=order)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        text = write(tmp_path / "page.html", scene, title="page", background=(1.0, 0.5, 0.0))
    told = json.loads(re.search(r'id="page">(.*?)</script>', text)[1])
    kind = "dilation" if isinstance(low_pass, sx.Dilation) else "antialiasing"
    assert told["lowPass"] == {"dilation": 0, "antialiasing": 0} | {kind: low_pass.variance}
    assert told["byDistance"] == (order == "distance")
    assert told["background"] == [1.0, 0.5, 0.0]


def test_an_unbuilt_viewer_is_named_with_the_command_that_builds_it(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    with pytest.raises(sx.InputError, match=r"viewer\.js: .*make page"):
        write(tmp_path / "page.html")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_shown_is_refused(tmp_path, stub):
    with pytest.raises(sx.FormatError, match=r"page\.html: .*degree 4.*Reduce it to degree 3"):
        web.save(tmp_path / "page.html", random_gaussians(degree=4), title="page")
    nothing = jax.tree.map(lambda leaf: leaf[:0], SCENE)
    with pytest.raises(sx.FormatError, match="no Gaussians"):
        web.save(tmp_path / "page.html", nothing, title="page")


def pixel(pose, point, camera):
    """Where the viewer draws a point of its frame: the projection of web/src/pose.js."""
    lens = pose["lens"]
    x, y, z = Rotation.from_quat(pose["quaternion"]).inv().apply(point - np.array(pose["position"]))
    ndc = np.array([lens["fx"] * x / -z - lens["sx"], lens["fy"] * y / -z - lens["sy"]])
    return (ndc * [1, -1] + 1) / 2 * [camera.width, camera.height]


def test_cameras_of_the_viewer_see_points_where_ours_do():
    staged = stage(SCENE, CAMERAS)
    for pose, camera in zip(staged.poses, CAMERAS.values(), strict=True):
        for point in np.asarray(SCENE.means)[:5]:
            expected = camera.to_pixel(camera.to_camera(jnp.asarray(point)))
            there = HALF_TURN @ (
                staged.place.scale * staged.place.rotation @ point + staged.place.translation
            )
            assert_allclose(pixel(pose, there, camera), expected, atol=1e-3)


def test_the_scene_is_upright_and_cameras_turn_around_what_they_look_at():
    tilted = Rotation.from_rotvec([0.3, -0.2, 2.0]).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = tilted.T
    cameras = {
        str(eye): replace(camera_at(eye), cam_from_world=camera_at(eye).cam_from_world @ jnp.float32(matrix))
        for eye in EYES
    }
    staged = stage(SCENE, cameras)
    turns = [Rotation.from_quat(pose["quaternion"]) for pose in staged.poses]
    assert_allclose([turn.apply([1, 0, 0])[1] for turn in turns], 0, atol=0.01)  # all photos are level
    assert np.mean([turn.apply([0, 1, 0])[1] for turn in turns]) > 0.5
    for pose in staged.poses:
        ahead = Rotation.from_quat(pose["quaternion"]).apply([0, 0, -pose["focus"]]) + pose["position"]
        assert_allclose(ahead, HALF_TURN @ staged.place.translation, atol=1e-3)  # where the origin went


def test_cameras_side_by_side_turn_around_the_middle_of_what_they_see():
    cameras = {str(x): camera_at((x, 0, -4), (x, 0, 0), focal=20.0) for x in (-0.1, 0.0, 0.1)}
    staged = stage(random_gaussians(n=500, spread=0.5), cameras)
    for pose in staged.poses:
        assert pose["focus"] / staged.place.scale == pytest.approx(4, abs=0.1)


def test_without_cameras_one_looks_at_the_whole_scene_from_outside():
    scene = replace(SCENE, means=SCENE.means * 70 + 300)
    staged = stage(scene, {})
    camera = camera_at(size=(1600, 1000))
    for point in np.asarray(scene.means):
        x, y = pixel(
            staged.start, HALF_TURN @ (staged.place.scale * point + staged.place.translation), camera
        )
        assert 0 < x < 1600
        assert 0 < y < 1000
    assert staged.start["camera"] == -1


@pytest.mark.slow
def test_a_scene_of_150_000_gaussians_is_small_enough_to_mail(tmp_path, viewer):
    many = random_gaussians(n=150_000, spread=3.0)
    web.save(tmp_path / "page.html", replace(many, sh=many.sh * 0.15), title="large")  # 0.045, as trained
    assert (tmp_path / "page.html").stat().st_size < 10e6  # the limit of most mail servers


@pytest.mark.parametrize("parts", [False, True], ids=["Gaussians", "a scene of parts"])
def test_broken_gaussians_are_left_out(tmp_path, monkeypatch, parts):
    (tmp_path / "viewer.js").write_text("")
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    broken = replace(SCENE, means=SCENE.means.at[3].set(jnp.nan))
    html = web.document(sx.Scene({"a": sx.Part(broken)}) if parts else broken, title="holed")
    (contents,) = re.findall(r'part\("(?:scene|part-0)", "([^"]*)"\)', html)
    (tmp_path / "scene.spz").write_bytes(base64.b64decode(contents))
    assert len(sx.load(tmp_path / "scene.spz")) == len(SCENE) - 1
