"""The timed operations: functions without arguments that start work on the device."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from splatax import backends
from splatax.bench.scenes import Scene
from splatax.losses import Photometric
from splatax.rendering import render
from splatax.stages import composite, project
from splatax.training.feed import Batch
from splatax.training.loop import first_state
from splatax.training.moving import Pace, Rows, moved
from splatax.training.recipes import Recipe
from splatax.training.step import train_step

Operation = Callable[[], Any]  # returns the arrays to wait for
BACKWARD = " F+B"  # forward and backward
FEATURES = (1, 16, 64)
LARGEST = 2.2e9  # bytes of an image of features; its gradient needs several times as much
VIEWS, SMALL = 64, (64, 64)  # cameras of a batch, and their size in pixels


def operations(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns every operation of a backend, and Adam, by name."""
    return {
        **projection(scene, backend),
        **rasterizer(scene, backend),
        **viewing(scene, backend),
        **features(scene, backend),
        **batches(scene, backend),
        **tangents(scene, backend),
        **training(scene, backend),
    }


def projection(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns operations that project Gaussians: forward, and with gradients of Gaussians and camera."""
    gaussians, camera = scene.gaussians, scene.camera
    splats = project(gaussians, camera, backend=backend)
    cotangents = replace(splats, extents=jnp.zeros_like(splats.extents))

    @jax.jit
    def gradient(gaussians, camera):
        _, pull_back = jax.vjp(lambda g, c: project(g, c, backend=backend), gaussians, camera)
        return pull_back(cotangents)

    return {
        "project": lambda: project(gaussians, camera, backend=backend),
        f"project{BACKWARD}": lambda: gradient(gaussians, camera),
    }


def rasterizer(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns operations that rasterize splats: forward, and with the gradient of a weighted sum."""
    splats = project(scene.gaussians, scene.camera, backend=backend)
    weights, _ = images(scene.camera.height, scene.camera.width)

    @jax.jit
    def forward(splats):
        return composite(splats, splats.colors, backend=backend)

    @jax.jit
    def gradient(splats):
        def total(splats):
            sums, alpha = composite(splats, splats.colors, backend=backend)
            return jnp.sum(sums * weights) + jnp.sum(alpha * weights[..., 0])

        return jax.value_and_grad(total)(splats)

    return {"rasterize": lambda: forward(splats), f"rasterize{BACKWARD}": lambda: gradient(splats)}


def viewing(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns the operation that renders one frame, as a viewer does."""
    draw = jax.jit(partial(render, backend=backend))
    return {"render": lambda: draw(scene.gaussians, scene.camera).rgb}


def widths_for(size: tuple[int, int]) -> tuple[int, ...]:
    """Returns the numbers of features to blend in images of a size: those whose image is not too large."""
    return tuple(width for width in FEATURES if 4 * width * size[0] * size[1] <= LARGEST)


def features(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns operations that blend several numbers of features, forward and with gradients."""
    splats = project(scene.gaussians, scene.camera, backend=backend)
    rng = np.random.default_rng(0)
    found: dict[str, Operation] = {}
    for width in widths_for((scene.camera.width, scene.camera.height)):
        values = jnp.asarray(rng.uniform(size=(len(scene.gaussians), width)), jnp.float32)

        @jax.jit
        def forward(splats, values):
            return composite(splats, values, backend=backend)

        @jax.jit
        def gradient(splats, values):
            def total(splats, values):
                return jnp.sum(jnp.square(composite(splats, values, backend=backend)[0]))

            return jax.grad(total, (0, 1))(splats, values)

        name = f"{width} features"
        found[name] = partial(forward, splats, values)
        found[f"{name}{BACKWARD}"] = partial(gradient, splats, values)
    return found


def batches(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns operations that render 64 small views at once: forward, and with the gradient of the scene.

    Each view sees another quarter of what the scene's camera sees.
    """
    small = scene.camera.resized(*SMALL)
    corners = jnp.asarray(np.random.default_rng(0).uniform(size=(VIEWS, 2)) * SMALL, jnp.float32)

    def view(gaussians, corner):
        x, y = corner
        nearer = replace(small, fx=2 * small.fx, fy=2 * small.fy, cx=2 * small.cx - x, cy=2 * small.cy - y)
        return render(gaussians, nearer, outputs=("rgb",), backend=backend).rgb

    def total(gaussians):
        return jnp.sum(jnp.square(jax.vmap(view, (None, 0))(gaussians, corners)))

    forward, gradient = jax.jit(jax.vmap(view, (None, 0))), jax.jit(jax.grad(total))
    name = f"{VIEWS} views"
    return {
        name: lambda: forward(scene.gaussians, corners),
        f"{name}{BACKWARD}": lambda: gradient(scene.gaussians),
    }


def tangents(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns the operation that computes the Jacobian of an image in the six numbers of a pose."""

    def image(twist):
        camera = scene.camera
        x, y, z = twist[:3]
        turn = jnp.eye(3) + jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        top = jnp.concatenate([turn @ camera.rotation, (camera.translation + twist[3:])[:, None]], axis=1)
        pose = camera.cam_from_world.at[:3].set(top)
        return render(
            scene.gaussians, replace(camera, cam_from_world=pose), outputs=("rgb",), backend=backend
        ).rgb

    jacobian = jax.jit(jax.jacfwd(image))
    return {"Jacobian in the pose": lambda: jacobian(jnp.zeros(6))}


def training(scene: Scene, backend: str) -> dict[str, Operation]:
    """Returns operations for the loss with its gradient, Adam, and a whole training step."""
    image, photo = images(scene.camera.height, scene.camera.width)
    loss = partial(Photometric(), kernel=backends.kernels(backend).photometric)
    loss_gradient = jax.jit(jax.value_and_grad(loss))
    return {
        f"loss{BACKWARD}": lambda: loss_gradient(image, photo),
        "Adam": adam(scene, backend),
        "training step": step(scene, Recipe().on(backends.resolve(backend))),
    }


def images(height: int, width: int) -> tuple[jax.Array, jax.Array]:
    """Returns two different images of random pixels."""
    rng = np.random.default_rng(0)
    first, second = rng.uniform(size=(2, height, width, 3)).astype(np.float32)
    return jnp.asarray(first), jnp.asarray(second)


def adam(scene: Scene, backend: str) -> Operation:
    """Returns an operation that moves all fields of the scene by Adam, in place."""
    # A copy, because the move donates its arguments.
    gaussians = jax.tree.map(jnp.array, scene.gaussians)
    recipe = Recipe().on(backends.resolve(backend))
    carried = [gaussians, recipe.optimizer.rule().init(gaussians)]
    gradients = jax.tree.map(lambda leaf: jnp.full_like(leaf, 1e-8), gaussians)
    openings = jnp.asarray(recipe.sh.openings(recipe.steps))
    count, one = jnp.int32(len(gaussians)), jnp.float32(1)
    pace = Pace(recipe.optimizer.rates, openings, one, jnp.asarray(True), count, one)

    def move(gaussians, opt_state, gradients):
        rows = Rows(gaussians, gradients, opt_state, one[None])
        return moved(rows, pace, jax.random.key(0), recipe)

    update = jax.jit(move, donate_argnums=(0, 1))

    def operation() -> Any:
        carried[:] = update(*carried, gradients)
        return carried[0].means

    return operation


def step(scene: Scene, recipe: Recipe) -> Operation:
    """Returns an operation that makes a whole training step, from projection to Adam."""
    gaussians = jax.tree.map(jnp.array, scene.gaussians)
    # A small extent keeps the means in place, so that each step does the same work.
    state = first_state(gaussians, recipe, extent=1e-6, photos=1)
    _, photo = images(scene.camera.height, scene.camera.width)
    batch = Batch(scene.camera, jnp.round(photo * 255).astype(jnp.uint8))
    carried = [state]

    def operation() -> Any:
        carried[0], loss = train_step(carried[0], batch, recipe)
        return loss, carried[0].gaussians.means

    return operation
