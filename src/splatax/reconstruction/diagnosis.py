"""Finds out why photos have no pose, and gives advice."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splatax.reconstruction.mapping import opened

if TYPE_CHECKING:
    import pycolmap

FEW_FEATURES = 200
FEW_MATCHES = 15  # matches that agree with one motion, COLMAP's minimum for a pair

FEATURELESS = "too few features: blurred, dark, or nothing but plain surfaces"
ALONE = "overlaps with no other photo"
APART = "belongs to a part that nothing connects with the rest"
CONTRADICTED = "overlaps with others, but no pose agrees with them"
ADVICE = {
    FEATURELESS: "Take them again with more light and a steady hand, and with textured things in view.",
    ALONE: "Take photos in smaller steps, so that each shows two thirds of what the one before showed.",
    APART: "Take photos that lead from one part to the other.",
    CONTRADICTED: "Move sideways between photos instead of turning on the spot, and keep moving things, "
    "mirrors and repeating patterns out of them.",
}


def reasons(path: Path, parts: "Sequence[pycolmap.Reconstruction]") -> dict[str, str]:
    """Returns, by name, why each photo of the database that is not in the largest part is missing."""
    import pycolmap

    placed = set(parts[0].reg_image_ids()) if parts else set()
    elsewhere = {image for part in parts[1:] for image in part.reg_image_ids()}
    with opened(path) as database:
        matched: Counter[int] = Counter()
        for pair, inliers in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
            if inliers >= FEW_MATCHES:
                matched.update(pycolmap.pair_id_to_image_pair(pair))
        found = {}
        for image in database.read_all_images():
            if image.image_id in placed:
                continue
            if database.num_keypoints_for_image(image.image_id) < FEW_FEATURES:
                found[image.name] = FEATURELESS
            elif not matched[image.image_id]:
                found[image.name] = ALONE
            else:
                found[image.name] = APART if image.image_id in elsewhere else CONTRADICTED
    return found


def by_photo(photos: Mapping[str, str], reasons: Mapping[str, str]) -> dict[str, str]:
    """Returns the reason for each photo of the faces of a panorama: that of the face which came closest.

    Args:
        photos: names of photos, by the names of their pictures in the database.
        reasons: by the names of pictures.
    """
    found: dict[str, str] = {}
    for picture, reason in reasons.items():
        name = photos[picture]
        found[name] = max(reason, found.get(name, reason), key=list(ADVICE).index)
    return found


def advice(rejected: dict[str, str]) -> str:
    """Returns advice for the most frequent reason."""
    known = Counter(reason for reason in rejected.values() if reason in ADVICE)
    if not known:
        return "Export the photos again."
    return ADVICE[known.most_common(1)[0][0]]
