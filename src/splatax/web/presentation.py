"""Presentations of scenes on pages: variants, notes at places of the scene, a start view and a flight."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from splatax.cameras import Camera
from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.scene import ColorMap, Drawable, Scene, Variants, chosen, seen
from splatax.transforms import Similarity
from splatax.web.staging import HALF_TURN, SIZE, Stage, pose_at, spread_of

Play = Literal["flight", "turntable"]


@dataclass(frozen=True)
class Hotspot:
    """A note at a place of the scene.

    Attributes:
        at: the place, world units.
        text: text of the note.
        part: the part that it belongs to, with which it is hidden; None for the scene.
    """

    at: tuple[float, float, float]
    text: str
    part: str | None = None


@dataclass(frozen=True)
class Presentation:
    """The offers of a page beside the view.

    Attributes:
        variants: options to choose from; the page opens with the first of each variant.
        hotspots: notes at places of the scene.
        start: the first view; None to see the whole scene, or what the capture's cameras see.
        path: cameras of a flight, at equal times; empty to fly through the cameras of the capture.
        seconds: duration of the flight.
        play: action of the play button, if there is a flight.
        autoplay: whether the page starts to play by itself. It does not if the visitor's system asks for less
            motion.
        buttons: whether buttons are shown; a page that is embedded in another may go without.
    """

    variants: Variants = field(default_factory=dict)
    hotspots: tuple[Hotspot, ...] = ()
    start: Camera | None = None
    path: Sequence[Camera] = ()
    seconds: float = 20.0
    play: Play = "flight"
    autoplay: bool = False
    buttons: bool = True


def described(scene: Drawable, staged: Stage, presentation: Presentation, name: str) -> dict[str, Any]:
    """Returns what the viewer reads about parts, variants, notes and motion, as JSON.

    Raises:
        FormatError: if the variants or the notes name what the scene has not.
    """
    parts = list(scene.names) if isinstance(scene, Scene) else []
    try:
        if isinstance(scene, Scene):
            chosen(scene, presentation.variants)
        elif presentation.variants:
            raise ValueError("only a scene of parts has variants.")
        notes = [_note(spot, staged, parts) for spot in presentation.hotspots]
    except ValueError as error:
        raise FormatError(f"{name}: {error}") from error
    means = np.asarray(seen.in_world(scene).means, np.float64)
    found: dict[str, Any] = {
        "variants": _variants(presentation.variants, parts),
        "hotspots": notes,
        "path": [pose_at(staged.place, means, camera) for camera in presentation.path],
        "seconds": presentation.seconds,
        "play": presentation.play,
        "autoplay": presentation.autoplay,
        "buttons": presentation.buttons,
    }
    if presentation.start is not None:
        found["start"] = pose_at(staged.place, means, presentation.start) | {"camera": -1}
    return found


def placed(scene: Drawable, place: Similarity) -> tuple[list[dict[str, Any]], dict[str, Gaussians]]:
    """Returns the parts as the viewer places them, and the Gaussians of each of their files.

    Parts that share Gaussians share a file. Gaussians alone are one file, in place.

    Args:
        scene: the scene.
        place: transform from the world to the viewer's frame.
    """
    if isinstance(scene, Gaussians):
        here = {"position": [0, 0, 0], "quaternion": [0, 0, 0, 1], "scale": 1, "visible": True, "color": None}
        return [{"file": "scene", "name": "scene", **here}], {"scene": place.transform(scene)}
    files: dict[str, Gaussians] = {}
    sized: dict[int, tuple[str, Similarity]] = {}
    parts = []
    for name, part in scene.parts.items():
        if id(part.gaussians) not in sized:
            file, own = f"part-{len(sized)}", standard(part.gaussians)
            sized[id(part.gaussians)] = (file, own)
            files[file] = own.transform(part.gaussians)
        file, own = sized[id(part.gaussians)]
        there = place.after(_on_host(part.pose)).after(own.inverse())
        color = None if part.color is None else _rows(part.color)
        parts.append(
            {"file": file, "name": name, "visible": bool(part.visible > 0), "color": color} | _object(there)
        )
    return parts, files


def standard(gaussians: Gaussians) -> Similarity:
    """Returns the transform that gives a part the viewer's standard size, for which its files are precise."""
    middle, radius = spread_of(np.asarray(gaussians.means, np.float64))
    return Similarity(np.eye(3), -SIZE / radius * middle, SIZE / radius)


def _on_host(pose: Similarity) -> Similarity:
    return Similarity(
        np.asarray(pose.rotation, np.float64), np.asarray(pose.translation, np.float64), float(pose.scale)
    )


def _object(place: Similarity) -> dict[str, Any]:
    """Returns a transform in the axes of three.js."""
    from scipy.spatial.transform import Rotation

    rotation = HALF_TURN @ np.asarray(place.rotation) @ HALF_TURN
    return {
        "position": (HALF_TURN @ np.asarray(place.translation)).tolist(),
        "quaternion": Rotation.from_matrix(rotation).as_quat().tolist(),
        "scale": float(place.scale),
    }


def _rows(color: ColorMap) -> list[list[float]]:
    """Returns the rows of a map of colours, each with its offset at the end."""
    return np.column_stack([np.asarray(color.matrix), np.asarray(color.offset)]).tolist()


def _variants(variants: Variants, parts: list[str]) -> list[dict[str, Any]]:
    return [
        {
            "name": variant,
            "options": [
                {
                    "name": name,
                    "shows": [parts.index(part) for part in option.shows],
                    "colors": {parts.index(part): _rows(color) for part, color in option.colors.items()},
                }
                for name, option in options.items()
            ],
        }
        for variant, options in variants.items()
    ]


def _note(spot: Hotspot, staged: Stage, parts: Sequence[str]) -> dict[str, Any]:
    if spot.part is not None and spot.part not in parts:
        raise ValueError(
            f"a hotspot belongs to part {spot.part!r}, but the scene has {', '.join(parts) or 'no parts'}."
        )
    place = staged.place
    at = HALF_TURN @ (place.scale * place.rotation @ np.array(spot.at, np.float64) + place.translation)
    return {"at": at.tolist(), "text": spot.text, "part": -1 if spot.part is None else parts.index(spot.part)}
