"""The order in which the splats of a view are blended: that of their depths, or of their distances.

A large Gaussian whose centre lies far outside the field of view can have a small depth although it is
farther from the camera than all that the picture shows. By depth it is drawn in front, as haze. By distance
it is drawn behind, and the order does not change when the camera turns. Kerbl et al. 2023 and most viewers
draw by depth. A scene is drawn in the order that it was trained in.
"""

from collections.abc import Iterable
from typing import Literal, get_args

Order = Literal["depth", "distance"]  # of centres: along the view (see `Lens.depth`), or from the camera
ORDERS: tuple[Order, ...] = get_args(Order)


def check_order(order: str) -> None:
    """Checks that an order is one.

    Raises:
        ValueError: if it is not.
    """
    if order not in ORDERS:
        raise ValueError(f"the order of splats is {order!r}. Choose {' or '.join(map(repr, ORDERS))}.")


def common(orders: Iterable[Order]) -> Order:
    """Returns the order of scenes that are drawn together: by distance if all of them are, else by depth.

    Scenes that `default` trained can be drawn in both orders, and those of other programs only by depth.
    """
    return "distance" if set(orders) == {"distance"} else "depth"
