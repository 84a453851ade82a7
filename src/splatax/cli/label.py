"""`splatax label`: a scene is split into parts by label images of its photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import tyro
from rich.progress import track

import splatax as sx
from splatax import editing, sensors
from splatax.cli.options import (
    BackendName,
    DownscaleOption,
    Model,
    OverwriteFlag,
    load_scene,
    read_model,
    resolve_backend,
    scene_of,
    shown_as,
)
from splatax.cli.output import say
from splatax.cli.page import tell_losses
from splatax.errors import InputError, shown
from splatax.io import label_images
from splatax.io.datasets import masks
from splatax.io.datasets.photos import counted
from splatax.io.memory import machine_memory
from splatax.io.scenes import save_scene

BYTES = 20  # of a Gaussian and a label: their votes, and channel, weight and sum while a view votes
BYTES_OF_PIXEL = 8  # of a view and a label: what is chosen, and what is drawn
VOTES_DIVISOR = 2  # votes may take the machine's memory divided by this
Labelled = list[tuple[sx.Camera, np.ndarray]]


@dataclass(frozen=True)
class Label:
    """Split a scene into parts by label images (masks) of its photos.

    Each Gaussian gets the label of the pixels that it fills most. DIR holds a label image for some or all
    photos, NAME.png for NAME.jpg: integers in one grey channel or a palette, 0 for the background, 255 for
    pixels to ignore. DIR/labels.txt may name the labels, one a line, starting with 0. Label images of
    held-out photos do not vote; they measure the result.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    masks: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the label images, and of labels.txt. It must not be the folder of the capture's own
    masks, whose black pixels training ignores."""
    out: Annotated[Path | None, shown_as("FILE.glb")] = None
    """The scene of parts to write. By default parts.glb in the folder of the model."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture. By default the one that the run was trained on."""
    downscale: DownscaleOption = None
    """Divide the width and height of the views by this number. By default as in training, else "auto"."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""

    def run(self) -> None:
        if self.out and self.out.suffix.lower() != ".glb":
            raise InputError(f"{self.out}: scenes of parts are kept in .glb files. Choose such a name.")
        model = read_model(self.model)
        out = self.out or model.path.parent / "parts.glb"
        if out.exists() and not self.overwrite:
            raise InputError(f"{out}: exists. Choose another name, or replace it: --overwrite.")
        voting, testing = self._labelled(model)
        count = 1 + max(int(labels.max()) for _, labels in voting + testing)
        if count < 2:
            raise InputError(f"{self.masks}: its label images have no label above 0, so there are no parts.")
        check_memory(len(model.gaussians), max(labels.size for _, labels in voting), count)
        names = label_images.names_in(self.masks, count)
        renderer = sx.Renderer(backend=resolve_backend(self.backend))
        found = editing.votes(model.gaussians, track(voting, description="voting"), count, renderer)
        labels = editing.labels_of(found)
        parts = editing.split_by_label(model.gaussians, labels, names)
        out.parent.mkdir(parents=True, exist_ok=True)
        save_scene(out, parts, comments=sensors.kept_metres(model.path))
        for name, part in parts.parts.items():
            say(f"{len(part.gaussians):9,} Gaussians  {name}")
        say(f"{out}: {len(parts.parts)} parts from {len(voting)} label images")
        tell_losses(out)
        if testing:
            mean = mean_iou(model.gaussians, labels, count, testing, renderer)
            say(f"mean intersection over union on {counted(len(testing), 'held-out photo')}: {mean:.3f}")

    def _labelled(self, model: Model) -> tuple[Labelled, Labelled]:
        """Returns the views of training and of test photos that have label images, with the labels."""
        capture = self.scene or scene_of(model)
        if capture is None:
            raise InputError(f"{self.model}: needs the cameras of its capture.", options=("scene",))
        if self.masks.resolve() == (capture / masks.FOLDER).resolve():
            raise InputError(
                f"{self.masks}: the capture keeps masks there, whose black pixels training ignores. Keep "
                "label images in a folder of another name, such as labels."
            )
        # Label images are of the photos as they are, so the views keep the lenses of the photos.
        dataset = load_scene(capture, self.downscale, model, undistort=False)
        self._tell_unused([view.name for view in (*dataset.train, *dataset.test)])
        voting, testing = (self._read(views) for views in (dataset.train, dataset.test))
        if not voting:
            raise InputError(
                f"{self.masks}: no label image of a training photo. Name them after photos, such as "
                f"{Path(dataset.train[0].name).with_suffix('.png')}."
            )
        return voting, testing

    def _tell_unused(self, photos: Sequence[str]) -> None:
        """Says which label images are of no photo, such as those whose name has a slip."""
        used = {label_images.path_of(self.masks, photo) for photo in photos}
        if unused := sorted(path for path in self.masks.rglob("*.png") if path not in used):
            say(
                f"{counted(len(unused), 'label image')} in {self.masks} not used, because no photo has the "
                f"name: {shown(unused[0].relative_to(self.masks).as_posix())}"
                + (" and others" if len(unused) > 1 else "")
            )

    def _read(self, views: Sequence[sx.View]) -> Labelled:
        found: Labelled = []
        for view in views:
            if path := label_images.path_of(self.masks, view.name):
                labels = label_images.read(path, view.camera.width, view.camera.height)
                found.append((view.camera, labels))
        return found


def check_memory(gaussians: int, pixels: int, count: int) -> None:
    """Refuses so many labels that their votes do not fit in memory, such as those of numbers with gaps.

    Args:
        gaussians: number of Gaussians.
        pixels: of the largest label image.
        count: number of labels.

    Raises:
        InputError: if they do not fit.
    """
    needed, limit = (BYTES * gaussians + BYTES_OF_PIXEL * pixels) * count, machine_memory() // VOTES_DIVISOR
    if needed > limit:
        raise InputError(
            f"the votes of {gaussians:,} Gaussians for {count:,} labels take {needed / 1e9:.3g} GB, and "
            f"{limit / 1e9:.3g} GB may be used. Number the labels from 0 without gaps."
        )


def mean_iou(
    gaussians: sx.Gaussians, labels: np.ndarray, count: int, views: Labelled, renderer: sx.Renderer
) -> float:
    """Returns the mean over labels of the intersection over union of rendered and given label images."""
    sensor = {"labels": sensors.Labels(jnp.asarray(labels), count)}
    drawn = [
        np.maximum(sensors.observe(gaussians, camera, sensor, renderer=renderer)["labels"], 0)
        for camera, _ in views
    ]
    truth = np.concatenate([given.ravel() for _, given in views])
    shown = np.concatenate([np.asarray(image).ravel() for image in drawn])
    return float(np.nanmean(editing.intersection_over_union(shown, truth, count)))
