"""The protocol of a lens: a map from points in camera axes to the image plane at focal length one.

The camera adds focal lengths and principal point. Nothing but the map is written down: the Jacobian that
projection needs is `jax.jacfwd` of it, and every coefficient has a gradient.
"""

from typing import ClassVar, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float

NEAR = 0.01  # world units; nearer points are not seen (as in gsplat)


@runtime_checkable
class Lens(Protocol):
    """Map from points in camera axes (x right, y down, z forward) to the image plane. A pytree.

    Attributes:
        PERIOD: width of the image plane after which it repeats, as in panoramas; None if it does not.
        CENTRAL: whether all rays pass through the camera's position. If not, they are parallel to z.
    """

    PERIOD: ClassVar[float | None]
    CENTRAL: ClassVar[bool]

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns the place of a point, which the lens must see, on the image plane."""
        ...

    def unproject(self, place: Float[Array, "2"], depth: Float[Array, ""]) -> Float[Array, "3"]:
        """Returns the point of this depth whose place on the image plane this is."""
        ...

    def depth(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Returns the depth of a point, world units, by which what lies in front is drawn in front."""
        ...

    def sees(self, point: Float[Array, "3"]) -> Bool[Array, ""]:
        """Returns whether `project` is defined for a point, and nothing else is projected to its place."""
        ...

    def linearized_at(
        self, point: Float[Array, "3"], low: Float[Array, "2"], high: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        """Returns where to take the Jacobian of `project` for a Gaussian with its mean at `point`.

        It is the point itself, unless it lies where the Jacobian would make the Gaussian's image very large
        and wrong.

        Args:
            point: in camera axes; the lens sees it.
            low, high: corners of the image with a margin, on the image plane.
        """
        ...
