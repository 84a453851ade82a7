"""The commands of the command line by name. A command is imported when it is used, because most of them
import JAX, which takes seconds."""

import importlib
from typing import NamedTuple


class Command(NamedTuple):
    """A command that may not have been imported yet."""

    home: str
    """Module of this package that defines it, and its class there, such as "train:Train"."""
    summary: str
    """First line of its help."""

    def load(self) -> type:
        """Imports its class."""
        module, _, kind = self.home.partition(":")
        return getattr(importlib.import_module(f"splatax.cli.{module}"), kind)


COMMANDS = {
    "create": Command("create:Create", "Make a web page from photos, a video, or a capture."),
    "reconstruct": Command(
        "reconstruct:Reconstruct",
        "Estimate the camera poses of photos or of a video, and write a capture to train on.",
    ),
    "inspect": Command(
        "inspect:Inspect",
        "Check a capture before training: list its contents, find problems and suggest fixes.",
    ),
    "train": Command("train:Train", "Train a scene on a capture."),
    "eval": Command(
        "evaluate:Evaluate",
        "Score a scene on held-out photos of its capture: PSNR, SSIM, LPIPS, and errors of depth and "
        "normals.",
    ),
    "render": Command("render:Render", "Render images from the capture's cameras or, with --path, a video."),
    "view": Command("view:View", "Open a scene in the browser, rendered by the training engine."),
    "compare": Command("compare:Compare", "Compare finished runs of one capture: scores, curves and images."),
    "export": Command("export:Export", "Convert a scene to another format, and optionally edit it."),
    "mesh": Command("mesh:Mesh", "Make a triangle mesh of the surfaces that the training cameras see."),
    "page": Command("page:Page", "Write a web page that shows a scene in any browser."),
    "compose": Command(
        "compose:Compose", "Compose a scene of parts with variants, as a web page or a .glb file."
    ),
    "bind": Command("bind:Bind", "Bind a static scan to the skeleton of a body, so that clips can move it."),
    "rig": Command(
        "rig:RigCommand", "Train Gaussians that follow a skeleton, from photos of it in known poses."
    ),
    "animate": Command(
        "animate:Animate",
        "Write a clip of a rigged scene as a video, a web page that plays it, or a .glb file.",
    ),
    "label": Command("label:Label", "Split a scene into parts by label images (masks) of its photos."),
    "metres": Command(
        "metres:Metres",
        "Store the scale of a scene, from a distance that is known in metres or from GPS positions.",
    ),
    "demo": Command("demo:Demo", "Render a synthetic scene, train on it and build its page."),
    "bench": Command("bench:Bench", "Time projection, rasterizer, loss, Adam and the whole training step."),
    "cache": Command(
        "cache:Cache",
        "Show where decoded photos are kept on disk and how much space they take, or remove them.",
    ),
    "plan": Command("plan:Plan", "Predict time, traffic and memory of a training step on many devices."),
    "blocks": Command(
        "blocks:Blocks",
        "Train a capture that is too large for one run in blocks, one by one or as jobs of a cluster.",
    ),
    "doctor": Command(
        "doctor:Doctor", "Show devices, backends and versions, and test each backend on a small scene."
    ),
}
