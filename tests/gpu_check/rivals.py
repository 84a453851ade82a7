"""Frames of another rasterizer of the same scenes. As a program, it prints a line of JSON for each scene.

It runs in a process of its own, which may fail: the packages may be missing, unbuilt, broken or of a version
with another interface. The calls follow the public sources of gsplat and splax; they have run with neither.
"""

import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from splatax.bench.scenes import Scene, procedural
from splatax.bench.timing import timed
from splatax.math import harmonics


def gsplat(scene: Scene, rounds: int) -> dict[str, float]:
    """Returns median milliseconds of a frame, and of a frame with the gradient of a sum over it."""
    import torch
    from gsplat import rasterization

    gaussians, camera = scene.gaussians, scene.camera

    def tensor(array, gradient=True):
        return torch.tensor(np.asarray(array), device="cuda").requires_grad_(gradient)

    fields = [tensor(leaf) for leaf in (gaussians.means, gaussians.quats, gaussians.log_scales)]
    logits, sh = tensor(gaussians.opacity_logits), tensor(gaussians.sh)
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32)
    pose, lens = tensor(camera.cam_from_world, False)[None], tensor(intrinsics, False)[None]

    def draw():
        means, quats, log_scales = fields
        scales, opacities = log_scales.exp(), logits.sigmoid()
        size = (camera.width, camera.height)
        degree = harmonics.degree_of(gaussians.sh.shape[1])
        return rasterization(
            means, quats, scales, opacities, sh, pose, lens, *size, sh_degree=degree, packed=False
        )[0]

    def frame():
        with torch.no_grad():
            draw()

    def with_gradient():
        torch.autograd.grad(draw().sum(), (*fields, logits, sh))

    def median(operation):
        operation()
        times = []
        for _ in range(rounds):
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            operation()
            end.record()
            torch.cuda.synchronize()
            times.append(begin.elapsed_time(end))
        return float(np.median(times))

    return {"render": median(frame), "render F+B": median(with_gradient)}


def splax(scene: Scene, rounds: int) -> dict[str, float]:
    """Returns median milliseconds of the same; XLA computes the colours from the spherical harmonics."""
    import splax

    camera = scene.camera
    fx, fy, cx, cy = (float(number) for number in (camera.fx, camera.fy, camera.cx, camera.cy))
    view = {"viewmat": jnp.asarray(camera.cam_from_world), "background": jnp.zeros(3)}
    view |= {"img_shape": (camera.height, camera.width), "f": (fx, fy), "c": (cx, cy)}

    def draw(render, gaussians):
        offsets = gaussians.means - camera.position
        directions = offsets / jnp.linalg.norm(offsets, axis=1, keepdims=True)
        colors = jnp.maximum(jax.vmap(harmonics.evaluate)(gaussians.sh, directions) + 0.5, 0)
        scales, opacities = jnp.exp(gaussians.log_scales), jax.nn.sigmoid(gaussians.opacity_logits)
        try:
            found = render(gaussians.means, scales, gaussians.quats, colors, opacities, **view)
        except (AssertionError, IndexError, TypeError, ValueError):  # of versions before 0.2
            found = render(gaussians.means, scales, gaussians.quats, colors, opacities[:, None], **view)
        return found[0] if isinstance(found, tuple) else found

    # Versions before 0.2 have a faster function for frames without gradients.
    without_gradient = getattr(getattr(splax, "inference", splax), "render", splax.render)
    frame = jax.jit(lambda gaussians: draw(without_gradient, gaussians))
    gradient = jax.jit(jax.grad(lambda gaussians: jnp.sum(draw(splax.render, gaussians))))

    def median(operation):
        timed(lambda: operation(scene.gaussians))
        return float(np.median([timed(lambda: operation(scene.gaussians)) for _ in range(rounds)]))

    return {"render": median(frame), "render F+B": median(gradient)}


PROGRAMS: dict[str, Callable[[Scene, int], dict[str, float]]] = {"gsplat": gsplat, "splax": splax}


def main() -> None:
    parser = ArgumentParser()
    parser.add_argument("program", choices=PROGRAMS)
    parser.add_argument(
        "numbers", type=int, nargs="+", help="width, height, rounds, then numbers of Gaussians"
    )
    options = parser.parse_args(sys.argv[1:])
    width, height, rounds, *counts = options.numbers
    for count in counts:
        found: dict[str, Any] = PROGRAMS[options.program](procedural(count, (width, height)), rounds)
        print(json.dumps({f"{count:,}": found}), flush=True)


if __name__ == "__main__":
    main()
