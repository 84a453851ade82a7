"""Scenes in the run folders of splatax, of INRIA's 3DGS and of gsplat, and what the folders tell of the run.

RUN/scene.ply                                          RUN/config.json        splatax
RUN/point_cloud/iteration_30000/point_cloud.ply        RUN/cfg_args           INRIA
RUN/ckpts/ckpt_29999_rank0.pt                          RUN/cfg.yml            gsplat
"""

import ast
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatax.errors import InputError
from splatax.runs.finished import options_beside
from splatax.runs.records import understood

SCENE = "scene.ply"
INRIA, CFG_ARGS = "point_cloud/iteration_*/point_cloud.ply", "cfg_args"
GSPLAT, CFG_YML = "ckpts/ckpt_*.pt", "cfg.yml"
LONGEST = 1 << 16  # characters of a file of options
WAY_OUT = "Put it back as it was; or remove it, and say how the scene was trained where that matters."
DIVISORS = (1, 2, 4, 8)  # of the size of photos, that INRIA's option can name
NORMALIZED = (
    "gsplat has normalized the world of this run, so the cameras of the capture do not fit the scene; "
    "--no-normalize-world-space keeps the world"
)


@dataclass(frozen=True)
class FoundScene:
    """The file of a scene, and what is known of the run that made it.

    Attributes:
        path: path of the splat file.
        name: name of the run, or of the file.
        options: options of the run, by the names that they have in splatax; empty if nothing is known.
        low_pass: name of the anti-aliasing filter, if the options of another program tell it.
        notes: lines for people to read.
    """

    path: Path
    name: str
    options: dict[str, Any] = field(default_factory=dict)
    low_pass: str | None = None
    notes: tuple[str, ...] = ()


def scene_at(path: Path) -> FoundScene:
    """Returns the scene of a splat file, or of the folder of a run, the latest if there are several.

    Raises:
        InputError: if a folder is not that of a run, or the file of its options is damaged.
    """
    if not path.is_dir():
        return FoundScene(path, name_of_file(path), options_beside(path))
    name = path.resolve().name
    if (scene := path / SCENE).exists():
        return FoundScene(scene, name, options_beside(scene))
    if found := sorted(path.glob(INRIA), key=lambda file: number_in(file.parent.name)):
        return of_inria(path, found[-1])
    if found := sorted(path.glob(GSPLAT), key=lambda file: (number_in(file.name), file.name)):
        latest = [file for file in found if number_in(file.name) == number_in(found[-1].name)]
        return of_gsplat(path, latest[0])
    raise InputError(
        f"{path}: no scene.ply in this folder, nor {INRIA} (INRIA) or {GSPLAT} (gsplat). Give a splat file, "
        "or the folder of a run."
    )


def name_of_file(path: Path) -> str:
    """Returns the name of a splat file without its suffix; of a run's scene.ply, that of the run."""
    path = path.resolve()
    return path.parent.name if path.name == SCENE else path.name.split(".")[0]


def number_in(name: str) -> int:
    """Returns the first whole number in a name; -1 if there is none."""
    match = re.search(r"\d+", name)
    return int(match[0]) if match else -1


def of_inria(run: Path, scene: Path) -> FoundScene:
    """Returns the scene of a run of INRIA's trainer, with the options in its `cfg_args`."""
    arguments = cfg_args(run / CFG_ARGS) if (run / CFG_ARGS).is_file() else {}
    options: dict[str, Any] = {}
    if source := arguments.get("source_path"):
        options["scene"] = str(source)
    if "white_background" in arguments:
        options["background"] = "white" if arguments["white_background"] else "black"
    shrunk = number_in(str(arguments.get("images", "")))
    resolution = arguments.get("resolution")
    if shrunk in DIVISORS or resolution in DIVISORS:
        options["downscale"] = max(shrunk, 1) * (resolution if resolution in DIVISORS else 1)
    notes = () if arguments.get("eval", True) else ("trained on all photos: no photo was held out",)
    low_pass = "antialiasing" if arguments.get("antialiasing") else None
    return FoundScene(scene, run.resolve().name, options, low_pass, notes)


def cfg_args(path: Path) -> dict[str, Any]:
    """Returns the arguments in a file that holds `Namespace(name=value, ...)`, of which nothing is run.

    Raises:
        InputError: if the file holds anything else than constants.
    """
    with understood(path, WAY_OUT):
        text = path.read_text(encoding="utf-8")
        if len(text) > LONGEST:
            raise ValueError("too long")
        call = ast.parse(text.strip(), mode="eval").body
        if not isinstance(call, ast.Call) or call.args or ast.unparse(call.func) != "Namespace":
            raise ValueError("not a Namespace of arguments")
        return {keyword.arg or "": ast.literal_eval(keyword.value) for keyword in call.keywords}


def of_gsplat(run: Path, scene: Path) -> FoundScene:
    """Returns the scene of a run of gsplat's trainer, with the options in its `cfg.yml`."""
    arguments = cfg_yml(run / CFG_YML) if (run / CFG_YML).is_file() else {}
    options: dict[str, Any] = {"background": "black"}
    normalized = arguments.get("normalize_world_space", "true") == "true"
    if (source := arguments.get("data_dir")) and not normalized:
        options["scene"] = source
    if (factor := arguments.get("data_factor", "")).isdecimal() and 0 < int(factor) < 1000:
        options["downscale"] = int(factor)
    low_pass = "antialiasing" if arguments.get("antialiased") == "true" else None
    return FoundScene(scene, run.resolve().name, options, low_pass, (NORMALIZED,) if normalized else ())


def cfg_yml(path: Path) -> dict[str, str]:
    """Returns the entries of a YAML file that are one word or one line of text; nested ones are left out.

    Raises:
        InputError: if the file is not text.
    """
    with understood(path, WAY_OUT):
        text = path.read_text(encoding="utf-8")
        if len(text) > LONGEST:
            raise ValueError("too long")
    entries = (re.fullmatch(r"(\w+): *(\S.*)", line.rstrip()) for line in text.splitlines())
    return {match[1]: match[2].strip("'\"") for match in entries if match}
