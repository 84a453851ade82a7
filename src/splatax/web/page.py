"""The page: the viewer and a scene inside one HTML file."""

import base64
import gzip
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from jaxtyping import Int

from splatax.cameras import Camera
from splatax.cameras.lenses.protocol import NEAR
from splatax.errors import FormatError, InputError
from splatax.gaussians import Gaussians, broken, rows_of
from splatax.io import formats
from splatax.io.files import write_whole
from splatax.low_pass import AlongRays, Antialiasing, Dilation, LowPass
from splatax.math import morton
from splatax.order import common
from splatax.rendering import Color
from splatax.scene import Drawable, seen
from splatax.transforms import Similarity
from splatax.web.detail import LOD_ABOVE, previews_of
from splatax.web.presentation import Presentation, described, placed, standard
from splatax.web.skinned import FPS, Motion
from splatax.web.staging import stage

MAX_SH_DEGREE = 3  # highest degree that the viewer draws
LOSES = (
    "positions are rounded to 24 bits, opacities, colours and scales to 8 bits, rotations to 10, SH to 7 "
    "bits, clipped to -1 to 1."
)
# The demo loses 0.08 dB on its test photos. The usual sizes, (8, 16), lose 1.7 dB in 39 % fewer bytes; .sog
# loses 0.1 dB in 40 % more.
SH_BUCKETS = (2, 2)
# Ellipses with it are closest to discs drawn along rays: docs/measure_discs_elsewhere.py.
ALONG_RAYS = Dilation(0.06)
VIEWER = Path(__file__).parent / "viewer.js"  # built from web/ by `make page`
NOTHING = Presentation()
CHUNK = 3 << 17  # bytes of each embedded chunk: progress is shown after each


def save(path: str | Path, scene: Drawable, **options: Any) -> None:
    """Writes a page that shows a scene, as one file that makes no network requests.

    Args:
        path: file to write.
        scene: Gaussians or a `Scene` of parts, with SH up to degree 3.
        options: title, and all other options of `document`.

    Raises:
        InputError: if the viewer has not been built.
        FormatError: if the scene is empty, or its SH degree is above 3.
    """
    write_whole(Path(path), document(scene, name=str(path), **options).encode())


def document(
    scene: Drawable,
    *,
    title: str,
    cameras: Mapping[str, Camera] | None = None,
    background: Color = (0.0, 0.0, 0.0),
    presentation: Presentation = NOTHING,
    motion: Motion | Mapping[str, Motion] | None = None,
    lod_above: int = LOD_ABOVE,
    name: str = "page",
) -> str:
    """Returns the HTML of a page that shows a scene.

    The scene is levelled and scaled to a standard size, according to its cameras.

    Args:
        scene: Gaussians or a `Scene` of parts, with SH up to degree 3.
        title: any text.
        cameras: cameras of the capture by name: the viewpoints, and the keyframes of the flight.
        background: display-referred RGB behind the scene, in [0, 1].
        presentation: variants, notes, start view and flight.
        motion: clip that the Gaussians play; for a `Scene`, those of some parts by their names, which play
            together. Colours do not turn with joints, so they are right at SH degree 0.
        lod_above: number of Gaussians above which the page opens with a preview, and then draws with level of
            detail. A page with a motion draws all its Gaussians.
        name: name of the page in error messages.

    Raises:
        InputError: if the viewer has not been built.
        FormatError: if the scene or a part is empty, its SH degree is above 3, its parts were trained with
            different low-pass filters, or the presentation names what the scene has not.
    """
    viewer = _viewer()
    cameras = cameras or {}
    low_pass = _check(scene, name)
    staged = stage(seen.in_world(scene), cameras)
    parts, files = placed(scene, staged.place)
    whole = {file: _whole(gaussians) for file, gaussians in files.items()}
    previews = {} if motion else previews_of(whole, lod_above)
    names = {file: f"preview-{file}" for file in previews}
    first = {names.get(file, file): previews.get(file, gaussians) for file, gaussians in whole.items()}
    page = {
        "background": [float(value) for value in background],
        "lowPass": _variances(low_pass),
        "byDistance": common(gaussians.order for gaussians in seen.clouds_of(scene).values()) == "distance",
        "near": NEAR * staged.place.scale,
        "cameras": staged.poses,
        "start": staged.start,
        "parts": [part | {"preview": names.get(part["file"])} for part in parts],
        **described(scene, staged, presentation, name),
        "motion": _motion(motion, scene, parts, files, staged.place, name),
    }
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("splatax.web", "."), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("page.html").render(
        title=title,
        count=len(scene),
        cameras=list(cameras),
        page=page,
        viewer=list(_chunks(gzip.compress(viewer, 9, mtime=0))),
        scenes={file: list(_chunks(_spz(gaussians))) for file, gaussians in first.items()},
        details={file: list(_chunks(_spz(whole[file]))) for file in previews},
    )


def _motion(
    motion: Motion | Mapping[str, Motion] | None,
    scene: Drawable,
    parts: Sequence[Mapping[str, Any]],
    files: Mapping[str, Gaussians],
    place: Similarity,
    name: str,
) -> dict[str, Any] | None:
    """Returns what the page needs of the clips of parts: the bones of each, and how they are played."""
    if not motion:
        return None
    if isinstance(motion, Motion) != isinstance(scene, Gaussians):
        raise FormatError(
            f"{name}: Gaussians have one motion, and a scene of parts has motions by the names of its parts."
        )
    moving = {"scene": motion} if isinstance(motion, Motion) else dict(motion)
    indices = {part["name"]: index for index, part in enumerate(parts)}
    bones = []
    for part, own in moving.items():
        if part not in indices:
            raise FormatError(
                f"{name}: a motion moves part {part!r}, but the scene has {', '.join(indices)}."
            )
        index = indices[part]
        gaussians = files[parts[index]["file"]]
        if len(own.rig.indices) != len(gaussians):
            raise FormatError(
                f"{name}: part {part!r} has {len(gaussians):,} Gaussians, and its rig "
                f"{len(own.rig.indices):,}."
            )
        here = place if isinstance(scene, Gaussians) else standard(scene[part].gaussians)
        bones.append({"part": index, **own.described(here, _order(gaussians), name)})
    clips = [own.clip for own in moving.values()]
    names = ", ".join(dict.fromkeys(clip.name for clip in clips))
    return {"clip": names, "seconds": max(clip.seconds for clip in clips), "fps": FPS, "parts": bones}


def _order(gaussians: Gaussians) -> Int[np.ndarray, " n"]:
    """Returns the rows that a page holds, in their order: neighbours in space are neighbours in the file.

    The file is smaller and drawn faster so. Broken Gaussians and empty slots are left out.
    """
    rows = np.flatnonzero(~(broken(gaussians) | np.isneginf(np.asarray(gaussians.opacity_logits))))
    return rows[morton.order(np.asarray(gaussians.means)[rows])]


def _check(scene: Drawable, name: str) -> LowPass:
    """Checks that a page can show a scene, and returns the filter that it is drawn with."""
    filters = set()
    for part, gaussians in seen.clouds_of(scene).items():
        which = f"part {part!r}" if part else "the scene"
        if len(gaussians) == 0:
            raise FormatError(f"{name}: {which} has no Gaussians to show.")
        if gaussians.sh_degree > MAX_SH_DEGREE:
            raise FormatError(
                f"{name}: a page shows SH up to degree {MAX_SH_DEGREE}, and {which} has degree "
                f"{gaussians.sh_degree}. Reduce it to degree {MAX_SH_DEGREE} first "
                "(splatax.editing.reduce_degree, or splatax export).",
                options=(f"sh_degree {MAX_SH_DEGREE}",),
            )
        filters.add(gaussians.low_pass)
    if len(filters) > 1:
        raise FormatError(
            f"{name}: a page has one low-pass filter, and its parts were trained with different ones. Train "
            "them alike."
        )
    return filters.pop()


def require_viewer() -> None:
    """Checks that pages can be written.

    Raises:
        InputError: if the viewer has not been built; the message says how to build it.
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
    """Returns the variances that the viewer's two filters add to each footprint, pixels^2.

    The viewer draws ellipses only. It shows scenes that are drawn along rays as thin Gaussians. These need a
    smaller dilation than others: `AlongRays` widens no splat that is larger than its blur.
    """
    dilation = ALONG_RAYS if isinstance(low_pass, AlongRays) else low_pass
    return {
        "dilation": dilation.variance if isinstance(dilation, Dilation) else 0,
        "antialiasing": low_pass.variance if isinstance(low_pass, Antialiasing) else 0,
    }


def _whole(gaussians: Gaussians) -> Gaussians:
    nearby = _order(gaussians)
    return rows_of(gaussians, nearby)


def _spz(gaussians: Gaussians) -> bytes:
    usual = Antialiasing() if isinstance(gaussians.low_pass, Antialiasing) else Dilation()
    gaussians = replace(gaussians, low_pass=usual, order="depth")  # the page says how it is shown
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.spz"
        formats.save(path, gaussians, buckets=SH_BUCKETS)
        return path.read_bytes()


def _chunks(contents: bytes) -> Iterator[str]:
    for start in range(0, len(contents), CHUNK):
        yield base64.b64encode(contents[start : start + CHUNK]).decode()
