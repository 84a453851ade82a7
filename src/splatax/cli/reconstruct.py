"""`splatax reconstruct`: from photos to a capture with camera poses."""

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatax.cli.interruption import resumable
from splatax.cli.options import OverwriteFlag, shown_as
from splatax.cli.output import say
from splatax.cli.stages import Stages
from splatax.errors import InputError
from splatax.io.datasets.photos import counted
from splatax.reconstruction import Outcome, forecast, pipeline, reconstruct, refusals
from splatax.reconstruction.mapping import Features
from splatax.reconstruction.pairs import Exhaustive, Pairing, Sequential, Similar
from splatax.reconstruction.panoramas import Panoramas
from splatax.reconstruction.photos import VIDEO
from splatax.reconstruction.work import clear
from splatax.runs.budget import duration
from splatax.runs.claim import claimed

PAIRINGS: dict[str, Pairing | None] = {
    "auto": None,
    "exhaustive": Exhaustive(),
    "similar": Similar(),
    "sequential": Sequential(),
}
DETAILS: dict[str, Features | None] = {
    "auto": None,
    "normal": Features(),
    "high": Features(longest_side=2400, most=16_384, first_octave=-1),
}
PairingName = Literal[*PAIRINGS]  # type: ignore[valid-type]
DetailName = Literal[*DETAILS]  # type: ignore[valid-type]
NAMED = 5  # photos that are named for each reason


@dataclass(frozen=True)
class FindingCameras:
    """Estimation of camera poses."""

    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 200
    """Number of video frames to use: the sharpest in each interval."""
    matching: PairingName = "auto"
    """Pairs of photos to match: all ("exhaustive"), visually similar ones, or consecutive ones. "auto": all
    pairs of up to 80 photos, similar pairs of more, consecutive frames of a video."""
    detail: DetailName = "auto"
    """Effort to find features. "high": takes about four times as long and finds more. "auto": normal, but
    also small features when there are 30 photos or fewer."""
    panoramas: Panoramas = "auto"
    """360-degree photos, among those that are twice as wide as they are high. "auto": photos whose metadata
    say so (GPano); "all": all of them; "none": none. They are cut into the faces of a cube, on which the
    scene is trained."""
    panorama_lens: Annotated[bool, shown_as()] = False
    """Keep 360-degree photos as they are, and train through the lens of panoramas, which is slower and gives
    softer scenes. By default they are cut into faces."""

    def check(self) -> None:
        """Raises InputError if a value makes no sense."""
        if self.frames < refusals.FEWEST:
            raise InputError(f"--frames: at least {refusals.FEWEST}, not {self.frames}.")


@dataclass(frozen=True)
class Reconstruct:
    """Estimate the camera poses of photos or of a video, and write a capture to train on.

    Structure from motion by COLMAP, on the CPU. Copies the photos to OUT/images, 360-degree photos as the
    faces of a cube, and writes the model, with the lens that was found, to OUT/sparse/0. If interrupted, run
    the same command again to resume.
    """

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photos, or a video."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Output folder for the capture."""
    cameras: FindingCameras = FindingCameras()
    undistort: Annotated[bool, shown_as()] = False
    """Resample the photos for pinhole cameras, for programs that know no lenses. By default photos are copied
    as they are. 360-degree photos become pinhole photos anyway, unless --panorama-lens keeps them."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    overwrite: OverwriteFlag = False
    """Start over and replace the results of an earlier call in the output folder."""

    def run(self) -> None:
        self.cameras.check()
        began = time.monotonic()
        with claimed(self.out), resumable(), Stages(pipeline.STAGES) as stages:
            if self.overwrite:
                clear(self.photos, self.out)
            outcome = reconstruct(
                self.photos,
                self.out,
                frames=self.cameras.frames,
                features=DETAILS[self.cameras.detail],
                pairing=PAIRINGS[self.cameras.matching],
                seed=self.seed,
                panoramas=self.cameras.panoramas,
                faces=not self.cameras.panorama_lens,
                undistort=self.undistort,
                watch=Forecasting(stages, self.photos, self.cameras),
            )
        for line in told(outcome):
            say(line)
        say(f"capture {self.out}, after {duration(time.monotonic() - began)}")
        say(f"check it: splatax inspect {self.out}      train on it: splatax train {self.out}")


class Forecasting:
    """Shows the progress of a reconstruction, and forecasts its end once the first photos have features."""

    def __init__(self, stages: Stages, source: Path, cameras: FindingCameras):
        self.stages, self.source, self.cameras = stages, source, cameras
        self._photos = 0
        self._first: tuple[int, float] | None = None
        self._told = False

    def __call__(self, stage: str, done: int, total: int) -> None:
        self.stages.show(stage, done, total)
        if stage == "reading":
            self._photos = total  # features are found in the faces of 360-degree photos, which are more
        if stage != "features" or self._told:
            return
        if self._first is None:
            self._first = done, time.monotonic()
        elif done > self._first[0]:
            self._told = True
            each = (time.monotonic() - self._first[1]) / (done - self._first[0])
            pairing = PAIRINGS[self.cameras.matching] or pipeline.pairing_for(self.source, total)
            left = duration(forecast.seconds_left(each, done, total, pairing, self._photos))
            self.stages.note(f"the cameras of {self._photos:,} photos take about {left} more")


def told(outcome: Outcome) -> list[str]:
    """Returns how many photos were registered, and why others were not, as lines."""
    count = len(outcome.registered)
    every = count + sum(reason != VIDEO for reason in outcome.rejected.values())
    lines = [
        f"{count} of {every} photos registered",
        f"{outcome.points:,} points, mean reprojection error {outcome.error:.2f} px",
    ]
    if outcome.panoramas:
        what = f"{counted(outcome.panoramas)} with a pose show 360 degrees"
        lines.append(f"{what}. If that is wrong: --panoramas none")
    if outcome.wide:
        what = f"{counted(outcome.wide)} twice as wide as high, taken for ordinary ones"
        lines.append(f"{what}. If they show 360 degrees: --panoramas all")
    for reason, number in Counter(outcome.rejected.values()).most_common():
        names = [name for name, why in outcome.rejected.items() if why == reason]
        more = f" and {number - NAMED} more" if number > NAMED else ""
        lines.append(f"not registered: {', '.join(names[:NAMED])}{more}: {reason}")
    return lines
