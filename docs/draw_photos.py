"""Draws the photos and the video of results.md from which `splatax create` makes pages.

python docs/draw_photos.py uneven FOLDER    writes 12 photos of the still life, each with another exposure
python docs/draw_photos.py video FILE       writes a video of a walk past it, 40 pictures
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from splatax.demo.raycast import photograph
from splatax.demo.scenes import scene_named
from splatax.io.video import writing

SIZE = (640, 480)
STOPS = (0.5, -0.4, 0.1, -0.6, 0.6, 0.3, -0.5, 0.0, 0.4, -0.3, -0.1, 0.2)  # of the exposures
GAMMA = 2.2  # of the camera
PAST, FRAMES = 50.0, 40  # degrees to each side of a walk; pictures of a video


def walk(count: int, past: float) -> list[np.ndarray]:
    """Returns photos from left to right, 8 bits; the first and the last are `past` degrees aside."""
    still_life = scene_named("still-life")
    viewpoints = replace(still_life.viewpoints, azimuths=(-past, past), elevations=(25.0,))
    scene = replace(still_life, viewpoints=viewpoints)
    cameras = sorted(scene.cameras(count, SIZE), key=lambda camera: float(camera.position[0]))
    return [np.asarray(photograph(camera, still_life))[..., :3] for camera in cameras]


def exposed(photo: np.ndarray, stops: float) -> np.ndarray:
    """Returns a photo as another exposure would have made it, clipped where it is too bright."""
    light = (photo / 255) ** GAMMA * 2**stops
    return np.round(255 * np.clip(light, 0, 1) ** (1 / GAMMA)).astype(np.uint8)


def main(kind: str, out: Path) -> None:
    """Draws what is asked for."""
    if kind == "uneven":
        out.mkdir(parents=True, exist_ok=True)
        for number, (photo, stops) in enumerate(zip(walk(len(STOPS), PAST / 2), STOPS, strict=True)):
            Image.fromarray(exposed(photo, stops)).save(out / f"IMG_{1201 + number}.jpg", quality=95)
    else:
        with writing(out, SIZE, fps=10) as add:
            for photo in walk(FRAMES, PAST):
                add(photo)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
