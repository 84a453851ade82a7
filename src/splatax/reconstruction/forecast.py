"""Forecasts the time of a reconstruction, from the time that the features of its first photos took."""

from splatax.reconstruction.pairs import Exhaustive, Pairing, Sequential, Similar

# Measured on two busy cores for 20 photos of 1512 x 1134 and 190 pairs, with normal and with smaller
# features: 2.2 and 11.7 s for the features of a photo, 0.16 and 0.91 s for a pair, 3.3 and 2.1 s a photo
# after that.
PAIR = 0.076  # time to match a pair, as a fraction of the time to find a photo's features
AFTER = 2.5  # seconds per photo, to find the poses and to write the capture
MUTUAL = 0.67  # pairs of similar photos, as a fraction of what there were if no two chose each other


def pairs_of(pairing: Pairing, count: int) -> int:
    """Returns about how many pairs of `count` photos are matched."""
    every = count * (count - 1) // 2
    if isinstance(pairing, Exhaustive):
        return every
    if isinstance(pairing, Similar):
        return min(every, round(count * (MUTUAL * pairing.neighbours + pairing.following)))
    assert isinstance(pairing, Sequential)
    near = pairing.overlap + pairing.doublings
    return min(every, round(count * (near + MUTUAL * pairing.neighbours)))


def seconds_left(feature_seconds: float, found: int, count: int, pairing: Pairing, photos: int) -> float:
    """Returns about how long the rest of a reconstruction takes.

    Args:
        feature_seconds: time that finding the features of one picture took.
        found: pictures whose features are found.
        count: all pictures, which are photos and faces of 360-degree photos.
        pairing: selection of pairs to match.
        photos: all photos.
    """
    matching = PAIR * feature_seconds * pairs_of(pairing, count)
    return feature_seconds * (count - found) + matching + AFTER * photos
