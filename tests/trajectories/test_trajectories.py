"""Trajectories pass their keyframes, move smoothly, look at their target, and refuse impossible captures."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from scenes import camera_at
from splatax import trajectories
from splatax.cameras.rig import up_of
from splatax.errors import FormatError, InputError
from splatax.trajectories.shapes import focus_of
from splatax.trajectories.tour import short_way

SIZE = (64, 36)


def ring(count=9, radius=3.0, height=-1.0, focus=(0.5, 0.2, -0.3)):
    """Cameras around a point, y down, all looking at it."""
    angles = 2 * np.pi * np.arange(count) / count
    places = np.stack([radius * np.sin(angles), np.full(count, height), radius * np.cos(angles)], axis=1)
    return [camera_at(tuple(place + focus), focus) for place in places]


def position(camera):
    return np.asarray(camera.position, np.float64)


def center_of_view(camera, depth):
    """What the middle of the picture shows at a distance."""
    return position(camera) + depth * np.asarray(camera.rotation, np.float64)[2]


def key(x=0.0, turn=0.0, fov=1.0):
    return trajectories.Keyframe(np.array([x, 0.0, 0.0]), Rotation.from_rotvec([0, turn, 0]), fov)


def test_a_path_passes_every_key_at_its_time():
    rng = np.random.default_rng(0)
    keys = [
        trajectories.Keyframe(rng.normal(size=3), Rotation.random(rng=rng), fov)
        for fov in (0.5, 1.0, 0.7, 1.4)
    ]
    times = [0.0, 1.0, 1.5, 4.0]
    for made, given in zip(trajectories.interpolate(keys, times, times), keys, strict=True):
        assert_allclose(made.position, given.position, atol=1e-12)
        assert (made.rotation.inv() * given.rotation).magnitude() < 1e-9
        assert made.fov == pytest.approx(given.fov)


@pytest.mark.parametrize("closed", [False, True])
def test_velocity_is_continuous_at_keys(closed):
    rng = np.random.default_rng(1)
    turns = [Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)) for _ in range(4)]
    keys = [
        trajectories.Keyframe(rng.normal(size=3), turn, f)
        for turn, f in zip(turns, (0.5, 1.0, 0.7, 1.4), strict=True)
    ]
    times = [0.0, 1.0, 1.5, 4.0, 5.0][: 4 + closed]
    h = 1e-5
    for time in [1.0, 1.5] + ([0.0] if closed else []):
        before, after = (times[-1], time) if closed and time == 0 else (time, time)
        a, b, c, d = trajectories.interpolate(
            keys, times, [before - h, before, after, after + h], closed=closed
        )
        assert_allclose((b.position - a.position) / h, (d.position - c.position) / h, atol=1e-3)
        spins = [(p.rotation.inv() * q.rotation).as_rotvec() / h for p, q in ((a, b), (c, d))]
        assert_allclose(*spins, atol=2e-3)


def test_even_steps_and_turns_stay_even():
    made = trajectories.interpolate([key(0, 0), key(1, 0.3), key(2, 0.6)], [0, 1, 2], np.linspace(0, 2, 9))
    assert_allclose([k.position[0] for k in made], np.linspace(0, 2, 9), atol=1e-12)
    assert_allclose([k.rotation.magnitude() for k in made], np.linspace(0, 0.6, 9), atol=1e-9)


def test_focal_length_changes_by_equal_factors():
    made = trajectories.interpolate([key(fov=1.0), key(fov=0.3)], [0, 1], [0, 0.5, 1])
    focal = [1 / np.tan(k.fov / 2) for k in made]
    assert focal[1] ** 2 == pytest.approx(focal[0] * focal[2])


def test_an_orbit_looks_at_what_the_cameras_look_at_from_as_far():
    focus = np.array([0.5, 0.2, -0.3])
    cameras = ring()
    assert_allclose(focus_of(cameras), focus, atol=1e-5)
    path = trajectories.orbit(cameras, 12, SIZE, focus_of(cameras))
    for camera in path:
        distance = np.linalg.norm(position(camera) - focus)
        assert distance == pytest.approx(np.sqrt(10), rel=1e-5)
        assert_allclose(center_of_view(camera, distance), focus, atol=1e-4)
        assert position(camera)[1] - focus[1] == pytest.approx(-1, abs=1e-4)
        assert np.asarray(camera.rotation)[1, 1] > 0.9  # the picture's y points to the world's, down
    assert len({tuple(np.round(position(camera), 3)) for camera in path}) == 12


def test_up_is_found_from_cameras_that_look_down():
    above = [camera_at(tuple(position(camera) + [0, -4, 0]), (0.5, 0.2, -0.3)) for camera in ring()[:3]]
    assert_allclose(up_of(above), [0, -1, 0], atol=0.05)


def test_orbits_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="same way"):
        focus_of([camera_at((x, 0, -4), (x, 0, 0)) for x in (0.0, 1.0, 2.0)])
    outwards = [camera_at(tuple(position(c)), tuple(2 * position(c) - [0.5, 0.2, -0.3])) for c in ring()]
    with pytest.raises(InputError, match="outwards"):
        focus_of(outwards)
    with pytest.raises(InputError, match="all directions"):
        trajectories.spiral(ring(), 4, SIZE, np.zeros((1, 3)))


def test_a_spiral_stays_among_its_cameras_and_looks_at_one_depth():
    cameras = [camera_at((x, y, -4.0), (x, y, 0.0)) for x in (-1.0, 0.0, 1.0) for y in (-0.5, 0.5)]
    points = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 2.0]])  # at depths 2 and 6: inverse mean 3
    path = trajectories.spiral(cameras, 40, SIZE, points)
    positions = np.stack([position(camera) for camera in path])
    assert np.abs(positions[:, 0]).max() == pytest.approx(1, abs=1e-3)
    assert np.abs(positions[:, 1]).max() <= 0.5 + 1e-5
    for camera in path:
        forward = np.asarray(camera.rotation, np.float64)[2]
        reached = position(camera) + forward * (-1 - position(camera)[2]) / forward[2]
        assert_allclose(reached, [0, 0, -1], atol=1e-4)


def test_a_tour_takes_the_short_way_at_even_speed():
    shuffled = [3, 0, 4, 1, 5, 2]
    cameras = [camera_at((float(x), 0.0, -4.0), (float(x), 0.0, 0.0)) for x in shuffled]
    x = np.array([position(camera)[0] for camera in trajectories.tour(cameras, 21, SIZE)])
    x = x if x[0] < x[-1] else x[::-1]
    assert_allclose(x, np.linspace(0, 5, 21), atol=1e-4)


def test_the_way_cannot_be_shortened_by_turning_a_part_of_it():
    places = np.random.default_rng(3).uniform(size=(25, 2))
    between = np.linalg.norm(places[:, None] - places[None], axis=2)
    way = short_way(between)
    assert sorted(way) == list(range(25))

    def length(order):
        return between[order[:-1], order[1:]].sum()

    shortest = min(length(way[:i] + way[i:j][::-1] + way[j:]) for i in range(25) for j in range(i + 2, 26))
    assert length(way) <= shortest + 1e-9


def test_cameras_from_one_place_make_a_film_that_rests():
    path = trajectories.tour([camera_at(), camera_at()], 3, SIZE)
    assert len(path) == 3
    assert_allclose(position(path[2]), position(path[0]))


def test_a_picture_of_another_shape_never_shows_more_than_the_photo():
    camera = camera_at(size=(40, 20), focal=30.0)
    for size in ((40, 40), (80, 20), (120, 60)):
        shown = trajectories.Keyframe.of(camera, size).camera(size)
        assert float(shown.fy) / size[1] >= float(camera.fy) / 20 - 1e-6
        assert float(shown.fx) / size[0] >= float(camera.fy) / 40 - 1e-6


def test_an_overview_has_the_scene_in_the_picture():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) + [5, 0, 9]
    camera = trajectories.overview(points, SIZE)
    seen = np.stack([camera.to_pixel(camera.to_camera(jnp.asarray(p, jnp.float32))) for p in points[:50]])
    assert ((seen > 0) & (seen < SIZE)).all()


def test_a_saved_path_is_read_back(tmp_path):
    keys = [key(0, 0, 1.0), key(2, 0.5, 0.6), key(3, 0.1, 0.9)]
    file = tmp_path / "path.json"
    file.write_bytes(trajectories.write(keys))
    path = trajectories.read(file, 3, SIZE)
    for camera, given in zip(path, keys, strict=True):
        assert_allclose(position(camera), given.position, atol=1e-6)
        assert_allclose(np.asarray(camera.rotation).T, given.rotation.as_matrix(), atol=1e-6)
        assert float(camera.fy) == pytest.approx(SIZE[1] / 2 / np.tan(given.fov / 2), rel=1e-5)


def test_a_closed_path_comes_back_and_seconds_set_the_rhythm(tmp_path):
    rows = [
        {"position": [x, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 50, "seconds": s}
        for x, s in ((0, 0), (1, 1), (2, 4))
    ]
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"keyframes": rows}))
    assert position(trajectories.read(file, 5, SIZE)[1])[0] == pytest.approx(1)
    file.write_text(json.dumps({"keyframes": rows, "closed": True}))
    closed = trajectories.read(file, 600, SIZE)
    assert np.linalg.norm(position(closed[-1]) - position(closed[0])) < 0.05


@pytest.mark.parametrize(
    ("contents", "reason"),
    [
        ("[", "not a JSON"),
        ("[]", "not a camera path"),
        ("{}", "'keyframes' is missing"),
        ('{"keyframes": []}', "no keyframes"),
        ('{"keyframes": [{"position": [0, 0, 0], "fov": 50}]}', "'wxyz' is missing"),
        ('{"keyframes": [{"position": [0, 0], "wxyz": [1, 0, 0, 0], "fov": 50}]}', "3 numbers"),
        (
            '{"keyframes": [{"position": [0, 0, 0], "wxyz": [0, 0, 0, 0], "fov": 50}]}',
            "keyframe 1: wxyz is zero",
        ),
        ('{"keyframes": {"a": 1}}', "no keyframes in a list"),
        ('{"keyframes": [1]}', "keyframe 1 is 1, not position, wxyz and fov"),
        ('{"keyframes": [{"position": [NaN, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 50}]}', "position is .nan"),
        ('{"keyframes": [{"position": "front", "wxyz": [1, 0, 0, 0], "fov": 50}]}', "is 'front', not 3 num"),
        ('{"keyframes": [{"position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": NaN}]}', "degrees, not nan"),
        ('{"keyframes": [{"position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": "wide"}]}', "not wide"),
        (
            '{"keyframes": [{"position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 50, "seconds": NaN}]}',
            "seconds are numbers, and all keyframes have them or none",
        ),
        ('{"keyframes": [{"position": [0, 0, 0], "wxyz": [1, 0, 0, 0], "fov": 180}]}', "180 degrees"),
    ],
)
def test_a_file_that_is_no_path_is_refused(tmp_path, contents, reason):
    file = tmp_path / "path.json"
    file.write_text(contents)
    with pytest.raises(FormatError, match=reason) as error:
        trajectories.read(file, 2, SIZE)
    assert str(file) in str(error.value)
