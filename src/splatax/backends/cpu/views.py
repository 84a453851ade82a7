"""Batches of views of one scene, which the native library draws from Gaussians to images in one call.

One view is drawn by the projection and the rasterizer, one after the other. In a batch, the splats of all
views would take longer to write and to read than to draw, because most Gaussians are outside most views. The
native call projects only the Gaussians that a camera may see, and draws them while they are in the caches.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.batchable import Places, batchable_call
from splatax.backends.cpu.library import Build
from splatax.backends.linear import Batched, linear_call
from splatax.backends.projection_kernels import FIELDS, packed
from splatax.backends.protocol import Composite, Project
from splatax.cameras import Camera
from splatax.cameras.lenses import Pinhole
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.order import Order
from splatax.projection import in_order
from splatax.splats import for_kernels

Images = tuple[Float[Array, "*v h w c"], Float[Array, "*v h w"]]


@dataclass(frozen=True)
class NativeDrawing:
    """The native kernel from Gaussians to images, for pinholes; see `splatax.backends.protocol.Draw`.

    Attributes:
        build: the native library.
        max_pairs: see `kernels` of this backend.
        project, composite: kernels of the same backend, which draw single views.
    """

    build: Build
    max_pairs: int
    project: Project
    composite: Composite

    def fits(self, camera: Camera, method: Method) -> bool:
        """Returns whether it draws what such a camera sees."""
        return isinstance(camera.lens, Pinhole) and camera.motion is None and method == EWA

    def __call__(self, gaussians: Gaussians, camera: Camera, low_pass: LowPass, depths: bool) -> Images:
        """Returns the sums of weighted colours, and of depths if they are asked for, and alpha."""
        leaves, structure = jax.tree.flatten((gaussians, camera))
        rows, matrix = jax.typeof(gaussians.sh), jax.typeof(gaussians.means)
        types = (
            rows.update(shape=(camera.height, camera.width, 4 if depths else 3)),
            matrix.update(shape=(camera.height, camera.width)),
        )
        sums, alpha = batchable_call(
            View(self, structure, low_pass, gaussians.order, depths), tuple(leaves), types
        )
        return sums, alpha


@dataclass(frozen=True)
class View:
    """A view of a scene, or a batch of them.

    Attributes:
        drawing: the kernels.
        structure: of Gaussians and camera.
        low_pass: the filter.
        order: of the splats.
        depths: whether depths are blended too.
    """

    drawing: NativeDrawing
    structure: Any
    low_pass: LowPass
    order: Order
    depths: bool

    def one(self, *leaves: Array) -> Images:
        """Draws one view."""
        gaussians, camera = jax.tree.unflatten(self.structure, leaves)
        splats = in_order(self.drawing.project(gaussians, camera, self.low_pass), gaussians, camera)
        columns = [splats.colors, splats.depths[:, None]] if self.depths else [splats.colors]
        return self.drawing.composite(for_kernels(splats), jnp.concatenate(columns, axis=1))

    def batch(self, size: int, places: Places, leaves: tuple[Array, ...]) -> Images | None:
        """Draws the views of one scene; None where each view has a scene of its own."""
        if any(place is not None for place in places[: len(FIELDS)]):
            return None
        cameras = [
            leaf if place == 0 else jnp.broadcast_to(leaf, (size, *leaf.shape))
            for leaf, place in zip(leaves, places, strict=True)
        ]
        return _draw((*leaves[: len(FIELDS)], *cameras[len(FIELDS) :]), self)

    def one_by_one(self, leaves: tuple[Array, ...]) -> Images:
        """Draws the views of one scene by the kernels for single views."""
        scene, cameras = leaves[: len(FIELDS)], leaves[len(FIELDS) :]
        return jax.vmap(lambda *camera: self.one(*scene, *camera))(*cameras)

    def arguments(self, leaves: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the arrays of a native call that have gradients: those of the scene, and packed cameras."""
        gaussians, cameras = jax.tree.unflatten(self.structure, leaves)
        # The kernel finds the box of slopes from the frame, as it does for a pinhole without one.
        return (
            *(getattr(gaussians, field) for field in FIELDS),
            jax.vmap(packed)(replace(cameras, frame=None)),
        )

    def frames(self, leaves: tuple[Array, ...]) -> Float[Array, "v 2"]:
        """Returns the width and height of what each camera fills of its image, pixels."""
        _, cameras = jax.tree.unflatten(self.structure, leaves)
        return jax.vmap(lambda camera: camera.size)(cameras)

    def call(
        self, symbol: str, shapes: list[tuple[int, ...]], arrays: tuple[Array, ...]
    ) -> tuple[Array, ...]:
        """Calls a function of the native library."""
        fades = isinstance(self.low_pass, Antialiasing)
        floor = self.low_pass.floor if isinstance(self.low_pass, Antialiasing) else 0
        return tuple(
            self.drawing.build.call(
                symbol,
                shapes,
                arrays,
                max_pairs=np.int64(self.drawing.max_pairs),
                variance=np.float32(self.low_pass.variance),
                fades=np.int64(fades),
                least_fade=np.float32(floor),
                by_distance=np.int64(self.order == "distance"),
            )
        )


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _draw(leaves: tuple[Array, ...], view: View) -> Images:
    arrays = view.arguments(leaves)
    _, camera = jax.tree.unflatten(view.structure, leaves)
    size = (arrays[-1].shape[0], camera.height, camera.width)
    shapes = [(*size, 4 if view.depths else 3), size]
    sums, alpha = view.call("splatax_scene_forward", shapes, (*arrays, view.frames(leaves)))
    return sums, alpha


@_draw.defjvp
def _(view: View, primals, tangents):
    images = _draw(*primals, view)
    return images, linear_call(Derivative(view), (*primals, images), tangents[0], images)


@dataclass(frozen=True)
class Derivative:
    """The derivative of a batch of views: backward by the native library, forward view by view."""

    view: View

    def apply(self, residuals, tangents: tuple[Array, ...]) -> Images:
        """Returns the tangents of the images."""
        return jax.jvp(self.view.one_by_one, residuals[:1], (tuple(tangents),))[1]

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the scene, summed over the views, and of the cameras."""
        return _pull_back(residuals, tuple(cotangents), self.view)

    def batched(self, each: Batched) -> None:
        """Returns None: a batch of batches is drawn batch by batch."""


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _pull_back(residuals, cotangents: tuple[Array, ...], view: View) -> tuple[Array, ...]:
    leaves, images = residuals
    arrays = view.arguments(leaves)
    shapes = [array.shape for array in arrays]
    inputs = (*arrays, view.frames(leaves), *images, *cotangents)
    gradients = view.call("splatax_scene_backward", shapes, inputs)
    return jax.vjp(view.arguments, leaves)[1](gradients)[0]


@_pull_back.defjvp
def _(view: View, primals, tangents):
    # The images are functions of the leaves, so their own tangents are not used.
    def gradient(leaves, cotangents):
        return jax.vjp(view.one_by_one, leaves)[1](cotangents)[0]

    (leaves, _), cotangents = primals
    (d_leaves, _), d_cotangents = tangents
    _, out = jax.jvp(gradient, (leaves, cotangents), (d_leaves, d_cotangents))
    return _pull_back(*primals, view), out
