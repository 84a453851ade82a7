"""Writes the page: the viewer and the scene inside one HTML file."""

import base64
import gzip
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jinja2
import numpy as np

from splatax.camera import Camera
from splatax.errors import FormatError, InputError
from splatax.gaussians import Gaussians
from splatax.io import formats
from splatax.io.files import write_whole
from splatax.math import morton
from splatax.projection import NEAR, Antialiasing, Dilation, LowPass
from splatax.web.staging import stage

MAX_SH_DEGREE = 3  # that the viewer draws
LOSES = (
    "As .spz, with finer SH: positions are rounded to 24 bits, opacities, colours and scales to 8 bits, "
    "rotations to 10, SH to 6 bits (degree 1) and 5 bits, clipped to -1 to 1."
)
SH_BUCKETS = (4, 8)  # half of the usual ones: 4 dB nearer to the scene for a fifth more bytes (fern)
VIEWER = Path(__file__).parent / "viewer.js"  # built from web/ by `make page`
CHUNK = 3 << 17  # bytes that come as one: progress is shown after each


def save(path: str | Path, gaussians: Gaussians, **options: Any) -> None:
    """Writes a page that shows a scene: it opens with a double click, and asks the network for nothing.

    Args:
        path: of the page.
        gaussians: the scene, with SH up to degree 3.
        options: title and all others of `document`.

    Raises:
        InputError, FormatError: as `document`.
    """
    write_whole(Path(path), document(gaussians, name=str(path), **options).encode())


def document(
    gaussians: Gaussians,
    *,
    title: str,
    cameras: Mapping[str, Camera] | None = None,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    low_pass: LowPass = Dilation(),
    name: str = "page",
) -> str:
    """The HTML of a page that shows a scene.

    The scene is put upright and scaled to an ordinary size, by its cameras.

    Args:
        gaussians: the scene, with SH up to degree 3.
        title: any text.
        cameras: of the capture, by name: places to look from, and the way of the camera path.
        background: display-referred RGB behind the scene, in [0, 1].
        low_pass: as the scene was trained.
        name: of the page, for errors.

    Raises:
        InputError: if the viewer has not been built.
        FormatError: if the scene is empty, or has harmonics that the viewer cannot draw.
    """
    viewer = _viewer()
    if len(gaussians) == 0:
        raise FormatError(f"{name}: the scene has no Gaussians to show.")
    if gaussians.sh_degree > MAX_SH_DEGREE:
        raise FormatError(
            f"{name}: a page shows SH up to degree {MAX_SH_DEGREE}, and the scene has degree "
            f"{gaussians.sh_degree}. Reduce it first: splatax export --sh-degree {MAX_SH_DEGREE}."
        )
    cameras = cameras or {}
    staged = stage(gaussians, cameras)
    page = {
        "background": list(background),
        "lowPass": _variances(low_pass),
        "near": NEAR * staged.place.scale,
        "cameras": staged.poses,
        "start": staged.start,
    }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("splatax.web", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("page.html").render(
        title=title,
        count=len(gaussians),
        cameras=list(cameras),
        page=page,
        viewer=list(_chunks(gzip.compress(viewer, 9, mtime=0))),
        scene=list(_chunks(_spz(staged.place.transform(gaussians)))),
    )


def require_viewer() -> None:
    """Makes sure that pages can be written here.

    Raises:
        InputError: if the viewer is not built; it says how to.
    """
    _viewer()


def _viewer() -> bytes:
    try:
        return VIEWER.read_bytes()
    except FileNotFoundError as error:
        raise InputError(
            f"{VIEWER}: the viewer is not built. Build it with `make page` in the sources of splatax "
            "(needs Node.js 18 or newer), or install a wheel, which contains it."
        ) from error


def _variances(low_pass: LowPass) -> dict[str, Any]:
    """Pixels^2 that are added to each footprint, in the two ways there are."""
    return {
        "dilation": low_pass.variance if isinstance(low_pass, Dilation) else 0,
        "antialiasing": low_pass.variance if isinstance(low_pass, Antialiasing) else 0,
    }


def _spz(gaussians: Gaussians) -> bytes:
    nearby = morton.order(np.asarray(gaussians.means))  # together: compresses and draws better
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        formats.save(path, jax.tree.map(lambda leaf: leaf[nearby], gaussians), buckets=SH_BUCKETS)
        return path.read_bytes()


def _chunks(contents: bytes) -> Iterator[str]:
    for start in range(0, len(contents), CHUNK):
        yield base64.b64encode(contents[start : start + CHUNK]).decode()
