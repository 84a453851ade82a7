"""Options that several commands share, how they are shown, and what they name: models, captures, backends."""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import jax
import tyro

import splatax as sx
from splatax import backends
from splatax.cli.output import say
from splatax.dataset import resplit
from splatax.errors import InputError
from splatax.low_pass import LOW_PASSES, low_pass_of
from splatax.order import Order
from splatax.reconstruction.calibration import ADJUSTMENTS
from splatax.runs.cameras import with_cameras
from splatax.runs.scene_files import scene_at
from splatax.splits import Every, parse_hold_out
from splatax.training.appearance import APPEARANCES
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.camera_refinement import CAMERA_REFINEMENTS
from splatax.training.photo_weights import PHOTO_WEIGHTS
from splatax.training.recipes import PRESETS

Downscale = Literal["auto"] | int
BackendName = Literal["auto", *backends.BACKENDS]  # type: ignore[valid-type]
BackgroundName = Literal[*BACKGROUNDS]  # type: ignore[valid-type]
AppearanceName = Literal["auto", *APPEARANCES]  # type: ignore[valid-type]
AdjustmentName = Literal["none", *ADJUSTMENTS]  # type: ignore[valid-type]
RefinementName = Literal[*CAMERA_REFINEMENTS]  # type: ignore[valid-type]
PhotoWeightsName = Literal["auto", *PHOTO_WEIGHTS]  # type: ignore[valid-type]


OTHER_RULE = Every(first=1)  # of runs of other programs, and of runs from before there was a choice
Value = TypeVar("Value")
Split = Literal["test", "train", "all"]
InitName = Literal["sfm", "random"]
RecipeName = Literal[*PRESETS]  # type: ignore[valid-type]


def shown_as(metavar: str | None = None) -> Any:
    """Returns how help shows an option: what the user types, and no default, which its text says in words."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


OverwriteFlag = Annotated[bool, shown_as()]
BackgroundOption = Annotated[BackgroundName | None, shown_as()]
LowPassOption = Annotated[str | None, shown_as(f"{{{','.join(LOW_PASSES)}}}[:VARIANCE]")]
OrderOption = Annotated[Order | None, shown_as()]
DownscaleOption = Annotated[Downscale | None, shown_as("{auto,N}")]
PathOption = Annotated[Path | None, shown_as("PATH")]
FolderOption = Annotated[Path | None, shown_as("FOLDER")]
HoldOutOption = Annotated[str | None, shown_as("{every:N,last,LIST,none}")]
TextOption = Annotated[str | None, shown_as("TEXT")]


def flag(name: str) -> str:
    """Returns an option as the user types it, from the name of its field."""
    return f"--{name.replace('_', '-')}"


def given(options: Any) -> dict[str, Any]:
    """Returns the options that are neither None nor False, by name, those in groups too."""
    found: dict[str, Any] = {}
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            found |= given(value)
        elif value is not None and value is not False:
            found[field.name] = value
    return found


def parsed(name: str, text: str, read: Callable[[str], Value]) -> Value:
    """Returns what the text of an option stands for.

    Raises:
        InputError: naming the option, if it stands for nothing; or of the file that the text names.
    """
    try:
        return read(text)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{flag(name)}: {error}.") from error


@dataclass(frozen=True)
class Model:
    """A trained scene, and the options of the run that trained it, where they are known."""

    path: Path
    name: str  # of the run or of the file
    gaussians: sx.Gaussians
    options: dict[str, Any]  # of the run that made it; empty if unknown


def read_model(path: Path, low_pass: str | None = None, order: Order | None = None) -> Model:
    """Reads a splat file, or the scene in the folder of a run, and the options of the run.

    Runs are those of splatax, of INRIA's 3DGS and of gsplat; see `runs.scene_files`.

    Args:
        path: of the file or folder.
        low_pass: the filter to draw with, as the user types it, instead of the one that the file or the run
            names.
        order: the order to draw in, instead of the one that the file names.

    Raises:
        InputError: if there is no model, it cannot be read, or it has no Gaussians.
    """
    found = scene_at(path)
    for note in found.notes:
        say(f"note    {note}")
    gaussians = sx.load(found.path)
    if len(gaussians) == 0:
        raise InputError(f"{found.path}: a scene without Gaussians. Write it again, or choose another one.")
    if chosen := low_pass or found.low_pass:
        gaussians = replace(gaussians, low_pass=parsed("low_pass", chosen, low_pass_of))
    if order:
        gaussians = replace(gaussians, order=order)
    return Model(found.path, found.name, gaussians, found.options)


def background_of(options: Mapping[str, Any], asked: str | None = None) -> tuple[float, float, float]:
    """Returns the RGB behind a scene: as asked for, else of a run with these options, else black."""
    return BACKGROUNDS[asked or options.get("background") or "black"].rgb


def parse_size(option: str, text: str) -> tuple[int, int]:
    """Returns width and height from text such as "960x540".

    Args:
        option: for the message.
        text: from the user.

    Raises:
        InputError: if it is something else.
    """
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise InputError(f"{option}: WIDTHxHEIGHT in pixels such as 960x540, not {text!r}.")
    return int(match[1]), int(match[2])


def scene_of(model: Model) -> Path | None:
    """Returns the capture that a model was trained on, if it is known and still there."""
    scene = model.options.get("scene")
    return Path(scene) if scene and Path(scene).is_dir() else None


def load_scene(
    scene: Path,
    downscale: Downscale | None,
    model: Model | None = None,
    hold_out: str | None = None,
    undistort: bool | None = None,
) -> sx.Dataset:
    """Loads a capture, by default with the size, held-out photos and cameras that a model was trained with.

    Raises:
        InputError: if an option makes no sense for the capture.
    """
    options = model.options if model else {}  # of runs before there was a choice, undistort is missing
    chosen = downscale
    if chosen is None:
        chosen = options.get("downscale", "auto")
    rule = hold_out or options.get("hold_out")
    if chosen != "auto" and int(chosen) < 1:
        raise InputError(f'--downscale: "auto" or a whole number from 1, not {chosen}.')
    dataset = sx.load_dataset(
        scene,
        downscale=None if chosen == "auto" else int(chosen),
        hold_out=None if rule is None else parsed("hold_out", rule, parse_hold_out),
        undistort=options.get("undistort", bool(options)) if undistort is None else undistort,
    )
    if model and (adjusted := options.get("cameras")):
        stored, beside = Path(adjusted), model.path.with_name(Path(adjusted).name)
        dataset = with_cameras(dataset, stored if stored.exists() else beside)
    unsaid = rule is None and bool(options) and "hold_out" not in options
    return resplit(dataset, OTHER_RULE) if unsaid and dataset.split == str(Every()) else dataset


def resolve_backend(name: str) -> str:
    """Returns the backend to use. Prints why if "auto" chooses a slower one.

    Raises:
        InputError: if it cannot run here.
    """
    try:
        chosen = backends.resolve(name).name
    except ValueError as error:
        raise InputError(f"--backend: {error}.") from error
    if name == "auto" and jax.default_backend() == "cpu" and chosen != "cpu":
        say(f"using the portable backend: {backends.why_unavailable('cpu')}")
    return chosen
