"""A room with another paper on each wall, and 360-degree photos of it with the metadata of a camera."""

import math

import numpy as np
from PIL import Image
from scipy import ndimage

import corner

SIZE, COUNT = (512, 256), 6
HALF = np.array([3.0, 1.5, 2.5])  # of the room
GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>'
)
WHOLE = GPANO.format('GPano:ProjectionType="equirectangular"')


def rays():
    """Directions of the pixels of a panorama."""
    longitude = ((np.arange(SIZE[0]) + 0.5) / SIZE[0] - 0.5) * 2 * math.pi
    latitude = ((np.arange(SIZE[1]) + 0.5) / SIZE[1] - 0.5) * math.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    aside = np.cos(latitude)
    return np.stack([aside * np.sin(longitude), np.sin(latitude), aside * np.cos(longitude)], axis=-1)


def turned(angle):
    """World from camera: a turn about the vertical axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def positions():
    rng = np.random.default_rng(5)
    return np.column_stack([np.linspace(-1, 1, COUNT), *rng.uniform(-0.3, 0.3, (2, COUNT))])


def photograph(position, angle, papers):
    """The room from a place: each wall has its own paper."""
    directions = rays() @ turned(angle).T
    times = (np.copysign(HALF, directions) - position) / directions
    axis, time = times.argmin(axis=-1), times.min(axis=-1)
    hits = position + time[..., None] * directions
    picture = np.zeros((*axis.shape, 3))
    for wall in range(3):
        for side in (0, 1):
            on = (axis == wall) & ((directions[..., wall] > 0) == side)
            u, v = (hits[on][:, (wall + k) % 3] * 90 for k in (1, 2))
            at = [u + 450, v + 700]
            for c in range(3):
                paper = papers[2 * wall + side][..., c]
                picture[on, c] = ndimage.map_coordinates(paper, at, order=1, mode="mirror")
    return picture.astype(np.uint8)


def write(folder):
    """Writes the photos as JPEG."""
    papers = [corner.wallpaper(seed) for seed in range(6)]
    for i, position in enumerate(positions()):
        picture = Image.fromarray(photograph(position, 0.7 * i, papers))
        picture.save(folder / f"room {i}.jpg", quality=95, xmp=WHOLE.encode())
