"""Renders 360-degree photos of the synthetic room, and compares two ways to train on them, for capture.md.

python docs/make_panoramas.py draw FOLDER       writes 14 photos with the metadata of a 360-degree camera
python docs/make_panoramas.py compare           trains on panoramas and on their faces, with the true cameras
"""

import sys
import time
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatax as sx
from splatax.cameras import Camera, panorama
from splatax.dataset import Dataset, View
from splatax.demo.dataset import demo_dataset
from splatax.demo.raycast import photograph
from splatax.demo.scenes import scene_named
from splatax.reconstruction import panoramas
from splatax.training.recipes import default

COUNT, SIZE = 14, (512, 256)
GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)


@cache
def drawn(number: int) -> np.ndarray:
    """Returns the panorama from one of the room's cameras."""
    room = scene_named("room")
    camera = room.cameras(COUNT, SIZE)[number]
    return np.asarray(photograph(panorama(camera.cam_from_world, *SIZE), room))[..., :3]


def draw(folder: Path) -> None:
    """Writes the panoramas as JPEG."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(COUNT):
        picture = Image.fromarray(drawn(number))
        picture.save(folder / f"room{number:02}.jpg", quality=95, subsampling=0, xmp=GPANO.encode())


def whole(room: Dataset) -> Dataset:
    """Returns the capture of the panoramas."""
    cameras = scene_named("room").cameras(COUNT, SIZE)
    views = [
        View(f"room{i:02}", panorama(camera.cam_from_world, *SIZE), partial(drawn, i))
        for i, camera in enumerate(cameras)
    ]
    return replace(room, train=tuple(views))


def in_faces(room: Dataset) -> Dataset:
    """Returns the capture of the faces of the panoramas, 90 degrees wide."""
    field = panoramas.SHOWN
    size = panoramas.size_of_faces(SIZE[0], field)
    focal, middle = (jnp.float32(number) for number in (panoramas.focal_of_faces(size, field), size / 2))
    views = []
    for view in whole(room).train:
        faces = cache(lambda view=view: panoramas.faces_of(view.pixels(), size, field))
        for number, face in enumerate(panoramas.FACES):
            turn = jnp.eye(4).at[:3, :3].set(jnp.array(face.rotation, jnp.float32))
            camera = Camera(focal, focal, middle, middle, turn @ view.camera.cam_from_world, size, size)
            pixels = partial(lambda faces, number: faces()[number], faces, number)
            views.append(View(f"{view.name}-{face.name}", camera, pixels, face_of=view.name))
    return replace(room, train=tuple(views))


def compare(steps: int = 400, gaussians: int = 10_000) -> None:
    """Prints the scores on ordinary photos of the room, which no run has seen."""
    room = demo_dataset(scene="room", width=160, height=120)
    faces = in_faces(room)
    runs = [("panoramas", whole(room), steps), ("faces", faces, steps), ("faces", faces, 3 * steps)]
    for name, dataset, count in runs:
        began = time.process_time()
        scene = sx.fit(dataset, default(count, gaussians))
        seconds = time.process_time() - began
        score = sx.evaluate(scene, room.test)
        print(
            f"{name:10} {count:5} steps {seconds:6.1f} s of CPU {score.psnr:6.2f} dB {score.ssim:.3f}",
            flush=True,
        )


if __name__ == "__main__":
    if sys.argv[1] == "draw":
        draw(Path(sys.argv[2]))
    else:
        compare()
