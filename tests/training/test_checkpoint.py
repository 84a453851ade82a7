"""A checkpoint that is read continues bit for bit, or is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

import splatax as sx
from scenes import random_gaussians
from shortened import shortened
from splatax.errors import FormatError
from splatax.training import checkpoint
from splatax.training.camera_refinement import CAMERA_REFINEMENTS, MANY
from splatax.training.density import NoDensityControl
from splatax.training.feed import order
from splatax.training.fingerprints import fingerprint
from splatax.training.loop import RunState, first_state, optimize
from splatax.training.recipes import PRESETS
from training.test_training import capture

STOPS = (1, 4, 5, 6, 17, 29)  # before, at and after refinements; the last but one step


@pytest.fixture(scope="module")
def dataset():
    return capture()


@pytest.fixture(
    scope="module",
    params=[pytest.param(n, marks=pytest.mark.slow if n == "2dgs" else []) for n in PRESETS],
)
def whole(request, dataset):
    """A recipe, what each of its steps yields, the checkpoints on the way, and the scene at the end."""
    recipe = shortened(request.param)
    yields, stops = [], {}
    for progress in optimize(dataset, recipe):
        yields.append((progress.step, float(progress.loss), progress.count))
        if progress.step in STOPS:
            stops[progress.step] = checkpoint.take(progress.state, {}, {})
    return recipe, yields, stops, progress.gaussians


@pytest.fixture
def saved(whole, tmp_path):
    """A checkpoint file, and the recipe of its run."""
    path = tmp_path / "00000017.npz"
    with path.open("wb") as file:
        checkpoint.write(file, whole[2][17])
    return path, whole[0]


@pytest.mark.parametrize("step", STOPS)
def test_a_run_that_was_stopped_ends_as_one_that_was_not(whole, dataset, tmp_path, step):
    recipe, yields, stops, gaussians = whole
    with (tmp_path / "run.npz").open("wb") as file:
        checkpoint.write(file, stops[step])
    state = checkpoint.restore(checkpoint.read(tmp_path / "run.npz"), recipe)
    again = []
    for progress in optimize(dataset, recipe, state):
        again.append((progress.step, float(progress.loss), progress.count))
    assert again == yields[step:]
    for a, b in zip(jax.tree.leaves(progress.gaussians), jax.tree.leaves(gaussians), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_training_goes_through_what_the_checkpoints_are_to_survive(whole):
    _, yields, _, gaussians = whole
    counts = [count for _, _, count in yields]
    assert counts[4] != counts[3]  # a refinement between two of the stops
    assert np.any(np.asarray(gaussians.sh[:, 1:]) != 0)


def test_nothing_is_left_to_do_after_the_last_step(whole, dataset):
    recipe, _, stops, _ = whole
    state = checkpoint.restore(stops[29], recipe)
    state = replace(state, train=replace(state.train, total=jnp.int32(20)))
    with pytest.raises(ValueError, match="nothing left to do: 29 of 20 steps"):
        next(optimize(dataset, recipe, state))


def test_header_and_other_arrays_come_back(whole, tmp_path):
    taken = replace(whole[2][4], header={"step": 4, "count": 7, "loss": float("inf"), "names": ["ä"]})
    taken = replace(taken, arrays={**taken.arrays, "history/losses": np.arange(3.0)})
    with (tmp_path / "a.npz").open("wb") as file:
        checkpoint.write(file, taken)
    back = checkpoint.read(tmp_path / "a.npz")
    assert (back.header, back.step) == (taken.header, 4)
    assert list(back.arrays) == list(taken.arrays)
    assert_array_equal(back.arrays["history/losses"], [0, 1, 2])


@pytest.mark.parametrize("name", CAMERA_REFINEMENTS)
def test_every_refinement_of_cameras_comes_back(dataset, name):
    recipe = replace(shortened("classic"), camera_refinement=CAMERA_REFINEMENTS[name])
    gaussians = random_gaussians(n=5, degree=recipe.sh.degree)
    train = first_state(gaussians, recipe, 1.0, len(dataset.train))
    taken = checkpoint.take(RunState(train, 5), {}, {})
    back = checkpoint.restore(taken, recipe).train.cameras
    assert jax.tree.structure(back) == jax.tree.structure(train.cameras)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(train.cameras), strict=True):
        assert_array_equal(a, b)


@pytest.mark.parametrize("name", ["poses", pytest.param("poses+focal", marks=pytest.mark.slow)])
def test_a_run_that_refines_poses_and_was_stopped_ends_with_the_same_bits(tmp_path, name):
    """Before all photos were seen, whose places are then not known yet, and after."""
    many = capture(views=MANY + 2)  # so many that the common part of their twists needs their places
    recipe = replace(shortened("default"), camera_refinement=CAMERA_REFINEMENTS[name])
    stops = {}
    for progress in optimize(many, recipe):
        if progress.step in (5, 19):
            stops[progress.step] = checkpoint.take(progress.state, {}, {})
    whole = checkpoint.take(progress.state, {}, {})
    assert any(path.endswith("places") and array.any() for path, array in whole.arrays.items())
    for stop in stops.values():
        with (tmp_path / "run.npz").open("wb") as file:
            checkpoint.write(file, stop)
        for progress in optimize(
            many, recipe, checkpoint.restore(checkpoint.read(tmp_path / "run.npz"), recipe)
        ):
            pass
        again = checkpoint.take(progress.state, {}, {})
        assert list(again.arrays) == list(whole.arrays)
        for path, array in again.arrays.items():
            assert array.tobytes() == whole.arrays[path].tobytes(), path


# --- damage ---


@pytest.mark.parametrize("fraction", [0, 0.001, 0.3, 0.9, 0.9999])
def test_a_file_that_was_cut_short_is_refused(saved, fraction):
    path, _ = saved
    contents = path.read_bytes()
    path.write_bytes(contents[: int(fraction * len(contents))])
    with pytest.raises(FormatError, match=r"00000017\.npz: damaged"):
        checkpoint.read(path)


@pytest.mark.slow
def test_a_flipped_bit_is_refused_or_changes_nothing(saved):
    path, _ = saved
    contents, rng = path.read_bytes(), np.random.default_rng(0)
    whole_file = checkpoint.read(path)
    size = len(contents)
    # Anywhere, and in the table of contents at the end, where a zip has most to go wrong.
    places = [*rng.integers(size, size=150), *rng.integers(size - 1500, size, size=250)]
    refused = 0
    for place in places:
        damaged = bytearray(contents)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            back = checkpoint.read(path)
        except FormatError:
            refused += 1
            continue
        assert back.header == whole_file.header
        for name, array in whole_file.arrays.items():
            assert back.arrays[name].tobytes() == array.tobytes()
    assert refused > 200  # the rest are dates and the like


def test_what_is_no_checkpoint_is_refused(tmp_path):
    for contents in (b"", b"not a zip", b"PK\x05\x06" + bytes(18)):
        (tmp_path / "a.npz").write_bytes(contents)
        with pytest.raises(FormatError, match=r"a\.npz: damaged"):
            checkpoint.read(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", weights=np.zeros(3))
    with pytest.raises(FormatError, match=r"a\.npz: damaged"):
        checkpoint.read(tmp_path / "a.npz")


def test_the_state_of_another_kind_of_run_is_refused(whole):
    recipe, _, stops, _ = whole
    with pytest.raises(FormatError, match=r"gaussians/sh is float32.* not float32"):
        checkpoint.restore(stops[17], replace(recipe, sh=replace(recipe.sh, degree=2)))
    if jax.tree.leaves(recipe.density.init(1)):
        with pytest.raises(FormatError, match="another kind of run: state/density_state"):
            checkpoint.restore(stops[17], replace(recipe, density=NoDensityControl()))


# --- what a run depends on ---


def test_the_order_of_photos_depends_on_seed_and_epoch_alone():
    def first(views, seed, epoch, n):
        return [index for index, _ in zip(order(views, seed, epoch), range(n), strict=False)]

    assert first(5, 0, 0, 25)[10:] == first(5, 0, 2, 15)
    assert sorted(first(5, 0, 3, 5)) == list(range(5))
    assert first(50, 0, 0, 50) != first(50, 1, 0, 50)
    assert first(50, 0, 0, 50) != first(50, 0, 1, 50)


def test_the_fingerprint_sees_what_changed(dataset):
    def changes(other):
        before, after = fingerprint(dataset), fingerprint(other)
        return {name for name in before if before[name] != after[name]}

    view, *rest = dataset.train
    assert changes(capture()) == set()
    assert changes(replace(dataset, train=(replace(view, name="x"), *rest))) == {"photo", "camera of"}
    assert changes(replace(dataset, train=(replace(view, mask=lambda: None), *rest))) == {"photo"}
    moved = replace(view.camera, fx=view.camera.fx + 1e-4)
    assert changes(replace(dataset, train=(replace(view, camera=moved), *rest))) == {"camera of"}
    points = sx.PointCloud(np.nextafter(dataset.points.positions, np.float32(9)), dataset.points.colors)
    assert changes(replace(dataset, points=points)) == {"points"}
    assert "photos" in changes(replace(dataset, train=dataset.train[1:]))


@pytest.mark.slow
def test_memory_stays_level(dataset):
    """2,000 steps of a scene that no longer grows: what is allocated is freed again."""
    recipe = replace(shortened("classic"), steps=2_600, density=NoDensityControl())
    rss = {}
    for progress in optimize(dataset, recipe):
        if progress.step in (600, 2_600):
            progress.loss.block_until_ready()
            rss[progress.step] = resident()
    assert rss[2_600] - rss[600] < 20e6


def resident() -> int:
    """Memory that this process holds now, bytes."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096
    except OSError:
        pytest.skip("the system does not tell")


def test_disk_usage_is_that_of_the_arrays(saved):
    path, _ = saved
    arrays = sum(array.nbytes for array in checkpoint.read(path).arrays.values())
    assert arrays < path.stat().st_size < arrays + 20_000
