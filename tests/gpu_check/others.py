"""Other rasterizers on the same arrays, where they are installed. It has run with none of them yet."""

import importlib.util
from typing import Any

import numpy as np

from gpu_check.plan import Plan
from splatax.bench.scenes import procedural


def others(plan: Plan) -> dict[str, Any]:
    """Times gsplat on the scenes of `speed.scenes`."""
    if plan.emulated or not all(importlib.util.find_spec(name) for name in ("torch", "gsplat")):
        return {"gsplat": "it needs a GPU" if plan.emulated else "not installed"}
    return {f"gsplat, {count:,}": gsplat(plan, count) for count in plan.counts}


def gsplat(plan: Plan, count: int) -> dict[str, float]:
    """Returns the median milliseconds of a frame, and of a frame with the gradient of a sum over it."""
    import torch
    from gsplat import rasterization

    scene = procedural(count, plan.size)
    gaussians, camera = scene.gaussians, scene.camera

    def tensor(array, gradient=True):
        return torch.tensor(np.asarray(array), device="cuda").requires_grad_(gradient)

    fields = [tensor(leaf) for leaf in (gaussians.means, gaussians.quats, gaussians.log_scales)]
    logits, sh = tensor(gaussians.opacity_logits), tensor(gaussians.sh)
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32)
    pose, lens = tensor(camera.cam_from_world, False)[None], tensor(intrinsics, False)[None]
    leaves = (*fields, logits, sh)

    def draw():
        means, quats, log_scales = fields
        return rasterization(
            means,
            quats,
            log_scales.exp(),
            logits.sigmoid(),
            sh,
            pose,
            lens,
            *plan.size,
            sh_degree=3,
            packed=False,
        )[0]

    def frame():
        with torch.no_grad():
            draw()

    def with_gradient():
        torch.autograd.grad(draw().sum(), leaves)

    def median(operation):
        operation()
        times = []
        for _ in range(plan.rounds):
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            begin.record()
            operation()
            end.record()
            torch.cuda.synchronize()
            times.append(begin.elapsed_time(end))
        return float(np.median(times))

    return {"render": median(frame), "render F+B": median(with_gradient)}
