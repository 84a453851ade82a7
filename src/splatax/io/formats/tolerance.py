"""How far a scene may be from what was saved: each format states its own, and a test holds it to that."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerance:
    """Largest differences for a scene of ordinary numbers; zero where a format keeps every bit.

    Attributes:
        means: as a fraction of the scene's size.
        degrees: of rotation.
        log_scales: natural logarithms.
        opacities: in [0, 1].
        dc: the constant SH coefficient; colour is about 0.28 of it.
        sh: higher coefficients; None if the format has none.
    """

    means: float = 0.0
    degrees: float = 0.0
    log_scales: float = 0.0
    opacities: float = 0.0
    dc: float = 0.0
    sh: float | None = 0.0
