"""`splatax animate`: a rigged scene in motion, as a video or a file."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from rich.progress import track

import splatax as sx
from splatax import trajectories, web
from splatax.cli.film import DEFAULT_SIZE
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    OverwriteFlag,
    TextOption,
    background_of,
    parse_size,
    resolve_backend,
    shown_as,
)
from splatax.cli.output import say
from splatax.cli.page import is_page, tell_losses
from splatax.cli.rigging import RIGGED
from splatax.errors import InputError
from splatax.io import video
from splatax.io.rigs import load_rigged, save_rigged
from splatax.metrics import to_8bit
from splatax.scene.clips import Clip
from splatax.scene.rigged import RiggedScene
from splatax.sensors import kept_metres

SAMPLES = 8  # times of the clip that the camera's distance is chosen for


@dataclass(frozen=True)
class Animate:
    """Write a clip of a rigged scene as a video, a web page that plays it, or a .glb file.

    A .glb file holds the splats with their skin and the clip. It is valid glTF, but today's splat viewers
    ignore skins and show it in the bound pose.
    """

    run_: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(name="run", metavar="RUN")]
    """The folder of a run of splatax rig, or a .glb file of splatax rig or splatax bind."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The video (.mp4, .webm, .gif, or a folder of images), page (.html) or .glb file to write."""
    clip: TextOption = None
    """Name of the clip. By default the first one in the file."""
    path: Annotated[str, tyro.conf.arg(metavar="{still,orbit,FILE}")] = "still"
    """Video: camera path. "still": one camera that sees the whole scene; "orbit": one turn around it; or a
    .json file of keyframes."""
    size: Annotated[str | None, shown_as("WIDTHxHEIGHT")] = None
    """Video: size in pixels. By default 960x540."""
    fps: Annotated[int, tyro.conf.arg(metavar="N")] = 30
    """Video: frames per second."""
    repeat: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Video: how many times to play the clip."""
    background: BackgroundOption = None
    """Colour behind the scene. By default black."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""
    overwrite: OverwriteFlag = False
    """Replace the output if it exists."""

    def run(self) -> None:
        for name in ("fps", "repeat"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name}: at least 1, not {getattr(self, name)}.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        path = self.run_ / RIGGED if self.run_.is_dir() else self.run_
        scene = load_rigged(path)
        clip = self._clip(scene)
        if self.out.suffix.lower() == ".glb":
            self.out.parent.mkdir(parents=True, exist_ok=True)
            save_rigged(self.out, replace(scene, clips={clip.name: clip}), comments=kept_metres(path))
            say(f"{self.out}: {len(scene.gaussians):,} Gaussians with a skin and the clip {clip.name}")
            say("note    splat viewers that ignore skins show the bound pose, without motion")
            tell_losses(self.out)
            return
        if is_page(self.out):
            self._page(scene, clip)
            return
        frames = self._film(scene, clip)
        say(f"{frames} frames in {self.out}")

    def _clip(self, scene: RiggedScene) -> Clip:
        """Returns the clip to play.

        Raises:
            InputError: if there is none of this name.
        """
        if not scene.clips:
            raise InputError(f"{self.run_}: has no clip. Bind the scan to a body with clips.")
        if self.clip is not None and self.clip not in scene.clips:
            raise InputError(f"--clip {self.clip}: the clips are {', '.join(scene.clips)}.")
        return scene.clips[self.clip] if self.clip else next(iter(scene.clips.values()))

    def _page(self, scene: RiggedScene, clip: Clip) -> None:
        """Writes a page that plays the clip."""
        title = self.run_.resolve().name if self.run_.is_dir() else self.run_.stem
        self.out.parent.mkdir(parents=True, exist_ok=True)
        behind, motion = background_of({}, self.background), web.Motion(scene.rig, clip)
        web.save(self.out, scene.gaussians, title=title, background=behind, motion=motion)
        size = self.out.stat().st_size / 1e6
        say(f"{self.out}: {len(scene.gaussians):,} Gaussians, the clip {clip.name}, {size:.1f} MB")
        tell_losses(self.out)
        if scene.gaussians.sh_degree:
            say("note    the page does not rotate view-dependent colour with the joints; videos do")

    def _film(self, scene: RiggedScene, clip: Clip) -> int:
        """Renders the video and returns its number of frames."""
        size = parse_size("--size", self.size) if self.size else DEFAULT_SIZE
        count = max(round(self.fps * clip.seconds), 1)
        rest, behind = scene.rig.skeleton.rest, np.asarray(background_of({}, self.background), np.float32)
        times = [clip.seconds * i / count for i in range(count)]
        some = times[:: -(-count // SAMPLES)]
        reach = [np.asarray(scene.at(clip.name, time).means) for time in some]
        cameras = self._cameras(np.concatenate(reach), size, count * self.repeat)
        renderer = sx.Renderer(behind, backend=resolve_backend(self.backend))
        draw = jax.jit(lambda pose, camera: renderer(scene.posed(pose), camera).rgb)
        with video.writing(self.out, size, self.fps) as add:
            for i, camera in enumerate(track(cameras, description="rendering")):
                add(to_8bit(np.asarray(draw(clip.pose(rest, times[i % count]), camera))))
        return len(cameras)

    def _cameras(self, means: np.ndarray, size: tuple[int, int], frames: int) -> list[sx.Camera]:
        """Returns one camera for each frame."""
        whole = trajectories.overview(means, size)
        if self.path == "still":
            return [whole] * frames
        if self.path == "orbit":
            return trajectories.orbit([whole], frames, size, np.median(means, axis=0))
        return trajectories.read(Path(self.path), frames, size)
