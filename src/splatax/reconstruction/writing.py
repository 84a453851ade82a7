"""Writes a reconstruction as a capture: the photos as they are, and the model with their lens.

360-degree photos are written as the faces of a cube, which are resampled once, at the angular resolution of
the photo, and stored without loss. Their poses differ by exact rotations: the model has them as a rig.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from splatax.cameras.conventions import PANORAMA
from splatax.io.datasets.photos import LARGEST_SIDE
from splatax.io.datasets.undistortion import undistortion_of_files
from splatax.reconstruction.panoramas import (
    FACES,
    SHOWN,
    faces_of,
    focal_of_faces,
    in_panorama,
    pixels_in_faces,
    rays_of,
    size_of_faces,
)
from splatax.reconstruction.photos import Photo, copy, read, save

if TYPE_CHECKING:
    import pycolmap

Pictures = Sequence[Float[np.ndarray, "_ 2"]]  # observations in each picture of a photo in the model, pixels
Placed = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]  # all of them: index of a camera, and pixels


@dataclass(frozen=True)
class Ways:
    """The ways in which photos are written.

    Attributes:
        faces: 360-degree photos are cut into the faces of a cube; else they are copied.
        undistort: other photos are resampled, at full size, for pinhole cameras; else they are copied.
    """

    faces: bool = True
    undistort: bool = False

    def of(self, model: "pycolmap.Reconstruction", image: "pycolmap.Image", photo: Photo) -> "Written":
        """Returns how the photos of one camera are written.

        Args:
            model: the model that was found.
            image: a picture by the camera; of a 360-degree photo the first.
            photo: the photo that the picture was made from.
        """
        camera = model.camera(image.camera_id)
        if photo.panorama:
            return as_faces(camera, photo) if self.faces else as_panorama(camera, photo)
        return as_pinhole(camera, photo) if self.undistort else as_it_is(camera, photo)


@dataclass(frozen=True)
class Written:
    """The photos of one camera in the capture.

    Attributes:
        cameras: of the pictures that each photo is written as: one, or those of the faces.
        names: returns the names of the pictures of a photo, from its own.
        place: returns where observations in the pictures of the model are in the written ones.
        write: writes the pictures of a photo to paths.
    """

    cameras: "Sequence[pycolmap.Camera]"
    names: Callable[[str], list[str]]
    place: Callable[[Pictures], Placed]
    write: Callable[[Photo, Sequence[Path]], None]


def write_capture(
    model: "pycolmap.Reconstruction",
    photos: dict[str, Photo],
    out: Path,
    watch: Callable[[int, int], None],
    ways: Ways = Ways(),
) -> "pycolmap.Reconstruction":
    """Writes OUT/images and OUT/sparse/0, and returns the model of the written photos.

    Args:
        model: model of the shrunk photos, and of the faces of panoramas.
        photos: original photos by their names in the model.
        out: folder of the capture.
        watch: function that is called with (photos written, all photos).
        ways: in which photos are written.
    """
    import pycolmap

    registered: dict[str, list[pycolmap.Image]] = {}
    for number in sorted(model.reg_image_ids()):
        image = model.image(number)
        registered.setdefault(photos[image.name].name, []).append(image)
    capture, written = pycolmap.Reconstruction(), dict[int, Written]()
    for number, point in model.points3D.items():
        capture.add_point3D_with_id(number, pycolmap.Point3D(xyz=point.xyz, color=point.color))
    for done, (name, images) in enumerate(registered.items()):
        watch(done, len(registered))
        photo, found = photos[images[0].name], images[0].camera_id
        if found not in written:
            written[found] = ways.of(model, images[0], photo)
            add_cameras(capture, written[found].cameras, found)
        names = written[found].names(name)
        written[found].write(photo, [out / "images" / each for each in names])
        add_photo(capture, names, images, written[found])
    capture.update_point_3d_errors()
    sparse = out / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    capture.write_binary(sparse)
    watch(len(registered), len(registered))
    return capture


def add_cameras(capture: "pycolmap.Reconstruction", cameras: "Sequence[pycolmap.Camera]", first: int) -> None:
    """Adds the cameras of a photo to the model of a capture, as a rig.

    Args:
        capture: the model.
        cameras: one, or those of all `FACES`.
        first: number of the first and of the rig; the others get those that follow, as in the model found.
    """
    import pycolmap

    rig = pycolmap.Rig(rig_id=first)
    for index, camera in enumerate(cameras):
        camera.camera_id = first + index
        capture.add_camera(camera)
        if index == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            turned = pycolmap.Rotation3d(np.array(FACES[index].rotation, float))
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d(turned, np.zeros(3)))
    capture.add_rig(rig)


def add_photo(
    capture: "pycolmap.Reconstruction", names: list[str], images: "Sequence[pycolmap.Image]", way: Written
) -> None:
    """Adds the pictures of a photo with their observations to the model of a capture.

    Args:
        capture: the model.
        names: of the pictures.
        images: of the photo in the model that was found; the first has its pose.
        way: how it is written.
    """
    import pycolmap

    found = [point for image in images for point in image.points2D]
    pixels = [np.array([point.xy for point in image.points2D]).reshape(-1, 2) for image in images]
    cameras, places = way.place(pixels) if found else (np.zeros(0, int), np.zeros((0, 2)))
    first = images[0]
    frame = pycolmap.Frame(frame_id=first.image_id, rig_id=way.cameras[0].camera_id)
    frame.rig_from_world = first.cam_from_world()
    written = []
    for index, (name, camera) in enumerate(zip(names, way.cameras, strict=True)):
        picture = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=images[index].image_id)
        picture.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in places[cameras == index]])
        picture.frame_id = frame.frame_id
        frame.add_data_id(picture.data_id)
        written.append(picture)
    capture.add_frame(frame)
    for picture in written:
        capture.add_image(picture)
    capture.register_frame(frame.frame_id)
    for index, picture in enumerate(written):
        for place, row in enumerate(np.flatnonzero(cameras == index)):
            if found[row].has_point3D():
                element = pycolmap.TrackElement(picture.image_id, place)
                capture.add_observation(found[row].point3D_id, element)


def as_it_is(shrunk: "pycolmap.Camera", photo: Photo) -> Written:
    """Returns how the photos of a camera are written unchanged, with their lens."""
    lens, scale = at_full_size(shrunk, photo)
    return Written([lens], itself, lambda pixels: together(pixels[0] * scale), copied)


def as_pinhole(shrunk: "pycolmap.Camera", photo: Photo) -> Written:
    """Returns how the photos of a camera are undistorted."""
    lens, scale = at_full_size(shrunk, photo)
    shrinking = float(-(-max(lens.width, lens.height) // LARGEST_SIDE))  # the loader's factor
    pinhole, straighten = undistortion_of_files(lens, shrinking)

    def straight(pixels: Pictures) -> Placed:
        slopes = lens.cam_from_img(pixels[0] * scale)
        return together(np.asarray(pinhole.img_from_cam(np.column_stack([slopes, np.ones(len(slopes))]))))

    return Written([pinhole], itself, straight, lambda photo, paths: save(paths[0], straighten(read(photo))))


def as_panorama(face: "pycolmap.Camera", photo: Photo) -> Written:
    """Returns how panoramas are written unchanged, with the features of their faces."""
    import pycolmap

    width, height = photo.size
    camera = pycolmap.Camera(model=PANORAMA, width=width, height=height, params=[width, height])

    def around(pixels: Pictures) -> Placed:
        return together(np.stack(in_panorama(rays_in(pixels, face.width), width, height), axis=-1))

    return Written([camera], itself, around, copied)


def as_faces(face: "pycolmap.Camera", photo: Photo) -> Written:
    """Returns how panoramas are written as the faces of a cube."""
    import pycolmap

    size = size_of_faces(photo.size[0], SHOWN)
    focal, middle = focal_of_faces(size, SHOWN), size / 2

    def write(photo: Photo, paths: Sequence[Path]) -> None:
        for path, pixels in zip(paths, faces_of(read(photo), size, SHOWN), strict=True):
            save(path, pixels)

    return Written(
        [
            pycolmap.Camera(model="PINHOLE", width=size, height=size, params=[focal, focal, middle, middle])
            for _ in FACES
        ],
        lambda name: [f"{name}-{each.name}.png" for each in FACES],
        lambda pixels: pixels_in_faces(rays_in(pixels, face.width), size),
        write,
    )


def itself(name: str) -> list[str]:
    """Returns the name of a photo that is written as one picture."""
    return [name]


def copied(photo: Photo, paths: Sequence[Path]) -> None:
    """Copies a photo to the one path."""
    copy(photo, paths[0])


def together(pixels: Float[np.ndarray, "n 2"]) -> Placed:
    """Returns observations that are all in one picture."""
    return np.zeros(len(pixels), int), pixels


def rays_in(pixels: Pictures, size: int) -> Float[np.ndarray, "n 3"]:
    """Returns the directions of the observations in all faces of a panorama, in the panorama's axes."""
    return np.concatenate([rays_of(each, face, size) for each, face in zip(pixels, FACES, strict=True)])


def at_full_size(
    shrunk: "pycolmap.Camera", photo: Photo
) -> "tuple[pycolmap.Camera, Float[np.ndarray, ' 2']]":
    """Returns the camera of the photos of a shrunk camera at their full size, and its size over the other."""
    import pycolmap

    lens = pycolmap.Camera(shrunk.todict())
    lens.rescale(*photo.size)
    return lens, np.array([lens.width / shrunk.width, lens.height / shrunk.height])
