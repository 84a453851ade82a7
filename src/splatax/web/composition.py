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
from splatax.web import tables
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
    except ValueError as error:
        raise FormatError(
            f"{path}: {str(error).removesuffix('.')}. docs/configurator.md shows an example."
        ) from error


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
    tables.table("the file", table, known)
    rows = tables.table("parts", table.get("parts", {}))
    if not rows:
        raise ValueError("no parts. Give at least one, such as [parts.body] with its file")
    files, motions = _Files(path.parent), dict[str, Motion]()
    scene = Scene({name: _part(files, name, row, motions) for name, row in rows.items()})
    variants = {
        variant: {
            name: _option(f"[variants.{variant}.{name}]", row)
            for name, row in tables.table(f"[variants.{variant}]", options).items()
        }
        for variant, options in tables.table("variants", table.get("variants", {})).items()
    }
    chosen(scene, variants)
    presentation = _presentation(path, table, variants)
    for spot in presentation.hotspots:
        if spot.part is not None and spot.part not in scene.parts:
            raise ValueError(
                f"[[hotspots]] has no part {spot.part!r}: the scene has {', '.join(scene.names)}"
            )
    title = tables.text("title", table.get("title", path.stem))
    return Composition(scene, presentation, title, _background(table.get("background", "black")), motions)


def _background(value: Any) -> Color:
    if isinstance(value, str) and value in COLORS:
        return COLORS[value]
    try:
        rgb = tables.color("background", value)
    except ValueError:
        rgb = (math.inf,) * 3
    if max(rgb) > 1:
        raise ValueError(f"background is {value!r}, not black, white or three numbers from 0 to 1")
    return rgb


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
    tables.table(where, row, known)
    file = tables.text(f"{where} file", tables.needed(where, row, "file"))
    node = tables.text(f"{where} node", row["node"]) if "node" in row else None
    if "clip" in row:
        clip = tables.text(f"{where} clip", row["clip"])
        gaussians, motions[name] = _moving(where, files, file, node, clip)
    else:
        gaussians = files.whole(file) if node is None else _node(where, files, file, node)
    place = {key: tables.numbers(f"{where} {key}", row[key], 3) for key in ("degrees", "move") if key in row}
    scale = tables.number(f"{where} scale", row.get("scale", 1))
    if scale <= 0:
        raise ValueError(f"{where} scale is {scale:g}, not above 0")
    pose = Similarity.of(**place, scale=scale)  # type: ignore[arg-type]
    visible = tables.flag(f"{where} visible", row.get("visible", True))
    return Part(gaussians, pose, visible, _color(where, row))


def _node(where: str, files: _Files, file: str, node: str) -> Gaussians:
    """Returns the Gaussians of a node of a .glb file."""
    scene = files.nodes(file)
    if node not in scene.parts:
        raise ValueError(f"{where} has node {node!r}, and the nodes of {file} are {', '.join(scene.names)}")
    return scene[node].gaussians


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
    if len(given) > 1:
        raise ValueError(f"{where} has more than one colour. Give tint, dye, or a matrix with an offset")
    if "offset" in row and given != ["matrix"]:
        raise ValueError(f"{where} has an offset without a matrix")
    if not given:
        return None
    if given == ["matrix"]:
        rows = row["matrix"] if isinstance(row["matrix"], list) and len(row["matrix"]) == 3 else None
        if rows is None:
            raise ValueError(f"{where} matrix is {row['matrix']!r}, not three rows of three numbers")
        matrix = [tables.numbers(f"{where} a row of matrix", numbers, 3) for numbers in rows]
        offset = tables.numbers(f"{where} offset", row.get("offset", (0, 0, 0)), 3)
        return ColorMap(np.array(matrix, np.float32), np.array(offset, np.float32))
    color = tables.color(f"{where} {given[0]}", row[given[0]])
    return ColorMap.tint(color) if given[0] == "tint" else ColorMap.dye(color)


def _option(where: str, row: dict[str, Any]) -> Option:
    maps = ("tint", "dye", "matrix", "offset")
    tables.table(where, row, ("show", *maps))
    for key in maps:
        if not isinstance(row.get(key, {}), dict):
            raise ValueError(f"{where} {key} names no part: write {key}.PART")
    parts = dict.fromkeys(part for key in maps for part in row.get(key, {}))
    colors = {}
    for part in parts:
        own = {key: row[key][part] for key in maps if part in row.get(key, {})}
        if (color := _color(f"{where} {part}", own)) is not None:
            colors[part] = color
    show = row.get("show", [])
    if not isinstance(show, list) or not all(isinstance(part, str) for part in show):
        raise ValueError(f"{where} show is {show!r}, not a list of names of parts")
    return Option(tuple(show), colors)


def _presentation(path: Path, table: dict[str, Any], variants: Variants) -> Presentation:
    rows = table.get("hotspots", [])
    if not isinstance(rows, list):
        raise ValueError("hotspots is one table. Write [[hotspots]] above each note")
    embed = tables.table("[embed]", table.get("embed", {}), ("buttons", "autoplay", "turntable"))
    flight = tables.table("[path]", table.get("path", {}), ("file", "seconds"))
    seconds = tables.number("[path] seconds", flight.get("seconds", SECONDS))
    if seconds <= 0:
        raise ValueError(f"[path] seconds is {seconds}, not a duration above 0")
    cameras = []
    if "path" in table:
        file = tables.text("[path] file", tables.needed("[path]", flight, "file"))
        cameras = keyframes.read(path.parent / file, FRAMES, SIZE)
    return Presentation(
        variants,
        tuple(map(_spot, rows)),
        _view(table["start"]) if "start" in table else None,
        cameras,
        seconds,
        "turntable" if tables.flag("[embed] turntable", embed.get("turntable", False)) else "flight",
        tables.flag("[embed] autoplay", embed.get("autoplay", False)),
        tables.flag("[embed] buttons", embed.get("buttons", True)),
    )


def _spot(row: Any) -> Hotspot:
    where = "[[hotspots]]"
    tables.table(where, row, ("at", "text", "part"))
    x, y, z = tables.numbers(f"{where} at", tables.needed(where, row, "at"), 3)
    part = tables.text(f"{where} part", row["part"]) if "part" in row else None
    return Hotspot((x, y, z), tables.text(f"{where} text", tables.needed(where, row, "text")), part)


def _view(row: Any) -> Camera:
    where = "[start]"
    tables.table(where, row, ("position", "target", "up", "fov"))
    position, target = (
        tables.numbers(f"{where} {key}", tables.needed(where, row, key), 3) for key in ("position", "target")
    )
    up = tables.numbers(f"{where} up", row.get("up", UP), 3)
    fov = tables.number(f"{where} fov", row.get("fov", 50))
    if not 0 < fov < 180:
        raise ValueError(f"{where} fov is an angle of 0 to 180 degrees, not {fov:g}")
    pose = look_at(*(jnp.asarray(point, jnp.float32) for point in (position, target, up)))
    if not np.isfinite(pose).all():
        raise ValueError(f"{where} position, target and up lie on a line")
    width, height = SIZE
    return Camera.simple_pinhole(height / 2 / math.tan(math.radians(fov) / 2), pose, width, height)
