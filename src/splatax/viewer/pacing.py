"""Choice of the frame size: small enough to be fluid while the camera moves, full size when it is still."""

from dataclasses import dataclass, field

HEIGHTS = (90, 128, 180, 256, 360, 512, 720)  # of frames while moving: each size is a compiled program
WIDTH_STEP = 16  # pixels, so that windows of nearly the same shape share programs
FORGET_SECONDS = 5.0  # after which a size that was too slow is tried again
WORTHWHILE = 2.0  # times the smallest frame, which is always allowed: much of the cost is not in pixels
BLEND = 0.5  # weight of a new measurement


@dataclass
class Pacing:
    """A model of the cost of a frame, which chooses frame sizes. The caller passes the current time.

    Attributes:
        budget: longest time for a frame while the camera moves, seconds.
    """

    budget: float = 1 / 15
    _costs: dict[int, tuple[float, float]] = field(default_factory=dict)  # pixels: seconds, measured at

    def size(self, window: tuple[int, int], most: int, *, moving: bool, now: float) -> tuple[int, int]:
        """Returns the width and height of the next frame, pixels.

        Args:
            window: width and height of the window to fill, pixels.
            most: largest height of a frame, pixels.
            moving: whether the camera moves.
            now: current time, seconds.
        """
        full = max(min(window[1], most), HEIGHTS[0])
        if not moving:
            return _shaped(window, full)
        sizes = [_shaped(window, height) for height in HEIGHTS if height < full] + [_shaped(window, full)]
        least = self._costs[min(self._costs)][0] if self._costs else 0.0
        limit = max(self.budget, WORTHWHILE * least)
        fluid = [size for size in sizes if self.expected(size, now) <= limit]
        return fluid[-1] if fluid else sizes[0]

    def observe(self, size: tuple[int, int], seconds: float, now: float) -> None:
        """Records the seconds that a frame of this size took."""
        pixels = size[0] * size[1]
        earlier = self._fresh(now).get(pixels, seconds)
        self._costs[pixels] = (BLEND * seconds + (1 - BLEND) * earlier, now)

    def expected(self, size: tuple[int, int], now: float) -> float:
        """Estimates the seconds for a frame, from the sizes that were measured recently.

        The estimate is linear in pixels between two measured sizes. Beyond them, half of the nearest
        measurement is assumed to be proportional to pixels. Without measurements it is infinite.
        """
        pixels, known = size[0] * size[1], self._fresh(now)
        below = max((other for other in known if other <= pixels), default=None)
        above = min((other for other in known if other >= pixels), default=None)
        if below is None and above is None:
            return float("inf")
        if below is None or above is None or below == above:
            nearest = above if below is None else below
            assert nearest is not None
            return known[nearest] * (1 + pixels / nearest) / 2
        fraction = (pixels - below) / (above - below)
        return known[below] + fraction * (known[above] - known[below])

    def _fresh(self, now: float) -> dict[int, float]:
        return {
            pixels: seconds for pixels, (seconds, when) in self._costs.items() if now - when < FORGET_SECONDS
        }


def _shaped(window: tuple[int, int], height: int) -> tuple[int, int]:
    width = window[0] * height / max(window[1], 1)
    return max(round(width / WIDTH_STEP), 1) * WIDTH_STEP, height
