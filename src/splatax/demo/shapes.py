"""Surfaces with closed-form ray intersections, for one ray; `jax.vmap` maps the functions over many."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Point = Float[Array, "3"]
Scalar = Float[Array, ""]
Vector = tuple[float | int, float | int, float | int]

NEAREST = 1e-3  # least distance of an intersection: a shadow ray must not meet the surface it leaves


@runtime_checkable
class Shape(Protocol):
    """A surface that rays can intersect."""

    def distance(self, origin: Point, direction: Point) -> Scalar:
        """Returns the distance to the first intersection along a unit direction; infinite if none."""
        ...

    def normal(self, point: Point) -> Point:
        """Returns the outward unit normal at a point on the surface."""
        ...


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    centre: Vector
    radius: float

    def distance(self, origin: Point, direction: Point) -> Scalar:
        return round_distance(origin - jnp.array(self.centre, float), direction, self.radius)

    def normal(self, point: Point) -> Point:
        return (point - jnp.array(self.centre, float)) / self.radius


@dataclass(frozen=True)
class Rectangle:
    """The parallelogram corner + s a + t b for s, t in [0, 1]; its normal is along a x b."""

    corner: Vector
    a: Vector
    b: Vector

    def distance(self, origin: Point, direction: Point) -> Scalar:
        normal = jnp.array(np.cross(self.a, self.b), float)
        along = (jnp.array(self.corner, float) - origin) @ normal / (direction @ normal)
        axes = jnp.array(np.linalg.pinv(np.stack([self.a, self.b], axis=1)))
        coordinates = axes @ (origin + along * direction - jnp.array(self.corner, float))
        inside = jnp.all((coordinates >= 0) & (coordinates <= 1)) & (along > NEAREST)
        return jnp.where(inside, along, jnp.inf)

    def normal(self, point: Point) -> Point:
        normal = np.cross(self.a, self.b)
        return jnp.array(normal / np.linalg.norm(normal))


@dataclass(frozen=True)
class Cylinder:
    """A cylinder from `base` to `top`, closed by discs."""

    base: Vector
    top: Vector
    radius: float

    @property
    def length(self) -> float:
        return float(np.linalg.norm(np.subtract(self.top, self.base)))

    @property
    def axis(self) -> Point:
        return jnp.array(np.subtract(self.top, self.base) / self.length)

    def split(self, vector: Point) -> tuple[Scalar, Point]:
        """Splits a vector into its component along the axis and the remainder across it."""
        along = vector @ self.axis
        return along, vector - along * self.axis

    def distance(self, origin: Point, direction: Point) -> Scalar:
        height, offset = self.split(origin - jnp.array(self.base, float))
        climb, across = self.split(direction)
        side = round_distance(offset, across, self.radius)
        on_side = (height + side * climb >= 0) & (height + side * climb <= self.length)
        best = jnp.where(on_side, side, jnp.inf)
        for end in (0.0, self.length):
            along = (end - height) / climb
            out = offset + along * across
            on_disc = (along > NEAREST) & (out @ out <= self.radius**2)
            best = jnp.minimum(best, jnp.where(on_disc, along, jnp.inf))
        return best

    def normal(self, point: Point) -> Point:
        height, outward = self.split(point - jnp.array(self.base, float))
        on_side = (height > NEAREST) & (height < self.length - NEAREST)
        ends = jnp.where(height > self.length / 2, 1, -1) * self.axis
        return jnp.where(on_side, outward / jnp.linalg.norm(outward), ends)


def box(corner: Vector, a: Vector, b: Vector, c: Vector) -> list[Rectangle]:
    """Returns the six faces of the box spanned by three edges, with outward normals."""
    faces = []
    for first, second, third in ((a, b, c), (b, c, a), (c, a, b)):
        opposite = tuple(np.add(corner, third).tolist())
        faces += [Rectangle(opposite, first, second), Rectangle(corner, second, first)]
    return faces


def round_distance(offset: Point, direction: Point, radius: float) -> Scalar:
    """Returns the least distance beyond `NEAREST` at which a ray is at `radius` from the origin.

    The solution starts from the ray's closest approach, because the textbook's discriminant cancels
    for thin shapes seen from afar (Haines et al. 2019).
    """
    squared = direction @ direction
    approach = -(offset @ direction) / squared
    closest = offset + approach * direction
    # NaN, which counts as a miss, if the ray passes by.
    half = jnp.sqrt((radius**2 - closest @ closest) / squared)
    near, far = approach - half, approach + half
    return jnp.where(near > NEAREST, near, jnp.where(far > NEAREST, far, jnp.inf))
