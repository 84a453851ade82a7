"""Synthetic scenes by name. A scene is one file and one line here."""

from splatax.demo.scene import Scene
from splatax.demo.scenes.glossy import GLOSSY
from splatax.demo.scenes.object import OBJECT
from splatax.demo.scenes.outdoor import OUTDOOR
from splatax.demo.scenes.room import ROOM
from splatax.demo.scenes.still_life import STILL_LIFE
from splatax.demo.scenes.thin import THIN

SCENES: dict[str, Scene] = {
    "still-life": STILL_LIFE,
    "room": ROOM,
    "object": OBJECT,
    "outdoor": OUTDOOR,
    "thin": THIN,
    "glossy": GLOSSY,
}
DEFAULT = "still-life"


def scene_named(name: str) -> Scene:
    """Returns the scene with a name.

    Raises:
        ValueError: if there is none.
    """
    if name not in SCENES:
        raise ValueError(f"scene is one of {', '.join(SCENES)}, not {name!r}")
    return SCENES[name]
