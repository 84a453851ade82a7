"""What is timed: each operation is a function without arguments that makes the device work."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from splatax import rasterizers
from splatax.bench.scenes import Scene
from splatax.losses import Photometric
from splatax.projection import project
from splatax.training import optimizer
from splatax.training.feed import Batch
from splatax.training.recipes import Recipe
from splatax.training.step import TrainState, train_step

Operation = Callable[[], Any]  # returns arrays to wait for
BACKWARD = " F+B"  # forward and backward


def shared(scene: Scene) -> dict[str, Operation]:
    """What does not depend on the rasterizer."""
    gaussians, camera = scene.gaussians, scene.camera
    weights = project(gaussians, camera)

    @jax.jit
    def project_gradient(gaussians, camera):
        def total(gaussians, camera):
            products = jax.tree.map(lambda a, b: jnp.sum(a * b), project(gaussians, camera), weights)
            return sum(jax.tree.leaves(products))

        return jax.grad(total, argnums=(0, 1))(gaussians, camera)

    image, photo = images(camera.height, camera.width)
    loss_gradient = jax.jit(jax.value_and_grad(Photometric()))
    return {
        "project": lambda: project(gaussians, camera),
        f"project{BACKWARD}": lambda: project_gradient(gaussians, camera),
        f"loss{BACKWARD}": lambda: loss_gradient(image, photo),
        "Adam": adam(scene),
    }


def of_backend(scene: Scene, backend: str) -> dict[str, Operation]:
    """What the rasterizer decides."""
    splats = project(scene.gaussians, scene.camera)
    weights, _ = images(scene.camera.height, scene.camera.width)

    @jax.jit
    def forward(splats):
        return rasterizers.composite(splats, splats.colors, backend=backend)

    @jax.jit
    def gradient(splats):
        def total(splats):
            sums, alpha = rasterizers.composite(splats, splats.colors, backend=backend)
            return jnp.sum(sums * weights) + jnp.sum(alpha * weights[..., 0])

        return jax.value_and_grad(total)(splats)

    return {
        "rasterize": lambda: forward(splats),
        f"rasterize{BACKWARD}": lambda: gradient(splats),
        "training step": step(scene, backend),
    }


def images(height: int, width: int) -> tuple[jax.Array, jax.Array]:
    """Two images that differ."""
    rng = np.random.default_rng(0)
    first, second = rng.uniform(size=(2, height, width, 3)).astype(np.float32)
    return jnp.asarray(first), jnp.asarray(second)


def adam(scene: Scene) -> Operation:
    """The update of all fields, in place."""
    # Copied, because the update uses up what it is given.
    gaussians = jax.tree.map(jnp.array, scene.gaussians)
    carried = [gaussians, optimizer.ADAM.init(gaussians)]
    gradients = jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e-8), gaussians)
    rates = Recipe().learning_rates.at(jnp.float32(0), jnp.float32(1), gaussians.sh.shape[1])
    update = jax.jit(optimizer.update, donate_argnums=(0, 2))

    def operation() -> Any:
        carried[:] = update(carried[0], gradients, carried[1], rates)
        return carried[0].means

    return operation


def step(scene: Scene, backend: str) -> Operation:
    """A whole step of training: projection, rasterizer, loss, all gradients, Adam."""
    recipe = replace(Recipe(steps=1_000_000), backend=backend)
    gaussians = jax.tree.map(jnp.array, scene.gaussians)
    state = TrainState(
        step=jnp.int32(0),
        gaussians=gaussians,
        opt_state=optimizer.ADAM.init(gaussians),
        density_state=recipe.density.init(len(gaussians)),
        key=jax.random.key(0),
        extent=jnp.float32(1e-6),  # so that the means stay, and each step does the same work
    )
    _, photo = images(scene.camera.height, scene.camera.width)
    batch = Batch(scene.camera, jnp.round(photo * 255).astype(jnp.uint8))
    carried = [state]

    def operation() -> Any:
        carried[0], loss = train_step(carried[0], batch, recipe)
        return loss, carried[0].gaussians.means

    return operation
