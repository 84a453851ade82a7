"""Foreign projections: their inputs, and their derivatives in both modes.

A kernel serves one kind of lens, for cameras that do not move, by EWA; the portable projection serves all
others, and second derivatives. Gradients, and tangents where the kernel has them, are the kernel's own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from splatax import projection
from splatax.backends.foreign import Shape
from splatax.backends.linear import Batched, OfBatch, linear_call
from splatax.backends.packed_cameras import POSE_END, Layout, PackedCamera, packed, packed_lens
from splatax.cameras import Camera
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.splats import Splats

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")  # in the order of the kernels
RESIDUALS = jax.tree.structure(((0,) * len(FIELDS), 0, 0))
Options = Mapping[str, np.int64 | np.float32]


@runtime_checkable
class Kernel(Protocol):
    """A foreign projection through one kind of lens, and its derivatives. It must be hashable."""

    @property
    def shares_scenes(self) -> bool:
        """True if the gradient of a scene that a batch of cameras shares is summed in one call."""
        ...

    def forward(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the arrays of `Splats`, from those of the scene and the packed camera."""
        ...

    def gradient(self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options) -> Sequence[Array]:
        """Returns the gradients of the scene's arrays and of the packed camera."""
        ...

    def tangent(
        self, shapes: Sequence[Shape], arrays: Sequence[Array], options: Options
    ) -> Sequence[Array] | None:
        """Returns the tangents of the differentiable arrays of `Splats`, or None if plain JAX finds them.

        The tangents of inputs that do not move have no rows.
        """
        ...


ProjectionKernels = Mapping[type, Kernel]  # by kind of lens


@dataclass(frozen=True)
class Settings:
    """The static settings of a projection.

    Attributes:
        kernel: the foreign functions.
        layout: of packed cameras.
        low_pass: the filter.
    """

    kernel: Kernel
    layout: Layout
    low_pass: LowPass

    @property
    def options(self) -> Options:
        """The attributes of a call."""
        fades = isinstance(self.low_pass, Antialiasing)
        return {
            "width": np.int64(self.layout.width),
            "height": np.int64(self.layout.height),
            "variance": np.float32(self.low_pass.variance),
            "fades": np.int64(fades),
            "least_fade": np.float32(self.low_pass.floor if isinstance(self.low_pass, Antialiasing) else 0),
        }

    def portable(self, arrays: tuple[Array, ...], camera: PackedCamera) -> tuple[Array, ...]:
        """Returns what the kernel does, by plain JAX."""
        one = partial(
            projection.project_one,
            camera=self.layout.camera(camera),
            position=camera[16:POSE_END],
            low_pass=self.low_pass,
            method=EWA,
        )
        rows = jax.vmap(lambda *fields: one(*fields))(*arrays)
        return tuple(rows._replace(extent=jax.lax.stop_gradient(rows.extent)))


def project(
    gaussians: Gaussians,
    camera: Camera,
    low_pass: LowPass,
    method: Method = EWA,
    *,
    kernels: ProjectionKernels,
) -> Splats:
    """Projects all Gaussians to one view. Differentiable in the Gaussians and the camera.

    Args:
        gaussians: n Gaussians.
        camera: of the view.
        low_pass: filter against aliasing.
        method: way to find footprints.
        kernels: the foreign projections, by kind of lens.
    """
    kernel = kernel_for(camera, kernels)
    if kernel is None or method != EWA:
        return projection.project(gaussians, camera, low_pass, method)
    arrays = tuple(getattr(gaussians, field) for field in FIELDS)
    settings = Settings(kernel, Layout.of(camera), low_pass)
    found = _project(arrays, packed(camera), camera.frame, settings)
    means2d, sqrt_conics, depths, extents, colors, opacities = found
    return Splats(means2d, sqrt_conics, depths, extents, colors, opacities, camera.width, camera.height)


def kernel_for(camera: Camera, kernels: ProjectionKernels) -> Kernel | None:
    """Returns the foreign projection for a camera, or None if there is none."""
    if camera.motion is not None:
        return None
    return kernels.get(type(packed_lens(camera)))


@partial(jax.custom_jvp, nondiff_argnums=(3,))
def _project(
    arrays: tuple[Array, ...], camera: PackedCamera, frame: Float[Array, "2"] | None, settings: Settings
) -> tuple[Array, ...]:
    n = len(arrays[0])
    shapes: list[Shape] = [(n, 2), (n, 3), (n,), (n, 2), (n, 3), (n,)]
    found = tuple(settings.kernel.forward(shapes, (*arrays, camera), settings.options))
    if frame is None:
        return found
    means2d, sqrt_conics, depths, extents, *rest = found
    inside = jnp.all(means2d - extents < frame[None], axis=1, keepdims=True)  # kernels cull by the canvas
    return means2d, sqrt_conics, depths, jnp.where(inside, extents, 0), *rest


@partial(_project.defjvp, symbolic_zeros=True)
def _(settings: Settings, primals, tangents):
    arrays, camera, frame = primals
    splats = _project(arrays, camera, frame, settings)
    moving = tuple(not isinstance(tangent, SymbolicZero) for tangent in (*tangents[0], tangents[1]))
    directions = tuple(
        tangent if moves else jnp.zeros(tangent.shape, tangent.dtype)
        for tangent, moves in zip((*tangents[0], tangents[1]), moving, strict=True)
    )
    return splats, linear_call(Derivative(settings, moving), (arrays, camera, splats[3]), directions, splats)


@dataclass(frozen=True)
class Derivative:
    """The derivative of a projection.

    Attributes:
        settings: of the projection.
        moving: which of the Gaussians' arrays and the camera have a tangent; those of the others are zero.
    """

    settings: Settings
    moving: tuple[bool, ...]

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats."""
        chosen = tuple(
            tangent if moves else None for tangent, moves in zip(tangents, self.moving, strict=True)
        )
        return _push(residuals, chosen, self.settings)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the Gaussians' arrays and of the camera."""
        return _pull_back(residuals, cotangents, self.settings)

    def batched(self, each: Batched) -> OfBatch | None:
        """Returns the map of a batch of cameras that share a scene; None for other batches."""
        scene = (None,) * len(FIELDS)
        shares = each.residuals == (*scene, 0, 0) and each.tangents[:5] == scene
        if self.settings.kernel.shares_scenes and shares:
            return OfBatch(SharedScene(self.settings, each))
        return None


@dataclass(frozen=True)
class SharedScene:
    """The derivative of a batch of cameras that share a scene, whose gradient is summed in the foreign call.

    Attributes:
        settings: of each projection.
        each: the same derivative, camera by camera.
    """

    settings: Settings
    each: Batched

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats of all cameras."""
        return self.each.apply(residuals, tangents)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the scene, summed over the cameras, and that of the cameras."""
        arrays, camera, extents = residuals
        leading = tuple(array[None] for array in arrays)
        *scene, d_camera = _pull_back((leading, camera, extents), cotangents, self.settings)
        if self.each.tangents[5] is None:
            d_camera = jnp.sum(d_camera, axis=0)
        return (*(array[0] for array in scene), d_camera)

    def batched(self, each: Batched) -> OfBatch:
        """Returns the map that `jax.vmap` makes of the same derivative, camera by camera."""
        return OfBatch(replace(each, inner=self.each))


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _push(residuals, tangents: tuple[Array | None, ...], settings: Settings) -> tuple[Array, ...]:
    """Returns the tangents of the splats; None stands for the tangent of what does not move."""
    arrays, camera, extents = residuals
    inputs = (*arrays, camera)
    given = [
        jnp.zeros((0, *array.shape[1:]), array.dtype) if tangent is None else tangent
        for array, tangent in zip(inputs, tangents, strict=True)
    ]
    n = len(arrays[0])
    shapes: list[Shape] = [(n, 2), (n, 3), (n,), (n, 3), (n,)]
    found = settings.kernel.tangent(shapes, (*inputs, extents, *given), settings.options)
    if found is None:
        return _portable_push(residuals, tangents, settings)
    means2d, sqrt_conics, depths, colors, opacities = found
    return means2d, sqrt_conics, depths, jnp.zeros_like(extents), colors, opacities


@_push.defjvp
def _(settings: Settings, primals, tangents):
    def push(residuals, directions):
        return _portable_push(residuals, directions, settings)

    return _push(*primals, settings), jax.jvp(push, primals, tangents)[1]


def _portable_push(residuals, tangents: tuple[Array | None, ...], settings: Settings) -> tuple[Array, ...]:
    arrays, camera, extents = residuals
    point = (*arrays, camera)
    moving = [i for i, tangent in enumerate(tangents) if tangent is not None]

    def splats(*values):
        inputs = list(point)
        for i, value in zip(moving, values, strict=True):
            inputs[i] = value
        return settings.portable(tuple(inputs[:-1]), inputs[-1])

    _, found = jax.jvp(splats, [point[i] for i in moving], [tangents[i] for i in moving])
    return _shown(extents, found)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _pull_back(residuals, cotangents: tuple[Array, ...], settings: Settings) -> tuple[Array, ...]:
    """Returns the gradients; those of a scene with a leading axis of 1 are summed over the cameras."""
    arrays, camera, extents = residuals
    d_means2d, d_sqrt_conics, d_depths, _, d_colors, d_opacities = cotangents
    inputs = (*arrays, camera, extents, d_means2d, d_sqrt_conics, d_depths, d_colors, d_opacities)
    shapes = [array.shape for array in (*arrays, camera)]
    return tuple(settings.kernel.gradient(shapes, inputs, settings.options))


@_pull_back.defjvp
def _(settings: Settings, primals, tangents):
    (arrays, camera, extents), cotangents = primals
    (d_arrays, d_camera, _), d_cotangents = tangents

    def gradient(arrays, camera, cotangents):
        if extents.ndim == 3:  # cameras that share a scene

            def all_splats(arrays, camera):
                scene = tuple(array[0] for array in arrays)
                return jax.vmap(settings.portable, (None, 0))(scene, camera)

        else:
            all_splats = settings.portable
        d_arrays, d_camera = jax.vjp(all_splats, arrays, camera)[1](_shown(extents, cotangents))
        return (*d_arrays, d_camera)

    _, out = jax.jvp(gradient, (arrays, camera, cotangents), (d_arrays, d_camera, d_cotangents))
    return _pull_back(*primals, settings), out


def _shown(extents: Float[Array, "*c n 2"], arrays: tuple[Array, ...]) -> tuple[Array, ...]:
    """Returns arrays of splats with zeros where the splats are culled."""
    drawn = extents[..., :1] > 0
    flat = drawn[..., 0]
    return tuple(jnp.where(drawn if array.ndim == drawn.ndim else flat, array, 0) for array in arrays)
