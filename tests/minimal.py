"""The part of splatax that works with only jax, optax, jaxtyping and numpy: python minimal.py [ARRAYS.npz]

With a path, also trains, and writes the picture and the gradients that it has checked.
"""

import json
import sys
import tempfile
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

with tempfile.TemporaryDirectory() as folder:  # a capture with one photo, to be decoded by pillow
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

if sys.argv[1:]:
    dataset = sx.demo_dataset(photos=3, width=32, height=24)
    recipe = sx.recipes.default(steps=2, max_gaussians=3000).on(backend)
    trained = sx.fit(dataset, recipe)
    assert len(trained) > 0
    np.savez(sys.argv[1], rgb, *jax.tree.leaves(gradient))
