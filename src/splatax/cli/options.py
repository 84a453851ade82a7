"""Options that several commands share, and a model as they are given one: a file, or a run."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax

import splatax as sx
from splatax import backends
from splatax.cli.output import say
from splatax.cli.runs import options_beside
from splatax.errors import InputError
from splatax.io import formats
from splatax.projection import LOW_PASSES, LowPass
from splatax.training.appearance import APPEARANCES
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.camera_refinement import CAMERA_REFINEMENTS

Downscale = Literal["auto"] | int
BackendName = Literal["auto", *backends.BACKENDS]  # type: ignore[valid-type]
BackgroundName = Literal[*BACKGROUNDS]  # type: ignore[valid-type]
AppearanceName = Literal[*APPEARANCES]  # type: ignore[valid-type]
RefinementName = Literal[*CAMERA_REFINEMENTS]  # type: ignore[valid-type]
LowPassName = Literal[*LOW_PASSES]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Model:
    """A trained scene, and how it was trained where that is known."""

    path: Path
    gaussians: sx.Gaussians
    options: dict[str, Any]  # of the run that made it; empty if unknown
    low_pass: LowPass


def read_model(path: Path, low_pass: str | None) -> Model:
    """Reads a splat file, or the scene.ply of a run's folder, and the config.json beside it.

    Args:
        path: of the file or folder.
        low_pass: the name of one to use instead of the one in the file.

    Raises:
        InputError: if there is no model, or it cannot be read.
    """
    if path.is_dir():
        if not (path / "scene.ply").exists():
            raise InputError(
                f"{path}: no scene.ply in this folder. Give a splat file, or the folder of a run."
            )
        path = path / "scene.ply"
    gaussians = sx.load(path)
    marked = formats.MIP in formats.comments(path)
    name = low_pass or ("antialiasing" if marked else "dilation")
    return Model(path, gaussians, options_beside(path), LOW_PASSES[name])


def background_of(options: Mapping[str, Any], asked: str | None = None) -> tuple[float, float, float]:
    """RGB behind a scene: as asked for, else as a run with these options was trained, else black."""
    return BACKGROUNDS[asked or options.get("background") or "black"].rgb


def parse_size(option: str, text: str) -> tuple[int, int]:
    """Width and height from "960x540".

    Args:
        option: that it was given with, for the message.
        text: of the user.

    Raises:
        InputError: if it is something else.
    """
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise InputError(f"{option}: WIDTHxHEIGHT in pixels such as 960x540, not {text!r}.")
    return int(match[1]), int(match[2])


def scene_of(model: Model) -> Path | None:
    """The capture that a run was trained on, if it is known and where it was."""
    scene = model.options.get("scene")
    return Path(scene) if scene and Path(scene).is_dir() else None


def load_scene(scene: Path, downscale: Downscale | None, model: Model | None = None) -> sx.Dataset:
    """Loads a capture, at the size that a model was trained at unless told otherwise."""
    chosen = downscale
    if chosen is None:
        chosen = model.options.get("downscale", "auto") if model else "auto"
    if chosen != "auto" and int(chosen) < 1:
        raise InputError(f'--downscale: "auto" or a whole number from 1, not {chosen}.')
    return sx.load_dataset(scene, downscale=None if chosen == "auto" else int(chosen))


def resolve_backend(name: str) -> str:
    """The rasterizer to use. Says so where "auto" has to do with a slower one.

    Raises:
        InputError: if it cannot run here.
    """
    try:
        chosen = backends.resolve(name).name
    except ValueError as error:
        raise InputError(f"--backend: {error}.") from error
    if name == "auto" and jax.default_backend() == "cpu" and chosen != "cpu":
        say(f"using the portable rasterizer: {backends.why_unavailable('cpu')}")
    return chosen
