"""`splatax metres`: the scale of a scene, from a distance that is known in metres or from GPS positions."""

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
from splatax.errors import InputError, shown
from splatax.io import formats
from splatax.io.datasets.photos import counted
from splatax.io.formats.marks import METRES, metres_mark
from splatax.io.gps import fix_of
from splatax.sensors.gps import GpsScale, scale_by_gps

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
POINT = re.compile(rf"\(?({NUMBER}),({NUMBER}),({NUMBER})\)?")


@dataclass(frozen=True)
class Metres:
    """Store the scale of a scene, from a distance that is known in metres or from GPS positions.

    A and B are two points of the scene as X,Y,Z, or two names of photos, whose cameras are that far apart.
    With --gps, the camera positions are fitted to the GPS positions in EXIF of the photos instead.
    The scale is kept in the scene file as a comment; the Gaussians stay as they are, so the cameras of the
    capture still fit. splatax.sensors.load_in_metres reads it. Write a point that starts with a minus
    sign in quoted parentheses: "(-1,0,2)".
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run."""
    a: Annotated[str | None, tyro.conf.Positional, shown_as("A")] = None
    """A point X,Y,Z in the scene's own units, or the name of a photo."""
    b: Annotated[str | None, tyro.conf.Positional, shown_as("B")] = None
    """Another point, or another photo."""
    length: Annotated[float | None, tyro.conf.Positional, shown_as("METRES")] = None
    """Distance between them in metres."""
    gps: Annotated[bool, shown_as()] = False
    """Use the GPS positions in EXIF of the photos instead of A, B and METRES. At least 4 different positions
    are needed. The command refuses positions that are too close together for their error."""
    gps_error: Annotated[float | None, shown_as("METRES")] = None
    """Expected error of a GPS position in metres, for example 0.03 for RTK. By default the error that
    the photos state in EXIF, or 5."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture, for names of photos and GPS. By default the one that the run was trained on."""
    out: Annotated[Path | None, shown_as("FILE.ply")] = None
    """Write a copy with the scale. By default the scene file itself is rewritten; it must be a .ply file."""

    def run(self) -> None:
        self.check()
        model = read_model(self.model)
        out = self.output(model)
        scale, found = self._by_gps(model) if self.gps else self._by_length(model)
        save_with_scale(out, model, scale)
        say(f"{out}: {found}, so one unit is {scale:.6g} m")
        tell_losses(out)

    def check(self) -> None:
        """Raises InputError unless the options name exactly one way to find the scale."""
        given = (self.a, self.b, self.length)
        if self.gps and any(value is not None for value in given):
            raise InputError("--gps: stands instead of A, B and METRES. Give one of them.")
        if not self.gps and any(value is None for value in given):
            raise InputError("two places A and B and their distance in METRES are needed, or --gps.")
        if self.gps_error is not None and not (self.gps and 0 < self.gps_error < float("inf")):
            raise InputError(f"--gps-error {self.gps_error}: a number of metres above 0, with --gps.")

    def output(self, model: Model) -> Path:
        """Returns the file to write.

        Raises:
            InputError: if it cannot keep the scale, or would replace another file than the scene.
        """
        out = self.out or model.path
        if formats.format_of(out) is not formats.FORMATS[".ply"]:
            raise InputError(
                f"{out}: only .ply files keep a scale without loss. Give a copy such a name.",
                options=("out",),
            )
        if self.out and self.out.exists():
            raise InputError(f"{self.out}: exists. Choose another name.", options=("out",))
        return out

    def _by_length(self, model: Model) -> tuple[float, str]:
        """Returns the metres of a unit by a known distance, and how they were found."""
        assert self.a is not None
        assert self.b is not None
        assert self.length is not None
        if not 0 < self.length < float("inf"):
            raise InputError(f"{self.length}: the distance in metres must be more than 0.")
        distance = float(np.linalg.norm(np.subtract(*places(model, self.scene, (self.a, self.b)))))
        if not distance > 0:
            raise InputError(f"{self.a} and {self.b}: in the same place. Choose two different places.")
        return self.length / distance, f"{distance:.6g} units are {self.length:.6g} m"

    def _by_gps(self, model: Model) -> tuple[float, str]:
        """Returns the metres of a unit by the GPS positions of the photos, and how they were found."""
        folder = self.scene or scene_of(model)
        if folder is None:
            raise InputError(f"{model.path}: GPS needs the photos of its capture.", options=("scene",))
        dataset = load_scene(folder, None, model)
        files = dataset.survey.files
        views = [view for view in dataset.standpoints if view.name in files]
        fixes = {view.photo: fix for view in views if (fix := fix_of(files[view.name])) is not None}
        cameras = {view.photo: view.camera for view in dataset.standpoints}
        found = scale_by_gps(cameras, fixes, self.gps_error)
        report(found, len(cameras))
        return found.metres_per_unit, f"{counted(found.used)} agree with GPS"


def save_with_scale(out: Path, model: Model, metres_per_unit: float) -> None:
    """Writes a scene with the comments of its file, and its scale instead of an earlier one."""
    kept = tuple(line for line in formats.comments(model.path) if not line.startswith((METRES, "SH deg")))
    out.parent.mkdir(parents=True, exist_ok=True)
    sx.save(out, model.gaussians, comments=(*kept, metres_mark(metres_per_unit)))


def report(found: GpsScale, photos: int) -> None:
    """Prints how well GPS positions and cameras fit together."""
    say(
        f"GPS: {found.used} of {photos} photos at {found.places} different places, {found.spread:.3g} m from "
        f"their middle (root mean square); {found.residual:.3g} m from their GPS positions after the fit, "
        f"expected {found.error:.3g} m"
    )
    say(f"GPS: standard error of the scale {100 * found.uncertainty:.2g} %, if errors are independent")
    if found.level:
        say("note    not all photos have an altitude: the fit is that of the plan, without heights")
    if found.wrong:
        listed = shown(", ".join(found.wrong), 200)
        say(f"note    {counted(len(found.wrong))} left out, whose GPS positions do not agree: {listed}")


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
