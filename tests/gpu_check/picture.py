"""An image and its gradients. As a program, it writes them to a file, from another process or device."""

import sys
from argparse import ArgumentParser
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gpu_check.plan import emulate
from splatax.bench.scenes import procedural
from splatax.rendering import render


def picture(backend: str, count: int, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Returns an image of a procedural scene, and gradients of a sum over it in the scene and the camera."""
    scene = procedural(count, size)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(size[1], size[0], 3)), jnp.float32)

    @jax.jit
    def compute(gaussians, camera):
        def objective(gaussians, camera):
            image = render(gaussians, camera, backend=backend)
            return jnp.sum(image.rgb * weights) + jnp.sum(image.depth * weights[..., 0]), image.rgb

        return jax.value_and_grad(objective, (0, 1), has_aux=True)(gaussians, camera)

    (_, image), (of_scene, of_camera) = compute(scene.gaussians, scene.camera)
    fields = ("means", "quats", "log_scales", "opacity_logits", "sh")
    gradients = {f"d {field}": getattr(of_scene, field) for field in fields}
    pose = {"d cam_from_world": of_camera.cam_from_world, "d fx": of_camera.fx}
    return {name: np.asarray(array) for name, array in ({"image": image} | gradients | pose).items()}


def largest_difference(actual: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> dict[str, float]:
    """Returns the largest difference of each array, as a fraction of its largest value."""
    return {
        name: float(np.abs(actual[name] - value).max() / max(np.abs(value).max(), 1e-12))
        for name, value in expected.items()
    }


def main() -> None:
    parser = ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("backend")
    parser.add_argument("numbers", type=int, nargs=3, help="Gaussians, width, height")
    parser.add_argument("--emulated", action="store_true")
    options = parser.parse_args(sys.argv[1:])
    if options.emulated:
        emulate()
    count, width, height = options.numbers
    np.savez(options.out, **picture(options.backend, count, (width, height)))


if __name__ == "__main__":
    main()
