"""Compares `default` with ideas that are not in it, scored on training photos that no run has seen.

python docs/measure_trials.py CAPTURES SEEDS TRIALS [STEPS [DOWNSCALE]]
    TRIALS      names of `TRIALS` with commas, or of variants of `measure_long.py`
    (the other arguments are those of `measure_long.py`, with 1,000 steps and a downscale of 4 by default)

CPU time is that of the steps. A step that took more than ten times the usual time compiled a program, and
counts as a usual one; what a trial does before and after its steps is not counted.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np
from measure_long import VARIANTS, loaded, rates, settling, varied
from scipy.spatial.transform import Rotation, Slerp
from trial_parts import BilateralGrid, FarPulls, Huber, JaxAdam, LearnedSky, OpacityNoise, Rays, SecondOrder

import splatax as sx
from splatax.cameras import Camera
from splatax.dataset import Dataset, Pixels, View
from splatax.evaluation import Scores, ViewScore, picture, score
from splatax.gaussians import Gaussians
from splatax.inspection.decisions import LUMINANCE, shades_at
from splatax.metrics import to_8bit
from splatax.order import Order
from splatax.rendering import Renderer
from splatax.sky import Sky
from splatax.training import loop
from splatax.training.backgrounds import Solid
from splatax.training.initialize import WithSky
from splatax.training.loop import Progress
from splatax.training.protocols import Loss
from splatax.training.recipes import Recipe, ShSchedule, default, room_for
from splatax.training.resolution import Resolution
from splatax.training.steppers import Stepper

DEFAULTS = 1_000, 4  # steps and downscale


@dataclass(frozen=True)
class Trained:
    """What a trial ends with.

    Attributes:
        scene: the scene.
        seconds: CPU time of its steps.
        renderer: draws it.
        gains: factors on the rendered colours of photos, by name; 1 for those that are not named.
    """

    scene: Gaussians
    seconds: float
    renderer: Renderer = Renderer()
    gains: Mapping[str, float] = field(default_factory=dict)


Trial = Callable[[Dataset, Recipe], Trained]


def fitted(dataset: Dataset, recipe: Recipe, stepper: Stepper | None = None) -> tuple[Progress, float]:
    """Trains a scene; returns the last step and the CPU time of all steps, seconds."""
    times, began = [], time.process_time()
    chosen = loop.stepper_for if stepper is None else lambda *_: stepper
    with patch.object(loop, "stepper_for", chosen):
        for progress in sx.optimize(dataset, recipe):
            progress.loss.block_until_ready()
            times.append(time.process_time() - began)
            began = time.process_time()
    each = np.array(times)
    return progress, float(np.where(each > 10 * np.median(each), np.median(each), each).sum())


def plain(dataset: Dataset, recipe: Recipe, stepper: Stepper | None = None) -> Trained:
    """Trains a recipe as it is."""
    progress, seconds = fitted(dataset, recipe, stepper)
    return Trained(progress.gaussians, seconds)


def of(change: Callable[[Recipe], Recipe]) -> Trial:
    """Returns the trial of a changed recipe."""
    return lambda dataset, recipe: plain(dataset, change(recipe))


def with_noise(recipe: Recipe, deviation: float) -> Recipe:
    """Returns a recipe with noise in the opacities of each view."""
    noisy = OpacityNoise(recipe.density, deviation)
    return replace(recipe, density=noisy, optimizer=replace(recipe.optimizer, rule=JaxAdam()))


def far_pulls(depth: float) -> Trial:
    """Returns the trial of pulls that count in full from this depth on, in extents of the scene."""

    def trial(dataset: Dataset, recipe: Recipe) -> Trained:
        known = {each.name: getattr(recipe.density, each.name) for each in fields(recipe.density)}
        return plain(dataset, replace(recipe, density=FarPulls(**known, full=depth * dataset.extent)))

    return trial


def ordered(by_depth: float | None, drawn: Order) -> Trial:
    """Returns the trial of splats in another order.

    Args:
        by_depth: probability that a step draws by depth; None for a scene whose own order is that by depth.
        drawn: the order of the pictures that are scored.
    """

    def trial(dataset: Dataset, recipe: Recipe) -> Trained:
        drawing = recipe.drawing.in_order("distance" if by_depth is not None else "depth")
        trained = plain(dataset, replace(recipe, drawing=replace(drawing, by_depth=by_depth or 0.0)))
        return replace(trained, scene=replace(trained.scene, order=drawn))

    return trial


def with_loss(recipe: Recipe, loss: Loss) -> Recipe:
    """Returns a recipe with another loss of the photos."""
    return replace(recipe, objective=replace(recipe.objective, loss=loss))


def by_second_order(**settings: float) -> Trial:
    """Returns the trial of second-order steps."""
    return lambda dataset, recipe: plain(dataset, recipe, SecondOrder(**settings))


def before_a_sky(count: int, radius: float) -> Trial:
    """Returns the trial of a scene with Gaussians on a sphere behind it."""
    return of(lambda r: replace(r, initialization=WithSky(r.initialization, count, radius)))


def before_a_learned_sky(dataset: Dataset, recipe: Recipe) -> Trained:
    """Trains a scene and the sky behind it."""
    sky = LearnedSky(Rays([view.camera for view in dataset.train]))
    recipe = replace(recipe, appearance=sky, drawing=replace(recipe.drawing, background=Solid()))
    progress, seconds = fitted(dataset, recipe)
    learned = progress.state.train.appearance.values[0].reshape(-1, 3)
    return Trained(progress.gaussians, seconds, Renderer(background=Sky(jnp.array(learned))))


def distilled(fraction: float) -> Trial:
    """Returns the trial of a scene that learns from two others at poses between photos.

    Each of the two makes a fraction of the steps. The pictures are means of theirs.
    """

    def trial(dataset: Dataset, recipe: Recipe) -> Trained:
        shorter = default(round(recipe.steps * fraction), recipe.density.max_gaussians)
        taught = [plain(dataset, replace(shorter, seed=recipe.seed + extra)) for extra in (100, 200)]
        between = [
            View(f"between{i}", camera, lambda pixels=mean_picture(taught, camera): pixels)
            for i, camera in enumerate(cameras_between(dataset.train))
        ]
        trained = plain(replace(dataset, train=(*dataset.train, *between)), recipe)
        return replace(trained, seconds=trained.seconds + sum(each.seconds for each in taught))

    return trial


def mean_picture(taught: Sequence[Trained], camera: Camera) -> Pixels:
    """Returns the mean of the pictures of several scenes."""
    return to_8bit(np.mean([np.asarray(each.renderer(each.scene, camera).rgb) for each in taught], axis=0))


def cameras_between(views: Sequence[View]) -> list[Camera]:
    """Returns a camera halfway between each photo and the photo nearest to it."""
    places = np.array([np.asarray(view.camera.position) for view in views])
    apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
    pairs = {(min(i, j), max(i, j)) for i, j in enumerate(apart.argmin(axis=1).tolist())}
    return [halfway(views[i].camera, views[j].camera) for i, j in sorted(pairs)]


def halfway(first: Camera, second: Camera) -> Camera:
    """Returns the first camera at the pose between the two."""
    turns = Rotation.from_matrix([np.asarray(each.rotation, np.float64) for each in (first, second)])
    pose = np.eye(4)
    pose[:3, :3] = Slerp([0, 1], turns)(0.5).as_matrix()
    pose[:3, 3] = -pose[:3, :3] @ (np.asarray(first.position) + np.asarray(second.position)) / 2
    return replace(first, cam_from_world=jnp.asarray(pose, jnp.float32))


def exposures_of(views: Sequence[View], positions: np.ndarray) -> np.ndarray:
    """Returns how much brighter photos are than others at the points that both see, stops."""
    luminances = [view.pixels()[..., :3] @ np.array(LUMINANCE) / 255 for view in views]
    cameras = [view.camera for view in views]
    shades = np.array([shades_at(positions, *each) for each in zip(cameras, luminances, strict=True)])
    shades = shades[:, np.isfinite(shades).sum(axis=0) >= 2]
    found = np.zeros(len(views))
    for _ in range(20):
        usual = np.nanmedian(shades - found[:, None], axis=0)
        found = np.nanmedian(shades - usual, axis=1)
    return found - found.mean()


def smooth_exposure(dataset: Dataset, recipe: Recipe) -> Trained:
    """Trains on photos whose exposure is made equal, and draws held-out photos with that of their neighbours.

    The exposure of a photo is the mean over the five photos around it by name, weighted 1, 2, 3, 2, 1.
    """
    views = sorted(dataset.train, key=lambda view: view.name)
    raw = exposures_of(views, dataset.points.positions.astype(np.float64))
    weights = np.array([1, 2, 3, 2, 1])
    around = np.convolve(np.pad(raw, 2, mode="edge"), weights / weights.sum(), "valid")
    print(f"exposure: {raw.std():.3f} stops, {(raw - around).std():.3f} of them not smooth", flush=True)

    def equal(view: View, stops: float) -> View:
        return replace(view, pixels=lambda: to_8bit(view.pixels() / 255 * 2**-stops))

    trained = plain(replace(dataset, train=tuple(map(equal, views, around.tolist()))), recipe)
    order = sorted(view.name for view in (*views, *dataset.test))
    ranks = [order.index(view.name) for view in views]
    gains = {
        view.name: float(2 ** np.interp(order.index(view.name), ranks, around)) for view in dataset.views
    }
    return replace(trained, gains=gains)


def scores(trained: Trained, views: Sequence[View]) -> Scores:
    """Returns the scores of a scene, drawn as its trial wants."""
    if not trained.gains:
        return sx.evaluate(trained.scene, views, renderer=trained.renderer)

    def compared(view: View) -> ViewScore:
        image = picture(trained.scene, view.camera) / 255 * trained.gains[view.name]
        return score(view.name, to_8bit(image), view.pixels())

    return Scores(tuple(map(compared, views)))


def haste(factor: float) -> Trial:
    """Returns the trial of another factor on the rates that `rates_for` raises."""
    raised = ("means", "means_final", "sh_dc", "sh_rest", "log_scales", "quats")
    return of(lambda r: rates(r, **dict.fromkeys(raised, factor)))


TRIALS: dict[str, Trial] = {
    "twice the steps": lambda d, r: plain(d, replace(default(2 * r.steps, room_for(d)), seed=r.seed)),
    "rates x 1.5": haste(1.5),
    "rates / 1.5": haste(1 / 1.5),
    "settled 0.15": of(lambda r: settling(r, 0.85, 0.15)),
    "settled 0.02": of(lambda r: settling(r, 0.85, 0.02)),
    "SH sooner": of(lambda r: replace(r, sh=ShSchedule(3, max(r.sh.every // 3, 1)))),
    "half size for 3/4": of(
        lambda r: replace(r, resolution=Resolution(((3 * r.steps // 4, 2),), smallest=60))
    ),
    "opacity noise 0.2": of(lambda r: with_noise(r, 0.2)),
    "opacity noise 0.5": of(lambda r: with_noise(r, 0.5)),
    "squares below 0.02": of(lambda r: with_loss(r, Huber(0.02))),
    "squares below 0.06": of(lambda r: with_loss(r, Huber(0.06))),
    "by depth": ordered(None, "depth"),
    "by depth: drawn by distance": ordered(None, "distance"),
    "by distance": ordered(0, "distance"),
    "by distance: drawn by depth": ordered(0, "depth"),
    "default: drawn by depth": ordered(0.5, "depth"),
    "a quarter by depth": ordered(0.25, "distance"),
    "a quarter by depth: drawn by depth": ordered(0.25, "depth"),
    "pulls from 0.2": far_pulls(0.2),
    "pulls from 0.37": far_pulls(0.37),
    "pulls from 0.7": far_pulls(0.7),
    "second order": by_second_order(),
    "second order wide": by_second_order(radius=0.2, radius_final=0.01),
    "second order narrow": by_second_order(radius=0.05, radius_final=0.0025),
    "second order slow": by_second_order(pace=0.1),
    "second order fast": by_second_order(pace=1.0),
    "bilateral grids": of(lambda r: replace(r, appearance=BilateralGrid())),
    "distilled": distilled(0.5),
    "sky of Gaussians": before_a_sky(500, 30.0),
    "sky of 200 Gaussians": before_a_sky(200, 30.0),
    "sky of 2000 Gaussians": before_a_sky(2_000, 30.0),
    "sky at 10 extents": before_a_sky(500, 10.0),
    "sky at 90 extents": before_a_sky(500, 90.0),
    "sky of harmonics": before_a_learned_sky,
    "smooth exposure": smooth_exposure,
}


def trial_named(name: str) -> Trial:
    """Returns a trial, or that of a variant of `measure_long.py`."""
    return TRIALS[name] if name in TRIALS else of(lambda recipe: varied(name, recipe))


def main(
    captures: Sequence[str], seeds: Sequence[int], trials: Sequence[str], steps: int, downscale: int
) -> None:
    """Prints a line for each run."""
    datasets = {capture: loaded(capture, downscale) for capture in captures}
    for seed in seeds:
        for name in trials:
            for capture, dataset in datasets.items():
                recipe = replace(default(steps, room_for(dataset)), seed=seed)
                trained = trial_named(name)(dataset, recipe)
                unseen, known = (scores(trained, views) for views in (dataset.test, dataset.train))
                print(
                    f"{capture.rsplit('/', 1)[-1]:8} seed {seed} {name:26} {unseen.psnr:6.2f} dB "
                    f"{unseen.ssim:.4f} corrected {unseen.corrected_psnr:.2f} (training photos "
                    f"{known.psnr:.2f} dB), {len(trained.scene):,} Gaussians, {trained.seconds:.1f} s of CPU",
                    flush=True,
                )


if __name__ == "__main__":
    folders, numbers, names = (argument.split(",") for argument in sys.argv[1:4])
    unknown = {name for name in names if name not in TRIALS and not {*name.split("+")} <= {*VARIANTS}}
    if unknown:
        sys.exit(f"no such trial: {', '.join(sorted(unknown))}. There are {', '.join([*TRIALS, *VARIANTS])}.")
    total, smaller = map(int, (*sys.argv[4:], *DEFAULTS[len(sys.argv[4:]) :]))
    main(folders, [int(number) for number in numbers], names, total, smaller)
