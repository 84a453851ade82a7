"""Reads Agisoft Metashape's exported cameras (`cameras.xml`), with the photos in the folder.

    CAPTURE/cameras.xml      CAPTURE/images/...      CAPTURE/points.ply (optional, the only .ply file)

Poses are camera-to-chunk with x right, y down, z forward; a similarity of the component or of the chunk leads
to the world. The principal point is relative to the photo's centre, P1 and P2 are OpenCV's p2 and p1, and
f + B1 is the focal length along x.
(Metashape user manual, appendix "Camera models"; www.agisoft.com/downloads/user-manuals)
"""

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from splatax.errors import DatasetError, shown
from splatax.io.damage import blamed_on
from splatax.io.datasets import lenses
from splatax.io.datasets.capture import Capture, Frame, Lens, always
from splatax.io.datasets.fields import MOST_FRAMES, nearest_rigid, too_many
from splatax.io.datasets.finding import Photos
from splatax.io.datasets.points import points_beside

if TYPE_CHECKING:
    import pycolmap

FILE = "cameras.xml"
LOOKED_FOR = "Metashape's cameras (.xml)"
BEGINNING = 4096  # bytes in which the kind of an XML file shows
LARGEST_SKEW = 0.5  # pixels by which B2 may move the edge of a photo
FISHEYES = ("fisheye", "equidistant_fisheye")
UNFIT = ("k4", "p3", "p4")  # coefficients of a frame camera that have no place in COLMAP's models


def recognise(path: Path) -> bool:
    """Returns whether the folder holds cameras of Metashape."""
    return bool(files_in(path))


def files_in(path: Path) -> list[Path]:
    """Returns the XML files of Metashape, `cameras.xml` first."""
    found = sorted(path.glob("*.xml"), key=lambda file: (file.name != FILE, file.name))
    return [file for file in found if file.is_file() and is_metashape(file)]


def is_metashape(file: Path) -> bool:
    """Returns whether an XML file begins like Metashape's."""
    with file.open("rb") as opened:
        beginning = opened.read(BEGINNING)
    return b"<document" in beginning and b"<chunk" in beginning


def read(path: Path, downscale: int | None) -> Capture:
    """Reads a capture. Cameras that are not aligned, or are switched off, are left out, and counted.

    Raises:
        DatasetError: if the file is damaged, or a lens model cannot be undistorted.
    """
    file = files_in(path)[0]
    way_out = "Export the cameras again."
    with blamed_on(file, "not valid XML of Metashape", way_out, DatasetError):
        chunk = chunk_of(file)
        cameras = list(chunk.find("cameras").iter("camera"))  # type: ignore[union-attr]
        if len(cameras) > MOST_FRAMES:
            raise too_many(file, len(cameras))
        found = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
        worlds = worlds_of(chunk)
        sensors: dict[str | None, Lens] = {}
        photos, frames = Photos(path), []
        for camera in cameras:
            matrix, sensor = camera.find("transform"), camera.get("sensor_id")
            if matrix is None or camera.get("enabled", "true").lower() in ("false", "0"):
                continue
            label = camera.get("label") or ""
            where = f"{file}, camera {shown(label)}"
            if sensor not in sensors:
                if sensor not in found:
                    raise DatasetError(f"{where}: it has no sensor. {way_out}")
                sensors[sensor] = always(lens_of(file, found[sensor]))
            world = worlds.get(camera.get("component_id"), worlds[None])
            pose = pose_of(where, numbers(matrix, 16).reshape(4, 4), world)
            frames.append(Frame(label, photos.path_of(label, where), sensors[sensor], pose))
    left_out = len(cameras) - len(frames)
    notes = (f"{left_out} cameras of {file.name} are not aligned or switched off",) if left_out else ()
    return Capture(file, path, frames, points_beside(path), notes=notes)


def chunk_of(file: Path) -> ElementTree.Element:
    """Returns the first chunk of a file that has cameras.

    Raises:
        DatasetError: if there is none, or the file defines entities, which could expand without end.
    """
    contents = file.read_bytes()
    if b"<!DOCTYPE" in contents or b"<!ENTITY" in contents:
        raise DatasetError(f"{file}: it defines entities, which Metashape never does. Export it again.")
    for chunk in ElementTree.fromstring(contents).iter("chunk"):
        if chunk.find("cameras") is not None:
            return chunk
    raise DatasetError(f"{file}: no chunk in it has cameras. Export the cameras again.")


def numbers(element: ElementTree.Element | None, count: int) -> Float[np.ndarray, " count"]:
    """Returns the numbers in an element.

    Raises:
        ValueError: if it has another count of numbers.
    """
    if element is None or element.text is None:
        raise ValueError("an element without numbers")
    values = np.array(element.text.split(), np.float64)
    if len(values) != count:
        raise ValueError(f"<{element.tag}> has {len(values)} numbers in place of {count}")
    return values


def worlds_of(chunk: ElementTree.Element) -> dict[str | None, Float[np.ndarray, "4 4"]]:
    """Returns the transforms to the world of each component, by its number, and under None of the chunk."""
    worlds: dict[str | None, Float[np.ndarray, "4 4"]] = {None: similarity(chunk.find("transform"))}
    for component in chunk.iter("component"):
        if (transform := component.find("transform")) is not None:
            worlds[component.get("id")] = similarity(transform)
    return worlds


def similarity(transform: ElementTree.Element | None) -> Float[np.ndarray, "4 4"]:
    """Returns a rotation, translation and scale as a matrix; missing parts have no effect."""
    matrix = np.eye(4)
    if transform is None:
        return matrix
    if (rotation := transform.find("rotation")) is not None:
        matrix[:3, :3] = numbers(rotation, 9).reshape(3, 3)
    if (scale := transform.find("scale")) is not None:
        matrix[:3, :3] *= numbers(scale, 1)[0]
    if (translation := transform.find("translation")) is not None:
        matrix[:3, 3] = numbers(translation, 3)
    return matrix


def pose_of(
    where: str, chunk_from_cam: Float[np.ndarray, "4 4"], world: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "3 4"]:
    """Returns the pose of a camera.

    Raises:
        DatasetError: if it is not a rotation and a translation, up to the scale of the world.
    """
    with np.errstate(all="ignore"):
        scale = np.cbrt(np.linalg.det(world[:3, :3]))
        matrix = world @ chunk_from_cam
        matrix[:3, :3] /= scale
    poses, good = nearest_rigid(matrix[None])
    if not good.all():
        raise DatasetError(
            f"{where}: its pose is not a rotation and a translation. Export the cameras again."
        )
    return np.linalg.inv(poses[0])[:3]


def lens_of(file: Path, sensor: ElementTree.Element) -> "pycolmap.Camera":
    """Returns the camera of a sensor, adjusted if it has been.

    Raises:
        DatasetError: if the sensor is not calibrated, or its lens model cannot be undistorted.
    """
    where = f"{file}, sensor {shown(sensor.get('label') or sensor.get('id') or '')}"
    calibrations = sorted(sensor.findall("calibration"), key=lambda c: c.get("class") != "adjusted")
    if not calibrations:
        raise DatasetError(f"{where}: it is not calibrated. Align the photos, then export the cameras.")
    calibration = calibrations[0]
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if kind not in ("frame", *FISHEYES):
        raise lenses.refused(where, kind)
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise DatasetError(f"{where}: it has no resolution. Export the cameras again.")
    width, height = (float(resolution.get(side, "")) for side in ("width", "height"))

    def value(name: str) -> float:
        found = calibration.find(name)
        return 0.0 if found is None else float(numbers(found, 1)[0])

    if abs(value("b2")) * height / 2 > LARGEST_SKEW * max(value("f"), 1):
        raise lenses.refused(where, f"{kind} with skew (b2 = {value('b2'):.3g})")
    size, focal = (width, height), (value("f") + value("b1"), value("f"))
    centre = (width / 2 + value("cx"), height / 2 + value("cy"))
    radial, tangential = [value(f"k{i}") for i in (1, 2, 3, 4)], (value("p2"), value("p1"))
    for name in UNFIT[kind in FISHEYES :]:
        if value(name):
            raise lenses.refused(where, f"{kind} with {name} = {value(name):.3g}")
    if kind in FISHEYES:
        return lenses.fisheye(size, focal, centre, (radial[0], radial[1], radial[2], radial[3]), tangential)
    return lenses.perspective(size, focal, centre, (radial[0], radial[1], radial[2]), tangential)
