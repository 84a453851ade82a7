"""Draws the pictures of the docs from a capture and a finished run on it.

    splatax train CAPTURE --out RUN --steps 2000
    python docs/make_pictures.py CAPTURE RUN

The script writes docs/images/{overview,initialization,ellipses,tiles,depth,progress}.jpg.
"""

import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from PIL import Image, ImageSequence

import splatax as sx
from splatax.backends.portable.binning import TILE, Cursor, Grid, bin_round, tile_boxes
from splatax.evaluation import photo_of, picture
from splatax.report.pictures import depth_map
from splatax.training.initialize import FromPoints, InFrusta

IMAGES = Path(__file__).parent / "images"
GAP = 6  # pixels between pictures side by side
QUALITY = 85


def main(capture: Path, run: Path) -> None:
    dataset, gaussians = sx.load_dataset(capture), sx.load(run / "scene.ply")
    view = dataset.test[0]
    splats = sx.project(gaussians, view.camera)
    drawn = sx.render(gaussians, view.camera)
    rendered = picture(gaussians, view.camera)
    depth = depth_map(np.asarray(drawn.depth), np.asarray(drawn.alpha))
    from_points, at_random = (start(dataset, 0, 0) for start in (FromPoints(), InFrusta()))

    IMAGES.mkdir(exist_ok=True)
    save("overview", photo_of(view, (0, 0, 0)), rendered)
    save("initialization", picture(from_points, view.camera), picture(at_random, view.camera))
    save("ellipses", ellipses(splats, every=3), ellipses(splats, every=1))
    save("tiles", tiles(splats))
    save("depth", depth)
    with Image.open(run / "progress.gif") as animation:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(animation)]
    chosen = [frames[i] for i in (0, 3, 6, 10, len(frames) - 1)]
    save("progress", *(frame[::2, ::2] for frame in chosen))


def save(name: str, *pictures: np.ndarray) -> None:
    """Writes pictures side by side, as one file."""
    gap = np.full((pictures[0].shape[0], GAP, 3), 255, np.uint8)
    row = [part for each in pictures for part in (gap, each)][1:]
    Image.fromarray(np.concatenate(row, axis=1)).save(IMAGES / f"{name}.jpg", quality=QUALITY)


def ellipses(splats: sx.Splats, every: int) -> np.ndarray:
    """Draws the splats of a view as discs of one standard deviation, far ones first.

    Args:
        splats: the splats.
        every: draw one out of this many.
    """
    visible = np.flatnonzero((np.asarray(splats.extents)[:, 0] > 0) & (np.asarray(splats.opacities) > 0.2))
    chosen = visible[np.argsort(-np.asarray(splats.depths)[visible])][::every]
    roots = np.zeros((len(chosen), 2, 2))
    roots[:, [0, 0, 1], [0, 1, 1]] = np.asarray(splats.sqrt_conics)[chosen]
    # The inverse of the root has the axes as left singular vectors and the lengths as singular values.
    axes, lengths, _ = np.linalg.svd(np.linalg.inv(roots))
    discs = EllipseCollection(
        *(2 * lengths.T),
        np.degrees(np.arctan2(axes[:, 1, 0], axes[:, 0, 0])),
        units="xy",
        offsets=np.asarray(splats.means2d)[chosen],
        facecolors=np.clip(np.asarray(splats.colors)[chosen], 0, 1),
        edgecolors=(0, 0, 0, 0.4),
        linewidths=0.15,
    )
    figure = Figure(figsize=(splats.width / 100, splats.height / 100), dpi=100)
    plot = figure.add_axes((0, 0, 1, 1))
    plot.set(xlim=(0, splats.width), ylim=(splats.height, 0))
    plot.axis("off")
    discs.set_offset_transform(plot.transData)
    plot.add_collection(discs)
    return canvas(figure)


def canvas(figure: Figure) -> np.ndarray:
    """Returns a figure as RGB pixels."""
    drawing = FigureCanvasAgg(figure)
    drawing.draw()
    return np.asarray(drawing.buffer_rgba())[..., :3].copy()


def tiles(splats: sx.Splats) -> np.ndarray:
    """Draws the number of splats in the list of each tile of the `xla` rasterizer; bright is many."""
    grid = Grid(splats.width, splats.height)
    boxes = tile_boxes(splats, grid)
    counts, cursor = np.zeros(grid.tiles, int), Cursor.start()
    while int(cursor.slab) == 0:
        lists, cursor = bin_round(cursor, boxes, grid)
        counts += np.diff(np.asarray(lists.starts))
    shades = (counts / np.percentile(counts, 99)).clip(0, 1).reshape(grid.rows, grid.columns)
    blocks = matplotlib.colormaps["magma"](shades, bytes=True)[..., :3]
    return blocks.repeat(TILE, axis=0).repeat(TILE, axis=1)[: splats.height, : splats.width]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
