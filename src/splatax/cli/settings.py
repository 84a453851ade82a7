"""The options of a training run with all defaults filled in: what config.json and checkpoints record."""

from collections.abc import Mapping, Set
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import splatax as sx
from splatax.blocks.plan import PLAN
from splatax.cli.options import (
    AdjustmentName,
    AppearanceName,
    BackendName,
    BackgroundName,
    Downscale,
    InitName,
    PhotoWeightsName,
    RecipeName,
    RefinementName,
    flag,
    parsed,
    resolve_backend,
)
from splatax.dataset import photos_in
from splatax.digests import file_digest
from splatax.errors import InputError
from splatax.low_pass import low_pass_of
from splatax.order import Order
from splatax.runs.budget import parse_bytes, parse_seconds
from splatax.runs.records import typed_fields
from splatax.splits import is_list, listed_in, parse_hold_out
from splatax.training.appearance import APPEARANCES
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.camera_refinement import CAMERA_REFINEMENTS
from splatax.training.geometry import Surfaces
from splatax.training.initialize import FromBlock, with_sky
from splatax.training.photo_weights import PHOTO_WEIGHTS
from splatax.training.protocols import Initialization
from splatax.training.recipes import PRESETS

FEWEST_TO_WEIGH = 10  # training photos: of fewer, each shows something that no other does
Kind = TypeVar("Kind")
LOWEST = {
    "steps": 1,
    "views": 1,
    "max_gaussians": 1,
    "seed": 0,
    "eval_every": 0,
    "checkpoint_every": 0,
    "checkpoint_steps": 0,
}


@dataclass(frozen=True)
class Settings:
    """Options of a training run, by the names that they have on the command line."""

    scene: Path | None = None
    out: Path | None = None
    title: str | None = None
    overwrite: bool = False
    budget: str | None = None
    memory: str | None = None
    steps: int = 30_000
    views: int = 1
    max_gaussians: Literal["auto"] | int = "auto"
    downscale: Downscale = "auto"
    hold_out: str | None = None
    leave_out: str = "auto"
    undistort: bool = False
    points: Path | None = None
    judged_by: Path | None = None
    recipe: RecipeName = "default"
    init: InitName = "sfm"
    sky: bool = False
    background: BackgroundName | None = None
    low_pass: str | None = None
    order: Order | None = None
    appearance: AppearanceName = "auto"
    refine: RefinementName = "none"
    adjust_cameras: AdjustmentName = "none"
    cameras: Path | None = None  # file of adjusted cameras, once they are found
    city: Path | None = None  # folder of a plan, for the run of one of its blocks
    block: int = 0
    geometry: bool = False
    geometry_after: float | None = None
    photo_weights: PhotoWeightsName = "auto"
    backend: BackendName = "auto"
    seed: int = 0
    eval_every: int = 0
    checkpoint_every: float = 120.0
    checkpoint_steps: int = 0

    @property
    def seconds(self) -> float | None:
        """The time budget; None without one."""
        return None if self.budget is None else parsed("budget", self.budget, parse_seconds)

    @property
    def memory_bytes(self) -> int | None:
        """The limit of memory; None without one."""
        return None if self.memory is None else parsed("memory", self.memory, parse_bytes)

    def check(self) -> None:
        """Raises InputError if a value makes no sense."""
        for name, least in LOWEST.items():
            value = getattr(self, name)
            if value != "auto" and not value >= least:
                raise InputError(f"{flag(name)}: at least {least}, not {value}.")
        late = self.geometry_after
        if late is not None and not 0 <= late < 1:
            raise InputError(f"{flag('geometry_after')}: from 0 to below 1, not {late}.")
        if late and not self.geometry:
            raise InputError(f"{flag('geometry_after')} is about {flag('geometry')}: give that too.")
        for name, read in (("budget", parse_seconds), ("memory", parse_bytes), ("low_pass", low_pass_of)):
            if (text := getattr(self, name)) is not None:
                parsed(name, text, read)
        if self.hold_out is not None:
            parsed("hold_out", self.hold_out, parse_hold_out)

    def absolute(self) -> "Settings":
        """Returns the settings with absolute paths of input files: a run may be resumed from elsewhere."""
        hold_out = self.hold_out
        if hold_out and is_list(hold_out):
            hold_out = str(Path(hold_out).absolute())
        leave_out = "".join(f"{name}\n" for name in listed_in(self.leave_out))
        return replace(
            self,
            scene=self.scene and self.scene.absolute(),
            hold_out=hold_out,
            leave_out=self.leave_out if self.leave_out in ("auto", "none") else leave_out,
            points=self.points and self.points.absolute(),
            cameras=self.cameras and self.cameras.absolute(),
            judged_by=self.judged_by and self.judged_by.absolute(),
            city=self.city and self.city.absolute(),
        )

    def most(self, dataset: sx.Dataset) -> int:
        """Returns the upper limit of the number of Gaussians, apart from memory."""
        return (
            PRESETS[self.recipe].max_gaussians(dataset)
            if self.max_gaussians == "auto"
            else self.max_gaussians
        )

    def to_recipe(self, dataset: sx.Dataset) -> sx.Recipe:
        """Returns the recipe that the options describe, for a capture.

        Raises:
            InputError: if the backend cannot run here.
        """
        preset = PRESETS[self.recipe]
        recipe = preset.build(steps=self.steps, max_gaussians=self.most(dataset), views=self.views)
        if self.geometry:
            late = Surfaces.after if self.geometry_after is None else self.geometry_after
            recipe = replace(recipe, objective=replace(recipe.objective, geometry=Surfaces(after=late)))
        weights = PHOTO_WEIGHTS[self.weighing(dataset)]
        recipe = replace(recipe, objective=replace(recipe.objective, weights=weights))
        drawing = replace(
            recipe.drawing.in_order(self.order or recipe.drawing.order),
            background=BACKGROUNDS[self.background] if self.background else recipe.drawing.background,
            low_pass=low_pass_of(self.low_pass) if self.low_pass else recipe.drawing.low_pass,
            backend=resolve_backend(self.backend),
        )
        return replace(
            recipe,
            initialization=self.initialization(),
            appearance=APPEARANCES["none" if self.appearance == "auto" else self.appearance],
            camera_refinement=CAMERA_REFINEMENTS[self.refine],
            drawing=drawing,
            seed=self.seed,
        )

    def weighing(self, dataset: sx.Dataset) -> str:
        """Returns the name of how photos are weighed.

        By default they are weighed robustly if the preset says so, and if there are enough of them.
        """
        if self.photo_weights != "auto":
            return self.photo_weights
        weighs = PRESETS[self.recipe].weighs_photos and not self.too_few_to_weigh(dataset)
        return "robust" if weighs else "equal"

    def too_few_to_weigh(self, dataset: sx.Dataset) -> bool:
        """Returns whether photos have equal weights only because the capture has few training photos."""
        by_default = self.photo_weights == "auto" and PRESETS[self.recipe].weighs_photos
        return by_default and photos_in(dataset.train) < FEWEST_TO_WEIGH

    def initialization(self) -> Initialization:
        """Returns how the first Gaussians are created."""
        if self.city:
            return FromBlock(file_digest(self.city / PLAN), self.block)
        preset = PRESETS[self.recipe]
        start = (
            preset.random_start if self.init == "random" else preset.build(steps=self.steps).initialization
        )
        return with_sky(start) if self.sky else start


NAMES = {field.name for field in fields(Settings)}


def as_started(kind: type[Kind], stored: Mapping[str, Any], given: Mapping[str, Any], free: Set[str]) -> Kind:
    """Returns the settings of an earlier run, with those given now that may change.

    Args:
        kind: the dataclass of the settings.
        stored: settings of the run, as JSON values.
        given: on the command line.
        free: names of settings that may change.

    Raises:
        InputError: if others are given with other values.
    """
    settings = kind(**typed_fields(kind, stored))
    for name, value in given.items():
        if name not in free and value != getattr(settings, name):
            begun = f"with {getattr(settings, name)}, which" if value is not True else "without it, which"
            raise InputError(
                f"{flag(name)}{'' if value is True else f' {value}'}: the run was started {begun} cannot be "
                "changed. Leave the option out, or start a new run."
            )
    return replace(settings, **given)  # type: ignore[type-var]
