"""One step of the scene's rows by the native library; see `splatax.moving` for what it computes."""

from dataclasses import dataclass

import jax
import numpy as np

from splatax.backends.cpu.library import Build
from splatax.backends.cpu.projection import NativeProjection, projections
from splatax.backends.packed_cameras import Layout, packed
from splatax.backends.packed_steps import FIELDS, PLACES, inputs
from splatax.backends.projection_kernels import Settings, kernel_for
from splatax.backends.protocol import Move, Project, PulledView
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.low_pass import AlongRays, LowPass
from splatax.moving import Moments, Rule, Step, checked


def move(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    step: Step,
    rule: Rule,
    block: int,
    build: Build,
) -> tuple[Gaussians, Moments]:
    """Makes one step with all rows, in place if the caller donates the arrays.

    Numbers at rest are not written. Numbers below 2^-126 count as zero.

    Raises:
        ValueError: if arrays do not fit together.
    """
    checked(gaussians, gradients, moments, step, block)
    arrays = [*jax.tree.leaves((gaussians, gradients, moments)), *inputs(step, rule)]
    shapes = [leaf.shape for leaf in jax.tree.leaves((gaussians, moments))]
    moved = build.call(
        "splatax_move",
        shapes,
        arrays,
        aliases=PLACES,
        block=np.int64(block),
    )
    structure = jax.tree.structure((gaussians, moments))
    return jax.tree.unflatten(structure, moved)


@dataclass(frozen=True)
class NativePullAndMove:
    """The gradient of the native projection and `move` at once; see `splatax.backends.protocol.PullAndMove`.

    Attributes:
        build: the native library.
        project, move: kernels of the same backend.
    """

    build: Build
    project: Project
    move: Move

    def fits(self, camera: Camera, low_pass: LowPass) -> bool:
        """Returns whether the native projection has a kernel for such a view."""
        return kernel_for(camera, projections(self.build)) is not None and not isinstance(low_pass, AlongRays)

    def __call__(
        self, gaussians: Gaussians, view: PulledView, moments: Moments, step: Step, rule: Rule, block: int
    ) -> tuple[Gaussians, Moments, Camera]:
        """Moves all rows, in place if the caller donates the arrays.

        Raises:
            ValueError: if arrays do not fit together.
        """
        checked(gaussians, gaussians, moments, step, block)
        kernel = kernel_for(view.camera, projections(self.build))
        assert isinstance(kernel, NativeProjection), "the view does not fit"
        camera, d = packed(view.camera), view.d_splats
        cotangents = [d.means2d, d.sqrt_conics, d.depths, d.colors, d.opacities]
        arrays = [
            *jax.tree.leaves(gaussians),
            camera,
            view.splats.extents,
            *cotangents,
            *jax.tree.leaves(moments),
            *inputs(step, rule),
        ]
        shapes = [leaf.shape for leaf in jax.tree.leaves((gaussians, moments))]
        *moved, d_camera = self.build.call(
            "splatax_pull_and_move",
            [*shapes, camera.shape],
            arrays,
            aliases=dict(zip([*range(FIELDS), *range(12, 12 + 2 * FIELDS)], range(3 * FIELDS), strict=True)),
            batches=False,
            block=np.int64(block),
            lens=np.int64(kernel.lens),
            **Settings(kernel, Layout.of(view.camera), view.low_pass).options,
        )
        scene, averages = jax.tree.unflatten(jax.tree.structure((gaussians, moments)), moved)
        return scene, averages, jax.vjp(packed, view.camera)[1](d_camera)[0]
