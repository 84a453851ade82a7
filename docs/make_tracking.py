"""Runs the code of tracking.md, prints its errors and draws its picture: `python docs/make_tracking.py`."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatax as sx
from splatax.cameras.geometry import seen_at

DOCS = Path(__file__).parent
GAP, CONTRAST = 4, 4  # white pixels between pictures; factor on differences


def names_of(page: Path) -> dict:
    """Runs the blocks of a page one after the other, and returns the names that they define."""
    names: dict = {}
    blocks = page.read_text().split("```python\n")[1:]
    exec("\n".join(block.split("```")[0] for block in blocks), names)
    return names


def errors_of(camera: sx.Camera, names: dict) -> dict[str, float]:
    """Returns the errors of a camera, and by how much it shows the Gaussians elsewhere, pixels."""
    truth, means = names["truth"], np.asarray(names["scene"].means)
    apart = np.asarray(camera.rotation @ truth.rotation.T, np.float64)
    pixels = [seen_at(each, means)[0] for each in (camera, truth)]
    return {
        "rotation, mrad": 1e3 * float(np.linalg.norm(apart - apart.T) / np.sqrt(8)),
        "position": float(jnp.linalg.norm(camera.position - truth.position)),
        "focal length": float(camera.fx / truth.fx - 1),
        "k1": float(camera.lens.radials[0] - truth.lens.radials[0]),
        "k2": float(camera.lens.radials[1] - truth.lens.radials[1]),
        "pixels": float(np.nanmedian(np.linalg.norm(pixels[0] - pixels[1], axis=1))),
    }


def main() -> None:
    names = names_of(DOCS / "tracking.md")
    photo = np.asarray(names["photo"])
    row = [photo]
    for camera in (names["start"], names["camera"]):
        print({name: f"{value:.2g}" for name, value in errors_of(camera, names).items()})
        off = np.asarray(sx.render(names["scene"], camera).rgb) - photo
        row.append(np.clip(0.5 + CONTRAST * off, 0, 1))
    gap = np.ones((photo.shape[0], GAP, 3))
    parts = [part for picture in row for part in (gap, picture)][1:]
    pixels = np.round(255 * np.concatenate(parts, axis=1)).astype(np.uint8)
    Image.fromarray(pixels).save(DOCS / "images" / "tracking.jpg", quality=85)


if __name__ == "__main__":
    main()
