"""Writes a reconstruction as a capture: the photos as they are, and the model with their lens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.cameras.conventions import PANORAMA
from splatax.io.datasets.photos import LARGEST_SIDE
from splatax.io.datasets.undistortion import undistortion
from splatax.reconstruction.panoramas import FACES, pixels_in_panorama
from splatax.reconstruction.photos import Photo, copy, read, save

if TYPE_CHECKING:
    import pycolmap

Move = Callable[[Float[np.ndarray, "n 2"]], Float[np.ndarray, "n 2"]]


@dataclass(frozen=True)
class Written:
    """The photos of one camera in the capture.

    Attributes:
        camera: of the photos as they are written.
        moves: for each photo of a moment in the model, in order, where its pixels are in the written photo.
        write: writes a photo to a path.
    """

    camera: "pycolmap.Camera"
    moves: Sequence[Move]
    write: Callable[[Photo, Path], None]


def write_capture(
    model: "pycolmap.Reconstruction",
    photos: dict[str, Photo],
    out: Path,
    watch: Callable[[int, int], None],
    undistort: bool = False,
) -> "pycolmap.Reconstruction":
    """Writes OUT/images and OUT/sparse/0, and returns the model of the written photos.

    Args:
        model: model of the shrunk photos, and of the faces of panoramas.
        photos: original photos by their names in the model.
        out: folder of the capture.
        watch: function that is called with (photos written, all photos).
        undistort: resamples photos, at full size, for pinhole cameras.
    """
    import pycolmap

    registered: dict[str, list[pycolmap.Image]] = {}
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        registered.setdefault(photos[image.name].name, []).append(image)
    capture, ways = pycolmap.Reconstruction(), dict[int, Written]()
    for number, point in model.points3D.items():
        capture.add_point3D_with_id(number, pycolmap.Point3D(xyz=point.xyz, color=point.color))
    for done, (name, images) in enumerate(registered.items()):
        watch(done, len(registered))
        photo, found = photos[images[0].name], images[0].camera_id
        if found not in ways:
            ways[found] = (
                as_panorama(model, images, photo)
                if photo.panorama
                else (
                    as_pinhole(model.camera(found), photo)
                    if undistort
                    else as_it_is(model.camera(found), photo)
                )
            )
            ways[found].camera.camera_id = found
            capture.add_camera_with_trivial_rig(ways[found].camera)
        ways[found].write(photo, out / "images" / name)
        add_photo(capture, name, images, ways[found])
    capture.update_point_3d_errors()
    sparse = out / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    capture.write_binary(sparse)
    watch(len(registered), len(registered))
    return capture


def add_photo(
    capture: "pycolmap.Reconstruction", name: str, images: "Sequence[pycolmap.Image]", way: Written
) -> None:
    """Adds a photo with its observations to the model of a capture.

    Args:
        capture: the model.
        name: of the photo.
        images: of its moment in the model that was found; the first has the pose of the photo.
        way: how it is written.
    """
    import pycolmap

    pixels, points = [], []
    for image, move in zip(images, way.moves, strict=True):
        if image.num_points2D():
            pixels += list(move(np.array([point.xy for point in image.points2D])))
            points += [point.point3D_id if point.has_point3D() else None for point in image.points2D]
    number = images[0].image_id
    written = pycolmap.Image(name=name, camera_id=way.camera.camera_id, image_id=number)
    written.points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
    capture.add_image_with_trivial_frame(written, images[0].cam_from_world())
    for index, point in enumerate(points):
        if point is not None:
            capture.add_observation(point, pycolmap.TrackElement(number, index))


def as_it_is(shrunk: "pycolmap.Camera", photo: Photo) -> Written:
    """Returns how the photos of a camera are written unchanged, with their lens."""
    lens, scale = at_full_size(shrunk, photo)
    return Written(lens, [lambda pixels: pixels * scale], copy)


def as_pinhole(shrunk: "pycolmap.Camera", photo: Photo) -> Written:
    """Returns how the photos of a camera are undistorted."""
    lens, scale = at_full_size(shrunk, photo)
    shrinking = float(-(-max(lens.width, lens.height) // LARGEST_SIDE))  # the loader's factor
    pinhole, straighten = undistortion(lens, shrinking)

    def straight(pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        slopes = lens.cam_from_img(pixels * scale)
        return np.asarray(pinhole.img_from_cam(np.column_stack([slopes, np.ones(len(slopes))])))

    return Written(pinhole, [straight], lambda photo, path: save(path, straighten(read(photo))))


def as_panorama(model: "pycolmap.Reconstruction", faces: "Sequence[pycolmap.Image]", photo: Photo) -> Written:
    """Returns how panoramas are written unchanged, with the features of their faces."""
    import pycolmap

    width, height = photo.size
    camera = pycolmap.Camera(model=PANORAMA, width=width, height=height, params=[width, height])
    size = model.camera(faces[0].camera_id).width
    moves = [lambda pixels, face=face: pixels_in_panorama(pixels, face, size, photo.size) for face in FACES]
    return Written(camera, moves, copy)


def at_full_size(
    shrunk: "pycolmap.Camera", photo: Photo
) -> "tuple[pycolmap.Camera, Float[np.ndarray, ' 2']]":
    """Returns the camera of the photos of a shrunk camera at their full size, and its size over the other."""
    import pycolmap

    lens = pycolmap.Camera(shrunk.todict())
    lens.rescale(*photo.size)
    return lens, np.array([lens.width / shrunk.width, lens.height / shrunk.height])
