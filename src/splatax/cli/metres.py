"""`splatax metres`: the scale of a scene, from one distance that is known in metres."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import splatax as sx
from splatax.cli.options import Model, load_scene, read_model, scene_of, shown_as
from splatax.cli.output import say
from splatax.cli.page import tell_losses
from splatax.errors import InputError
from splatax.io import formats
from splatax.io.formats.marks import METRES, metres_mark

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
POINT = re.compile(rf"\(?({NUMBER}),({NUMBER}),({NUMBER})\)?")


@dataclass(frozen=True)
class Metres:
    """Store the scale of a scene, from one distance that is known in metres.

    A and B are two points of the scene as X,Y,Z, or two names of photos, whose cameras are that far apart.
    The scale is kept in the scene file as a comment; the Gaussians stay as they are, so the cameras of the
    capture still fit. splatax.sensors.load_in_metres reads it. Write a point that starts with a minus
    sign in quoted parentheses: "(-1,0,2)".
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run."""
    a: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="A")]
    """A point X,Y,Z in the scene's own units, or the name of a photo."""
    b: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="B")]
    """Another point, or another photo."""
    length: Annotated[float, tyro.conf.Positional, tyro.conf.arg(metavar="METRES")]
    """Distance between them in metres."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture, for names of photos. By default the one that the run was trained on."""
    out: Annotated[Path | None, shown_as("FILE.ply")] = None
    """Write a copy with the scale. By default the scene file itself is rewritten; it must be a .ply file."""

    def run(self) -> None:
        if not 0 < self.length < float("inf"):
            raise InputError(f"{self.length}: the distance in metres must be more than 0.")
        model = read_model(self.model, None)
        out = self.out or model.path
        if formats.format_of(out) is not formats.FORMATS[".ply"]:
            raise InputError(
                f"{out}: only .ply files keep a scale without loss. Give a copy such a name.",
                options=("out",),
            )
        if self.out and self.out.exists():
            raise InputError(f"{self.out}: exists. Choose another name.", options=("out",))
        distance = float(np.linalg.norm(np.subtract(*places(model, self.scene, (self.a, self.b)))))
        if not distance > 0:
            raise InputError(f"{self.a} and {self.b}: in the same place. Choose two different places.")
        scale = self.length / distance
        kept = tuple(line for line in formats.comments(model.path) if not line.startswith((METRES, "SH deg")))
        out.parent.mkdir(parents=True, exist_ok=True)
        sx.save(out, model.gaussians, comments=(*kept, metres_mark(scale)))
        say(f"{out}: {distance:.6g} units are {self.length:.6g} m, so one unit is {scale:.6g} m")
        tell_losses(out)


def places(model: Model, capture: Path | None, texts: tuple[str, str]) -> list[np.ndarray]:
    """Returns the world points that two texts name.

    Raises:
        InputError: if a text is neither a point nor the name of a photo, or the capture is not known.
    """
    found: dict[str, np.ndarray] = {
        text: np.array([float(number) for number in match.groups()])
        for text in texts
        if (match := POINT.fullmatch(text))
    }
    if len(found) < len(set(texts)):
        folder = capture or scene_of(model)
        if folder is None:
            raise InputError(
                f"{texts[0]} and {texts[1]}: not both points X,Y,Z; for photos the capture is "
                f"needed, which {model.path} does not name.",
                options=("scene",),
            )
        cameras = {view.name: view.camera for view in load_scene(folder, None, model).views}
        for text in texts:
            if text not in found and text not in cameras:
                first, *_ = cameras
                raise InputError(
                    f"{text}: neither a point such as 0.1,0.2,3 nor a photo of {folder}, whose photos have "
                    f"names such as {first}."
                )
        found |= {text: np.asarray(cameras[text].position) for text in texts if text not in found}
    return [found[text].astype(np.float64) for text in texts]
