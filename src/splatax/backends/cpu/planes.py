"""The planes of Gaussians by the native library; see `splatax.surfaces` for what it computes.

JAX computes how a lens maps the points around each mean, for any lens. The library does all else, row by row,
so its numbers do not depend on how many rows there are or where they live. Second derivatives come from the
portable formulas.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from splatax import surfaces
from splatax.backends.cpu.library import Build
from splatax.backends.linear import Batched, linear_call
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.surfaces import Found, PlaneRows, Planes, planes_of_rows

MOVING = len(PlaneRows._fields) - 1  # all fields but the extents have a derivative


def planes(gaussians: Gaussians, camera: Camera, splats: Splats, build: Build) -> Planes:
    """Returns the planes of Gaussians in one view; see `splatax.surfaces.planes`."""
    return surfaces.planes(gaussians, camera, splats, NativeRows(build))


@dataclass(frozen=True)
class NativeRows:
    """The kernel that computes the planes of rows. Equal ones share compiled programs.

    Attributes:
        build: the native library.
    """

    build: Build

    def __call__(self, rows: PlaneRows) -> Found:
        """Returns what `splatax.surfaces.planes_of_rows` does."""
        return _find(rows, self.build)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _find(rows: PlaneRows, build: Build) -> Found:
    slopes, normals, axes = _call(build, "splatax_planes_forward", rows, _shapes(rows), [])
    return slopes, normals, axes


@_find.defjvp
def _(build: Build, primals, tangents):
    (rows,), (directions,) = primals, tangents
    found = _find(rows, build)
    return found, linear_call(Derivative(build), rows, tuple(directions[:MOVING]), found)


@dataclass(frozen=True)
class Derivative:
    """The derivative of the planes of rows.

    Attributes:
        build: the native library.
    """

    build: Build

    def apply(self, residuals: PlaneRows, tangents: tuple[Array, ...]) -> Found:
        """Returns the tangents of the planes."""
        return _push(residuals, tuple(tangents), self.build)

    def transpose(self, residuals: PlaneRows, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the rows' fields but the extents."""
        return _pull_back(residuals, tuple(cotangents), self.build)

    def batched(self, each: Batched) -> None:
        """Returns None: the map of a batch is made by `jax.vmap`, and the library takes batches."""


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _push(rows: PlaneRows, tangents: tuple[Array, ...], build: Build) -> Found:
    directions = rows._replace(**dict(zip(PlaneRows._fields, tangents, strict=False)))
    slopes, normals, axes = _call(
        build, "splatax_planes_tangent", rows, _shapes(rows), _flat(directions)[:MOVING]
    )
    return slopes, normals, axes


@_push.defjvp
def _(build: Build, primals, tangents):
    return _push(*primals, build), jax.jvp(_portable_push, primals, tangents)[1]


def _portable_push(rows: PlaneRows, tangents: tuple[Array, ...]) -> Found:
    def found(moving: tuple[Array, ...]) -> Found:
        return planes_of_rows(PlaneRows._make((*moving, rows.extents)))

    return jax.jvp(found, (tuple(rows[:MOVING]),), (tangents,))[1]


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _pull_back(rows: PlaneRows, cotangents: tuple[Array, ...], build: Build) -> tuple[Array, ...]:
    shapes = [array.shape for array in _flat(rows)[:MOVING]]
    places, *others = _call(build, "splatax_planes_backward", rows, shapes, cotangents)
    return places.reshape(rows.places.shape), *others


@_pull_back.defjvp
def _(build: Build, primals, tangents):
    def gradient(rows: PlaneRows, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        def found(moving: tuple[Array, ...]) -> Found:
            return planes_of_rows(PlaneRows._make((*moving, rows.extents)))

        return jax.vjp(found, tuple(rows[:MOVING]))[1](cotangents)[0]

    return _pull_back(*primals, build), jax.jvp(gradient, primals, tangents)[1]


def _flat(rows: PlaneRows) -> list[Array]:
    """Returns the arrays as the library takes them, with the places of a row as nine numbers."""
    flat = rows._replace(places=jnp.reshape(rows.places, (len(rows.places), 9)))
    return [array for array in flat if array is not None]


def _shapes(rows: PlaneRows) -> list[tuple[int, ...]]:
    """Returns the shapes of slopes, normals and axes."""
    n = len(rows.disparities)
    return [(n, 2), (n, 3), (n, 3)]


def _call(
    build: Build, symbol: str, rows: PlaneRows, shapes: Sequence[tuple[int, ...]], more: Sequence[Array]
) -> tuple[Array, ...]:
    """Calls a function of the library with the rows, and with more arrays."""
    blurred = np.int64(rows.blurs is not None and len(rows.blurs) > 0)
    return tuple(build.call(symbol, shapes, [*_flat(rows), *more], batches=True, blurred=blurred))
