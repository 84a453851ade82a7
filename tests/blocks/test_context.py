"""The context of a block is drawn with it, and is neither learned nor changed by density control."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from splatax import backends
from splatax.dataset import Block, Dataset, PointCloud, View
from splatax.evaluation import picture
from splatax.gaussians import joined
from splatax.low_pass import AlongRays
from splatax.math import harmonics
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.results import NoPages, Results
from splatax.runs.session import Session
from splatax.training import checkpoint
from splatax.training.feed import Batch
from splatax.training.fingerprints import fingerprint
from splatax.training.geometry import Surfaces
from splatax.training.initialize import FromBlock
from splatax.training.loop import first_state, optimize
from splatax.training.priors import Sparsity
from splatax.training.recipes import ShSchedule, classic, default
from splatax.training.step import compare


def cloud(seed, count, low, high):
    rng = np.random.default_rng(seed)
    sh = np.zeros((count, harmonics.count(0), 3), np.float32)
    sh[:, 0] = harmonics.from_rgb(rng.uniform(0.1, 0.9, (count, 3)))
    return sx.Gaussians(
        jnp.asarray(rng.uniform(low, high, (count, 3)), jnp.float32),
        jnp.asarray(rng.normal(size=(count, 4)), jnp.float32),
        jnp.asarray(rng.uniform(-2.3, -1.6, (count, 3)), jnp.float32),
        jnp.asarray(rng.uniform(0, 2, count), jnp.float32),
        jnp.asarray(sh),
    )


OWN, AROUND = cloud(0, 40, (-1, -1, -1), (0, 1, 1)), cloud(1, 60, (0, -1, -1), (1, 1, 1))


def camera_at(x):
    pose = sx.look_at(*(jnp.array(v, jnp.float32) for v in ((x, 0, -4), (0, 0, 0), (0, -1, 0))))
    return sx.Camera.simple_pinhole(36.0, pose, 32, 24)


def capture(scene=None, block=Block(OWN, AROUND)):
    """Photos of a scene, by default of the block and its context together."""
    scene = joined([OWN, AROUND]) if scene is None else scene
    views = [
        View(f"{i}.png", camera, lambda camera=camera: picture(scene, camera))
        for i, camera in enumerate(map(camera_at, (-1.0, -0.3, 0.4, 1.2)))
    ]
    none = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    return Dataset(tuple(views), (), none, block=block)


def recipe(steps=4, build=classic, **options):
    made = build(steps=steps, max_gaussians=80, **options)
    return replace(made, initialization=FromBlock("plan", 0), sh=ShSchedule(degree=0))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("low_pass", "surfaces", "by_depth"), [(None, True, None), (AlongRays(), False, 0.0), (None, False, 1.0)]
)
def test_gradients_in_context_are_those_of_the_whole_scene(low_pass, surfaces, by_depth):
    """The context is a part of the scene whose own gradients nobody asks for."""
    how = recipe().on(backends.resolve("auto"))
    if by_depth is not None:
        how = replace(how, drawing=replace(how.drawing, order="distance", by_depth=by_depth))
    if low_pass:
        how = replace(how, drawing=replace(how.drawing, low_pass=low_pass))
    if surfaces:
        how = replace(how, objective=replace(how.objective, geometry=Surfaces(consistency=0.1, after=0.0)))
    photo = jnp.asarray(np.random.default_rng(3).integers(0, 255, (24, 32, 3), np.uint8))
    batch, key = Batch(camera_at(0.2), photo), jax.random.key(0)
    state = first_state(OWN, how, 2.0, 4)
    whole = first_state(joined([OWN, AROUND]), how, 2.0, 4)
    found = compare(state, replace(batch, context=AROUND), how, key)
    expected = compare(whole, batch, how, key)
    np.testing.assert_allclose(found.loss, expected.loss, rtol=1e-6)
    assert len(found.shown.splats.depths) == len(OWN), "density control must not see the context"
    (d_own, _), (d_whole, _) = (each.pull_back(each.d_shown) for each in (found, expected))
    for own, all_rows in zip(jax.tree.leaves(d_own), jax.tree.leaves(d_whole), strict=True):
        np.testing.assert_allclose(own, all_rows[: len(OWN)], atol=1e-6, rtol=1e-4)


HIDDEN = cloud(2, 40, (-1, -1, -9), (0, 1, -8))  # behind all cameras


@pytest.mark.parametrize("views", [1, 2])
def test_a_prior_is_a_mean_over_the_gaussians_of_the_whole_scene(views):
    """A block of half of the Gaussians has the moments that they have in a run of all of them."""
    dataset = capture(block=Block(OWN, HIDDEN, fraction=0.5))
    whole = replace(dataset, block=Block(joined([OWN, HIDDEN]), HIDDEN))
    moments = []
    for captured in (dataset, whole):
        how = recipe(views=views)
        how = replace(how, objective=replace(how.objective, prior=Sparsity(opacity=5.0)))
        adam, *_ = next(optimize(captured, how)).state.train.opt_state
        moments.append(np.asarray(adam.mu.opacity_logits[: len(OWN)]))
    np.testing.assert_allclose(*moments, rtol=1e-4, atol=1e-7)
    assert np.abs(moments[0]).min() > 0


@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("order", ["depth", "distance"])
def test_photos_that_the_context_explains_leave_no_loss(views, order):
    losses, how = {}, recipe(views=views)
    how = replace(how, drawing=replace(how.drawing, order=order, by_depth=1.0))  # as the photos are drawn
    for name, around in (("with", AROUND), ("without", jax.tree.map(lambda leaf: leaf[:1], AROUND))):
        run = optimize(capture(block=Block(OWN, around)), how)
        losses[name] = float(next(run).loss)
    assert losses["with"] < 0.005 < 0.05 < losses["without"]


def test_the_context_stays_as_it_is_and_is_not_in_the_result():
    dataset = capture(scene=cloud(5, 90, (-1, -1, -1), (1, 1, 1)))
    before = [np.array(leaf) for leaf in jax.tree.leaves(AROUND)]
    how = recipe(12, default)
    how = replace(how, density=replace(how.density, every=3, start=3))
    for progress in optimize(dataset, how):  # grows, and moves rows
        pass
    assert progress.count == 80
    scene = progress.gaussians
    assert not np.isin(np.asarray(scene.means), np.asarray(AROUND.means)).any()
    for leaf, old in zip(jax.tree.leaves(AROUND), before, strict=True):
        np.testing.assert_array_equal(leaf, old)
    shown = dataset.in_context(scene)
    assert len(shown) == 80 + len(AROUND)
    np.testing.assert_array_equal(shown.means[80:], AROUND.means)


def test_a_block_that_is_resumed_ends_with_the_same_bits():
    dataset, how = capture(scene=cloud(5, 90, (-1, -1, -1), (1, 1, 1))), recipe(12, default)
    for progress in optimize(dataset, how):
        if progress.step == 5:
            saved = checkpoint.take(progress.state, {}, {})
    for resumed in optimize(dataset, how, checkpoint.restore(saved, how)):
        pass
    for whole, again in zip(
        jax.tree.leaves(progress.gaussians), jax.tree.leaves(resumed.gaussians), strict=True
    ):
        np.testing.assert_array_equal(whole, again)


def test_scores_of_a_block_are_of_the_block_in_its_context(tmp_path):
    """The block starts from the truth, and alone it leaves half of each photo black."""
    dataset = capture()
    dataset = replace(dataset, train=dataset.train[1:], test=dataset.train[:1])
    with Checkpoints(tmp_path, {}) as checkpoints:
        run = Session(dataset, recipe(), checkpoints, eval_every=2)
        for _ in run.steps():
            pass
    results = Results("block", dataset, recipe(), run.history, run.last, {}, tmp_path)
    scores = results.write(NoPages())
    assert [evaluation.scores.psnr > 25 for evaluation in run.history.evaluations] == [True, True]
    assert scores.psnr == run.history.evaluations[-1].scores.psnr
    assert len(sx.load(tmp_path / "scene.ply")) == len(OWN)
    assert sx.evaluate(results.gaussians, dataset.test).psnr < 20


def test_another_context_is_another_capture():
    same, other = capture(), capture(block=Block(OWN, jax.tree.map(lambda leaf: leaf[1:], AROUND)))
    assert fingerprint(capture()) == fingerprint(same)
    assert fingerprint(other) != fingerprint(same)
    assert "block" not in fingerprint(capture(block=None)), "checkpoints of whole captures stay"


def test_a_start_without_harmonics_gets_them_and_one_with_too_many_is_refused():
    start = FromBlock("plan", 0)
    assert start(capture(), 2, 0).sh.shape == (40, 9, 3)
    more = replace(OWN, sh=jnp.zeros((40, 9, 3)))
    with pytest.raises(sx.DatasetError, match="SH degree 2, the recipe of 1"):
        start(capture(block=Block(more, AROUND)), 1, 0)
    with pytest.raises(sx.DatasetError, match="whole one"):
        start(capture(block=None), 1, 0)
