"""A car of two wheels on one file of Gaussians, for tests of parts and variants."""

import splatax as sx
from scenes import random_gaussians
from splatax.scene import ColorMap, Option
from splatax.transforms import Similarity

BODY = random_gaussians(0, n=3000, scale=(0.01, 0.04), spread=0.6)
WHEEL = random_gaussians(1, n=800, scale=(0.02, 0.08), spread=0.5)
PARTS = {
    "body": sx.Part(BODY),
    "wheel": sx.Part(WHEEL, Similarity.of(degrees=(0.0, 70.0, 20.0), scale=0.5, move=(-0.9, 0.4, -0.4))),
    "sport": sx.Part(WHEEL, Similarity.of(degrees=(90.0, 0.0, 0.0), scale=0.6, move=(0.8, 0.4, -0.4))),
}
PAINT = {"plain": Option(), "red": Option(colors={"body": ColorMap.dye((1.0, 0.2, 0.1))})}
WHEELS = {"city": Option(shows=("wheel",)), "sport": Option(shows=("sport",))}
