"""The part of splatax that needs only jax, optax, jaxtyping and numpy: python minimal.py [PATH [complete]]

With the path of an .npz file, also trains, differentiates in every way, and writes the picture and the
derivatives that it has checked. The word `complete` says that all other packages are there, so that none is
told to be missing.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatax as sx
from splatax.math import harmonics
from splatax.packages import MissingPackageError

rng = np.random.default_rng(0)
fields = (
    rng.uniform(-1, 1, (40, 3)),
    rng.normal(size=(40, 4)),
    rng.uniform(-3, -1, (40, 3)),
    rng.normal(size=40),
    0.3 * rng.normal(size=(40, harmonics.count(1), 3)),
)
gaussians = sx.Gaussians(*(jnp.asarray(field, jnp.float32) for field in fields))
pose = sx.look_at(*(jnp.array(v, jnp.float32) for v in ((0, 0, -4), (0, 0, 0), (0, -1, 0))))
camera = sx.Camera.simple_pinhole(30.0, pose, 32, 24)
weights = jnp.asarray(rng.normal(size=(24, 32, 3)), jnp.float32)


# A wheel for the baseline alone is quick to build; any machine runs it, though `auto` looks for the best.
backend = sx.backends.resolve("cpu-baseline")


def objective(gaussians):
    rgb = sx.render(gaussians, camera, backend=backend).rgb
    return jnp.sum(rgb * weights), rgb


splats = sx.project(gaussians, camera)
sums, alpha = sx.composite(splats, splats.colors, backend=backend)
(_, rgb), gradient = jax.value_and_grad(objective, has_aux=True)(gaussians)
assert np.allclose(sums, rgb, atol=1e-6)  # over black
assert float(alpha.max()) > 0.5
assert all(np.isfinite(leaf).all() and np.any(leaf) for leaf in jax.tree.leaves(gradient))


def moved(shift):
    """The picture of a camera beside the first one."""
    there = replace(camera, cam_from_world=camera.cam_from_world.at[:3, 3].add(shift))
    return sx.render(gaussians, there, outputs=("rgb",), backend=backend).rgb


def loss(gaussians):
    """A scalar that is not linear in the picture."""
    return jnp.mean(jnp.square(sx.render(gaussians, camera, outputs=("rgb",), backend=backend).rgb))


def derivatives():
    """Of forward mode, of batches, and second ones, each checked against another way to it."""
    still, along = jnp.zeros(3), jnp.array([0.1, -0.2, 0.3])
    jacobian = jax.jacfwd(moved)(still)
    _, tangent = jax.jvp(moved, (still,), (along,))
    assert np.abs(tangent).max() > 0.01
    assert np.allclose(jacobian @ along, tangent, atol=1e-4)
    shifts = jnp.stack([still, along])
    batch, batch_of_jacobians = jax.vmap(moved)(shifts), jax.vmap(jax.jacfwd(moved))(shifts)
    assert np.allclose(batch, [moved(shift) for shift in shifts], atol=1e-5)
    assert np.allclose(batch_of_jacobians[0], jacobian, atol=1e-4)
    direction = jax.tree.map(jnp.ones_like, gaussians)
    _, product = jax.jvp(jax.grad(loss), (gaussians,), (direction,))  # of the Hessian with a direction
    same = jax.grad(lambda g: jax.jvp(loss, (g,), (direction,))[1])(gaussians)
    for one, other in zip(jax.tree.leaves(product), jax.tree.leaves(same), strict=True):
        assert np.any(one)
        assert np.allclose(one, other, atol=1e-3 * float(jnp.max(jnp.abs(one))))
    return jax.tree.leaves((tangent, jacobian, batch, batch_of_jacobians, product))


def packages_that_are_missing_are_named(folder):
    """A capture has one photo, to be decoded by pillow."""
    frame = {"file_path": "photo.png", "transform_matrix": np.eye(4).tolist()}
    capture = {"fl_x": 30, "fl_y": 30, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": [frame]}
    Path(folder, "transforms.json").write_text(json.dumps(capture))
    Path(folder, "photo.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    for use in (
        lambda: [view.pixels() for view in sx.load_dataset(folder).views],
        lambda: sx.save(Path(folder, "scene.sog"), gaussians),
    ):
        try:
            use()
            said = "nothing"
        except MissingPackageError as error:
            said = str(error)
        assert "pip install" in said, said


if sys.argv[2:] != ["complete"]:
    with tempfile.TemporaryDirectory() as folder:
        packages_that_are_missing_are_named(folder)
if sys.argv[1:]:
    dataset = sx.demo_dataset(photos=3, width=32, height=24)
    recipe = sx.recipes.default(steps=2, max_gaussians=3000).on(backend)
    trained = sx.fit(dataset, recipe)
    assert len(trained) > 0
    np.savez(sys.argv[1], rgb, *jax.tree.leaves(gradient), *derivatives())
