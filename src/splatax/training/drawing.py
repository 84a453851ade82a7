"""The way in which training steps draw the scene that they compare with photos.

Some steps, chosen at random, draw a scene by depth although its order is that by distance. Such a scene can
be drawn in both orders: most other viewers sort by depth.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from splatax.backends.protocol import Kernels
from splatax.gaussians import Gaussians
from splatax.low_pass import Dilation, LowPass
from splatax.order import Order
from splatax.splats import Splats
from splatax.training.backgrounds import Solid
from splatax.training.protocols import Background

BY_DEPTH = 0.5  # probability that a step draws by depth; see docs/recipes.md for others
ByDepth = Bool[Array, ""] | None  # whether a view is drawn by depth; None in the order of the scene


@dataclass(frozen=True)
class Drawing:
    """Settings of how steps draw a scene.

    Attributes:
        background: the colour behind the scene, and behind transparent photos.
        low_pass: the filter.
        order: the order in which the scene is drawn.
        by_depth: probability that a step draws a scene by depth although its order is that by distance.
        backend: "auto" or the name of a backend, which a trainer looks up before its first step; or kernels.
    """

    background: Background = Solid()
    low_pass: LowPass = Dilation()
    order: Order = "depth"
    by_depth: float = 0.0
    backend: str | Kernels = "auto"

    @property
    def kernels(self) -> Kernels:
        """The kernels. Steps take them from here, so that traced code cannot look a backend up.

        Raises:
            ValueError: if the backend is still a name.
        """
        if isinstance(self.backend, Kernels):
            return self.backend
        raise ValueError(
            f"the recipe names the backend {self.backend!r}, but a step needs its kernels: look them up "
            f"once, recipe.on(splatax.backends.resolve({self.backend!r}))."
        )

    def of(self, gaussians: Gaussians) -> Gaussians:
        """Returns a scene of training, whose filter and order are the defaults, with those of the steps."""
        return replace(gaussians, low_pass=self.low_pass, order=self.order)

    def in_order(self, order: Order) -> "Drawing":
        """Returns the settings for a scene of an order; one by distance is drawn by depth in some steps."""
        return replace(self, order=order, by_depth=BY_DEPTH if order == "distance" else 0.0)

    def sample(self, key: PRNGKeyArray) -> tuple[Float[Array, "3"], ByDepth]:
        """Returns the background of a view, and whether the view is drawn by depth."""
        background = self.background.sample(key)
        if self.order == "depth" or not self.by_depth:
            return background, None
        return background, jax.random.bernoulli(jax.random.fold_in(key, 1), self.by_depth)


def reordered(splats: Splats, by_depth: ByDepth) -> Splats:
    """Returns splats that are drawn by depth if that is true, else in their own order."""
    if by_depth is None or splats.sort_keys is None:
        return splats
    return replace(splats, sort_keys=jnp.where(by_depth, splats.depths, splats.sort_keys))
