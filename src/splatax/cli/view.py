"""`splatax view`: a scene in the browser; and the same beside training."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import splatax as sx
from splatax import trajectories
from splatax.cli.interruption import Interruption
from splatax.cli.options import (
    BackendName,
    BackgroundName,
    LowPassName,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    scene_of,
)
from splatax.cli.output import complain, say
from splatax.runs.history import History
from splatax.viewer.pictures import Look
from splatax.viewer.server import LOCAL, PORT, WINDOW, Viewer

RESTING_SHARE = 0.15  # of training's time, for those who look and do not move
MOVING_SHARE = 0.5  # for those who do
LONGEST_SECONDS = 0.5  # of drawing between two steps


@dataclass(frozen=True)
class View:
    """Look at a scene in the browser, drawn by the renderer that trains. Ctrl-C ends it."""

    model: tyro.conf.Positional[Path]
    """A splat file, or the folder of a run."""
    scene: tyro.conf.Positional[Path | None] = None
    """Folder of the capture, to jump to its photos. Without it: the one that the run was trained on."""
    port: int = PORT
    """Where to listen; the next free one if it is taken."""
    host: str = LOCAL[0]
    """Who may look: this machine alone; "0.0.0.0" is all who can reach it."""
    background: BackgroundName | None = None
    """Behind the scene. Without it: as trained, else black."""
    low_pass: LowPassName | None = None
    """Without it: as the file says."""
    backend: BackendName = "auto"
    """Rasterizer."""

    def run(self) -> None:
        model = read_model(self.model, self.low_pass)
        scene = self.scene or scene_of(model)
        views = load_scene(scene, None, model).views if scene else ()
        background = background_of(model.options, self.background)
        look = Look("colour", None, background, model.low_pass, resolve_backend(self.backend))
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
    """Says where to look, and who can."""
    if host not in LOCAL:
        complain(f"warning: --host {host}: all who can reach this machine can look, and use the controls")
    say(f"viewer  {viewer.address}")


class Audience:
    """Those who look on while a scene is trained. Without any, `waits` is all that is done.

    Attributes:
        viewer: that they look into.
    """

    def __init__(self, viewer: Viewer):
        self.viewer = viewer
        self._ended, self._spent = 0.0, 0.0

    @property
    def waits(self) -> bool:
        """Whether it is time to draw: of all time, that for drawing is within its share."""
        if not self.viewer.watched:
            return False
        share = MOVING_SHARE if self.viewer.moving else RESTING_SHARE
        since = time.monotonic() - self._ended
        return self.viewer.panels.paused or self._spent * (1 - share) <= share * since

    def show(self, progress: sx.Progress, history: History, stopped: Callable[[], bool]) -> None:
        """Draws the scene as it is, for as long as a step took where someone moves, and for as long as
        training is paused. All may leave: then it goes on."""
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
    """Lets people look while a scene is trained."""
    positions = np.stack([np.asarray(view.camera.position, np.float64) for view in dataset.views])
    points = dataset.points.positions if len(dataset.points) else positions
    look = Look("colour", None, recipe.background.rgb, recipe.low_pass, recipe.backend)
    start = dataset.views[0].camera
    with Viewer(dataset.views, start, np.median(points, axis=0), look, host=host, port=port) as viewer:
        announce(viewer, host)
        yield Audience(viewer)
