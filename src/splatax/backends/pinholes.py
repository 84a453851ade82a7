"""Projection by foreign kernels that know only pinholes: their inputs, and their derivatives in both modes.

The kernels serve cameras that do not move, by EWA; the portable projection serves all others. Gradients are
the kernels' own. Forward mode and second derivatives come from the portable projection, which JAX
differentiates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import projection
from splatax.backends.foreign import Shape
from splatax.backends.linear import Batched, Dims, linear_call
from splatax.cameras import Camera
from splatax.cameras.lenses import Pinhole
from splatax.footprints import EWA, Method
from splatax.gaussians import Gaussians
from splatax.low_pass import Antialiasing, LowPass
from splatax.splats import Splats

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")  # in the order of the kernels
RESIDUALS = jax.tree.structure(((0,) * len(FIELDS), 0, 0))
PackedCamera = Float[Array, "19"]  # fx, fy, cx, cy, rotation by rows, translation, position
Options = Mapping[str, np.int64 | np.float32]


@runtime_checkable
class Kernel(Protocol):
    """A foreign projection and its gradient. It must be hashable."""

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


@dataclass(frozen=True)
class Settings:
    """The static settings of a projection.

    Attributes:
        kernel: the foreign functions.
        width, height: of the image, pixels.
        low_pass: the filter.
    """

    kernel: Kernel
    width: int
    height: int
    low_pass: LowPass

    @property
    def options(self) -> Options:
        """The attributes of a call."""
        fades = isinstance(self.low_pass, Antialiasing)
        return {
            "width": np.int64(self.width),
            "height": np.int64(self.height),
            "variance": np.float32(self.low_pass.variance),
            "fades": np.int64(fades),
            "least_fade": np.float32(self.low_pass.floor if isinstance(self.low_pass, Antialiasing) else 0),
        }

    def portable(self, arrays: tuple[Array, ...], camera: PackedCamera) -> tuple[Array, ...]:
        """Returns what the kernel does, by plain JAX."""
        fx, fy, cx, cy = camera[:4]
        pose = jnp.eye(4, dtype=camera.dtype).at[:3, :3].set(camera[4:13].reshape(3, 3))
        view = Camera(fx, fy, cx, cy, pose.at[:3, 3].set(camera[13:16]), self.width, self.height)
        one = partial(
            projection.project_one, camera=view, position=camera[16:], low_pass=self.low_pass, method=EWA
        )
        rows = jax.vmap(lambda *fields: one(*fields))(*arrays)
        return tuple(rows._replace(extent=jax.lax.stop_gradient(rows.extent)))


def project(
    gaussians: Gaussians, camera: Camera, low_pass: LowPass, method: Method = EWA, *, kernel: Kernel
) -> Splats:
    """Projects all Gaussians to one view. Differentiable in the Gaussians and the camera."""
    still = camera.motion is None and camera.frame is None  # the kernels know no canvases
    if not (isinstance(camera.lens, Pinhole) and still and method == EWA):
        return projection.project(gaussians, camera, low_pass, method)
    arrays = tuple(getattr(gaussians, field) for field in FIELDS)
    settings = Settings(kernel, camera.width, camera.height, low_pass)
    means2d, sqrt_conics, depths, extents, colors, opacities = _project(arrays, packed(camera), settings)
    return Splats(means2d, sqrt_conics, depths, extents, colors, opacities, camera.width, camera.height)


def packed(camera: Camera) -> PackedCamera:
    """Returns the numbers of a camera as one array, as `CameraField` in native/ orders them."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    return jnp.concatenate(
        [jnp.stack(numbers), jnp.ravel(camera.rotation), camera.translation, camera.position]
    )


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _project(arrays: tuple[Array, ...], camera: PackedCamera, settings: Settings) -> tuple[Array, ...]:
    n = len(arrays[0])
    shapes: list[Shape] = [(n, 2), (n, 3), (n,), (n, 2), (n, 3), (n,)]
    return tuple(settings.kernel.forward(shapes, (*arrays, camera), settings.options))


@_project.defjvp
def _(settings: Settings, primals, tangents):
    arrays, camera = primals
    splats = _project(arrays, camera, settings)
    directions = (*tangents[0], tangents[1])
    return splats, linear_call(Derivative(settings), (arrays, camera, splats[3]), directions, splats)


@dataclass(frozen=True)
class Derivative:
    """The derivative of a projection: backward by the kernel, forward by the portable projection."""

    settings: Settings

    def apply(self, residuals, tangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the tangents of the splats."""
        arrays, camera, extents = residuals
        _, found = jax.jvp(self.settings.portable, (arrays, camera), (tangents[:5], tangents[5]))
        return _shown(extents, found)

    def transpose(self, residuals, cotangents: tuple[Array, ...]) -> tuple[Array, ...]:
        """Returns the gradients of the Gaussians' arrays and of the camera."""
        return _pull_back(residuals, cotangents, self.settings)

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> "SharedScene | None":
        """Returns the map of a batch of cameras that share a scene; None for other batches."""
        scene = (None,) * len(FIELDS)
        shares = residuals == (*scene, 0, 0) and tangents[:5] == scene
        if self.settings.kernel.shares_scenes and shares:
            return SharedScene(self.settings, Batched(self, RESIDUALS, residuals, tangents))
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

    def batched(self, size: int, residuals: Dims, tangents: Dims) -> Batched:
        """Returns the map that `jax.vmap` makes of the same derivative, camera by camera."""
        return Batched(self.each, RESIDUALS, residuals, tangents)


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
