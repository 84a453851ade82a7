"""The report of a rig: its photos beside the posed scene, with scores and curves."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from splatax.dataset import View, mask_of
from splatax.evaluation import Scores, score
from splatax.io.rigs.poses import Posing
from splatax.metrics import to_8bit
from splatax.rendering import Color, render
from splatax.report.gallery import Gallery
from splatax.report.page import Account, report
from splatax.runs.budget import duration
from splatax.runs.history import History
from splatax.runs.machine import device
from splatax.runs.results import Comparison
from splatax.scene.rigged import RiggedScene
from splatax.training.step import photo_over


def posed_comparisons(
    scene: RiggedScene, posing: Posing, views: Iterable[View], background: Color
) -> Iterator[Comparison]:
    """Yields each photo that has a pose beside the scene in that pose, with its scores.

    Args:
        scene: the trained scene.
        posing: poses of the photos.
        views: the photos.
        background: RGB behind the scene.

    Raises:
        DatasetError: if a photo is too small to be compared, or its mask leaves too little of it.
    """
    behind = np.asarray(background, np.float32)
    draw = jax.jit(lambda pose, camera: render(scene.posed(pose), camera, background=behind).rgb)
    for view in views:
        if (name := posing.pose_of.get(view.name)) is None:
            continue
        photo = to_8bit(np.asarray(photo_over(jnp.asarray(view.pixels()), jnp.asarray(behind))))
        image, mask = to_8bit(np.asarray(draw(posing.poses[name], view.camera))), mask_of(view)
        yield Comparison(score(view.name, image, photo, mask), photo, image, mask)


def seen_by(comparisons: Iterable[Comparison]) -> Gallery:
    """Returns a gallery of all comparisons, which keeps the pictures of the worst."""
    gallery = Gallery()
    for comparison in comparisons:
        gallery.see(comparison)
    return gallery


def rig_report(
    title: str, galleries: Mapping[str, Gallery], history: History, notes: Sequence[str] = ()
) -> bytes:
    """Returns the report of a rig as one HTML file.

    Args:
        title: of the report.
        galleries: the photos by what they are, such as "held-out"; the first with photos is shown.
        history: record of the run.
        notes: lines about the capture.

    Raises:
        ValueError: if no gallery has a photo.
    """
    facts: dict[str, str] = {}
    filled = {kind: gallery for kind, gallery in galleries.items() if gallery.scores}
    if not filled:
        raise ValueError("no photo to report on.")
    for kind, gallery in filled.items():
        scores = Scores(tuple(gallery.scores))
        facts |= {
            f"PSNR of {len(scores.views)} {kind} photos": f"{scores.psnr:.2f} dB",
            f"SSIM of {kind} photos": f"{scores.ssim:.4f}",
        }
    facts |= {
        "Gaussians": f"{history.counts[-1]:,}",
        "steps" + (", then interrupted" if history.interrupted else ""): f"{history.steps:,}",
        "training": duration(history.train_seconds),
        "device": device(),
    }
    return report(title, Account(facts, notes), history, next(iter(filled.values())), b"").encode()
