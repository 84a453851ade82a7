"""The pose of a part from one RGB-D frame, by the gradient of its rendering."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.cameras.geometry import points_at
from splatax.errors import InputError
from splatax.pytrees import pytree
from splatax.rendering import BLACK, Renderer
from splatax.scene import Scene
from splatax.sensors.depth import local_points, travelled
from splatax.transforms import Similarity

COVERED = 0.5  # least alpha of a pixel with a surface
LEAST_AHEAD = 1e-3  # z of a point at lens depth 1, below which its z says nothing about the distance


@dataclass(frozen=True)
class LocationSearch:
    """Settings of a search for the pose of a part.

    Attributes:
        steps: number of steps of Adam, at least 1.
        shifting: fraction of the steps, at the start, in which the part is shifted and not turned. A small
            part that is some pixels beside its place gets a wrong turn, from which it may not come back.
        rate: learning rate at the start, radians per step, and fractions of the part's radius per step for
            the translation; it falls log-linearly.
        final: fraction of `rate` at the end.
        depth_weight: weight of relative depth errors beside those of colour.
        most: relative depth error from which a pixel counts no more, because it shows another surface.
    """

    steps: int = 200
    shifting: float = 0.3
    rate: float = 0.02
    final: float = 0.05
    depth_weight: float = 20.0
    most: float = 0.1


@dataclass(frozen=True)
class RgbdFrame:
    """A photo with a depth image from one camera.

    Attributes:
        camera: camera of the images' size.
        rgb: display-referred colour, in [0, 1].
        depth: as `sensors.Depth(along=...)` measures it, in units of the scene; 0, NaN or infinite where it
            is not measured.
        along: "axis" for z in camera axes, "ray" for the distance along the pixel's ray. A panorama needs
            "ray": z is not above 0 at the sides and behind the camera, where "axis" measures nothing.
    """

    camera: Camera
    rgb: Float[np.ndarray, "h w 3"] | Float[Array, "h w 3"]
    depth: Float[np.ndarray, "h w"] | Float[Array, "h w"]
    along: Literal["axis", "ray"] = "axis"

    def lens_depths(self) -> Float[Array, "h w"]:
        """Returns the depths as the camera's lens defines them, as `render` draws them; 0 where unknown.

        They are z for perspective lenses, and the distance for fisheyes and panoramas.
        """
        measured = jnp.asarray(self.depth, jnp.float32)
        # The points of a ray have z, distance and lens depth in fixed proportions; parallel rays have z only.
        points = local_points(self.camera, jnp.ones_like(measured))
        unit = points[..., 2] if self.along == "axis" else travelled(self.camera, points)
        known = jnp.isfinite(measured) & (measured > 0) & (unit > LEAST_AHEAD)
        return jnp.where(known, measured / jnp.where(known, unit, 1), 0)

    def points(self) -> Float[np.ndarray, "n 3"]:
        """Returns the world points of the pixels whose depth is measured, row by row.

        They serve as the landmarks of a training view, `View(..., landmarks=frame.points)`, which
        `training.geometry.Surfaces` compares with the depth of the scene.
        """
        depth = np.asarray(self.lens_depths())
        rows, columns = np.nonzero(depth)
        return points_at(self.camera, np.stack([columns, rows], axis=1) + 0.5, depth[rows, columns])


def located(
    scene: Scene,
    name: str,
    frame: RgbdFrame,
    search: LocationSearch = LocationSearch(),
    renderer: Renderer = Renderer(BLACK),
) -> Similarity:
    """Returns the pose of a part that makes the scene look like a frame; see `location_search`."""
    *_, (pose, _) = location_search(scene, name, frame, search, renderer)
    return pose


def location_search(
    scene: Scene,
    name: str,
    frame: RgbdFrame,
    search: LocationSearch = LocationSearch(),
    renderer: Renderer = Renderer(BLACK),
) -> Iterator[tuple[Similarity, Float[Array, ""]]]:
    """Moves a part rigidly towards a frame, and yields its pose and the loss after each step.

    The loss is the mean absolute difference of colour, plus that of relative depth over the pixels where both
    have a surface. The part is shifted first, and then also turned about its middle. The other parts stay.

    Args:
        scene: the parts, at poses near those in the frame.
        name: the part to move.
        frame: the colour and depth to match.
        search: settings.
        renderer: background, filter and backend.

    Raises:
        InputError: if the images do not have the camera's size, there are no steps, or the fraction of
            those that only shift is not in [0, 1].
        ValueError: if there is no part of this name.
    """
    size = (frame.camera.height, frame.camera.width)
    if frame.rgb.shape[:2] != size or frame.depth.shape != size:
        raise InputError(
            f"images of {frame.rgb.shape[:2]} and {frame.depth.shape} pixels (height, width) for a camera of "
            f"{size}. Give images of the camera's size."
        )
    if search.steps < 1:
        raise InputError(f"a search of {search.steps} steps. Give at least 1.")
    if not 0 <= search.shifting <= 1:
        raise InputError(f"a fraction {search.shifting} of steps that only shift. Give a number from 0 to 1.")
    start = scene[name].pose.cast(jnp.float32)
    means = np.asarray(scene[name].gaussians.means, np.float64)
    means = means[np.isfinite(means).all(axis=1)]
    middle = np.median(means, axis=0)
    radius = jnp.float32(np.median(np.linalg.norm(means - middle, axis=1)) * float(start.scale))
    pivot = start.scale * (start.rotation @ jnp.asarray(middle, jnp.float32)) + start.translation
    place = _Place(start, jnp.asarray(pivot), radius)
    rate = optax.exponential_decay(search.rate, search.steps, search.final)
    rule, steps = optax.adam(rate), jnp.zeros(6)
    state = rule.init(steps)
    target = jnp.asarray(frame.rgb, jnp.float32), frame.lens_depths()
    weights = jnp.array([search.depth_weight, search.most], jnp.float32)

    for step in range(search.steps):
        value, gradient = _compare(steps, place, scene, target, frame.camera, weights, renderer, name)
        gradient = jnp.nan_to_num(gradient)
        if step < search.shifting * search.steps:
            gradient = gradient.at[:3].set(0)
        updates, state = rule.update(gradient, state)
        steps = jnp.asarray(optax.apply_updates(steps, updates))
        yield place.moved(steps), value


@pytree
@dataclass(frozen=True)
class _Place:
    """Where a part starts, the point that it turns about, and its radius."""

    start: Similarity
    pivot: Float[Array, "3"]
    radius: Float[Array, ""]

    def moved(self, steps: Float[Array, "6"]) -> Similarity:
        """Returns the start, turned about the pivot, and then shifted by multiples of the radius."""
        turn = Similarity.from_twist(jnp.concatenate([steps[:3], jnp.zeros(3)])).rotation
        place = self.pivot + turn @ (self.start.translation - self.pivot) + self.radius * steps[3:]
        return Similarity(turn @ self.start.rotation, place, self.start.scale)


@partial(jax.jit, static_argnames="name")
@jax.value_and_grad
def _compare(steps, place, scene, target, camera, weights, renderer, name):
    moved = scene.posed({name: place.moved(steps)})
    drawn = renderer(moved, camera, ("rgb", "alpha", "median_surface_depth"))
    rgb, depth = target
    depth_weight, most = weights
    both = (depth > 0) & (drawn.median_surface_depth > 0) & (drawn.alpha >= COVERED)
    apart = jnp.abs(drawn.median_surface_depth - depth) / jnp.where(both, depth, 1)
    apart = jnp.where(both, jnp.minimum(apart, most), 0)
    return jnp.mean(jnp.abs(drawn.rgb - rgb)) + depth_weight * jnp.sum(apart) / jnp.maximum(jnp.sum(both), 1)
