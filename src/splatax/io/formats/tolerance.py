"""Largest errors of a scene after saving and loading; each format declares its own, and a test checks it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    """Largest differences for a scene of ordinary numbers; zero if a format keeps every bit.

    Attributes:
        means: centres, as a fraction of the scene's size.
        degrees: angle of the rotation.
        log_scales: natural logarithms of the scales.
        opacities: opacities in [0, 1].
        dc: constant SH coefficient; colour is about 0.28 times it.
        sh: higher SH coefficients; None if the format has none.
    """

    means: float = 0.0
    degrees: float = 0.0
    log_scales: float = 0.0
    opacities: float = 0.0
    dc: float = 0.0
    sh: float | None = 0.0
