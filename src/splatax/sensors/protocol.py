"""The protocol of a sensor: which views it draws, and how it measures in them."""

from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import Array

from splatax.cameras import Camera
from splatax.outputs import Rendering
from splatax.scene import Drawable

Key = jax.Array  # a random key; jaxtyping's Key needs typed keys, and both kinds are accepted


@runtime_checkable
class Sensor(Protocol):
    """A sensor of one camera. A frozen dataclass and a pytree, so its numbers are traced."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs of `render` that the sensor needs."""
        ...

    def views(self, camera: Camera) -> tuple[Camera, ...]:
        """Returns the views to draw. Sensors that return `(camera,)` itself share one drawing."""
        ...

    def features(self, scene: Drawable) -> dict[str, Array]:
        """Returns the numbers of each Gaussian, [n c], to draw beside the outputs, by name.

        Raises:
            ValueError: if the scene does not fit the sensor.
        """
        ...

    def read(self, drawn: tuple[Rendering, ...], views: tuple[Camera, ...], key: Key | None) -> Any:
        """Returns the measurement, one array or a named tuple of arrays.

        Args:
            drawn: the renderings of the views.
            views: the cameras that `views` returned.
            key: of the noise; None for a measurement without noise.
        """
        ...


class Plain:
    """The base of sensors that draw the view of the camera itself, or nothing beside the outputs."""

    def views(self, camera: Camera) -> tuple[Camera, ...]:
        """Returns the camera itself."""
        return (camera,)

    def features(self, scene: Drawable) -> dict[str, Array]:
        """Returns nothing: the outputs are all that is drawn."""
        return {}
