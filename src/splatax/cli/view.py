"""`splatax view`: a scene in the browser, finished or while it is trained."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import splatax as sx
from splatax import trajectories
from splatax.cli.interruption import Interruption
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    LowPassOption,
    OrderOption,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    scene_of,
    shown_as,
)
from splatax.cli.output import complain, say
from splatax.runs.history import History
from splatax.viewer.pictures import Look
from splatax.viewer.server import LOCAL, PORT, WINDOW, Viewer

RESTING_FRACTION = 0.15  # fraction of the time that drawing may take while no camera moves
MOVING_FRACTION = 0.5  # and while one moves
LONGEST_SECONDS = 0.5  # of drawing between two steps


@dataclass(frozen=True)
class View:
    """Open a scene in the browser, rendered by the training engine.

    Press Ctrl-C to quit.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    scene: Annotated[Path | None, tyro.conf.Positional, shown_as("CAPTURE")] = None
    """Folder of the capture, to jump to its photos. By default the one that the run was trained on."""
    port: Annotated[int, tyro.conf.arg(metavar="PORT")] = PORT
    """Port of the viewer; if it is taken, the next free one is used."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = LOCAL[0]
    """Address to listen on. The default accepts connections from this machine only; 0.0.0.0 accepts
    connections from the network."""
    background: BackgroundOption = None
    """Colour behind the scene. By default as in training, else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    order: OrderOption = None
    """Order in which splats are drawn. By default the one that the file names, else depth."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""

    def run(self) -> None:
        model = read_model(self.model, self.low_pass, self.order)
        scene = self.scene or scene_of(model)
        views = load_scene(scene, None, model).views if scene else ()
        background = background_of(model.options, self.background)
        look = Look(renderer=sx.Renderer(background, backend=resolve_backend(self.backend)))
        means = np.asarray(model.gaussians.means, np.float64)
        start = views[0].camera if views else trajectories.overview(means, WINDOW)
        with (
            Interruption() as interruption,
            Viewer(views, start, np.median(means, axis=0), look, host=self.host, port=self.port) as viewer,
        ):
            announce(viewer, self.host)
            viewer.panels.scene(len(model.gaussians))
            viewer.serve(model.gaussians, lambda: interruption.requested)


def announce(viewer: Viewer, host: str) -> None:
    """Prints the address of the viewer, and warns if others can reach it."""
    if host not in LOCAL:
        complain(
            f"warning: --host {host}: everyone who can reach this machine can watch, and use the controls"
        )
    say(f"viewer  {viewer.address}")


class Audience:
    """Browsers that watch a scene while it is trained. Without any, `waits` is the only cost.

    Attributes:
        viewer: the server of the live viewer.
    """

    def __init__(self, viewer: Viewer):
        self.viewer = viewer
        self._ended, self._spent = 0.0, 0.0

    @property
    def waits(self) -> bool:
        """True if it is time to draw: drawing has taken less than its fraction of the time."""
        if not self.viewer.watched:
            return False
        fraction = MOVING_FRACTION if self.viewer.moving else RESTING_FRACTION
        since = time.monotonic() - self._ended
        return self.viewer.panels.paused or self._spent * (1 - fraction) <= fraction * since

    def show(self, progress: sx.Progress, history: History, stopped: Callable[[], bool]) -> None:
        """Draws the scene while training is paused, and for the time of a step while a camera moves.

        Returns early when all viewers have left.
        """
        start = time.monotonic()
        step_seconds = min(start - self._ended, LONGEST_SECONDS)
        panels = self.viewer.panels
        panels.training(progress.step, progress.total, progress.count, float(progress.loss), history.psnr)
        if panels.curve_due:
            history.losses[:] = [float(loss) for loss in history.losses]
            panels.curve(np.array(history.losses))
        self.viewer.changed()
        self.viewer.draw(progress.padded)
        while self.viewer.watched and not stopped():
            if not panels.paused and not (self.viewer.moving and time.monotonic() - start < step_seconds):
                break
            if not self.viewer.draw(progress.padded):
                time.sleep(0.01)
        self._ended = time.monotonic()
        self._spent = self._ended - start if not panels.paused else 0.0


@contextmanager
def audience(dataset: sx.Dataset, recipe: sx.Recipe, host: str, port: int) -> Iterator[Audience]:
    """Shows a scene in the browser while it is trained."""
    positions = np.stack([np.asarray(view.camera.position, np.float64) for view in dataset.views])
    points = dataset.points.positions if len(dataset.points) else positions
    look = Look(renderer=recipe.renderer)
    start = dataset.views[0].camera
    with Viewer(dataset.views, start, np.median(points, axis=0), look, host=host, port=port) as viewer:
        announce(viewer, host)
        yield Audience(viewer)
