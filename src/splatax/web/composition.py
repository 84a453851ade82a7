"""Compositions: a .toml file that places parts, and says what a page offers.

title = "Car"
[parts.body]
file = "body.ply"
[parts.wheel]
file = "wheel.ply"
degrees = [0, 90, 0]
scale = 0.5
move = [1, 0, 0.2]
[variants.paint.white]
[variants.paint.red]
dye.body = [0.9, 0.1, 0.1]
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera, look_at
from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.io import formats
from splatax.io.rigs import load_animated
from splatax.io.rigs.scenes import animated_in
from splatax.io.scenes import load_scene, opened, variants_in
from splatax.rendering import Color
from splatax.scene import ColorMap, Option, Part, Scene, Variants, chosen
from splatax.trajectories import keyframes
from splatax.transforms import Similarity
from splatax.web.presentation import Hotspot, Presentation
from splatax.web.skinned import Motion

COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
UP = (0.0, -1.0, 0.0)  # y points down, as in a camera
FRAMES = 60  # cameras of a flight
SIZE = (1600, 1000)  # pixels; only their ratio matters
SECONDS = 20.0


@dataclass(frozen=True)
class Composition:
    """A scene and its presentation, as a .toml file of parts describes them.

    Attributes:
        scene: all parts; `scene.chosen` applies the variants to it.
        presentation: the offers of its page.
        title: title of the page.
        background: display-referred RGB behind the scene.
        motions: clips that parts play, by the names of the parts.
    """

    scene: Scene
    presentation: Presentation
    title: str
    background: Color
    motions: Mapping[str, Motion] = field(default_factory=dict)

    @property
    def at_first(self) -> Scene:
        """The scene with the first option of each variant, as the page opens and as files keep it."""
        return chosen(self.scene, self.presentation.variants)


def compose(path: str | Path) -> Composition:
    """Reads a .toml file of parts and variants, and the splat files that it names; or a .glb file of them.

    docs/configurator.md lists the keys. Files are looked for beside the .toml file, and read once each. A
    .glb file has parts, variants and clips, of which its page plays the first: its page has no notes, and its
    title is the name of the file.

    Raises:
        FormatError: if a file is missing or damaged, a key is unknown or has no valid value, or a variant or
            a note names a part that there is not.
    """
    path = Path(path)
    if path.suffix.lower() == ".glb":
        return _from_glb(path)
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file. Give a .toml file of parts.") from None
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: not a TOML file ({error}).") from error
    try:
        return _composed(path, table)
    except FormatError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        reason = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise FormatError(f"{path}: {reason}. docs/configurator.md shows an example.") from error


def _from_glb(path: Path) -> Composition:
    """Returns the scene of a .glb file with its variants, and the first clip of its skinned parts."""
    with opened(path) as file:
        scene, variants = variants_in(file)
        animated = animated_in(file, scene)
    clip = next(iter(animated.clips.values()), None)
    motions = {} if clip is None else {name: Motion(rig, clip) for name, rig in animated.rigs.items()}
    bound = {
        name: replace(scene[name], gaussians=animated.scene[name].gaussians, pose=animated.scene[name].pose)
        for name in motions
    }
    return Composition(scene.replaced(bound), Presentation(variants), path.stem, COLORS["black"], motions)


def _composed(path: Path, table: dict[str, Any]) -> Composition:
    known = ("title", "background", "parts", "variants", "hotspots", "start", "path", "embed")
    _check_keys("the file", table, known)
    files, rows, motions = _Files(path.parent), table.get("parts", {}), dict[str, Motion]()
    scene = Scene({name: _part(files, name, row, motions) for name, row in rows.items()})
    variants = {
        variant: {name: _option(f"[variants.{variant}.{name}]", row) for name, row in options.items()}
        for variant, options in table.get("variants", {}).items()
    }
    chosen(scene, variants)
    presentation = _presentation(path, table, variants)
    for spot in presentation.hotspots:
        if spot.part is not None:
            scene[spot.part]
    background = table.get("background", "black")
    rgb = COLORS.get(background) if isinstance(background, str) else _numbers("background", background, 3)
    if rgb is None:
        raise ValueError(f"background is {background!r}, not black, white or three numbers")
    title = str(table.get("title", path.stem))
    return Composition(scene, presentation, title, (rgb[0], rgb[1], rgb[2]), motions)


class _Files:
    """The splat files of a composition, each of which is read once in each of the ways that parts need it."""

    def __init__(self, folder: Path):
        self.whole = cache(lambda name: formats.load(folder / name))
        self.nodes = cache(lambda name: load_scene(folder / name))
        self.animated = cache(lambda name: load_animated(folder / name))


def _part(files: _Files, name: str, row: dict[str, Any], motions: dict[str, Motion]) -> Part:
    """Returns a part, and adds its clip to the motions if it plays one."""
    where = f"[parts.{name}]"
    known = ("file", "node", "clip", "degrees", "scale", "move", "visible", "tint", "dye", "matrix", "offset")
    _check_keys(where, row, known)
    file, node = str(row["file"]), row.get("node")
    if "clip" in row:
        gaussians, motions[name] = _moving(where, files, file, node, str(row["clip"]))
    else:
        gaussians = files.whole(file) if node is None else files.nodes(file)[node].gaussians
    place = {key: _numbers(f"{where} {key}", row[key], 3) for key in ("degrees", "move") if key in row}
    pose = Similarity.of(**place, scale=float(row.get("scale", 1)))  # type: ignore[arg-type]
    visible = _flag(f"{where} visible", row.get("visible", True))
    return Part(gaussians, pose, visible, _color(where, row))


def _moving(where: str, files: _Files, file: str, node: str | None, clip: str) -> tuple[Gaussians, Motion]:
    """Returns the Gaussians of a part with a skin, and the clip that moves it."""
    animated, name = files.animated(file), Path(file).name
    names = [skinned for skinned in animated.rigs if node in (None, skinned)]
    if len(names) != 1:
        listed = ", ".join(animated.rigs) or "none"
        raise ValueError(f"{where} has a clip, so it needs one part with a skin; {name} has {listed}")
    if clip not in animated.clips:
        listed = ", ".join(animated.clips) or "none"
        raise ValueError(f"{where} has clip {clip!r}, and the clips of {name} are {listed}")
    gaussians = replace(animated.scene[names[0]].gaussians)  # of its own: others may play another clip
    return gaussians, Motion(animated.rigs[names[0]], animated.clips[clip])


def _color(where: str, row: Mapping[str, Any]) -> ColorMap | None:
    given = [key for key in ("tint", "dye", "matrix") if key in row]
    if len(given) > 1 or ("offset" in row and given != ["matrix"]):
        raise ValueError(f"{where} has more than one colour. Give tint, dye, or a matrix with an offset")
    if not given:
        return None
    if given == ["matrix"]:
        rows = [_numbers(f"{where} matrix", numbers, 3) for numbers in row["matrix"]]
        offset = _numbers(f"{where} offset", row.get("offset", (0, 0, 0)), 3)
        return ColorMap(np.array(rows, np.float32).reshape(3, 3), np.array(offset, np.float32))
    red, green, blue = _numbers(f"{where} {given[0]}", row[given[0]], 3)
    return {"tint": ColorMap.tint, "dye": ColorMap.dye}[given[0]]((red, green, blue))


def _option(where: str, row: dict[str, Any]) -> Option:
    maps = ("tint", "dye", "matrix", "offset")
    _check_keys(where, row, ("show", *maps))
    parts = dict.fromkeys(part for key in maps for part in row.get(key, {}))
    colors = {}
    for part in parts:
        own = {key: row[key][part] for key in maps if part in row.get(key, {})}
        color = _color(f"{where} {part}", own)
        if color is None:
            raise ValueError(f"{where} {part} has an offset without a matrix")
        colors[part] = color
    show = row.get("show", [])
    if not isinstance(show, list):
        raise ValueError(f"{where} show is {show!r}, not a list of parts")
    return Option(tuple(map(str, show)), colors)


def _presentation(path: Path, table: dict[str, Any], variants: Variants) -> Presentation:
    spots = []
    for row in table.get("hotspots", []):
        _check_keys("[[hotspots]]", row, ("at", "text", "part"))
        x, y, z = _numbers("[[hotspots]] at", row["at"], 3)
        spots.append(Hotspot((x, y, z), str(row["text"]), row.get("part")))
    embed, flight, start = table.get("embed", {}), table.get("path", {}), table.get("start")
    _check_keys("[embed]", embed, ("buttons", "autoplay", "turntable"))
    _check_keys("[path]", flight, ("file", "seconds"))
    seconds = float(flight.get("seconds", SECONDS))
    if not 0 < seconds < math.inf:
        raise ValueError(f"[path] seconds is {seconds}, not a duration above 0")
    cameras = keyframes.read(path.parent / flight["file"], FRAMES, SIZE) if flight else []
    return Presentation(
        variants,
        tuple(spots),
        None if start is None else _view(start),
        cameras,
        seconds,
        "turntable" if _flag("[embed] turntable", embed.get("turntable", False)) else "flight",
        _flag("[embed] autoplay", embed.get("autoplay", False)),
        _flag("[embed] buttons", embed.get("buttons", True)),
    )


def _view(row: dict[str, Any]) -> Camera:
    _check_keys("[start]", row, ("position", "target", "up", "fov"))
    position, target = (_numbers(f"[start] {key}", row[key], 3) for key in ("position", "target"))
    up = _numbers("[start] up", row.get("up", UP), 3)
    fov = float(row.get("fov", 50))
    if not 0 < fov < 180:
        raise ValueError(f"[start] fov is an angle of 0 to 180 degrees, not {fov}")
    pose = look_at(*(jnp.asarray(point, jnp.float32) for point in (position, target, up)))
    if not np.isfinite(pose).all():
        raise ValueError("[start] position, target and up lie on a line")
    width, height = SIZE
    return Camera.simple_pinhole(height / 2 / math.tan(math.radians(fov) / 2), pose, width, height)


def _numbers(what: str, values: Any, count: int) -> tuple[float, ...]:
    numbers = [float(value) for value in values] if isinstance(values, list | tuple) else []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{what} is {values!r}, not {count} numbers")
    return tuple(numbers)


def _flag(what: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{what} is {value!r}, not true or false")
    return value


def _check_keys(where: str, row: Any, known: tuple[str, ...]) -> None:
    if not isinstance(row, dict):
        raise ValueError(f"{where} is {row!r}, not a table")
    for key in row:
        if key not in known:
            raise ValueError(f"{where} has {key!r}, which is not one of {', '.join(known)}")
