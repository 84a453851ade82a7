"""Draws docs/images/sensors.jpg: what four sensors measure in a scene trained on the demo capture.

It also prints the mean intersection over union of the labels that are lifted from the true labels of the
training photos, as `splatax label` does on held-out photos.

python docs/make_sensors.py
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from PIL import Image

import splatax as sx
from splatax import editing, sensors
from splatax.cli.label import mean_iou
from splatax.demo.raycast import truth
from splatax.demo.scenes import scene_named
from splatax.metrics import to_8bit

SIZE, GAP, QUALITY = (128, 96), 6, 85
LARGER = 3  # times the size of the training photos, to look at
THINGS = np.array([0, 0, 0, 1, 2, 3, 4, 4, 4, 4, 4, 4, 5, 5, 5])  # of the surfaces of the demo scene
COLORS = np.array(
    [[70, 70, 80], [215, 60, 50], [240, 190, 60], [70, 150, 180], [90, 170, 90], [230, 230, 230]]
)


def main() -> None:
    dataset = sx.demo_dataset(width=SIZE[0], height=SIZE[1])
    gaussians = sx.fit(dataset, sx.recipes.default(steps=500, max_gaussians=4000))
    surfaces = scene_named("still-life")

    def labelled(view: sx.View) -> tuple[sx.Camera, np.ndarray]:
        found = np.asarray(truth(view.camera, surfaces).surfaces)
        return view.camera, np.where(found < 0, -1, THINGS[found]).astype(np.int32)

    rows = editing.labels_of(editing.votes(gaussians, map(labelled, dataset.train), len(COLORS)))
    testing = [labelled(view) for view in dataset.test]
    score = mean_iou(gaussians, rows, len(COLORS), testing, sx.Renderer())
    print(
        f"{len(gaussians):,} Gaussians, label images of {len(dataset.train)} photos, {len(COLORS)} labels: "
        f"mIoU {score:.4f} on {len(testing)} held-out photos of {SIZE[0]} x {SIZE[1]} pixels"
    )
    camera = dataset.test[0].camera.resized(LARGER * SIZE[0], LARGER * SIZE[1])
    asked = {
        "color": sensors.Color(sensors.ColorNoise(exposure=0.25, gain=4.0, full_well=500.0)),
        "depth": sensors.Depth(sensors.DepthNoise()),
        "normals": sensors.Normals(),
        "labels": sensors.Labels(jnp.asarray(rows), len(COLORS)),
    }
    found = jax.tree.map(np.asarray, sensors.observe(gaussians, camera, asked, key=jax.random.key(0)))
    measured = found["depth"] > 0
    low, high = np.percentile(found["depth"][measured], (1, 99))
    shades = matplotlib.colormaps["viridis_r"]((found["depth"] - low) / (high - low))[..., :3]
    pictures = (
        to_8bit(found["color"]),
        to_8bit(np.where(measured[..., None], shades, 0)),
        to_8bit(found["normals"] * np.array([0.5, -0.5, -0.5]) + 0.5),
        np.where(found["labels"][..., None] < 0, 0, COLORS[found["labels"]]).astype(np.uint8),
    )
    gap = np.full((camera.height, GAP, 3), 255, np.uint8)
    row = [part for each in pictures for part in (gap, each)][1:]
    path = Path(__file__).parent / "images" / "sensors.jpg"
    Image.fromarray(np.concatenate(row, axis=1)).save(path, quality=QUALITY)


if __name__ == "__main__":
    main()
